// contribute: add each splat's contribution to one picture, the sum of its blending weights.
//
// threads   256 per block of 256 splats
// reads     model, status, tile_counts, slot_begins, gradients (from a `backward` pass with an error of one at every pixel)
// writes    contributions [n_splats] (accumulated)
// source    contributions as in Fan et al. 2024 (LightGaussian) and Fang and Wang 2024 (Mini-Splatting), summed over views

#import view
#import model
#import gradient
#import status

@group(0) @binding(0) var<uniform> model: Model;
@group(0) @binding(1) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(2) var<storage, read> slot_begins: array<u32>;
@group(0) @binding(3) var<storage, read> gradients: array<Gradient>;
@group(0) @binding(4) var<storage, read_write> contributions: array<f32>;
@group(0) @binding(5) var<storage, read> status: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let splat_ix = folded(wg, n_wgs) * 256u + lane;
    if splat_ix >= model.n_splats || status[FAILED] != 0u { return; } // Allowed here: no barrier below.
    let begin = slot_begins[splat_ix];
    var sum = 0.0;
    for (var slot = begin; slot < begin + tile_counts[splat_ix]; slot++) { sum += gradients[slot].conic.w; }
    contributions[splat_ix] += sum;
}
