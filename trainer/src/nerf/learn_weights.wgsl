// learn_weights: one step of Adam for the weights of a layer.
//
// threads   one per weight
// reads     rule, pace, v_weights
// writes    weights, moments (first and second)
// twin      optim/reference.rs
// source    Kingma and Ba 2015; pull of Loshchilov and Hutter 2019 (AdamW)

#import learn_rule

@group(0) @binding(0) var<uniform> rule: LearnRule;
@group(0) @binding(1) var<storage, read> pace: Pace;
@group(0) @binding(2) var<storage, read> v_weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> weights: array<f32>;
@group(0) @binding(4) var<storage, read_write> moments: array<vec2f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = wg.x * 64u + lane;
    if ix >= arrayLength(&weights) { return; }
    let v = v_weights[ix];
    if !(abs(v) < 1e30) { return; } // What is not finite teaches nothing.
    let moment = mix(vec2f(v, v * v), moments[ix], rule.betas);
    moments[ix] = moment;
    let corrected = moment * pace.correction;
    let rate = rule.rate * pace.rate_frac;
    weights[ix] -= rate * (corrected.x / (sqrt(corrected.y) + rule.epsilon) + rule.pull * weights[ix]);
}
