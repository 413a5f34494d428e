// sum_cells: mean occupancy of all cells, as an integer, so that the order of additions does not matter.
//
// threads   one per 32 cells
// reads     cell_occupancy
// writes    occupancy_sum (mean of the occupancy, clamped to 0 to 1 per cell, times MAX_SUM)

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
