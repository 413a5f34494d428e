// supervision: the targets of the loss and its weights.

#import random

struct Supervision {
    background_srgb: vec4f,   // behind everything; w unused
    dssim_frac: f32,          // weight of D-SSIM in the color loss, 0 to 1
    depth_weight: f32,        // per meter
    depth_clip_m: f32,        // larger depth residuals have no gradient
    random_background: f32,   // maximum of a random background per step, which penalizes uncovered areas; 0: off
}

const WINDOW = 11u;
const HALO = 5u;
const SPAN = 26u;          // 16 + 2 * HALO

// Gaussian of sigma 1.5 over 11 pixels, summing to 1.
const GAUSSIAN = array<f32, 11>(
    0.001028380084, 0.007598758135, 0.03600077213, 0.1093606895, 0.2130055377, 0.2660117249,
    0.2130055377, 0.1093606895, 0.03600077213, 0.007598758135, 0.001028380084,
);

fn rgb_of(packed: u32) -> vec3f {
    return unpack4x8unorm(packed).rgb;
}

fn background_at(supervision: Supervision, step: u32) -> vec3f {
    return supervision.background_srgb.rgb + supervision.random_background * uniform3(vec3u(step, 1u, 2u));
}
