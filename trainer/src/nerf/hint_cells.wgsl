// hint_cells: what a depth image tells about cells of the occupancy that no sample was taken in yet.
//
// threads   one per hint
// reads     hints [n]: cells; in the highest two bits what is told of them, see below
// writes    thickness
//
// What is told is listed in the order of its weight, each kind in a dispatch of its own: a cell may be told more than once.

#import folded

@group(0) @binding(0) var<storage, read> hints: array<u32>;
@group(0) @binding(1) var<storage, read_write> cell_occupancy: array<f32>;

override KIND: u32;

const UNBOUNDED = 0u; // Something may be there, too far or too dark for the depth camera.
const FREE = 1u;
const SURFACE = 2u;

// Of a cell that no image looks at, of one that was looked through, and of one that is to be walked until it was visited.
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
