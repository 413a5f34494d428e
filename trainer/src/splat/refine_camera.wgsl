// refine_camera: sum the gradients with respect to the camera of one image, and take one optimizer step for the camera
// parameters.
//
// threads   one workgroup of 256
// reads     view, model, lens, rule, camera_sums [3, n_blocks], gain_sums [n_tiles], status
// writes    params
// twin      splat/reference/project.rs (the view's gradient); optim/reference.rs
//
// Per-image parameters decay towards zero, so that corrections common to all images go to the shared parameters.

#import view
#import model
#import camera_params
#import status
#import param_step

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> model: Model;
@group(0) @binding(2) var<uniform> lens: Lens;
@group(0) @binding(3) var<storage, read> camera_sums: array<vec4f>;
@group(0) @binding(4) var<storage, read> gain_sums: array<vec4f>;
@group(0) @binding(5) var<storage, read> status: array<u32>;
@group(0) @binding(6) var<storage, read_write> params: array<vec4f>;
@group(0) @binding(7) var<uniform> rule: CameraRule;

override GRADIENTS_ONLY: bool = false;   // Stores the gradients as the parameters' values, for tests.
var<workgroup> wg_sums: array<vec4f, 1024>; // [256, 4]

fn gradient_of(param: u32) -> f32 {
    let rotation = wg_sums[0].xyz;
    let translation = wg_sums[1].xyz;
    if param < TRANSLATION { return rotation[param - ROTATION]; }
    if param < TIME_OFFSET { return translation[param - TRANSLATION]; }
    if param == TIME_OFFSET { return -dot(lens.angular.xyz, rotation) - dot(lens.linear.xyz, translation); }
    if param < PRINCIPAL { return view.focal_px[param - LOG_FOCAL] * vec2f(wg_sums[0].w, wg_sums[1].w)[param - LOG_FOCAL]; }
    if param < LOG_GAIN { return view.focal_px[param - PRINCIPAL] * wg_sums[2].xy[param - PRINCIPAL]; }
    return wg_sums[3].xyz[min(param - LOG_GAIN, 2u)];
}

fn rate_of(param: u32) -> f32 {
    if param < TRANSLATION { return rule.rotation_rate; }
    if param < TIME_OFFSET { return rule.translation_rate_m; }
    if param == TIME_OFFSET { return rule.time_offset_rate; }
    if param < LOG_GAIN { return rule.focal_rate; }
    return rule.gain_rate;
}

fn is_finite(x: f32) -> bool {
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
    workgroupBarrier(); // All sums are written.
    for (var stride = 128u; stride > 0u; stride /= 2u) {
        if lane < stride {
            for (var part = 0u; part < 4u; part++) { wg_sums[part * 256u + lane] += wg_sums[part * 256u + lane + stride]; }
        }
        workgroupBarrier(); // The lower half of the lanes holds the sums of both halves.
    }
    let total = array<vec4f, 4>(wg_sums[0], wg_sums[256], wg_sums[512], wg_sums[768]);
    workgroupBarrier(); // All lanes have read the totals before the first four sums are overwritten.
    if lane == 0u {
        wg_sums[0] = total[0];
        wg_sums[1] = total[1];
        wg_sums[2] = total[2];
        wg_sums[3] = total[3];
    }
    workgroupBarrier(); // The totals are written before `gradient_of` reads them.
    let param = min(lane, N_PARAMS - 1u);
    let gradient = gradient_of(param);
    let is_usable = lane < N_PARAMS && status[FAILED] == 0u && is_finite(gradient);
    let bit = 1u << param;
    if GRADIENTS_ONLY {
        if is_usable { params[lens.camera_params + param].x = gradient; }
    } else {
        if is_usable && (rule.camera_mask & bit) != 0u {
            params[lens.camera_params + param] = adam_step(params[lens.camera_params + param], gradient, rate_of(param), 0.0);
        }
        if is_usable && (rule.image_mask & bit) != 0u {
            params[lens.image_params + param] = adam_step(params[lens.image_params + param], gradient, rate_of(param), rule.image_decay);
        }
    }
}
