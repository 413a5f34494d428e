// end_step: counts the step, and chooses the gradient scale of each level so that sums keep 8 bits of headroom.
//
// threads   one per level
// reads     rule, largest [n_levels] of this step's sums, counts ([0]: overflowed contributions of this step)
// writes    scales [n_levels], largest (reset to zero), counts ([0]: reset to zero, [1]: total), steps, step_scale
//
// The scale of each level is a power of two, chosen from the level's largest sum.

#import adam_rule

@group(0) @binding(4) var<uniform> rule: AdamRule;
@group(0) @binding(5) var<storage, read_write> step_scale: StepScale;
@group(0) @binding(0) var<storage, read_write> scales: array<f32>;
@group(0) @binding(1) var<storage, read_write> largest: array<u32>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> steps: array<u32>;

const TARGET_BITS = 23u;   // of the largest sum, of 31
const MAX_SCALE = 1.0e30;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n_saturated = counts[0];
    if lane < arrayLength(&scales) {
        let n_bits = 32u - countLeadingZeros(largest[lane]);
        // A level without gradients keeps its scale. After an overflow, the required change is unknown.
        var change = select(exp2(f32(TARGET_BITS) - f32(n_bits)), 1.0, n_bits == 0u);
        if n_saturated > 0u { change = min(change, 1.0) / 16.0; }
        scales[lane] = clamp(scales[lane] * change, 1.0 / MAX_SCALE, MAX_SCALE);
        largest[lane] = 0u;
    }
    storageBarrier(); // All lanes have read the overflow count.
    if lane == 0u {
        counts[1] += n_saturated;
        counts[0] = 0u;
        steps[0] += 1u;
        step_scale = step_scale_at(rule, f32(steps[0]));
    }
}
