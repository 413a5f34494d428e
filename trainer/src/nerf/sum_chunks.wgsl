// sum_chunks: slopes towards the weights of a layer, over all chunks of samples, in their order.
//
// threads   one per 4 weights
// reads     partial_sums [n_chunks, n_weights]
// writes    v_weights [n_weights]

@group(0) @binding(0) var<storage, read> partial_sums: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> v_weights: array<vec4f>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = wg.x * 64u + lane;
    let n = arrayLength(&v_weights);
    if ix >= n { return; }
    var sum = vec4f(0.0);
    for (var at = ix; at < arrayLength(&partial_sums); at += n) { sum += partial_sums[at]; }
    v_weights[ix] = sum;
}
