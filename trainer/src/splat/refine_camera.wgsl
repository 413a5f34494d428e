// refine_camera: sum the slopes towards the camera of one image, and take a step of its terms.
//
// threads   one workgroup of 256
// reads     view, model, lens, rule, camera_sums [3, n_blocks], gain_sums [n_tiles], status
// writes    terms
// twin      splat/reference/project.rs (the view's gradient); optim/reference.rs
//
// The terms of an image are pulled towards nothing, so that it is the camera's that explain what all images share.

#import view
#import model
#import camera_terms
#import status
#import term_step

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<uniform> lens: Lens;
@group(0) @binding(3) var<storage, read> camera_sums: array<vec4f>;
@group(0) @binding(4) var<storage, read> gain_sums: array<vec4f>;
@group(0) @binding(5) var<storage, read> status: array<u32>;
@group(0) @binding(6) var<storage, read_write> terms: array<vec4f>;
@group(0) @binding(7) var<uniform> rule: CameraRule;

override GRADIENTS_ONLY: bool = false;   // Stored as the terms' values, for tests.
var<workgroup> wg_sums: array<vec4f, 1024>; // [256, 4]

fn slope_of(term: u32) -> f32 {
    let turn = wg_sums[0].xyz;
    let shift = wg_sums[1].xyz;
    if term < SHIFT { return turn[term - TURN]; }
    if term < DELAY { return shift[term - SHIFT]; }
    if term == DELAY { return -dot(lens.angular.xyz, turn) - dot(lens.linear.xyz, shift); }
    if term < PRINCIPAL { return view.focal_px[term - LOG_FOCAL] * vec2f(wg_sums[0].w, wg_sums[1].w)[term - LOG_FOCAL]; }
    if term < LOG_GAIN { return view.focal_px[term - PRINCIPAL] * wg_sums[2].xy[term - PRINCIPAL]; }
    return wg_sums[3].xyz[min(term - LOG_GAIN, 2u)];
}

fn rate_of(term: u32) -> f32 {
    if term < SHIFT { return rule.turn_rate; }
    if term < DELAY { return rule.shift_rate_m; }
    if term == DELAY { return rule.delay_rate; }
    if term < LOG_GAIN { return rule.focal_rate; }
    return rule.gain_rate;
}

fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_blocks = (model.n_splats + 255u) / 256u;
    var sums = array<vec4f, 4>();
    for (var block = lane; block < n_blocks; block += 256u) {
        sums[0] += camera_sums[block * 3u];
        sums[1] += camera_sums[block * 3u + 1u];
        sums[2] += camera_sums[block * 3u + 2u];
    }
    for (var tile = lane; tile < view.n_tiles.x * view.n_tiles.y; tile += 256u) { sums[3] += gain_sums[tile]; }
    for (var part = 0u; part < 4u; part++) { wg_sums[part * 256u + lane] = sums[part]; }
    workgroupBarrier(); // All have told.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride {
            for (var part = 0u; part < 4u; part++) { wg_sums[part * 256u + lane] += wg_sums[part * 256u + lane + stride]; }
        }
        workgroupBarrier(); // This half holds what the other knew.
    }
    let total = array<vec4f, 4>(wg_sums[0], wg_sums[256], wg_sums[512], wg_sums[768]);
    workgroupBarrier(); // All have read before the first four are overwritten.
    if lane == 0u {
        wg_sums[0] = total[0];
        wg_sums[1] = total[1];
        wg_sums[2] = total[2];
        wg_sums[3] = total[3];
    }
    workgroupBarrier(); // The totals are where `slope_of` looks.
    let term = min(lane, TERMS - 1u);
    let slope = slope_of(term);
    let learns = lane < TERMS && status[FAILED] == 0u && finite(slope);
    let bit = 1u << term;
    if GRADIENTS_ONLY {
        if learns { terms[lens.camera_terms + term].x = slope; }
    } else {
        if learns && (rule.of_camera & bit) != 0u {
            terms[lens.camera_terms + term] = stepped(terms[lens.camera_terms + term], slope, rate_of(term), 0.0);
        }
        if learns && (rule.of_image & bit) != 0u {
            terms[lens.image_terms + term] = stepped(terms[lens.image_terms + term], slope, rate_of(term), rule.image_pull);
        }
    }
}
