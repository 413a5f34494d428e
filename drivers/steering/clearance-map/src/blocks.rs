//! The blocks of the mapped region, which exist once something was seen in them.

use crate::block::Block;
use crate::config::{BLOCK_VOXELS, MapConfig};
use crate::grid::{Grid, VoxelIx};
use nalgebra::Vector3;

/// All blocks.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    pub(crate) grid: Grid,
    blocks: Vec<Option<Box<Block>>>,
    is_in_region: Vec<bool>,
}

impl Blocks {
    /// No blocks, around the origin of the world.
    pub(crate) fn new(config: &MapConfig) -> Self {
        let grid = Grid::around(config, &Vector3::zeros());
        let n = grid.n_blocks * grid.n_blocks * grid.n_blocks;
        Self {
            grid,
            blocks: vec![None; n],
            is_in_region: (0..n).map(|ix| is_in_region(&grid, config, ix)).collect(),
        }
    }

    /// Number of possible blocks.
    pub(crate) fn len(&self) -> usize {
        self.blocks.len()
    }

    /// Whether a block is within the mapped region.
    pub(crate) fn is_in_region(&self, ix: usize) -> bool {
        self.is_in_region[ix]
    }

    pub(crate) fn get(&self, ix: usize) -> Option<&Block> {
        self.blocks[ix].as_deref()
    }

    pub(crate) fn existing(&mut self, ix: usize) -> Option<&mut Block> {
        self.blocks[ix].as_deref_mut()
    }

    /// The block, which is made if it is within the region.
    pub(crate) fn get_or_make(&mut self, ix: usize) -> Option<&mut Block> {
        if !self.is_in_region[ix] {
            return None;
        }
        Some(self.blocks[ix].get_or_insert_with(Block::unknown))
    }

    /// The block of a voxel, which is made if it is within the region, and the index in it.
    pub(crate) fn of_voxel(&mut self, at: VoxelIx) -> Option<(&mut Block, usize)> {
        let block = self.get_or_make(at.block)?;
        Some((block, at.voxel))
    }

    pub(crate) fn clear(&mut self) {
        self.blocks.fill(None);
    }

    /// Moves the region by whole blocks, so that voxels keep their place in the world. Blocks that
    /// leave it are forgotten.
    pub(crate) fn move_to(&mut self, grid: Grid) {
        let mut moved = vec![None; self.blocks.len()];
        for (ix, block) in self.blocks.iter_mut().enumerate() {
            let at = self.grid.block_at(ix);
            let new = [0, 1, 2].map(|axis| {
                let in_world = i64::try_from(at[axis])
                    .unwrap_or(i64::MAX)
                    .saturating_add(self.grid.first_block[axis]);
                usize::try_from(in_world.saturating_sub(grid.first_block[axis])).ok()
            });
            let [Some(x), Some(y), Some(z)] = new else {
                continue;
            };
            if [x, y, z].iter().all(|block| *block < grid.n_blocks) {
                let new_ix = grid.block_ix([x, y, z]);
                if self.is_in_region[new_ix] {
                    moved[new_ix] = block.take();
                }
            }
        }
        for block in moved.iter_mut().flatten() {
            block.is_changed = true;
        }
        self.blocks = moved;
        self.grid = grid;
    }

    /// Memory of the blocks, bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.blocks.iter().flatten().count() * size_of::<Block>()
            + self.blocks.len() * size_of::<Option<Box<Block>>>()
    }
}

/// The region is a sphere, with one block more, because it only follows the base in steps.
fn is_in_region(grid: &Grid, config: &MapConfig, ix: usize) -> bool {
    let border = config.border_blocks();
    let at = grid.block_at(ix);
    let is_border = |block: &usize| *block < border || *block >= grid.n_blocks - border;
    let radius = config.radius_m / (config.voxel_m * BLOCK_VOXELS as f64) + 1.0;
    let middle = 0.5 * (grid.n_blocks as f64 - 1.0);
    let from_middle = Vector3::from(at.map(|block| block as f64 - middle));
    !at.iter().any(is_border) && from_middle.norm() <= radius
}
