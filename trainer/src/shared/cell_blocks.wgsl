// cell_blocks: the blocks that cells of the occupancy are told of in, behind the cells themselves.

const MAX_BLOCKS = 16u; // along an axis

// Cells of a block along an axis, of so many.
fn block_cells_of(n_cells: u32) -> u32 {
    return max(n_cells / MAX_BLOCKS, 1u);
}
