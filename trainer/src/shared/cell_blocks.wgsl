// cell_blocks: blocks of occupancy cells. Their bits are stored after those of the cells.

const MAX_BLOCKS = 16u; // along an axis

// Cells per block along an axis, for a grid of `n_cells`.
fn block_cells_of(n_cells: u32) -> u32 {
    return max(n_cells / MAX_BLOCKS, 1u);
}
