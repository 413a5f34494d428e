// index_blocks: inserts the blocks of the pool into an empty table.
//
// threads   one per block
// reads     field, status (N_BLOCKS), coords [n_blocks]
// writes    status (bounds, TABLE_FULL), keys, entries
// twin      none: tests of `model` check that blocks are found again

#import field
#import field_status
#import field_insert

@group(0) @binding(0) var<uniform> field: Field;
@group(0) @binding(1) var<storage, read> coords: array<vec4i>;
@group(0) @binding(2) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(3) var<storage, read_write> keys: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> entries: array<u32>;

override WG_SIZE = 64u;
@compute @workgroup_size(WG_SIZE)
fn main(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) n_wgs: vec3u, @builtin(local_invocation_index) lane: u32) {
    let slot = (wg.y * n_wgs.x + wg.x) * WG_SIZE + lane;
    if slot >= min(atomicLoad(&status[N_BLOCKS]), field.n_block_slots) { return; } // No barrier follows this return.
    let block = coords[slot].xyz;
    let row = insert_chunk(block >> vec3u(3u));
    if row == 0u {
        atomicStore(&status[TABLE_FULL], 1u);
        atomicStore(&status[FAILED], 1u);
        return;
    }
    entries[(row - 1u) * BLOCK_VOXELS + voxel_in_block(block)] = slot + 1u;
}
