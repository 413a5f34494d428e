// grow_weigh: compute each splat's weight in the choice of parents from its error, and prefix sums within blocks of 256.
//
// threads   256 per block
// reads     growth, means, shapes, error_sums
// writes    weights [n_before] (0 where dead), cumulative [n_before] (within the block), block_weights [n_blocks]
// source    weights from errors instead of opacities as in Bulo et al. 2024 (Revising densification)

#import view
#import growth
#import scan_f32

@group(0) @binding(0) var<uniform> growth: Growth;
@group(0) @binding(1) var<storage, read> means: array<vec4f>;
@group(0) @binding(2) var<storage, read> shapes: array<vec4f>;
@group(0) @binding(3) var<storage, read> error_sums: array<f32>;
@group(0) @binding(4) var<storage, read_write> weights: array<f32>;
@group(0) @binding(5) var<storage, read_write> cumulative: array<f32>;
@group(0) @binding(6) var<storage, read_write> block_weights: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = folded(wg, n_wgs);
    let splat_ix = block * 256u + lane;
    var weight = 0.0;
    if splat_ix < growth.n_before && !is_dead(means[splat_ix], shapes[splat_ix], growth.min_opacity) {
        weight = clamp(error_sums[splat_ix], 0.0, 1e12);
    }
    let sum = inclusive_scan_f32(lane, weight);
    if splat_ix < growth.n_before {
        weights[splat_ix] = weight;
        cumulative[splat_ix] = sum;
    }
    if lane == 255u && block * 256u < growth.n_before { block_weights[block] = sum; }
}
