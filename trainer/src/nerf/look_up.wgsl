// look_up: what the grid holds around every point.
//
// threads   one per sample and level
// reads     batch, levels [n_levels], points [n_samples] (in the unit cube), grid [n_entries]
// writes    features [n_samples, n_levels]
// twin      nerf/reference/grid.rs
// source    Mueller et al. 2022

#import folded
#import ray_batch
#import hash_grid

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> grid: array<vec2f>;
@group(0) @binding(4) var<storage, read_write> features: array<vec2f>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    let n_levels = arrayLength(&levels);
    let sample = ix / n_levels;
    if sample >= batch.n_samples { return; }
    let level = levels[ix % n_levels];
    let cell = cell_of(level, points[sample].xyz);
    var found = vec2f(0.0);
    for (var corner = 0u; corner < 8u; corner++) {
        let step = step_of(corner);
        found += weight_of(cell, step) * grid[entry_of(level, cell.first + step)];
    }
    features[ix] = found;
}
