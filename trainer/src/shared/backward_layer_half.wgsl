// backward_layer: gradients with respect to a layer's inputs, which may be the outputs of the layer below.
//
// Gradients are plain f16 without residuals: their rounding error is small compared with their noise between steps.

fn put_residual(at: u32, i: u32, value: f32) {}

fn put_residuals(at: u32, value: vec4f) {}

fn evaluate_layer(layer: Layer, tile: u32, lane: u32) {
    let n_words = layer.n_in / 4u;
    for (var row = 16u * subgroup; row < layer.n_in; row += 16u * n_subgroups) {
        var left: coop_mat16x16<f32, C>; // samples
        var right: coop_mat16x16<f32, C>;
        for (var j = 0u; j < layer.n_out; j += 16u) {
            // Loading by column transposes the weights.
            let w = coopLoad<coop_mat16x16<f16, A>>(&weights[layer.first_weight + j * n_words + row / 4u], n_words);
            left = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[j * HALF_STRIDE], HALF_STRIDE), left);
            right = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[j * HALF_STRIDE + 4u], HALF_STRIDE), right);
        }
        coopStoreT(left, &wg_sums[row * STRIDE], STRIDE);
        coopStoreT(right, &wg_sums[row * STRIDE + 4u], STRIDE);
    }
    finish_layer(layer, tile, layer.n_in, lane);
}
