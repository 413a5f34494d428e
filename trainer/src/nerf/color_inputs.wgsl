// color_inputs: what the network of the color is given.
//
// threads   one per sample
// reads     batch, rays, spans, told [n_samples, 16] (logarithm of the density, then what is handed on), codes [n_images, N_CODE]
// writes    inputs [n_samples, N_IN]: 16 harmonics of the direction, 15 handed on, the code, zeros
// twin      nerf/reference/field.rs

#import folded
#import ray_batch
#import sh

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> spans: array<Span>;
@group(0) @binding(3) var<storage, read> told: array<f32>;
@group(0) @binding(4) var<storage, read> codes: array<f32>;
@group(0) @binding(5) var<storage, read_write> inputs: array<f32>;

override N_IN: u32;
override N_CODE: u32;

struct ShSums {
    begin: u32,
}

fn sh_term(sums: ptr<function, ShSums>, k: u32, basis: f32, slope: vec3f) {
    inputs[(*sums).begin + 1u + k] = basis;
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let sample = folded(wg, n_wgs) * 256u + lane;
    if sample >= batch.n_samples { return; }
    let ray = rays[spans[sample].ray];
    let begin = sample * N_IN;
    inputs[begin] = SH_0;
    var sums = ShSums(begin);
    each_sh(&sums, ray.direction, 3u);
    for (var k = 0u; k < 15u; k++) { inputs[begin + 16u + k] = told[sample * 16u + 1u + k]; }
    for (var k = 0u; k < N_CODE; k++) { inputs[begin + 31u + k] = codes[ray.code * N_CODE + k]; }
    for (var k = 31u + N_CODE; k < N_IN; k++) { inputs[begin + k] = 0.0; }
}
