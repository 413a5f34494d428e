//! A complete version of the map, as answers need it: which voxels are not free, and ages.

use crate::block::{BLOCK_CELLS, NEVER};
use crate::blocks::Blocks;
use crate::clock::MapClock;
use crate::config::BLOCK_VOXELS;
use crate::grid::Grid;

/// One bit per voxel, and one time per cell of [`crate::block::CELL_VOXELS`] voxels per side.
#[derive(Clone, Debug)]
pub(crate) struct Snapshot {
    pub(crate) grid: Grid,
    pub(crate) clock: MapClock,
    /// Rows of voxels along x, one bit each, set if the voxel is not free. See [`Grid::row`].
    pub(crate) blocked: Vec<u8>,
    /// The same for voxels in which a surface was seen; `None` if nothing asks for it.
    pub(crate) occupied: Option<Vec<u8>>,
    /// Time of the oldest free voxel of each cell, or [`NEVER`]. Order: z, y, x.
    pub(crate) oldest: Vec<u32>,
}

impl Snapshot {
    /// A map in which nothing was ever seen.
    ///
    /// * `has_surfaces`: whether surfaces are asked for.
    pub(crate) fn unknown(grid: Grid, has_surfaces: bool) -> Self {
        let side = grid.side();
        let n_bytes = side * side * grid.row_bytes();
        let n_cells = grid.n_blocks * BLOCK_CELLS;
        Self {
            grid,
            clock: MapClock::default(),
            blocked: vec![u8::MAX; n_bytes],
            occupied: has_surfaces.then(|| vec![0; n_bytes]),
            oldest: vec![NEVER; n_cells * n_cells * n_cells],
        }
    }

    /// Copies the blocks that have changed.
    pub(crate) fn update(&mut self, blocks: &mut Blocks) {
        for block_ix in 0..blocks.len() {
            let [x, y, z] = blocks.grid.block_at(block_ix);
            let Some(block) = blocks.existing(block_ix).filter(|block| block.is_changed) else {
                continue;
            };
            block.is_changed = false;
            for dz in 0..BLOCK_VOXELS {
                for dy in 0..BLOCK_VOXELS {
                    let row = self.grid.row(y * BLOCK_VOXELS + dy, z * BLOCK_VOXELS + dz);
                    self.blocked[row + x] = block.blocked_row(dy, dz);
                    if let Some(occupied) = &mut self.occupied {
                        occupied[row + x] = block.occupied_row(dy, dz);
                    }
                }
            }
            for cell_ix in 0..BLOCK_CELLS * BLOCK_CELLS * BLOCK_CELLS {
                let cell = [0, 1, 2].map(|axis| cell_ix >> axis & 1);
                let at = [x, y, z].map(|block| block * BLOCK_CELLS);
                let ix = self.cell(at[0] + cell[0], at[1] + cell[1], at[2] + cell[2]);
                self.oldest[ix] = block.oldest_free(cell);
            }
        }
    }

    /// Index of a cell.
    pub(crate) fn cell(&self, x: usize, y: usize, z: usize) -> usize {
        let side = self.grid.n_blocks * BLOCK_CELLS;
        (z * side + y) * side + x
    }
}
