// forward_layer: evaluates one layer. The outputs may be the inputs of the next layer.
//
// Each input and weight is the sum of two f16 numbers. The second number is the rounding error of the first. With the
// 11 bits of one f16 alone, colors were noisy.

var<workgroup> wg_residuals: array<vec4<f16>, 640>;

fn put_residual(at: u32, i: u32, value: f32) { wg_residuals[at][i] = f16(clamp(value, -MAX_HALF, MAX_HALF)); }

fn put_residuals(at: u32, value: vec4f) { wg_residuals[at] = narrowed(value); }

fn evaluate_layer(layer: Layer, tile: u32, lane: u32) {
    let n_words = layer.n_in / 4u;
    for (var row = 16u * subgroup; row < layer.n_out; row += 16u * n_subgroups) {
        var left: coop_mat16x16<f32, C>; // samples
        var right: coop_mat16x16<f32, C>;
        for (var k = 0u; k < layer.n_in; k += 16u) {
            let first = layer.first_weight + row * n_words + k / 4u;
            let w = coopLoadT<coop_mat16x16<f16, A>>(&weights[first], n_words);
            let w_residual = coopLoadT<coop_mat16x16<f16, A>>(&weights[n_weight_words() + first], n_words);
            let x_left = coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[k * HALF_STRIDE], HALF_STRIDE);
            let x_right = coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[k * HALF_STRIDE + 4u], HALF_STRIDE);
            left = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_residuals[k * HALF_STRIDE], HALF_STRIDE), left);
            right = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_residuals[k * HALF_STRIDE + 4u], HALF_STRIDE), right);
            left = coopMultiplyAdd(w_residual, x_left, left);
            right = coopMultiplyAdd(w_residual, x_right, right);
            left = coopMultiplyAdd(w, x_left, left);
            right = coopMultiplyAdd(w, x_right, right);
        }
        coopStoreT(left, &wg_sums[row * STRIDE], STRIDE);
        coopStoreT(right, &wg_sums[row * STRIDE + 4u], STRIDE);
    }
    finish_layer(layer, tile, layer.n_out, lane);
}
