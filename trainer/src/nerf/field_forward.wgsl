// field_forward: density and color of every sample, before the exponential and the sigmoid.
//
// threads   LANES per 32 samples
// reads     batch, levels [n_levels], points [n_samples] (in the unit cube), grid [n_entries], weights, rays, spans,
//           terms [n_images, TERM_STRIDE] (of images past their end the code is zero)
// writes    told [n_samples] (logarithm of the density); where COLORS: colors [n_samples];
//           where KEEPS: held [n_tiles, n_held_rows, 8] (vec4 of four samples)
// twin      nerf/reference/field.rs
// source    Mueller et al. 2022

#import folded
#import ray_batch
#import hash_grid
#import network_tile
#import sh
#import image_terms

@group(0) @binding(0) var<storage, read> batch: Batch;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
@group(0) @binding(2) var<storage, read> points: array<vec4f>;
@group(0) @binding(3) var<storage, read> grid: array<vec2f>;
@group(0) @binding(4) var<storage, read> weights: array<vec4f>;
@group(0) @binding(5) var<storage, read> rays: array<Ray>;
@group(0) @binding(6) var<storage, read> spans: array<Span>;
@group(0) @binding(7) var<storage, read> terms: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> told: array<f32>;
@group(0) @binding(9) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(10) var<storage, read_write> held: array<vec4f>;

override N_CODE: u32;
override COLORS: bool;
override KEEPS: bool;

const NOT_KEPT = 0xffffffffu;
const N_OF_DENSITY = 2u;           // layers of the first network
const N_LAYERS = 5u;

struct ShSums {
    sample: u32,
}

fn sh_term(sums: ptr<function, ShSums>, k: u32, basis: f32, slope: vec3f) {
    put(1u + k, (*sums).sample, basis);
}

// Puts one number in the bank that the second network starts from.
fn put(row: u32, sample: u32, value: f32) {
    wg_rows[BANK + row * STRIDE + sample / 4u][sample % 4u] = value;
}

fn keep(tile: u32, row: u32, part: u32, value: vec4f) {
    held[(tile * n_held_rows() + row) * PARTS + part] = value;
}

// What the grid holds around the points, in the first bank.
fn look_up(tile: u32, lane: u32) {
    let n_levels = arrayLength(&levels);
    for (var item = lane; item < n_levels * PARTS; item += LANES) {
        let level = levels[item / PARTS];
        let part = item % PARTS;
        var found: array<vec4f, 2>;
        for (var i = 0u; i < 4u; i++) {
            let sample = tile * TILE + 4u * part + i;
            var sum = vec2f(0.0);
            if sample < batch.n_samples {
                let cell = cell_of(level, points[sample].xyz);
                for (var corner = 0u; corner < 8u; corner++) {
                    let step = step_of(corner);
                    sum += weight_of(cell, step) * grid[entry_of(level, cell.first + step)];
                }
            }
            found[0][i] = sum.x;
            found[1][i] = sum.y;
        }
        for (var feature = 0u; feature < 2u; feature++) {
            let row = 2u * (item / PARTS) + feature;
            wg_rows[row * STRIDE + part] = found[feature];
            if KEEPS { keep(tile, row, part, found[feature]); }
        }
    }
    for (var item = 2u * n_levels * PARTS + lane; item < N_FEATURES * PARTS; item += LANES) {
        wg_rows[item / PARTS * STRIDE + item % PARTS] = vec4f(0.0);
        if KEEPS { keep(tile, item / PARTS, item % PARTS, vec4f(0.0)); }
    }
}

struct Layer {
    from_bank: u32,
    first_weight: u32,
    n_in: u32,
    n_out: u32,
    kept_row: u32,         // NOT_KEPT: the last of its network, which is not cut at zero
}

fn layer_of(ix: u32) -> Layer {
    switch ix {
        case 0u: { return Layer(0u, 0u, N_FEATURES, N_HIDDEN, hidden_0_row()); }
        case 1u: { return Layer(BANK, told_weights(), N_HIDDEN, N_TOLD, NOT_KEPT); }
        case 2u: { return Layer(BANK, hidden_1_weights(), N_COLOR_IN, N_HIDDEN, hidden_1_row()); }
        case 3u: { return Layer(0u, hidden_2_weights(), N_HIDDEN, N_HIDDEN, hidden_2_row()); }
        default: { return Layer(BANK, color_weights(), N_HIDDEN, N_COLORS, NOT_KEPT); }
    }
}

// One layer, from rows of a bank to rows of the other.
fn work_out(layer: Layer, tile: u32, lane: u32) {
    let part = lane % PARTS;
    let n_words = layer.n_in / 4u;
    for (var group = lane / PARTS; group < layer.n_out / 4u; group += LANES / PARTS) {
        let row = layer.first_weight + 4u * group * n_words;
        var sums: mat4x4f; // a column a row
        for (var k = 0u; k < n_words; k++) {
            let at = layer.from_bank + 4u * k * STRIDE + part;
            let x = mat4x4f(wg_rows[at], wg_rows[at + STRIDE], wg_rows[at + 2u * STRIDE], wg_rows[at + 3u * STRIDE]);
            let w = mat4x4f(weights[row + k], weights[row + n_words + k], weights[row + 2u * n_words + k], weights[row + 3u * n_words + k]);
            sums += x * w;
        }
        for (var j = 0u; j < 4u; j++) {
            var sum = sums[j];
            if layer.kept_row != NOT_KEPT {
                sum = max(sum, vec4f(0.0));
                if KEEPS { keep(tile, layer.kept_row + 4u * group + j, part, sum); }
            }
            wg_rows[(BANK - layer.from_bank) + (4u * group + j) * STRIDE + part] = sum;
        }
    }
    workgroupBarrier(); // The rows are there before the next layer reads them, and this one has read what that overwrites.
}

fn code_of(image: u32, k: u32) -> f32 {
    let at = image * TERM_STRIDE + CODE + k;
    if at < arrayLength(&terms) { return terms[at].x; }
    return 0.0;
}

// Direction, what is handed on, and the image's code, in the second bank.
fn color_inputs(tile: u32, lane: u32) {
    for (var sample = lane; sample < TILE; sample += LANES) {
        let ix = min(tile * TILE + sample, batch.n_samples - 1u);
        let ray = rays[spans[ix].ray];
        put(0u, sample, SH_0);
        var sums = ShSums(sample);
        each_sh(&sums, ray.direction, 3u);
        for (var k = 0u; k < N_CODE; k++) { put(N_HARMONICS + N_HANDED_ON + k, sample, code_of(ray.code, k)); }
        for (var row = N_HARMONICS + N_HANDED_ON + N_CODE; row < N_COLOR_IN; row++) { put(row, sample, 0.0); }
    }
    for (var item = lane; item < N_HANDED_ON * PARTS; item += LANES) {
        let row = item / PARTS;
        wg_rows[BANK + (N_HARMONICS + row) * STRIDE + item % PARTS] = wg_rows[(1u + row) * STRIDE + item % PARTS];
    }
    workgroupBarrier(); // All inputs are there before they are read.
    if KEEPS {
        for (var item = lane; item < N_COLOR_IN * PARTS; item += LANES) {
            keep(tile, color_input_row() + item / PARTS, item % PARTS, wg_rows[BANK + item / PARTS * STRIDE + item % PARTS]);
        }
    }
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let tile = folded(wg, n_wgs);
    if tile * TILE < batch.n_samples {
        look_up(tile, lane);
        workgroupBarrier(); // The features are there before the first layer reads them.
        // A loop, so that the code of a layer is there once: it is long.
        for (var ix = 0u; ix < select(N_OF_DENSITY, N_LAYERS, COLORS); ix++) {
            if ix == N_OF_DENSITY { color_inputs(tile, lane); }
            work_out(layer_of(ix), tile, lane);
            if ix + 1u == N_OF_DENSITY {
                for (var sample = lane; sample < TILE; sample += LANES) {
                    if tile * TILE + sample < batch.n_samples { told[tile * TILE + sample] = wg_rows[sample / 4u][sample % 4u]; }
                }
            }
        }
        if COLORS {
            for (var sample = lane; sample < TILE; sample += LANES) {
                let at = sample / 4u;
                let i = sample % 4u;
                let color = vec4f(wg_rows[at][i], wg_rows[at + STRIDE][i], wg_rows[at + 2u * STRIDE][i], wg_rows[at + 3u * STRIDE][i]);
                if tile * TILE + sample < batch.n_samples { colors[tile * TILE + sample] = color; }
            }
        }
    }
}
