// mark_cells: marks the cells to sample: sufficiently opaque cells, and cells that were never updated. Marks solid cells
// also in a second set.
//
// threads   one per 32 cells
// reads     cell_occupancy, occupancy_sum
// writes    occupied (one bit per cell), steps ([1]: updates so far)

#import folded
#import occupancy_sum
#import occupancy_update
#import cell_blocks

@group(0) @binding(0) var<uniform> occupancy_update: OccupancyUpdate;
@group(0) @binding(1) var<storage, read> cell_occupancy: array<f32>;
@group(0) @binding(2) var<storage, read> occupancy_sum: array<u32>;
@group(0) @binding(3) var<storage, read_write> occupied: array<u32>;
@group(0) @binding(4) var<storage, read_write> steps: array<u32>;

// Cells with a lower opacity per step are skipped. If the mean opacity is low, the threshold is half of the mean
// opacity.
const MIN_OCCUPANCY = 0.02;
// Cells with a higher opacity per step may hold thin objects.
const MIN_SOLID_OCCUPANCY = 0.1;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let word = folded(wg, n_wgs) * 64u + lane;
    if 32u * word >= arrayLength(&cell_occupancy) { return; }
    let mean = f32(occupancy_sum[0]) / MAX_SUM;
    let threshold = min(MIN_OCCUPANCY, 0.5 * mean);
    var bits = 0u;
    var solid_bits = 0u;
    for (var bit = 0u; bit < 32u; bit++) {
        let value = cell_occupancy[32u * word + bit];
        if value < 0.0 || value > threshold { bits |= 1u << bit; }
        if value < 0.0 || value > max(threshold, MIN_SOLID_OCCUPANCY) { solid_bits |= 1u << bit; }
    }
    occupied[word] = bits;
    occupied[n_set_words(occupancy_update.n_cells) + word] = solid_bits;
    if word == 0u { steps[1] += 1u; }
}
