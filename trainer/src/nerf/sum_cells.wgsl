// sum_cells: the mean of what cells hold back, as a whole number, so that the order does not matter.
//
// threads   one per 32 cells
// reads     thickness
// writes    thickness_sum (at most 1 a cell, in units of 1 / MOST_SUM of all)

#import folded
#import occupancy_sum

@group(0) @binding(0) var<storage, read> cell_occupancy: array<f32>;
@group(0) @binding(1) var<storage, read_write> occupancy_sum: array<atomic<u32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let word = folded(wg, n_wgs) * 64u + lane;
    if 32u * word >= arrayLength(&cell_occupancy) { return; }
    var sum = 0.0;
    for (var bit = 0u; bit < 32u; bit++) { sum += clamp(cell_occupancy[32u * word + bit], 0.0, 1.0); }
    atomicAdd(&occupancy_sum[0], u32(sum * MAX_SUM / f32(arrayLength(&cell_occupancy))));
}
