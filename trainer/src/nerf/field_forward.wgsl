// field_forward: density and color of every sample, before the exponential and the sigmoid.
//
// threads   LANES per 32 samples; workgroups loop if there are more samples
// reads     batch, levels [n_levels], grid [n_entries], weights, spans; if DENSITY: points [n_samples] (in the unit
//           cube); if COLORS: rays, image_params [n_images, IMAGE_PARAM_STRIDE] (the embedding of images past the end is
//           zero); if COLORS and not DENSITY: geometry of each span's `sample`
// writes    if DENSITY: log_density [n_samples]; if STORE_GEOMETRY: geometry [n_samples, 4] (outputs of the
//           density network); if COLORS: colors [n_samples]; if STORE_ACTIVATIONS: activations [n_tiles, n_activation_rows, 8]
//           (four samples)
// twin      nerf/reference/field.rs
// source    Mueller et al. 2022

#import number
#import folded
#import ray_batch
#import hash_grid
#import grid_entries
#import network_tile
#import rows
#import forward_layer
#import sh
#import image_params

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> grid: array<Entry>;
@group(0) @binding(4) var<storage, read> weights: array<Four>;
@group(0) @binding(5) var<storage, read> rays: array<Ray>;
@group(0) @binding(6) var<storage, read> spans: array<Span>;
@group(0) @binding(7) var<storage, read> image_params: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> log_density: array<f32>;
@group(0) @binding(9) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(10) var<storage, read_write> activations: array<Four>;
@group(0) @binding(11) var<storage, read_write> geometry: array<Four>;

override EMBEDDING_DIM: u32;
override DENSITY: bool;
override COLORS: bool;
override STORE_ACTIVATIONS: bool;
override STORE_GEOMETRY: bool;

const NOT_STORED = 0xffffffffu;
const N_DENSITY_LAYERS = 2u;           // layers of the first network
const N_LAYERS = 5u;

struct ShSums {
    sample: u32,
}

fn add_sh_term(sums: ptr<function, ShSums>, k: u32, basis: f32, gradient: vec3f) {
    put(BANK, 1u + k, (*sums).sample, basis);
}

fn store_activation(tile: u32, row: u32, part: u32, value: vec4f) {
    activations[(tile * n_activation_rows() + row) * PARTS + part] = narrowed(value);
}

// Stores rows of a bank that are inputs of a layer.
fn store_inputs(tile: u32, bank: u32, first_row: u32, n_rows: u32, lane: u32) {
    for (var item = lane; item < n_rows * PARTS; item += LANES) {
        let row = item / PARTS;
        store_activation(tile, first_row + row, item % PARTS, four(bank, row, item % PARTS));
    }
}

// Interpolates grid features at the points into the first bank. Neighboring threads process neighboring samples of one
// level, which share the cells of coarse levels.
fn interpolate_features(tile: u32, lane: u32) {
    let n_levels = arrayLength(&levels);
    for (var item = lane; item < n_levels * TILE; item += LANES) {
        let level_ix = item / TILE;
        let level = levels[level_ix];
        let sample = item % TILE;
        var sum = vec2f(0.0);
        if tile * TILE + sample < batch.n_samples {
            let cell = cell_of(level, points[tile * TILE + sample].xyz);
            for (var corner = 0u; corner < 8u; corner++) {
                let step = step_of(corner);
                sum += weight_of(cell, step) * entry_value(grid[entry_of(level, cell.first + step)]);
            }
        }
        put(0u, 2u * level_ix, sample, sum.x);
        put(0u, 2u * level_ix + 1u, sample, sum.y);
    }
    for (var item = 2u * n_levels * PARTS + lane; item < N_FEATURES * PARTS; item += LANES) {
        put_four(0u, item / PARTS, item % PARTS, vec4f(0.0));
    }
    workgroupBarrier(); // The features are written before they are read.
    if STORE_ACTIVATIONS { store_inputs(tile, 0u, 0u, N_FEATURES, lane); }
}

struct Layer {
    from_bank: u32,
    first_weight: u32,
    n_in: u32,
    n_out: u32,
    stored_row: u32,         // NOT_STORED: the last layer of its network, without a ReLU
}

fn layer_of(ix: u32) -> Layer {
    switch ix {
        case 0u: { return Layer(0u, 0u, N_FEATURES, N_HIDDEN, hidden_0_row()); }
        case 1u: { return Layer(BANK, density_out_weights(), N_HIDDEN, N_DENSITY_OUT, NOT_STORED); }
        case 2u: { return Layer(BANK, hidden_1_weights(), N_COLOR_IN, N_HIDDEN, hidden_1_row()); }
        case 3u: { return Layer(0u, hidden_2_weights(), N_HIDDEN, N_HIDDEN, hidden_2_row()); }
        default: { return Layer(BANK, color_weights(), N_HIDDEN, N_COLORS, NOT_STORED); }
    }
}

// Outputs of a layer, after its ReLU.
fn layer_output(layer: Layer, tile: u32, row: u32, part: u32, sum: vec4f) -> vec4f {
    if layer.stored_row == NOT_STORED { return sum; }
    let cut = max(sum, vec4f(0.0));
    if STORE_ACTIVATIONS { store_activation(tile, layer.stored_row + row, part, cut); }
    return cut;
}

fn embedding_of(image: u32, k: u32) -> f32 {
    let at = image * IMAGE_PARAM_STRIDE + EMBEDDING + k;
    if at < arrayLength(&image_params) { return image_params[at].x; }
    return 0.0;
}

// Stores the outputs of the first network, sample by sample.
fn store_geometry(tile: u32, lane: u32) {
    for (var item = lane; item < TILE * 4u; item += LANES) {
        let sample = item / 4u;
        var four: vec4f;
        for (var k = 0u; k < 4u; k++) { four[k] = out_four(0u, 4u * (item % 4u) + k, sample / 4u)[sample % 4u]; }
        if tile * TILE + sample < batch.n_samples { geometry[4u * tile * TILE + item] = narrowed(four); }
    }
}

// Loads the geometry features of the samples, which an earlier dispatch stored, into the second bank.
fn load_geometry(tile: u32, lane: u32) {
    for (var item = lane; item < TILE * 4u; item += LANES) {
        let ix = min(tile * TILE + item / 4u, batch.n_samples - 1u);
        let four = vec4f(geometry[4u * spans[ix].sample + item % 4u]);
        for (var k = 0u; k < 4u; k++) {
            let output = 4u * (item % 4u) + k; // 0 is the density
            if output > 0u { put(BANK, N_HARMONICS + output - 1u, item / 4u, four[k]); }
        }
    }
}

// Loads direction, geometry features and the image's embedding into the second bank.
fn gather_color_inputs(tile: u32, lane: u32) {
    for (var sample = lane; sample < TILE; sample += LANES) {
        let ix = min(tile * TILE + sample, batch.n_samples - 1u);
        let ray = rays[spans[ix].ray];
        put(BANK, 0u, sample, SH_0);
        var sums = ShSums(sample);
        each_sh(&sums, ray.direction, 3u);
        for (var k = 0u; k < EMBEDDING_DIM; k++) { put(BANK, N_HARMONICS + N_GEOMETRY_FEATURES + k, sample, embedding_of(ray.embedding, k)); }
        for (var row = N_HARMONICS + N_GEOMETRY_FEATURES + EMBEDDING_DIM; row < N_COLOR_IN; row++) { put(BANK, row, sample, 0.0); }
    }
    if DENSITY {
        for (var item = lane; item < N_GEOMETRY_FEATURES * PARTS; item += LANES) {
            let row = item / PARTS;
            put_four(BANK, N_HARMONICS + row, item % PARTS, out_four(0u, 1u + row, item % PARTS));
        }
    } else {
        load_geometry(tile, lane);
    }
    workgroupBarrier(); // All inputs are written before they are read.
    if STORE_ACTIVATIONS { store_inputs(tile, BANK, color_input_row(), N_COLOR_IN, lane); }
}

fn work(first_tile: u32, lane: u32) {
    for (var tile = first_tile; tile * TILE < batch.n_samples; tile += n_workgroups) {
        if DENSITY { interpolate_features(tile, lane); }
        // The loop avoids several copies of the long code of a layer.
        for (var ix = select(N_DENSITY_LAYERS, 0u, DENSITY); ix < select(N_DENSITY_LAYERS, N_LAYERS, COLORS); ix++) {
            if ix == N_DENSITY_LAYERS { gather_color_inputs(tile, lane); }
            evaluate_layer(layer_of(ix), tile, lane);
            if ix + 1u == N_DENSITY_LAYERS {
                for (var sample = lane; sample < TILE; sample += LANES) {
                    if tile * TILE + sample < batch.n_samples { log_density[tile * TILE + sample] = out_four(0u, 0u, sample / 4u)[sample % 4u]; }
                }
                if STORE_GEOMETRY { store_geometry(tile, lane); }
            }
        }
        if COLORS {
            for (var sample = lane; sample < TILE; sample += LANES) {
                var color: vec4f;
                for (var row = 0u; row < 4u; row++) { color[row] = out_four(0u, row, sample / 4u)[sample % 4u]; }
                if tile * TILE + sample < batch.n_samples { colors[tile * TILE + sample] = color; }
            }
        }
        workgroupBarrier(); // The outputs are read before the next tile overwrites them.
    }
}
