// list_stale: lists the blocks whose triangles may have changed. These are the changed blocks and all their neighbors,
// whose cubes and normals read the changed voxels. The order depends on thread timing, but results do not, because
// blocks are processed independently.
//
// groups    one per block of the pool; 32 threads, 27 of which handle the block and its neighbors
// reads     field, status, coords, changed, keys, entries
// writes    is_stale [n_block_slots] (all 0 before), stale [1 + n_stale] (count, 0 before; then slots)
// twin      none: mesh/tests.rs compares an incrementally updated mesh with one built at once

#import field
#import field_status
#import field_lookup
#import folded

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<storage, read> status: array<u32>;
@group(0) @binding(2) var<storage, read> coords: array<vec4i>;
@group(0) @binding(3) var<storage, read> changed: array<u32>;
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> entries: array<u32>;
@group(0) @binding(6) var<storage, read_write> is_stale: array<atomic<u32>>;
@group(0) @binding(7) var<storage, read_write> stale: array<atomic<u32>>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = folded(wg, n_wgs);
    if at >= min(status[N_BLOCKS], field.n_block_slots) || lane >= 27u { return; } // No barrier follows this return.
    if changed[at] == 0u { return; }
    let slot = find_slot(coords[at].xyz + around(lane));
    if slot == 0u { return; }
    if atomicExchange(&is_stale[slot - 1u], 1u) == 0u {
        let ix = atomicAdd(&stale[0], 1u);
        atomicStore(&stale[1u + ix], slot - 1u);
    }
}
