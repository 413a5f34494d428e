// update_images: sums the gradients of an image's rays and samples, and takes one Adam step for its pose and appearance
// embedding.
//
// threads   one workgroup of 64 per image
// reads     batch, rule, step_scale, rays (in the order of their images, like their samples), v_rays [n_rays, 2],
//           v_embeddings [n_samples]
// writes    image_params [n_images, IMAGE_PARAM_STRIDE]
// twin      nerf/reference/pose.rs, nerf/reference/field.rs, optim/reference.rs
//
// Weight decay keeps the parameters of an image near zero unless the images show otherwise.

#import folded
#import ray_batch
#import adam_rule
#import image_params
#import param_step

struct ImageParamRule {
    learned: u32,          // bit i: parameter i
    n_images: u32,
    rotation_rate: f32,        // radians per step, initially
    translation_rate: f32,       // units of the scene radius per step, initially
    embedding_rate: f32,        // per step, initially
    weight_decay: f32,             // fraction by which a parameter decays per step, initially
    unused: vec2u,
}

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<uniform> rule: ImageParamRule;
@group(0) @binding(2) var<storage, read> step_scale: StepScale;
@group(0) @binding(3) var<storage, read> rays: array<Ray>;
@group(0) @binding(4) var<storage, read> v_rays: array<vec4f>;
@group(0) @binding(5) var<storage, read> v_embeddings: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> image_params: array<vec4f>;

const MAX_ABS = 1e30;
const PARTS = 3u;          // rotation, translation, embedding: three parameters each

var<workgroup> wg_sums: array<vec4f, 192>; // [PARTS, 64]

// The first ray that belongs to this image or a later one.
fn first_ray_of(image: u32) -> u32 {
    var begin = 0u;
    var end = batch.n_rays;
    while begin < end {
        let middle = (begin + end) / 2u;
        if rays[middle].embedding < image { begin = middle + 1u; } else { end = middle; }
    }
    return begin;
}

fn first_sample_of(ray: u32) -> u32 {
    if ray < batch.n_rays { return rays[ray].first_sample; }
    return batch.n_samples;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let image = folded(wg, n_wgs);
    let begin = first_ray_of(image);
    let end = first_ray_of(image + 1u);
    var sums = array<vec4f, PARTS>();
    for (var ix = begin + lane; ix < end; ix += 64u) {
        sums[0] += v_rays[2u * ix];
        sums[1] += v_rays[2u * ix + 1u];
    }
    let end_sample = first_sample_of(end);
    for (var ix = first_sample_of(begin) + lane; ix < end_sample; ix += 64u) { sums[2] += v_embeddings[ix]; }
    for (var part = 0u; part < PARTS; part++) { wg_sums[part * 64u + lane] = sums[part]; }
    workgroupBarrier(); // All lanes have written their sums.
    for (var stride = 32u; stride > 0u; stride /= 2u) {
        if lane < stride {
            for (var part = 0u; part < PARTS; part++) { wg_sums[part * 64u + lane] += wg_sums[part * 64u + lane + stride]; }
        }
        workgroupBarrier(); // The lower half holds the sums of both halves.
    }
    let part = min(lane / 3u, PARTS - 1u);
    let gradient = wg_sums[part * 64u][lane % 3u];
    let is_learned = lane < IMAGE_PARAM_STRIDE && (rule.learned & (1u << lane)) != 0u;
    // Skips non-finite gradients, and images without rays.
    if image < rule.n_images && is_learned && begin < end && abs(gradient) < MAX_ABS {
        let at = image * IMAGE_PARAM_STRIDE + lane;
        let rate = step_scale.rate_frac * vec3f(rule.rotation_rate, rule.translation_rate, rule.embedding_rate)[part];
        image_params[at] = adam_step(image_params[at], gradient, rate, rule.weight_decay * step_scale.rate_frac);
    }
}
