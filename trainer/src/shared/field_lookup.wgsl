// field_lookup: finds chunks and blocks of a field that is not modified concurrently.
//
// needs     field, keys and entries as plain arrays

// Returns the row of a chunk plus one, or 0 if there is no such chunk.
fn find_row(chunk: vec3i) -> u32 {
    if !chunk_in_range(chunk) { return 0u; }
    let key = key_of(chunk);
    var at = hash_of(key) & (field.n_chunk_slots - 1u);
    for (var probe = 0u; probe < MAX_PROBES; probe++) {
        let there = keys[at];
        if there == key { return at + 1u; }
        if there == 0u { return 0u; }
        at = (at + 1u) & (field.n_chunk_slots - 1u);
    }
    return 0u;
}

// Returns the slot of a block plus one, or 0 if there is no such block. `row` is the row of its chunk plus one.
fn slot_in_row(row: u32, block: vec3i) -> u32 {
    if row == 0u { return 0u; }
    return entries[(row - 1u) * BLOCK_VOXELS + voxel_in_block(block)];
}

// Returns the slot of a block plus one, or 0 if there is no such block.
fn find_slot(block: vec3i) -> u32 {
    return slot_in_row(find_row(block >> vec3u(3u)), block);
}

// Offset of neighbor 0 to 26 from a block, in blocks; 13 is the block itself.
fn around(ix: u32) -> vec3i {
    return vec3i(vec3u(ix % 3u, ix / 3u % 3u, ix / 9u)) - 1;
}
