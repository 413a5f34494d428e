// layer_forward: one layer of a network for all samples.
//
// threads   one per 4 samples and 4 outputs
// reads     batch, inputs [n_samples, N_IN], weights [N_OUT, N_IN]
// writes    outputs [n_samples, N_OUT], cut at zero where RELU
// twin      nerf/reference/network.rs
//
// Widths are multiples of 4; threads beside each other share what they read, so that it comes out of the nearest cache.

#import folded
#import ray_batch

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> inputs: array<vec4f>;
@group(0) @binding(2) var<storage, read> weights: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> outputs: array<vec4f>;

override N_IN: u32;
override N_OUT: u32;
override RELU: bool;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_in = N_IN / 4u;
    let n_out = N_OUT / 4u;
    let column = ix % n_out;
    let first = ix / n_out * 4u;
    if first >= batch.n_samples { return; }
    let rows = min(vec4u(first, first + 1u, first + 2u, first + 3u), vec4u(batch.n_samples - 1u)) * n_in;
    let row = column * 4u * n_in;
    var sums: mat4x4f;
    for (var k = 0u; k < n_in; k++) {
        let a = mat4x4f(inputs[rows.x + k], inputs[rows.y + k], inputs[rows.z + k], inputs[rows.w + k]);
        let w = mat4x4f(weights[row + k], weights[row + n_in + k], weights[row + 2u * n_in + k], weights[row + 3u * n_in + k]);
        sums += transpose(w) * a;
    }
    for (var i = 0u; i < 4u; i++) {
        if first + i >= batch.n_samples { break; }
        var out = sums[i];
        if RELU { out = max(out, vec4f(0.0)); }
        outputs[(first + i) * n_out + column] = out;
    }
}
