// scatter: slopes towards the entries of the grid, as whole numbers, so that their order does not matter.
//
// threads   one per sample and level
// reads     batch, levels [n_levels], points, v_features [n_samples, n_levels], scales [n_levels] (powers of two)
// writes    v_grid [n_entries, 2] (slope times scale), counts: [0] saturated contributions
// twin      nerf/reference/grid.rs

#import folded
#import ray_batch
#import hash_grid

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> v_features: array<vec2f>;
@group(0) @binding(4) var<storage, read> scales: array<f32>;
@group(0) @binding(5) var<storage, read_write> v_grid: array<atomic<i32>>;
@group(0) @binding(6) var<storage, read_write> counts: array<atomic<u32>>;

// One contribution is at most this: 2^7 of them fit into a sum.
const MOST = 16777216.0;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_levels = arrayLength(&levels);
    let sample = ix / n_levels;
    if sample >= batch.n_samples { return; }
    let level = levels[ix % n_levels];
    let cell = cell_of(level, points[sample].xyz);
    let v = v_features[ix] * scales[ix % n_levels];
    for (var corner = 0u; corner < 8u; corner++) {
        let step = step_of(corner);
        let entry = entry_of(level, cell.first + step);
        let part = weight_of(cell, step) * v;
        for (var feature = 0u; feature < 2u; feature++) {
            let value = part[feature];
            if !(abs(value) < MOST) {
                atomicAdd(&counts[0], 1u);
            } else if value != 0.0 {
                atomicAdd(&v_grid[2u * entry + feature], i32(round(value)));
            }
        }
    }
}
