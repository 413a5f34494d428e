// param_step: one Adam step for a parameter of a camera or an image.
//
// Each parameter is a vec4f: its value, Adam's two moments, and the number of steps taken.
//
// twin      optim/reference.rs

const PARAM_BETAS = vec2f(0.9, 0.99);
const PARAM_EPSILON = 1e-15;

// `decay` is the fraction by which the step decays the value toward zero.
fn adam_step(before: vec4f, gradient: f32, rate: f32, decay: f32) -> vec4f {
    let moments = mix(vec2f(gradient, gradient * gradient), before.yz, PARAM_BETAS);
    let n_steps = before.w + 1.0;
    let unbiased = moments / (1.0 - pow(PARAM_BETAS, vec2f(n_steps)));
    let value = before.x - rate * unbiased.x / (sqrt(unbiased.y) + PARAM_EPSILON);
    return vec4f(value * (1.0 - decay), moments, n_steps);
}
