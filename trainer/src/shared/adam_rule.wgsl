// learn_rule: how parameters of a field learn.

struct AdamRule {
    rate: f32,             // at the start
    final_rate_frac: f32,  // what is left of it at the end of the planned steps
    betas: vec2f,          // of Adam
    epsilon: f32,          // of Adam
    weight_decay: f32,             // of weights towards zero, per step and unit of rate
    n_planned_steps: f32,
    unused: f32,
}

// How far the next step goes; made anew at the end of each.
struct StepScale {
    rate_frac: f32,        // of the rate at the start
    unused: f32,
    correction: vec2f,     // one over what is missing from the means over the steps so far
}

fn step_scale_at(rule: AdamRule, step: f32) -> StepScale {
    let rate_frac = pow(rule.final_rate_frac, clamp(step / max(rule.n_planned_steps, 1.0), 0.0, 1.0));
    return StepScale(rate_frac, 0.0, 1.0 / (1.0 - pow(rule.betas, vec2f(step + 1.0))));
}
