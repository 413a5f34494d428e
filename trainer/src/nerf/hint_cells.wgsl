// hint_cells: applies hints from images to occupancy cells that have not been sampled yet.
//
// threads   one per hint
// reads     hints [n]: cell index, with the kind of hint in the highest two bits, see below
// writes    cell_occupancy
//
// Hints are sorted by priority, and each kind has its own dispatch, because a cell may have several hints.

#import folded

@group(0) @binding(0) var<storage, read> hints: array<u32>;
@group(0) @binding(1) var<storage, read_write> cell_occupancy: array<f32>;

override KIND: u32;

const UNBOUNDED = 0u; // Possibly occupied, but too far or too dark for the depth camera.
const FREE = 1u;
const SURFACE = 2u;

// Values of a cell that is outside all views, observed to be free, or sampled until its first update.
const OUTSIDE_VIEWS = 0.0;
const EMPTY = 1e-30;
const NEVER_UPDATED = -1.0;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    if ix >= arrayLength(&hints) { return; }
    let hint = hints[ix];
    if hint >> 30u != KIND { return; }
    let cell = hint & 0x3fffffffu;
    let previous = cell_occupancy[cell];
    if KIND == SURFACE {
        cell_occupancy[cell] = max(previous, 1.0);
    } else if KIND == FREE {
        if previous <= 0.0 { cell_occupancy[cell] = EMPTY; }
    } else if previous == OUTSIDE_VIEWS {
        cell_occupancy[cell] = NEVER_UPDATED;
    }
}
