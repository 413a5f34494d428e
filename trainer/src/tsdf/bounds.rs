//! Approximate bounds of a distance field.

use super::block::{BLOCK_EDGE, GridCoord};
use super::chosen_grid::VoxelGrid;
use crate::Bounds;

/// Bounds around the blocks of a field. `None` without blocks.
pub(super) fn bounds<'a>(
    blocks: impl Iterator<Item = &'a GridCoord>,
    voxel_grid: &VoxelGrid,
) -> Option<Bounds> {
    let centers_m: Vec<_> = blocks.map(|block| center_m(block, voxel_grid)).collect();
    Bounds::of_points(&centers_m)
}

/// Center of a block in world, meters.
fn center_m(block: &GridCoord, voxel_grid: &VoxelGrid) -> [f64; 3] {
    let coordinate =
        |axis: usize| (f64::from(block[axis]) + 0.5) * f64::from(BLOCK_EDGE) * voxel_grid.voxel_m;
    [0, 1, 2].map(|axis| voxel_grid.anchor_m[axis] + coordinate(axis))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn block_bounds_follow_the_lattice() {
        let voxel_grid = VoxelGrid {
            voxel_m: 0.125,
            truncation_m: 0.5,
            scale_m: 0.5,
            noise_per_m2: 0.0,
            max_depth_m: 9.0,
            max_weight: 1,
            anchor_m: [10.0, 0.0, -1.0],
        };
        let bounds = bounds([[0, 0, 0], [1, 0, 0], [2, 0, 0]].iter(), &voxel_grid).expect("blocks");
        assert_eq!(bounds.center_m, [11.5, 0.5, -0.5]);
        assert_eq!(bounds.radius_m, 1.0);
    }
}
