// gradient_sum: adds the gradients of a splat's intersections in their order.

@group(0) @binding(4) var<storage, read> slot_begins: array<u32>;
@group(0) @binding(5) var<storage, read> gradients: array<Gradient>;

fn gradient_of(splat_ix: u32, n_touched: u32) -> Gradient {
    var sum: Gradient;
    let begin = slot_begins[splat_ix];
    for (var slot = begin; slot < begin + n_touched; slot++) {
        let part = gradients[slot];
        sum.position += part.position;
        sum.conic += part.conic;
        sum.color += part.color;
    }
    return sum;
}
