// update_grid: one Adam step for the grid entries with a gradient, and the largest sum of each level.
//
// threads   one per entry
// reads     rule, step_scale, levels [n_levels], scales [n_levels]
// writes    grid, moments [n_entries] (two first, two second), v_grid (reset to zero), largest [n_levels]
// twin      optim/reference.rs
// source    Mueller et al. 2022, section 4 (entries without a gradient stay unchanged)

#import folded
#import hash_grid
#import adam_rule

@group(0) @binding(0) var<uniform> rule: AdamRule;
@group(0) @binding(1) var<storage, read> step_scale: StepScale;
@group(0) @binding(2) var<storage, read> levels: array<Level>;
@group(0) @binding(3) var<storage, read> scales: array<f32>;
@group(0) @binding(4) var<storage, read_write> grid: array<vec2f>;
@group(0) @binding(5) var<storage, read_write> moments: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> v_grid: array<vec2i>;
@group(0) @binding(7) var<storage, read_write> largest: array<atomic<u32>>;

const MAX_LEVELS = 16u;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = folded(wg, n_wgs) * 256u + lane;
    if ix >= arrayLength(&grid) { return; }
    let sum = v_grid[ix];
    if all(sum == vec2i(0)) { return; }
    v_grid[ix] = vec2i(0);
    var level = 0u;
    for (var step = MAX_LEVELS / 2u; step > 0u; step /= 2u) {
        let above = min(level + step, arrayLength(&levels) - 1u);
        if ix >= levels[above].begin { level = above; }
    }
    let max_abs = max(abs(sum.x), abs(sum.y));
    atomicMax(&largest[level], u32(max_abs)); // A maximum does not depend on the order.
    let v = vec2f(sum) / scales[level];
    let moment = mix(vec4f(v, v * v), moments[ix], rule.betas.xxyy);
    moments[ix] = moment;
    let corrected = moment * step_scale.correction.xxyy;
    grid[ix] -= rule.rate * step_scale.rate_frac * corrected.xy / (sqrt(corrected.zw) + rule.epsilon);
}
