// term_step: one step of Adam for a term of a camera or of an image.
//
// A term is a vec4f: its value, Adam's two means, and how many steps it has taken.
//
// twin      optim/reference.rs

const TERM_BETAS = vec2f(0.9, 0.99);
const TERM_EPSILON = 1e-15;

// pull: the share by which the step pulls it towards nothing.
fn stepped(before: vec4f, slope: f32, rate: f32, pull: f32) -> vec4f {
    let moments = mix(vec2f(slope, slope * slope), before.yz, TERM_BETAS);
    let n_steps = before.w + 1.0;
    let unbiased = moments / (1.0 - pow(TERM_BETAS, vec2f(n_steps)));
    let value = before.x - rate * unbiased.x / (sqrt(unbiased.y) + TERM_EPSILON);
    return vec4f(value * (1.0 - pull), moments, n_steps);
}
