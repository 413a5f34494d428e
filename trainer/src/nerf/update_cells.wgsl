// update_cells: updates the opacity of the cells that this update evaluates.
//
// threads   one per point
// reads     occupancy_update, steps ([1]: updates so far), log_density [n_points]
// writes    cell_occupancy [n_cells^3]: decayed maximum of the opacity over one step; negative: never updated; 0:
//           outside all views
// source    Mueller et al. 2022, appendix C

#import folded
#import density
#import occupancy_update

@group(0) @binding(0) var<uniform> occupancy_update: OccupancyUpdate;
@group(0) @binding(1) var<storage, read> steps: array<u32>;
@group(0) @binding(2) var<storage, read> log_density: array<f32>;
@group(0) @binding(3) var<storage, read_write> cell_occupancy: array<f32>;

const OUTSIDE_VIEWS = 0.0;
const MIN_OCCUPANCY = 1e-30;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    if ix >= occupancy_update.n_points { return; }
    let cell = updated_cell(occupancy_update, steps[1], ix);
    let opacity = density_of(log_density[ix]) * occupancy_update.step;
    let previous = cell_occupancy[cell];
    // The field is not trained in cells outside all views, so its density in these cells is meaningless.
    if previous != OUTSIDE_VIEWS { cell_occupancy[cell] = max(max(occupancy_update.decay * previous, opacity), MIN_OCCUPANCY); }
}
