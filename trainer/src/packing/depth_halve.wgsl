// depth_halve: nearest depth of each square of 2 x 2 pixels, and the largest of them.
//
// threads   one per square
// reads     packing, depths [n_pixels] (meters, 0: none)
// writes    halved [n_squares] (0: none), packed (FURTHEST)

#import packing
#import folded

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> depths: array<f32>;
@group(0) @binding(2) var<storage, read_write> halved: array<f32>;
@group(0) @binding(3) var<storage, read_write> packed: array<atomic<u32>>;

const NONE = 0x7f800000u;  // bits of infinity; the bits of NaN and negative numbers are larger

var<workgroup> wg_furthest: atomic<u32>;

fn bits_at(px: vec2u) -> u32 {
    let at = min(px, packing.size_px - vec2u(1u));
    let bits = bitcast<u32>(depths[at.y * packing.size_px.x + at.x]);
    return select(bits, NONE, bits == 0u);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    if lane == 0u { atomicStore(&wg_furthest, 0u); }
    workgroupBarrier(); // The maximum is zero.
    let square = folded(wg, n_wgs) * 256u + lane;
    let half_size = (packing.size_px + vec2u(1u)) / 2u;
    if square < half_size.x * half_size.y {
        let px = 2u * vec2u(square % half_size.x, square / half_size.x);
        let nearest = min(min(bits_at(px), bits_at(px + vec2u(1u, 0u))), min(bits_at(px + vec2u(0u, 1u)), bits_at(px + vec2u(1u, 1u))));
        let known = select(nearest, 0u, nearest >= NONE);
        halved[square] = bitcast<f32>(known);
        atomicMax(&wg_furthest, known);
    }
    workgroupBarrier(); // The maximum is complete.
    if lane == 0u { atomicMax(&packed[FURTHEST], atomicLoad(&wg_furthest)); }
}
