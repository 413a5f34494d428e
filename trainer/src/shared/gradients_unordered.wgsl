// gradients: the intersections of a splat are added to its sum in any order. For benchmarks only: results differ by
// rounding between runs.

@group(0) @binding(9) var<storage, read_write> gradients: array<atomic<f32>>; // 12 per splat, see `Gradient`

// Slot for the gradient of a tile's entry.
fn slot_of(entry: u32, tile: Tile) -> u32 {
    return entries[entry].x;
}

fn write_gradient(slot: u32, part: u32, value: f32) {
    if value != 0.0 { atomicAdd(&gradients[slot * N_PARTS_OF_GRADIENT + part], value); }
}

fn write_zero_gradient(slot: u32, part: u32) {}
