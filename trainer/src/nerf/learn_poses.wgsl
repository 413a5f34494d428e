// learn_poses: sums the slopes of an image's rays, and takes one step of Adam for its pose.
//
// threads   one workgroup of 64 per image
// reads     batch, rule, pace, rays (in the order of their images), v_rays [n_rays, 2]
// writes    terms [n_images, TERM_STRIDE]
// twin      nerf/reference/pose.rs, optim/reference.rs
//
// Terms are pulled towards nothing: an image moves only as far as it has reason to.

#import folded
#import ray_batch
#import learn_rule
#import image_terms

struct PoseRule {
    turn_rate: f32,        // radians a step, at the start
    shift_rate: f32,       // units of the radius a step, at the start
    pull: f32,             // share of a term that is lost in a step, at the start
    n_images: u32,
}

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> rule: PoseRule;
@group(0) @binding(2) var<storage, read> pace: Pace;
@group(0) @binding(3) var<storage, read> rays: array<Ray>;
@group(0) @binding(4) var<storage, read> v_rays: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> terms: array<vec4f>;

const BETAS = vec2f(0.9, 0.99);
const EPSILON = 1e-15;
const MOST = 1e30;

var<workgroup> wg_sums: array<vec4f, 128>; // [64, 2]

// The first ray of an image that is not before this one.
fn first_ray_of(image: u32) -> u32 {
    var begin = 0u;
    var end = batch.n_rays;
    while begin < end {
        let middle = (begin + end) / 2u;
        if rays[middle].code < image { begin = middle + 1u; } else { end = middle; }
    }
    return begin;
}

fn step_of(before: vec4f, slope: f32, rate: f32) -> vec4f {
    let moments = mix(vec2f(slope, slope * slope), before.yz, BETAS);
    let n_steps = before.w + 1.0;
    let unbiased = moments / (1.0 - pow(BETAS, vec2f(n_steps)));
    let value = before.x - rate * unbiased.x / (sqrt(unbiased.y) + EPSILON);
    return vec4f(value * (1.0 - rule.pull * pace.rate_frac), moments, n_steps);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let image = folded(wg, n_wgs);
    let begin = first_ray_of(image);
    let end = first_ray_of(image + 1u);
    var turn = vec4f(0.0);
    var shift = vec4f(0.0);
    for (var ix = begin + lane; ix < end; ix += 64u) {
        turn += v_rays[2u * ix];
        shift += v_rays[2u * ix + 1u];
    }
    wg_sums[lane] = turn;
    wg_sums[64u + lane] = shift;
    workgroupBarrier(); // All have told.
    for (var stride = 32u; stride > 0u; stride /= 2u) {
        if lane < stride {
            wg_sums[lane] += wg_sums[lane + stride];
            wg_sums[64u + lane] += wg_sums[64u + lane + stride];
        }
        workgroupBarrier(); // This half holds what the other knew.
    }
    let is_shift = lane >= SHIFT;
    let slope = wg_sums[select(0u, 64u, is_shift)][lane % SHIFT];
    // What is not finite teaches nothing; nor does an image without rays.
    if image < rule.n_images && lane < TERMS && begin < end && abs(slope) < MOST {
        let at = image * TERM_STRIDE + lane;
        terms[at] = step_of(terms[at], slope, pace.rate_frac * select(rule.turn_rate, rule.shift_rate, is_shift));
    }
}
