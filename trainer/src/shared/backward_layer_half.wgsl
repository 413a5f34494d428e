// backward_layer: slopes towards what goes into a layer; where they go on into another, they do so too.
//
// Slopes are single numbers of f16: what they are off is nothing beside what they differ from step to step.

fn put_residual(at: u32, i: u32, value: f32) {}

fn put_residuals(at: u32, value: vec4f) {}

fn evaluate_layer(layer: Layer, tile: u32, lane: u32) {
    let n_words = layer.n_in / 4u;
    for (var row = 16u * subgroup; row < layer.n_in; row += 16u * n_subgroups) {
        var left: coop_mat16x16<f32, C>; // samples
        var right: coop_mat16x16<f32, C>;
        for (var j = 0u; j < layer.n_out; j += 16u) {
            // Column by column, which turns the weights over.
            let w = coopLoad<coop_mat16x16<f16, A>>(&weights[layer.first_weight + j * n_words + row / 4u], n_words);
            left = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[j * HALF_STRIDE], HALF_STRIDE), left);
            right = coopMultiplyAdd(w, coopLoadT<coop_mat16x16<f16, B>>(&wg_halves[j * HALF_STRIDE + 4u], HALF_STRIDE), right);
        }
        coopStoreT(left, &wg_sums[row * STRIDE], STRIDE);
        coopStoreT(right, &wg_sums[row * STRIDE + 4u], STRIDE);
    }
    workgroupBarrier(); // The sums are there before they are read, and what went in was read before it is overwritten.
    if layer.stored_row != NOT_STORED {
        for (var item = lane; item < layer.n_in * PARTS; item += LANES) {
            let row = item / PARTS;
            let part = item % PARTS;
            put_four(0u, row, part, layer_output(layer, tile, row, part, out_four(0u, row, part)));
        }
        workgroupBarrier(); // The rows are there before the next layer reads them, and the sums were read before it overwrites them.
    }
}
