// told_backward: slopes towards what the first network told, from those towards the density and towards what it handed on.
//
// threads   one per sample
// reads     batch, v_log_density [n_samples], v_color_inputs [n_samples, N_IN]
// writes    v_told [n_samples, 16]
// twin      nerf/reference/field.rs

#import folded
#import ray_batch

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> v_log_density: array<f32>;
@group(0) @binding(2) var<storage, read> v_color_inputs: array<f32>;
@group(0) @binding(3) var<storage, read_write> v_told: array<f32>;

override N_IN: u32;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let sample = folded(wg, n_wgs) * 256u + lane;
    if sample >= batch.n_samples { return; }
    v_told[16u * sample] = v_log_density[sample];
    for (var k = 0u; k < 15u; k++) { v_told[16u * sample + 1u + k] = v_color_inputs[N_IN * sample + 16u + k]; }
}
