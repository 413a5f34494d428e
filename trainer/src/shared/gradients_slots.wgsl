// gradients: each intersection of splat and tile has a slot of its own, written once; `update` adds a splat's in order.

@group(0) @binding(9) var<storage, read_write> gradients: array<f32>; // 12 a slot, see `Gradient`

// Where the gradients of a tile's entry go.
fn slot_of(entry: u32, tile: Tile) -> u32 {
    return entries[entry].z + countOneBits(entries[entry].y & ((1u << tile.in_bin) - 1u));
}

fn write_gradient(slot: u32, part: u32, value: f32) {
    gradients[slot * N_PARTS_OF_GRADIENT + part] = value;
}

// What is hidden in its tile has nothing to tell, but its slot is read.
fn write_zero_gradient(slot: u32, part: u32) {
    gradients[slot * N_PARTS_OF_GRADIENT + part] = 0.0;
}
