// layer_gradient: slopes towards the weights of a layer, summed over a chunk of the samples.
//
// threads   one per chunk, 4 outputs and 4 inputs
// reads     batch, inputs [n_samples, N_IN], v_outputs [n_samples, N_OUT]
// writes    partial_sums [n_chunks, N_OUT, N_IN]
// twin      nerf/reference/network.rs

#import folded
#import ray_batch

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> inputs: array<vec4f>;
@group(0) @binding(2) var<storage, read> v_outputs: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> partial_sums: array<vec4f>;

override N_IN: u32;
override N_OUT: u32;
override N_CHUNK: u32;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_in = N_IN / 4u;
    let n_out = N_OUT / 4u;
    let column = ix % n_in;
    let row = ix / n_in % n_out;
    let chunk = ix / (n_in * n_out);
    let at = chunk * N_OUT * n_in + 4u * row * n_in + column;
    if at + 3u * n_in >= arrayLength(&partial_sums) { return; }
    let end = min((chunk + 1u) * N_CHUNK, batch.n_samples);
    var sums: mat4x4f; // a column an output
    for (var sample = chunk * N_CHUNK; sample < end; sample++) {
        let input = inputs[sample * n_in + column];
        let v = v_outputs[sample * n_out + row];
        sums += mat4x4f(v.x * input, v.y * input, v.z * input, v.w * input);
    }
    for (var i = 0u; i < 4u; i++) { partial_sums[at + i * n_in] = sums[i]; }
}
