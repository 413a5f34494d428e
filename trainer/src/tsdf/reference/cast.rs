//! Twin of `cast_rays.wgsl`. Finds the first crossing from outside to inside with small constant
//! steps.

use crate::tsdf::block::{Blocks, block_of, voxel_ix};
use crate::tsdf::chosen_grid::VoxelGrid;
use model_files::Edits;
use nalgebra::{Point3, Vector3};

/// Length of a step, voxels. The interpolated distance is smooth within a voxel, so two crossings
/// within such a step are unlikely. The kernel takes longer steps.
const STEP_VOXELS: f64 = 0.05;

/// A ray in the field's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Origin, meters from the anchor.
    pub origin_m: Point3<f64>,
    /// Change per meter of depth.
    pub along: Vector3<f64>,
    /// Range of depths that is searched for a surface, meters.
    pub range_m: [f64; 2],
}

/// Intersection of a ray with the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Depth, meters.
    pub depth_m: f64,
    /// sRGB, 0 to 1.
    pub color_srgb: [f64; 3],
}

/// The first surface along the ray that faces its origin and is not erased.
pub fn cast(blocks: &Blocks, voxel_grid: &VoxelGrid, ray: &Ray, edits: &Edits) -> Option<Hit> {
    let at = |depth_m: f64| (ray.origin_m + ray.along * depth_m).coords / voxel_grid.voxel_m;
    let step_m = STEP_VOXELS * voxel_grid.voxel_m / ray.along.norm();
    let mut depth_m = ray.range_m[0];
    let mut before: Option<(f64, f64)> = None;
    while depth_m < ray.range_m[1] {
        // Only crossings from positive to negative count, because back faces are not rendered. A
        // point next to an unobserved voxel has no distance, so no surface is found there.
        let here = distance_at(blocks, &at(depth_m));
        if let (Some((outside_m, outside)), Some(inside)) =
            (before, here.filter(|distance| *distance < 0.0))
        {
            // The surface is at the zero of the line through both distances.
            let hit_m = outside_m + (depth_m - outside_m) * outside / (outside - inside);
            let hit_in_world =
                ray.origin_m + ray.along * hit_m + Vector3::from(voxel_grid.anchor_m);
            if !edits.erases(hit_in_world.coords.into()) {
                return Some(Hit {
                    depth_m: hit_m,
                    color_srgb: color_at(blocks, &at(hit_m)),
                });
            }
        }
        before = here
            .filter(|distance| *distance >= 0.0)
            .map(|distance| (depth_m, distance));
        depth_m += step_m;
    }
    None
}

/// The eight voxels around a point, which is given in voxels, and their interpolation weights.
#[expect(
    clippy::cast_possible_truncation,
    reason = "coordinates are rounded down on purpose"
)]
fn around(point: &Vector3<f64>) -> impl Iterator<Item = ([i32; 3], f64)> {
    // Centers of voxels are at half-integers.
    let corner = point.map(|along| (along - 0.5).floor());
    let share = point.map(|along| along - 0.5) - corner;
    (0..8usize).map(move |ix| {
        let is_next = |axis: usize| ix >> axis & 1 == 1;
        let part = (0..3)
            .map(|axis| {
                if is_next(axis) {
                    share[axis]
                } else {
                    1.0 - share[axis]
                }
            })
            .product();
        (
            std::array::from_fn(|axis| corner[axis] as i32 + i32::from(is_next(axis))),
            part,
        )
    })
}

/// Distance as a fraction of the field's scale. `None` if one of the eight voxels was not observed.
fn distance_at(blocks: &Blocks, point: &Vector3<f64>) -> Option<f64> {
    around(point).try_fold(0.0, |sum, (voxel, part)| {
        Some(sum + part * blocks.get(&block_of(voxel))?.distance(voxel_ix(voxel))?)
    })
}

fn color_at(blocks: &Blocks, point: &Vector3<f64>) -> [f64; 3] {
    // Unlike distances, colors may be missing, because only voxels near the surface store a color.
    // The weights of the available colors are normalized.
    let mut sum = Vector3::zeros();
    let mut weight = 0.0;
    for (voxel, part) in around(point) {
        let color = blocks
            .get(&block_of(voxel))
            .and_then(|block| block.color_srgb(voxel_ix(voxel)));
        if let Some(color) = color {
            sum += Vector3::from(color) * part;
            weight += part;
        }
    }
    if weight > 1e-6 {
        (sum / weight).into()
    } else {
        [0.5; 3]
    }
}
