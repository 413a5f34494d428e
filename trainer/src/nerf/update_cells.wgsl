// note_cells: how much light the visited cells hold back.
//
// threads   one per point
// reads     visit, steps ([1]: visits so far), told [n_points]
// writes    thickness [n_cells^3]: largest share lately, over one step; negative: never visited; 0: no image looks at it
// source    Mueller et al. 2022, appendix C

#import folded
#import density
#import visit

@group(0) @binding(0) var<uniform> visit: Visit;
@group(0) @binding(1) var<storage, read> steps: array<u32>;
@group(0) @binding(2) var<storage, read> told: array<f32>;
@group(0) @binding(3) var<storage, read_write> thickness: array<f32>;

const UNSEEN = 0.0;
const LEAST_SEEN = 1e-30;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 64u + lane;
    if ix >= visit.n_points { return; }
    let cell = visited_cell(visit, steps[1], ix);
    let seen = density_of(told[ix]) * visit.step;
    let known = thickness[cell];
    // What no image looks at never learns what is there, so nothing it says is worth a sample.
    if known != UNSEEN { thickness[cell] = max(max(visit.kept_frac * known, seen), LEAST_SEEN); }
}
