// weight_gradients: gradients with respect to the weights of all layers, summed over a chunk of samples.
//
// threads   SUM_LANES per layer and chunk of CHUNK_TILES * 32 samples
// reads     batch, activations [n_tiles, n_activation_rows, 8], v_activations [n_tiles, n_gradient_rows, 8]
// writes    partial_sums [n_chunks, n_weights]
// twin      nerf/reference/network.rs
//
// A thread computes 4 outputs and 4 inputs of the layer. If there are more threads, several share the samples.

#import folded
#import ray_batch
#import network_tile
#import network_layers

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> activations: array<vec4f>;
@group(0) @binding(2) var<storage, read> v_activations: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> partial_sums: array<f32>;

override SUM_LANES: u32;
override CHUNK_TILES: u32;

const BANK = 576u;         // start of the rows of gradients: 64 strides

var<workgroup> wg_rows: array<vec4f, 1152>;

@compute @workgroup_size(SUM_LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs);
    let first_tile = ix / N_LAYERS * CHUNK_TILES;
    let layer = layer_of(ix % N_LAYERS);
    let n_in = layer.n_in / 4u;
    let n_out = layer.n_out / 4u;
    let n_blocks = n_in * n_out;
    let n_shares = min(PARTS, SUM_LANES / n_blocks); // of the samples
    let share = lane / n_blocks;
    // Neighboring threads read consecutive rows, so that they use different memory banks.
    let input = lane % n_blocks % n_in;
    let output = lane % n_blocks / n_in;
    let n_tiles = (batch.n_samples + TILE - 1u) / TILE;
    if first_tile < n_tiles {
        var sums: mat4x4f; // one column per output
        for (var tile = first_tile; tile < min(first_tile + CHUNK_TILES, n_tiles); tile++) {
            for (var item = lane; item < layer.n_in * PARTS; item += SUM_LANES) {
                wg_rows[item / PARTS * STRIDE + item % PARTS] = activations[(tile * n_activation_rows() + layer.activation_row) * PARTS + item];
            }
            for (var item = lane; item < layer.n_out * PARTS; item += SUM_LANES) {
                wg_rows[BANK + item / PARTS * STRIDE + item % PARTS] = v_activations[(tile * n_gradient_rows() + layer.v_row) * PARTS + item];
            }
            workgroupBarrier(); // All rows of the tile are written before they are read.
            if share < n_shares {
                for (var part = share; part < PARTS; part += n_shares) {
                    let h_at = input * STRIDE + part;
                    let h_step = n_in * STRIDE;
                    let h = mat4x4f(wg_rows[h_at], wg_rows[h_at + h_step], wg_rows[h_at + 2u * h_step], wg_rows[h_at + 3u * h_step]);
                    let v_at = BANK + output * STRIDE + part;
                    let v_step = n_out * STRIDE;
                    let v = mat4x4f(wg_rows[v_at], wg_rows[v_at + v_step], wg_rows[v_at + 2u * v_step], wg_rows[v_at + 3u * v_step]);
                    sums += transpose(h) * v;
                }
            }
            workgroupBarrier(); // All lanes have read before the next tile overwrites the rows.
        }
        for (var j = 0u; j < 4u; j++) { wg_rows[4u * lane + j] = sums[j]; }
        workgroupBarrier(); // All partial sums are written before they are added.
        if share == 0u {
            for (var j = 0u; j < 4u; j++) {
                var sum = vec4f(0.0);
                for (var other = 0u; other < n_shares; other++) { sum += wg_rows[4u * (lane + other * n_blocks) + j]; }
                let row = ix / N_LAYERS * 4u * n_weight_words() + 4u * layer.first_weight + (output + j * n_out) * layer.n_in;
                for (var i = 0u; i < 4u; i++) { partial_sums[row + input + i * n_in] = sum[i]; }
            }
        }
    }
}
