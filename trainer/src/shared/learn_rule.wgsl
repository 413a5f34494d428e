// learn_rule: how parameters of a field learn.

struct LearnRule {
    rate: f32,             // at the start
    final_rate_frac: f32,  // what is left of it at the end of the planned steps
    betas: vec2f,          // of Adam
    epsilon: f32,          // of Adam
    pull: f32,             // of weights towards zero, per step and unit of rate
    n_planned_steps: f32,
    unused: f32,
}

fn rate_at(rule: LearnRule, step: f32) -> f32 {
    return rule.rate * pow(rule.final_rate_frac, clamp(step / max(rule.n_planned_steps, 1.0), 0.0, 1.0));
}

// One over what is missing from the means over the steps so far.
fn correction_at(rule: LearnRule, step: f32) -> vec2f {
    return 1.0 / (1.0 - pow(rule.betas, vec2f(step + 1.0)));
}
