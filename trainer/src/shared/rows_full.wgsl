// rows: inputs and outputs of layers in workgroup memory. The kernel defines a function `work`.
//
// Layers alternate between two banks of rows: they read from one and write to the other. Within a layer, a thread
// computes four rows of four samples.

const BANK = 576u;                 // start of the second bank: 64 strides

var<private> n_workgroups: u32;
var<workgroup> wg_rows: array<vec4f, 1152>;

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    n_workgroups = n_wgs.x * n_wgs.y;
    work(folded(wg, n_wgs), lane);
}

fn put(bank: u32, row: u32, sample: u32, value: f32) {
    wg_rows[bank + row * STRIDE + sample / 4u][sample % 4u] = value;
}

fn put_four(bank: u32, row: u32, part: u32, value: vec4f) { wg_rows[bank + row * STRIDE + part] = value; }

// Inputs of a layer.
fn four(bank: u32, row: u32, part: u32) -> vec4f { return wg_rows[bank + row * STRIDE + part]; }

// Outputs of a layer.
fn out_four(bank: u32, row: u32, part: u32) -> vec4f { return wg_rows[bank + row * STRIDE + part]; }
