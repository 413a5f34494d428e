// update_weights: sums the gradients of the weights of all layers over the chunks of samples, and takes one Adam step.
//
// threads   256 per 16 vec4 of weights: 16 threads per vec4 share the chunks
// reads     rule, step_scale, batch, partial_sums [n_chunks, N_SUMS]
// writes    weights [n_weights], moments [n_weights / 4, 2] (first and second of 4 weights)
// twin      optim/reference.rs
// source    Kingma and Ba 2015; weight decay of Loshchilov and Hutter 2019 (AdamW)

#import ray_batch
#import adam_rule

@group(0) @binding(0) var<uniform> rule: AdamRule;
@group(0) @binding(1) var<storage, read> step_scale: StepScale;
@group(0) @binding(2) var<storage, read> batch: Batch;
@group(0) @binding(3) var<storage, read> partial_sums: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> weights: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> moments: array<vec4f>;

override CHUNK: u32;       // samples
override N_SUMS: u32;      // vec4 per chunk; those past the weights are padding

const WORDS = 16u;         // vec4 of weights per workgroup
const THREADS_PER_WEIGHT = 16u;
const MAX_ABS = 1e30;

var<workgroup> wg_sums: array<vec4f, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = wg.x * WORDS + lane % WORDS;
    let n = arrayLength(&weights);
    let n_chunks = (batch.n_samples + CHUNK - 1u) / CHUNK;
    var sum = vec4f(0.0);
    if ix < n {
        for (var chunk = lane / WORDS; chunk < n_chunks; chunk += THREADS_PER_WEIGHT) { sum += partial_sums[chunk * N_SUMS + ix]; }
    }
    wg_sums[lane] = sum;
    workgroupBarrier(); // All partial sums are written before they are added.
    if lane < WORDS && ix < n {
        var v = vec4f(0.0);
        for (var thread_ix = 0u; thread_ix < THREADS_PER_WEIGHT; thread_ix++) { v += wg_sums[thread_ix * WORDS + lane]; }
        let is_usable = abs(v) < vec4f(MAX_ABS); // Skip non-finite gradients.
        let first = select(moments[2u * ix], mix(v, moments[2u * ix], rule.betas.x), is_usable);
        let second = select(moments[2u * ix + 1u], mix(v * v, moments[2u * ix + 1u], rule.betas.y), is_usable);
        moments[2u * ix] = first;
        moments[2u * ix + 1u] = second;
        let step = first * step_scale.correction.x / (sqrt(second * step_scale.correction.y) + rule.epsilon) + rule.weight_decay * weights[ix];
        weights[ix] = select(weights[ix], weights[ix] - rule.rate * step_scale.rate_frac * step, is_usable);
    }
}
