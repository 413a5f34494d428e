// adam_rule: settings of the Adam optimizer for a radiance field.

struct AdamRule {
    rate: f32,             // initial learning rate
    final_rate_frac: f32,  // fraction of the initial rate that remains after the planned steps
    betas: vec2f,          // Adam's betas
    epsilon: f32,          // Adam's epsilon
    weight_decay: f32,             // decay of weights toward zero, per step and unit of rate
    n_planned_steps: f32,
    unused: f32,
}

// Scale of the next step. It is recomputed at the end of each step.
struct StepScale {
    rate_frac: f32,        // fraction of the initial rate
    unused: f32,
    correction: vec2f,     // 1 / (1 - beta^step) for both means: Adam's bias correction
}

fn step_scale_at(rule: AdamRule, step: f32) -> StepScale {
    let rate_frac = pow(rule.final_rate_frac, clamp(step / max(rule.n_planned_steps, 1.0), 0.0, 1.0));
    return StepScale(rate_frac, 0.0, 1.0 / (1.0 - pow(rule.betas, vec2f(step + 1.0))));
}
