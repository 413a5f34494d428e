// gradient_sum: reads the sum that a splat's intersections were added to, and resets it to zero for the next step.

@group(0) @binding(5) var<storage, read_write> gradients: array<Gradient>;

fn gradient_of(splat_ix: u32, n_touched: u32) -> Gradient {
    var sum: Gradient;
    if n_touched != 0u {
        sum = gradients[splat_ix];
        gradients[splat_ix] = Gradient();
    }
    return sum;
}
