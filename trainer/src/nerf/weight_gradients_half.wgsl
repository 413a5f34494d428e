// weight_gradients_half: variant of `weight_gradients` with cooperative matrices.
//
// threads   256 per layer and chunk of CHUNK_TILES * 32 samples
// reads     batch, activations [n_tiles, n_activation_rows, 8], v_activations [n_tiles, n_gradient_rows, 8]
// writes    partial_sums [n_chunks, n_weights] (the last layer has 16 outputs)
// twin      nerf/reference/network.rs
//
// A subgroup computes 16 outputs and 16 inputs of the layer, over all samples of the chunk.

#import number
#import folded
#import ray_batch
#import network_tile
#import network_layers

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> activations: array<Four>;
@group(0) @binding(2) var<storage, read> v_activations: array<Four>;
@group(0) @binding(3) var<storage, read_write> partial_sums: array<f32>;

override CHUNK_TILES: u32;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u,
    @builtin(subgroup_id) subgroup: u32, @builtin(num_subgroups) n_subgroups: u32,
) {
    let ix = folded(wg, n_wgs);
    let first_tile = ix / N_LAYERS * CHUNK_TILES;
    let layer = layer_of(ix % N_LAYERS);
    let n_in = layer.n_in / 16u;
    let n_tiles = (batch.n_samples + TILE - 1u) / TILE;
    for (var block = subgroup; block < n_in * layer.n_out / 16u; block += n_subgroups) {
        let output = block / n_in * 16u;
        let input = block % n_in * 16u;
        var sums: coop_mat16x16<f32, C>;
        for (var tile = first_tile; tile < min(first_tile + CHUNK_TILES, n_tiles); tile++) {
            let v_at = (tile * n_gradient_rows() + layer.v_row + output) * PARTS;
            let h_at = (tile * n_activation_rows() + layer.activation_row + input) * PARTS;
            for (var part = 0u; part < PARTS; part += 4u) {
                let v = coopLoadT<coop_mat16x16<f16, A>>(&v_activations[v_at + part], PARTS);
                let h = coopLoad<coop_mat16x16<f16, B>>(&activations[h_at + part], PARTS);
                sums = coopMultiplyAdd(v, h, sums);
            }
        }
        // The product needs a name, because naga 30 cannot store unnamed results.
        let total = sums * (1.0 / gradient_scale(batch.n_rays));
        let stride = layer.n_in;
        let first = 4u * (ix / N_LAYERS * n_weight_words() + layer.first_weight) + output * stride + input;
        coopStoreT(total, &partial_sums[first], stride);
    }
}
