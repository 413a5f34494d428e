// depth_counts: quantize the halved depths to 16 bits; the largest depth becomes 65535.
//
// threads   one per pair of squares
// reads     packing, halved [n_squares] (meters, 0: none), packed (FURTHEST)
// writes    depth_counts [n_squares / 2, rounded up] (two counts per word, the first in the low bits; 0: none)

#import packing
#import folded

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> halved: array<f32>;
@group(0) @binding(2) var<storage, read> packed: array<u32>;
@group(0) @binding(3) var<storage, read_write> depth_counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let pair = folded(wg, n_wgs) * 256u + lane;
    let half_size = (packing.size_px + vec2u(1u)) / 2u;
    let n_squares = half_size.x * half_size.y;
    if 2u * pair >= n_squares { return; } // Allowed here: no barrier below.
    let furthest = bitcast<f32>(packed[FURTHEST]);
    var word = 0u;
    for (var i = 0u; i < 2u; i++) {
        if 2u * pair + i >= n_squares { continue; }
        let depth = halved[2u * pair + i];
        let count = clamp(u32(depth / furthest * 65535.0 + 0.5), 1u, 65535u);
        word |= select(0u, count, depth > 0.0) << (16u * i);
    }
    depth_counts[pair] = word;
}
