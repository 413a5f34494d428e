// arrange_weights: the weights of each layer in the order in which neighboring threads read them on the way there: four inputs of all
// outputs one after the other.
//
// threads   one per 4 weights
// reads     weights [n_outputs, n_inputs] of each layer
// writes    arranged [n_inputs / 4, n_outputs] of each layer (vec4 of four inputs)

#import network_tile

@group(0) @binding(0) var<storage, read> weights: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> arranged: array<vec4f>;

struct Layer {
    first_weight: u32,
    n_in: u32,
    n_out: u32,
}

fn layer_with(ix: u32) -> Layer {
    if ix < told_weights() { return Layer(0u, N_FEATURES, N_HIDDEN); }
    if ix < hidden_1_weights() { return Layer(told_weights(), N_HIDDEN, N_TOLD); }
    if ix < hidden_2_weights() { return Layer(hidden_1_weights(), N_COLOR_IN, N_HIDDEN); }
    if ix < color_weights() { return Layer(hidden_2_weights(), N_HIDDEN, N_HIDDEN); }
    return Layer(color_weights(), N_HIDDEN, N_COLORS);
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) lane: u32) {
    let ix = wg.x * LANES + lane;
    if ix >= n_weight_words() { return; }
    let layer = layer_with(ix);
    let word = ix - layer.first_weight;
    let n_words = layer.n_in / 4u;
    arranged[layer.first_weight + word % n_words * layer.n_out + word / n_words] = weights[ix];
}
