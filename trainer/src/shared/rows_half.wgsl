// rows: inputs and outputs of layers in workgroup memory. The kernel defines a function `work`.
//
// Inputs are f16 and outputs f32, with one bank of each. A subgroup computes 16 rows of all samples. The import of the
// layers defines whether the f16 rounding error is kept (`put_residual`, `put_residuals`).

const BANK = 0u;
const HALF_STRIDE = 10u;           // like STRIDE, in vec4 of f16

var<workgroup> wg_halves: array<vec4<f16>, 640>;
var<workgroup> wg_sums: array<vec4f, 576>;
var<private> n_workgroups: u32;
var<private> subgroup: u32;
var<private> n_subgroups: u32;

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32,
    @builtin(subgroup_id) subgroup_ix: u32, @builtin(num_subgroups) n_subgroups_total: u32,
) {
    subgroup = subgroup_ix;
    n_subgroups = n_subgroups_total;
    n_workgroups = n_wgs.x * n_wgs.y;
    work(folded(wg, n_wgs), lane);
}

fn put(bank: u32, row: u32, sample: u32, value: f32) {
    let high = f16(clamp(value, -MAX_HALF, MAX_HALF));
    wg_halves[row * HALF_STRIDE + sample / 4u][sample % 4u] = high;
    put_residual(row * HALF_STRIDE + sample / 4u, sample % 4u, value - f32(high));
}

fn put_four(bank: u32, row: u32, part: u32, value: vec4f) {
    let high = narrowed(value);
    wg_halves[row * HALF_STRIDE + part] = high;
    put_residuals(row * HALF_STRIDE + part, value - vec4f(high));
}

// Inputs of a layer.
fn four(bank: u32, row: u32, part: u32) -> vec4f { return vec4f(wg_halves[row * HALF_STRIDE + part]); }

// Outputs of a layer.
fn out_four(bank: u32, row: u32, part: u32) -> vec4f { return wg_sums[row * STRIDE + part]; }

// Converts the sums of a layer into the inputs of the next one, unless it is the last of its network. Every lane must call
// it.
fn finish_layer(layer: Layer, tile: u32, n_rows: u32, lane: u32) {
    // The sums are complete before they are read, and the inputs were read before they are overwritten.
    workgroupBarrier();
    if layer.stored_row != NOT_STORED {
        for (var item = lane; item < n_rows * PARTS; item += LANES) {
            let row = item / PARTS;
            let part = item % PARTS;
            put_four(0u, row, part, layer_output(layer, tile, row, part, out_four(0u, row, part)));
        }
        // The rows are written before the next layer reads them, and the sums were read before it overwrites them.
        workgroupBarrier();
    }
}
