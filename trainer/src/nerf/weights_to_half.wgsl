// weights_to_half: converts the weights of all layers to f16 for cooperative matrices, with zeros for padding outputs.
// The f16 rounding errors of all weights follow the weights.
//
// threads   one per four weights
// reads     weights [n_weights / 4]
// writes    half_weights [2, n_padded_weights / 4]

#import number

@group(0) @binding(0) var<storage, read> weights: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> half_weights: array<Four>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let n = arrayLength(&half_weights) / 2u;
    if id.x < n {
        var four = vec4f(0.0);
        if id.x < arrayLength(&weights) { four = weights[id.x]; }
        let high = narrowed(four);
        half_weights[id.x] = high;
        half_weights[n + id.x] = narrowed(four - vec4f(high));
    }
}
