//! Twin of `readings.wgsl`.

use crate::tsdf::chosen_grid::VoxelGrid;
use keyframe::DepthMap;
use nalgebra::Vector3;

/// A pixel's depth and surface orientation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reading {
    /// Meters along z. It is 0 for invalid pixels.
    pub depth_m: f64,
    /// Dot product of the ray (z = 1) and the unit surface normal.
    pub ray_dot_normal: f64,
}

/// Wide differences for normals use pixels at this distance on each side. They reduce the noise of
/// normals threefold.
const WIDE_STEP: i64 = 3;
/// Maximum second difference of depths on a flat surface, in units of the noise. A second
/// difference has a standard deviation of sqrt(1 + 4 + 1) = 2.45 units, so this maximum is 2.45
/// standard deviations.
const MAX_FLAT_NOISES: f64 = 6.0;
/// Minimum valid depth, meters. Nearer readings are errors of the sensor.
const MIN_DEPTH_M: f64 = 0.01;
/// Maximum slope of a valid surface, which is the change of depth over lateral distance. Steeper
/// surfaces count as edges.
const MAX_SLOPE: f64 = 6.0;

/// The ray through a position in the image, scaled to z = 1.
pub(super) fn ray_of(depth: &DepthMap, position_px: [f64; 2]) -> Vector3<f64> {
    let along = |axis: usize| (position_px[axis] - depth.principal_px[axis]) / depth.focal_px[axis];
    Vector3::new(along(0), along(1), 1.0)
}

/// Determines the valid pixels and the orientation of their surface.
pub fn readings(depth: &DepthMap, voxel_grid: &VoxelGrid) -> Vec<Reading> {
    let [width, height] = depth.size_px.map(i64::from);
    (0..height)
        .flat_map(|y| (0..width).map(move |x| [x, y]))
        .map(|pixel| reading(depth, voxel_grid, pixel))
        .collect()
}

fn depth_at(depth: &DepthMap, voxel_grid: &VoxelGrid, [x, y]: [i64; 2]) -> Option<f64> {
    let [width, height] = depth.size_px.map(i64::from);
    if x < 0 || y < 0 || x >= width || y >= height {
        return None;
    }
    let depth_m = f64::from(depth.depth_m[usize::try_from(y * width + x).ok()?]);
    (MIN_DEPTH_M..=voxel_grid.max_depth_m)
        .contains(&depth_m)
        .then_some(depth_m)
}

/// The point of a pixel at a depth, in the camera frame.
fn point_at(depth: &DepthMap, [x, y]: [i64; 2], depth_m: f64) -> Vector3<f64> {
    ray_of(depth, [x as f64 + 0.5, y as f64 + 0.5]) * depth_m
}

/// The pixel `step` pixels further along an axis, and its depth if it is valid.
fn neighbor(
    depth: &DepthMap,
    voxel_grid: &VoxelGrid,
    mut pixel: [i64; 2],
    axis: usize,
    step: i64,
) -> Option<([i64; 2], f64)> {
    pixel[axis] += step;
    depth_at(depth, voxel_grid, pixel).map(|depth_m| (pixel, depth_m))
}

/// Difference of two points of the surface along an axis of the image. `None` next to a depth step,
/// and without a neighbor.
fn tangent_along(
    depth: &DepthMap,
    voxel_grid: &VoxelGrid,
    pixel: [i64; 2],
    center_m: f64,
    axis: usize,
) -> Option<Vector3<f64>> {
    let noise_m = voxel_grid.noise_per_m2 * center_m * center_m;
    let at = |step: i64| neighbor(depth, voxel_grid, pixel, axis, step);
    // On a surface that is flat within its noise, wider differences reduce the noise of the normal.
    let wide_pair = [at(WIDE_STEP), at(-WIDE_STEP)];
    let is_flat = match wide_pair {
        [Some((_, high_m)), Some((_, low_m))] => {
            (high_m - 2.0 * center_m + low_m).abs() <= MAX_FLAT_NOISES * noise_m
        }
        _ => false,
    };
    // A pixel next to a depth step may have a depth between object and background.
    let limit = MAX_SLOPE * center_m / depth.focal_px[axis] + 6.0 * noise_m;
    let sides = [at(1), at(-1)];
    if sides
        .iter()
        .flatten()
        .any(|(_, depth_m)| (depth_m - center_m).abs() > limit)
        || sides == [None, None]
    {
        return None;
    }
    // If a side has no neighbor, the center takes its place.
    let taken = if is_flat { wide_pair } else { sides };
    let [high, low] = taken.map(|side| {
        side.map_or_else(
            || point_at(depth, pixel, center_m),
            |(at, depth_m)| point_at(depth, at, depth_m),
        )
    });
    Some(high - low)
}

fn reading(depth: &DepthMap, voxel_grid: &VoxelGrid, pixel: [i64; 2]) -> Reading {
    let Some(center_m) = depth_at(depth, voxel_grid, pixel) else {
        return Reading::default();
    };
    let tangent = |axis: usize| tangent_along(depth, voxel_grid, pixel, center_m, axis);
    let (Some(x), Some(y)) = (tangent(0), tangent(1)) else {
        return Reading::default();
    };
    let ray = ray_of(depth, [pixel[0] as f64 + 0.5, pixel[1] as f64 + 0.5]);
    let normal = x.cross(&y);
    // The tangents point right and down, so their cross product points away from the camera.
    // Otherwise, the camera cannot see the surface.
    let ray_dot_normal = ray.dot(&normal) / normal.norm().max(1e-30);
    if ray_dot_normal > 0.0 {
        Reading {
            depth_m: center_m,
            ray_dot_normal,
        }
    } else {
        Reading::default()
    }
}
