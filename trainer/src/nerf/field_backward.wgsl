// field_backward: backpropagates the gradients of densities and colors through all layers to the grid entries. Grid
// gradients are summed as integers, so their order does not matter.
//
// threads   LANES per 32 samples
// reads     batch, levels [n_levels], points, weights, activations [n_tiles, n_activation_rows, 8], v_log_density
//           [n_samples], v_colors [n_samples], scales [n_levels] (powers of two)
// writes    v_activations [n_tiles, n_gradient_rows, 8], v_grid [n_entries, 2] (gradient times scale), counts: [0]
//           saturated contributions
// twin      nerf/reference/field.rs, nerf/reference/grid.rs

#import number
#import folded
#import ray_batch
#import hash_grid
#import network_tile
#import rows
#import backward_layer

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> weights: array<Four>;
@group(0) @binding(4) var<storage, read> activations: array<Four>;
@group(0) @binding(5) var<storage, read> v_log_density: array<f32>;
@group(0) @binding(6) var<storage, read> v_colors: array<vec4f>;
@group(0) @binding(7) var<storage, read> scales: array<f32>;
@group(0) @binding(8) var<storage, read_write> v_activations: array<Four>;
@group(0) @binding(9) var<storage, read_write> v_grid: array<atomic<i32>>;
@group(0) @binding(10) var<storage, read_write> counts: array<atomic<u32>>;

// Largest contribution. 2^7 contributions of this size fit into a sum.
const MAX_ABS = 16777216.0;
const NO_RELU = 0xffffffffu;
const NOT_STORED = 0xffffffffu;
const N_COLOR_LAYERS = 3u;             // layers of the second network
const N_LAYERS = 5u;

fn store_activation(tile: u32, row: u32, part: u32, value: vec4f) {
    v_activations[(tile * n_gradient_rows() + row) * PARTS + part] = narrowed(value);
}

struct Layer {
    from_bank: u32,
    first_weight: u32,
    n_in: u32,
    n_out: u32,
    relu_row: u32,          // row of the layer's inputs if a ReLU was applied to them, else NO_RELU
    stored_row: u32,         // NOT_STORED if the gradients are not needed later
}

// Layers in backward order.
fn layer_of(ix: u32) -> Layer {
    switch ix {
        case 0u: { return Layer(0u, color_weights(), N_HIDDEN, N_COLORS, hidden_2_row(), v_hidden_2_row()); }
        case 1u: { return Layer(BANK, hidden_2_weights(), N_HIDDEN, N_HIDDEN, hidden_1_row(), v_hidden_1_row()); }
        case 2u: { return Layer(0u, hidden_1_weights(), N_COLOR_IN, N_HIDDEN, NO_RELU, NOT_STORED); }
        case 3u: { return Layer(0u, density_out_weights(), N_HIDDEN, N_DENSITY_OUT, hidden_0_row(), 0u); }
        default: { return Layer(BANK, 0u, N_FEATURES, N_HIDDEN, NO_RELU, v_features_row()); }
    }
}

// Gradients with respect to a layer's inputs, backpropagated through the ReLU of the inputs.
fn layer_output(layer: Layer, tile: u32, row: u32, part: u32, sum: vec4f) -> vec4f {
    var v = sum;
    if layer.relu_row != NO_RELU {
        let activation = activations[(tile * n_activation_rows() + layer.relu_row + row) * PARTS + part];
        v = select(vec4f(0.0), v, activation > Four());
    }
    if layer.stored_row != NOT_STORED { store_activation(tile, layer.stored_row + row, part, v); }
    return v;
}

// Loads the gradients from compositing into the first bank.
fn seed_color_gradients(tile: u32, lane: u32) {
    for (var item = lane; item < N_COLORS * PARTS; item += LANES) {
        let row = item / PARTS;
        let part = item % PARTS;
        var v = vec4f(0.0);
        for (var i = 0u; i < 4u; i++) {
            let sample = tile * TILE + 4u * part + i;
            if sample < batch.n_samples && row < 4u { v[i] = v_colors[sample][row] * gradient_scale(batch.n_rays); }
        }
        put_four(0u, row, part, v);
        store_activation(tile, v_color_row() + row, part, v);
    }
    workgroupBarrier(); // The gradients are written before the last layer reads them.
}

// Loads the gradients of density and geometry features into the first bank.
fn seed_density_gradients(tile: u32, lane: u32) {
    for (var item = lane; item < N_DENSITY_OUT * PARTS; item += LANES) {
        let row = item / PARTS;
        let part = item % PARTS;
        var v = vec4f(0.0);
        if row == 0u {
            for (var i = 0u; i < 4u; i++) {
                let sample = tile * TILE + 4u * part + i;
                if sample < batch.n_samples { v[i] = v_log_density[sample] * gradient_scale(batch.n_rays); }
            }
        } else {
            v = out_four(BANK, N_HARMONICS - 1u + row, part);
        }
        put_four(0u, row, part, v);
        store_activation(tile, v_density_out_row() + row, part, v);
    }
    workgroupBarrier(); // The gradients are written before the layer reads them.
}

fn add(entry: u32, gradient: vec2f) {
    for (var feature = 0u; feature < 2u; feature++) {
        let value = gradient[feature];
        if !(abs(value) < MAX_ABS) {
            atomicAdd(&counts[0], 1u);
        } else if value != 0.0 {
            atomicAdd(&v_grid[2u * entry + feature], i32(round(value)));
        }
    }
}

// Scatters gradients from the first bank to the grid. Of four adjacent samples, those in the same cell are summed
// first.
fn scatter(tile: u32, lane: u32) {
    for (var item = lane; item < arrayLength(&levels) * PARTS; item += LANES) {
        let level_ix = item / PARTS;
        let level = levels[level_ix];
        let part = item % PARTS;
        let scale = scales[level_ix] / gradient_scale(batch.n_rays);
        let v_0 = out_four(0u, 2u * level_ix, part) * scale;
        let v_1 = out_four(0u, 2u * level_ix + 1u, part) * scale;
        let first = tile * TILE + 4u * part;
        if first >= batch.n_samples { continue; }
        let n = min(4u, batch.n_samples - first);
        var cell = cell_of(level, points[first].xyz);
        var sums: array<vec2f, 8>;
        for (var i = 0u; i < n; i++) {
            for (var corner = 0u; corner < 8u; corner++) { sums[corner] += weight_of(cell, step_of(corner)) * vec2f(v_0[i], v_1[i]); }
            let here = cell.first;
            if i + 1u < n { cell = cell_of(level, points[first + i + 1u].xyz); }
            if i + 1u == n || any(cell.first != here) {
                for (var corner = 0u; corner < 8u; corner++) {
                    add(entry_of(level, here + step_of(corner)), sums[corner]);
                    sums[corner] = vec2f(0.0);
                }
            }
        }
    }
}

fn work(tile: u32, lane: u32) {
    if tile * TILE < batch.n_samples {
        seed_color_gradients(tile, lane);
        // The loop avoids several copies of the long code of a layer.
        for (var ix = 0u; ix < N_LAYERS; ix++) {
            if ix == N_COLOR_LAYERS { seed_density_gradients(tile, lane); }
            evaluate_layer(layer_of(ix), tile, lane);
        }
        scatter(tile, lane);
    }
}
