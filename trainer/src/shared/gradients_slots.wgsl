// gradients: each intersection of splat and tile has its own slot, written once; `update` adds a splat's slots in
// order.

@group(0) @binding(9) var<storage, read_write> gradients: array<f32>; // 12 per slot, see `Gradient`

// Slot for the gradient of a tile's entry.
fn slot_of(entry: u32, tile: Tile) -> u32 {
    return entries[entry].z + countOneBits(entries[entry].y & ((1u << tile.in_bin) - 1u));
}

fn write_gradient(slot: u32, part: u32, value: f32) {
    gradients[slot * N_PARTS_OF_GRADIENT + part] = value;
}

// Splats hidden in a tile have no gradient, but their slot is read.
fn write_zero_gradient(slot: u32, part: u32) {
    gradients[slot * N_PARTS_OF_GRADIENT + part] = 0.0;
}
