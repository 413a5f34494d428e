// sample_cells: chooses a random point in each occupancy cell that this update evaluates.
//
// threads   one per point
// reads     occupancy_update, steps ([1]: updates so far)
// writes    points [n_points] (in the unit cube), batch (n_samples)

#import folded
#import occupancy_update
#import random

@group(0) @binding(0) var<uniform> occupancy_update: OccupancyUpdate;
@group(0) @binding(1) var<storage, read> steps: array<u32>;
@group(0) @binding(2) var<storage, read_write> batch: array<u32>;
@group(0) @binding(3) var<storage, read_write> points: array<vec4f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    if ix >= occupancy_update.n_points { return; }
    let n_cells = occupancy_update.n_cells;
    let cell = updated_cell(occupancy_update, steps[1], ix);
    let corner = vec3f(vec3u(cell, cell / n_cells, cell / n_cells / n_cells) % n_cells);
    points[ix] = vec4f((corner + uniform3(vec3u(cell, steps[1], 7u))) / f32(n_cells), 0.0);
    if ix == 0u { batch[1] = occupancy_update.n_points; }
}
