// forward_layer: evaluates one layer. Reads rows of one bank and writes rows of the other.

fn evaluate_layer(layer: Layer, tile: u32, lane: u32) {
    let part = lane % PARTS;
    let n_words = layer.n_in / 4u;
    for (var group = lane / PARTS; group < layer.n_out / 4u; group += LANES / PARTS) {
        let row = layer.first_weight + 4u * group * n_words;
        var sums: mat4x4f; // one column per row
        for (var k = 0u; k < n_words; k++) {
            let at = layer.from_bank + 4u * k * STRIDE + part;
            let x = mat4x4f(wg_rows[at], wg_rows[at + STRIDE], wg_rows[at + 2u * STRIDE], wg_rows[at + 3u * STRIDE]);
            let w = mat4x4f(weights[row + k], weights[row + n_words + k], weights[row + 2u * n_words + k], weights[row + 3u * n_words + k]);
            sums += x * w;
        }
        for (var j = 0u; j < 4u; j++) {
            put_four(BANK - layer.from_bank, 4u * group + j, part, layer_output(layer, tile, 4u * group + j, part, sums[j]));
        }
    }
    // The layer has read its inputs and written its rows before the next layer reads or overwrites them.
    workgroupBarrier();
}
