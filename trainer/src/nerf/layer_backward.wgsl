// layer_backward: slopes towards the inputs of a layer from those towards its outputs.
//
// threads   one per 4 samples and 4 inputs
// reads     batch, inputs [n_samples, N_IN], weights [N_OUT, N_IN], v_outputs [n_samples, N_OUT]
// writes    v_inputs [n_samples, N_IN], zero where the input was cut and CUT says that it may be
// twin      nerf/reference/network.rs

#import folded
#import ray_batch

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> inputs: array<vec4f>;
@group(0) @binding(2) var<storage, read> weights: array<vec4f>;
@group(0) @binding(3) var<storage, read> v_outputs: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> v_inputs: array<vec4f>;

override N_IN: u32;
override N_OUT: u32;
override CUT: bool;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_in = N_IN / 4u;
    let n_out = N_OUT / 4u;
    let column = ix % n_in;
    let first = ix / n_in * 4u;
    if first >= batch.n_samples { return; }
    let rows = min(vec4u(first, first + 1u, first + 2u, first + 3u), vec4u(batch.n_samples - 1u)) * n_out;
    var sums: mat4x4f;
    for (var j = 0u; j < n_out; j++) {
        let v = mat4x4f(v_outputs[rows.x + j], v_outputs[rows.y + j], v_outputs[rows.z + j], v_outputs[rows.w + j]);
        let at = 4u * j * n_in + column;
        let w = mat4x4f(weights[at], weights[at + n_in], weights[at + 2u * n_in], weights[at + 3u * n_in]);
        sums += w * v;
    }
    for (var i = 0u; i < 4u; i++) {
        if first + i >= batch.n_samples { break; }
        let at = (first + i) * n_in + column;
        var v = sums[i];
        if CUT { v = select(vec4f(0.0), v, inputs[at] > vec4f(0.0)); }
        v_inputs[at] = v;
    }
}
