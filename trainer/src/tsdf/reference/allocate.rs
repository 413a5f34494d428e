//! Twin of `allocate_blocks.wgsl`. The twin finds the blocks that a ray crosses by a different
//! method. It sorts the positions at which the ray passes block faces.

use super::readings::{Reading, ray_of};
use crate::tsdf::block::GridCoord;
use crate::tsdf::chosen_grid::VoxelGrid;
use keyframe::DepthMap;
use nalgebra::{Point3, Vector3};
use std::collections::BTreeSet;

/// The blocks that one depth image requires.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RequiredBlocks {
    /// Blocks that the ray crosses over a length of at least `margin`.
    pub definite: BTreeSet<GridCoord>,
    /// Blocks that the ray crosses, or that are closer to it than `margin`.
    pub possible: BTreeSet<GridCoord>,
}

impl VoxelGrid {
    /// Truncation distance for a reading at this depth, meters.
    pub fn truncation_at(&self, depth_m: f64) -> f64 {
        (3.0 * self.noise_per_m2 * depth_m * depth_m).clamp(self.truncation_m, self.scale_m)
    }
}

/// Returns the blocks to allocate. `margin` is the tolerance for rounding, in blocks.
#[expect(
    clippy::cast_possible_truncation,
    reason = "coordinates are rounded down on purpose"
)]
pub fn required_blocks(
    depth: &DepthMap,
    readings: &[Reading],
    voxel_grid: &VoxelGrid,
    margin: f64,
) -> RequiredBlocks {
    let field_from_depth = voxel_grid.field_from_world() * depth.world_from_camera;
    let width = depth.size_px[0] as usize;
    let block_m = 8.0 * voxel_grid.voxel_m;
    // The kernel rounds in f32, so it may add or miss blocks that a ray hardly touches. The twin
    // therefore distinguishes blocks that the kernel must allocate from blocks that it may
    // allocate.
    let mut required = RequiredBlocks::default();
    for (ix, reading) in readings
        .iter()
        .enumerate()
        .filter(|(_, reading)| reading.depth_m > 0.0)
    {
        let ray = ray_of(
            depth,
            [(ix % width) as f64 + 0.5, (ix / width) as f64 + 0.5],
        );
        // The truncation is converted from a depth along z to the longer distance along the ray.
        let band_m = voxel_grid.truncation_at(reading.depth_m) / ray.norm();
        let at = |z: f64| (field_from_depth * Point3::from(ray * z)).coords / block_m;
        let begin = at((reading.depth_m - band_m).max(0.0));
        let end = at(reading.depth_m + band_m);
        for (enter, leave) in intervals(&begin, &end) {
            let middle = begin + (end - begin) * (0.5 * (enter + leave));
            let block_coord: GridCoord = middle.map(|along| along.floor() as i32).into();
            if (leave - enter) * (end - begin).norm() > margin
                && is_clear_of_faces(&middle, margin / 8.0)
            {
                required.definite.insert(block_coord);
            }
            // Near a face, rounding may move the ray to the neighbor.
            for share in [enter, leave] {
                let point = begin + (end - begin) * share;
                for ix in 0..27 {
                    let offset = Vector3::new(ix % 3 - 1, ix / 3 % 3 - 1, ix / 9 - 1)
                        .map(f64::from)
                        * margin;
                    required
                        .possible
                        .insert((point + offset).map(|along| along.floor() as i32).into());
                }
            }
            required.possible.insert(block_coord);
        }
    }
    required
}

/// Whether a point is farther than `margin` from every face of the blocks.
fn is_clear_of_faces(point: &Vector3<f64>, margin: f64) -> bool {
    point
        .iter()
        .all(|along| (margin..1.0 - margin).contains(&(along - along.floor())))
}

/// Intervals between the faces that a line passes, as fractions of the line's length.
fn intervals(begin: &Vector3<f64>, end: &Vector3<f64>) -> Vec<(f64, f64)> {
    let mut cuts = vec![0.0, 1.0];
    for axis in 0..3 {
        let low = begin[axis].min(end[axis]);
        let high = begin[axis].max(end[axis]);
        let mut face = low.floor() + 1.0;
        while face < high {
            cuts.push((face - begin[axis]) / (end[axis] - begin[axis]));
            face += 1.0;
        }
    }
    cuts.sort_by(f64::total_cmp);
    cuts.windows(2).map(|pair| (pair[0], pair[1])).collect()
}
