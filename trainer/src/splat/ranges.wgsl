// ranges: find where each tile's intersections begin and end, and the splat of each.
//
// threads   one per intersection, with a stride
// reads     view, status, tile_keys (sorted), slots (sorted along), slot_splats
// writes    tile_ranges [n_tiles] (cleared before), sorted_splats [n_isect]

#import view
#import status

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> slot_splats: array<u32>;
@group(0) @binding(5) var<storage, read_write> tile_ranges: array<vec2u>;
@group(0) @binding(6) var<storage, read_write> sorted_splats: array<u32>;

override WG_SIZE = 256u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let n_isect = status[N_ISECT];
    let stride = n_wgs.x * n_wgs.y * WG_SIZE;
    for (var i = folded(wg, n_wgs) * WG_SIZE + lane; i < n_isect; i += stride) {
        let tile = tile_keys[i];
        sorted_splats[i] = slot_splats[slots[i]];
        if tile >= view.n_tiles.x * view.n_tiles.y { continue; }
        if i == 0u || tile_keys[i - 1u] != tile { tile_ranges[tile].x = i; }
        if i + 1u == n_isect || tile_keys[i + 1u] != tile { tile_ranges[tile].y = i + 1u; }
    }
}
