//! Where voxels are: blocks of voxels around the arm's base, aligned with the world.

use crate::config::{BLOCK_VOXELS, MapConfig};
use nalgebra::Vector3;

/// Voxels per block.
pub(crate) const VOXELS_PER_BLOCK: usize = BLOCK_VOXELS * BLOCK_VOXELS * BLOCK_VOXELS;

/// A cube of blocks. Its coordinates are in voxels, from its lowest corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Grid {
    pub(crate) voxel_m: f64,
    /// Blocks per side.
    pub(crate) n_blocks: usize,
    /// Index of the lowest block, counted from the origin of the world.
    pub(crate) first_block: [i64; 3],
}

/// A voxel, as the index of its block, and its index in the block (z, then y, then x).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct VoxelIx {
    pub(crate) block: usize,
    pub(crate) voxel: usize,
}

impl Grid {
    /// The grid whose central block contains a point of the world.
    pub(crate) fn around(config: &MapConfig, center_in_world: &Vector3<f64>) -> Self {
        let n_blocks = config.n_blocks();
        let block_m = BLOCK_VOXELS as f64 * config.voxel_m;
        let first =
            |center_m: f64| to_i64((center_m / block_m).floor()) - to_i64(n_blocks as f64 / 2.0);
        Self {
            voxel_m: config.voxel_m,
            n_blocks,
            first_block: [0, 1, 2].map(|axis| first(center_in_world[axis])),
        }
    }

    /// Voxels per side.
    pub(crate) fn side(&self) -> usize {
        self.n_blocks * BLOCK_VOXELS
    }

    /// A point of the world in voxels.
    pub(crate) fn in_voxels(&self, in_world: &Vector3<f64>) -> Vector3<f64> {
        let side = BLOCK_VOXELS as f64;
        let first = self.first_block.map(|block| block as f64 * side);
        in_world / self.voxel_m - Vector3::from(first)
    }

    /// Index of a block.
    pub(crate) fn block_ix(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.n_blocks + y) * self.n_blocks + x
    }

    /// Position of a block.
    pub(crate) fn block_at(&self, ix: usize) -> [usize; 3] {
        let n = self.n_blocks;
        [ix % n, ix / n % n, ix / (n * n)]
    }

    /// The voxel with these coordinates, which must be within the grid.
    pub(crate) fn voxel(&self, at: [usize; 3]) -> VoxelIx {
        let [x, y, z] = at.map(|voxel| voxel % BLOCK_VOXELS);
        VoxelIx {
            block: self.block_ix(at.map(|voxel| voxel / BLOCK_VOXELS)),
            voxel: (z * BLOCK_VOXELS + y) * BLOCK_VOXELS + x,
        }
    }

    /// The voxel that contains a point in voxels; `None` outside.
    pub(crate) fn voxel_of(&self, point: &Vector3<f32>) -> Option<VoxelIx> {
        let side = self.side() as f32;
        let is_inside = |x: f32| x >= 0.0 && x < side;
        if !point.iter().all(|x| is_inside(*x)) {
            return None;
        }
        Some(self.voxel([floor(point.x), floor(point.y), floor(point.z)]))
    }

    /// Bytes per row of the bit field of this grid: one per block, padded to whole words.
    pub(crate) fn row_bytes(&self) -> usize {
        self.n_blocks.next_multiple_of(size_of::<u64>())
    }

    /// Index of the first byte of a row.
    pub(crate) fn row(&self, y: usize, z: usize) -> usize {
        (z * self.side() + y) * self.row_bytes()
    }
}

/// Index of a voxel or a pixel: a number that is not negative, rounded down.
#[expect(
    clippy::cast_possible_truncation,
    reason = "callers check the range; outside, the cast saturates"
)]
pub(crate) fn floor(x: f32) -> usize {
    x as usize
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "blocks of the world around a finite pose; outside, the cast saturates"
)]
fn to_i64(x: f64) -> i64 {
    x as i64
}
