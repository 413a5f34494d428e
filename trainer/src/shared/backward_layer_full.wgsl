// backward_layer: gradients with respect to a layer's inputs. Reads rows of one bank and writes rows of the other.

fn evaluate_layer(layer: Layer, tile: u32, lane: u32) {
    let part = lane % PARTS;
    let n_words = layer.n_in / 4u;
    for (var group = lane / PARTS; group < n_words; group += LANES / PARTS) {
        var sums: mat4x4f; // one column per row
        for (var j = 0u; j < layer.n_out; j += 4u) {
            let at = layer.from_bank + j * STRIDE + part;
            let v = mat4x4f(wg_rows[at], wg_rows[at + STRIDE], wg_rows[at + 2u * STRIDE], wg_rows[at + 3u * STRIDE]);
            let row = layer.first_weight + j * n_words + group;
            let w = mat4x4f(weights[row], weights[row + n_words], weights[row + 2u * n_words], weights[row + 3u * n_words]);
            sums += v * transpose(w);
        }
        for (var i = 0u; i < 4u; i++) {
            put_four(BANK - layer.from_bank, 4u * group + i, part, layer_output(layer, tile, 4u * group + i, part, sums[i]));
        }
    }
    // The layer has read its inputs and written its rows before the next layer reads or overwrites them.
    workgroupBarrier();
}
