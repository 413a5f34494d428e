// jpeg_transform: color conversion, discrete cosine transform and quantization of 8 x 8 pixels.
//
// threads   64 per MCU (8 x 8 pixels), one per pixel
// reads     packing, pixels [n_pixels] (rgba8), tables (see tables.rs)
// writes    coefficients [n_mcus, 3, 64] in zigzag order, non_zero [n_mcus, 3, 2] (bit masks of the coefficients)
// source    ITU-T T.81, sections A.3.3 and A.3.4; colors of JFIF (ITU-T T.871)

#import packing
#import folded

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> pixels: array<u32>;
@group(0) @binding(2) var<storage, read> tables: array<f32>;
@group(0) @binding(3) var<storage, read_write> coefficients: array<i32>;
@group(0) @binding(4) var<storage, read_write> non_zero: array<u32>;

const BASIS = 0u;          // offsets in `tables`
const QUANTIZERS = 64u;    // reciprocals: luminance, chrominance
const ZIGZAG = 192u;

var<workgroup> wg_samples: array<vec3f, 64>;
var<workgroup> wg_rows: array<vec3f, 64>;
var<workgroup> wg_masks: array<atomic<u32>, 6>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let mcu = folded(wg, n_wgs);
    let column = lane % 8u;
    let row = lane / 8u;
    // Pixels beyond the edge repeat the last pixel.
    let at = min(8u * vec2u(mcu % packing.n_mcus.x, mcu / packing.n_mcus.x) + vec2u(column, row), packing.size_px - vec2u(1u));
    let pixel = pixels[at.y * packing.size_px.x + at.x];
    let rgb = vec3f(vec3u(pixel & 255u, (pixel >> 8u) & 255u, (pixel >> 16u) & 255u));
    wg_samples[lane] = vec3f(
        dot(rgb, vec3f(0.299, 0.587, 0.114)) - 128.0,
        dot(rgb, vec3f(-0.168736, -0.331264, 0.5)),
        dot(rgb, vec3f(0.5, -0.418688, -0.081312)),
    );
    if lane < 6u { atomicStore(&wg_masks[lane], 0u); }
    workgroupBarrier(); // The samples are written.
    var sum = vec3f(0.0);
    for (var x = 0u; x < 8u; x++) { sum += tables[BASIS + 8u * column + x] * wg_samples[8u * row + x]; }
    wg_rows[lane] = sum;
    workgroupBarrier(); // The rows are transformed.
    sum = vec3f(0.0);
    for (var y = 0u; y < 8u; y++) { sum += tables[BASIS + 8u * row + y] * wg_rows[8u * y + column]; }
    let quantizers = vec3f(tables[QUANTIZERS + lane], vec2f(tables[QUANTIZERS + 64u + lane]));
    let quantized = vec3i(clamp(round(sum * quantizers), vec3f(-1023.0), vec3f(1023.0)));
    let order = u32(tables[ZIGZAG + lane]);
    let is_mcu = mcu < packing.n_mcus.x * packing.n_mcus.y;
    for (var color = 0u; color < 3u; color++) {
        if is_mcu { coefficients[(3u * mcu + color) * 64u + order] = quantized[color]; }
        if quantized[color] != 0 { atomicOr(&wg_masks[2u * color + order / 32u], 1u << (order % 32u)); }
    }
    workgroupBarrier(); // The masks are complete.
    if is_mcu && lane < 6u { non_zero[6u * mcu + lane] = atomicLoad(&wg_masks[lane]); }
}
