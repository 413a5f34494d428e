//! Twin of `integrate.wgsl`, applied to all given blocks. Blocks outside the camera's view stay
//! unchanged.

use super::readings::{Reading, ray_of};
use crate::tsdf::block::{GridCoord, N_VOXELS};
use crate::tsdf::chosen_grid::VoxelGrid;
use keyframe::{DepthMap, Keyframe};
use nalgebra::{Point3, Vector3};
use std::collections::BTreeMap;

/// State of a voxel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Voxel {
    /// Signed distance to the surface, meters.
    pub distance_m: f64,
    /// Weight in 256ths, which is an integer. It is 0 if the voxel was not observed.
    pub weight: f64,
    /// sRGB, 0 to 1.
    pub color_srgb: [f64; 3],
    /// Weight of the color in 256ths, which is an integer.
    pub color_weight: f64,
}

/// Voxels of blocks, x fastest.
pub type VoxelBlocks = BTreeMap<GridCoord, Vec<Voxel>>;

/// Minimum cosine between ray and normal for scaling distances. Normals of steeper surfaces are
/// mostly noise.
const MIN_RAY_DOT_NORMAL: f64 = 0.3;
/// An observation through a solid voxel shows that the voxel is free, and cancels this number of
/// observations of the voxel. This number applies if the surface behind the voxel is one truncation
/// away. The next constant applies if the surface is at least two truncations away. With larger
/// numbers, surfaces that are only displaced by pose errors would be carved away. See "Carving" in
/// `docs/benchmarks/2026-11-23-tsdf.md`.
const CARVING_NEAR: f64 = 1.0;
const CARVING_FAR: f64 = 4.0;
/// Colors are stored up to this distance from the surface, in voxels. Pictures and meshes do not
/// use colors at larger distances.
const COLOR_VOXELS: f64 = 2.0;

/// Fuses a keyframe with depth into the given blocks.
pub fn integrate(
    blocks: &mut VoxelBlocks,
    keyframe: &Keyframe,
    readings: &[Reading],
    voxel_grid: &VoxelGrid,
) {
    let Some(depth) = &keyframe.depth else { return };
    for (block_coord, voxels) in blocks {
        debug_assert_eq!(voxels.len(), N_VOXELS, "a block has all its voxels");
        for (ix, voxel) in voxels.iter_mut().enumerate() {
            let offset = [ix % 8, ix / 8 % 8, ix / 64];
            let along = |axis: usize| {
                (f64::from(8 * block_coord[axis]) + offset[axis] as f64 + 0.5) * voxel_grid.voxel_m
            };
            let in_field = Point3::new(along(0), along(1), along(2));
            let in_world = voxel_grid.field_from_world().inverse() * in_field;
            fuse(voxel, keyframe, depth, readings, voxel_grid, &in_world);
        }
    }
}

fn fuse(
    voxel: &mut Voxel,
    keyframe: &Keyframe,
    depth: &DepthMap,
    readings: &[Reading],
    voxel_grid: &VoxelGrid,
    in_world: &Point3<f64>,
) {
    let point = depth.world_from_camera.inverse() * in_world;
    let Some(position_px) = projected(&point, depth.focal_px, depth.principal_px, depth.size_px)
    else {
        return;
    };
    let reading = reading_near(depth, readings, position_px);
    if reading.depth_m <= 0.0 {
        return;
    }
    // The distance is measured to the tangent plane of the surface, rather than along the ray.
    let distance_m = (reading.depth_m - point.z) * reading.ray_dot_normal.max(MIN_RAY_DOT_NORMAL);
    let truncation_m = voxel_grid.truncation_at(reading.depth_m);
    let ray_m = ray_of(depth, position_px).norm();
    // Hidden voxels are unknown. The distance behind the surface is measured along the ray, because
    // a grazing ray leaves an object again just past its rim.
    let behind_m = (point.z - reading.depth_m) * ray_m;
    if behind_m > truncation_m {
        return;
    }
    // The noise of depth grows with its square. `ray_dot_normal / ray_m` is the cosine of the angle
    // to the normal, because `ray_dot_normal` is relative to a ray with z = 1. The falloff begins
    // one voxel behind the surface.
    let nearness = (1.0 / (reading.depth_m * reading.depth_m)).min(1.0);
    let falloff = ((truncation_m - behind_m) / (truncation_m - voxel_grid.voxel_m)).clamp(0.0, 1.0);
    let gain_frac = nearness * (reading.ray_dot_normal / ray_m).powi(2) * falloff;
    // The voxel is in free space far in front of a surface. The distance to the nearest surface is
    // unknown, so only solid voxels change. They lose weight until they count as unobserved.
    if distance_m > truncation_m {
        if voxel.weight > 0.0 && voxel.distance_m < 0.0 {
            let past_truncation = (distance_m / truncation_m - 1.0).min(1.0);
            let carving = CARVING_NEAR + (CARVING_FAR - CARVING_NEAR) * past_truncation;
            let weight_loss = (carving * 256.0 * (1.0 / (point.z * point.z)).min(1.0) + 0.5)
                .floor()
                .max(1.0);
            if weight_loss >= voxel.weight {
                voxel.distance_m = 0.0;
                voxel.weight = 0.0;
            } else {
                voxel.weight -= weight_loss;
            }
        }
        return;
    }
    // This is a running mean (Curless and Levoy 1996). Because of the maximum weight, objects that
    // were moved away fade.
    let weight_gain = (256.0 * gain_frac + 0.5).floor().clamp(1.0, 256.0);
    let sum = voxel.weight + weight_gain;
    voxel.distance_m = (voxel.distance_m * voxel.weight + distance_m * weight_gain) / sum;
    voxel.weight = sum.min(f64::from(voxel_grid.max_weight));
    if distance_m.abs() <= COLOR_VOXELS * voxel_grid.voxel_m {
        fuse_color(
            voxel,
            keyframe,
            weight_gain,
            f64::from(voxel_grid.max_weight),
            in_world,
        );
    }
}

fn fuse_color(
    voxel: &mut Voxel,
    keyframe: &Keyframe,
    weight_gain: f64,
    max_weight: f64,
    in_world: &Point3<f64>,
) {
    let point = keyframe.world_from_camera.inverse() * in_world;
    let Some(position_px) = projected(
        &point,
        keyframe.focal_px,
        keyframe.principal_px,
        keyframe.size_px,
    ) else {
        return;
    };
    let [red, green, blue, alpha] = color_near(keyframe, position_px);
    // Near a masked pixel, the interpolated color would contain the color of the masked pixel.
    if alpha <= 0.999 {
        return;
    }
    let sum = voxel.color_weight + weight_gain;
    for (previous, observed) in voxel.color_srgb.iter_mut().zip([red, green, blue]) {
        *previous = (*previous * voxel.color_weight + observed * weight_gain) / sum;
    }
    voxel.color_weight = sum.min(max_weight);
}

fn projected(
    point: &Point3<f64>,
    focal: [f64; 2],
    principal: [f64; 2],
    size_px: [u32; 2],
) -> Option<[f64; 2]> {
    let block_coord: [f64; 2] =
        std::array::from_fn(|axis| focal[axis] * point[axis] / point.z + principal[axis]);
    let inside =
        (0..2).all(|axis| block_coord[axis] >= 0.0 && block_coord[axis] < f64::from(size_px[axis]));
    (point.z > 0.0 && inside).then_some(block_coord)
}

/// The four pixels around a position, clamped to the image, and the weights of the right and lower
/// pixels.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to the image"
)]
fn corners(position_px: [f64; 2], size_px: [u32; 2]) -> ([usize; 4], [f64; 2]) {
    // Pixel centers are at half-integers.
    let base = position_px.map(|along| (along - 0.5).floor());
    let clamped = |axis: usize, step: f64| {
        (base[axis] + step).clamp(0.0, f64::from(size_px[axis]) - 1.0) as usize
    };
    let at = |x: f64, y: f64| clamped(1, y) * size_px[0] as usize + clamped(0, x);
    (
        [at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0), at(1.0, 1.0)],
        [0, 1].map(|axis| position_px[axis] - 0.5 - base[axis]),
    )
}

fn mixed(values: [f64; 4], share: [f64; 2]) -> f64 {
    let mix = |a: f64, b: f64, share: f64| a * (1.0 - share) + b * share;
    mix(
        mix(values[0], values[1], share[0]),
        mix(values[2], values[3], share[0]),
        share[1],
    )
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a position inside the image"
)]
fn reading_near(depth: &DepthMap, readings: &[Reading], position_px: [f64; 2]) -> Reading {
    let (at, share) = corners(position_px, depth.size_px);
    let four = at.map(|ix| readings[ix]);
    // At the border of the valid readings, interpolation would mix in zeros.
    if four.iter().any(|reading| reading.depth_m <= 0.0) {
        return readings
            [position_px[1] as usize * depth.size_px[0] as usize + position_px[0] as usize];
    }
    Reading {
        depth_m: mixed(four.map(|reading| reading.depth_m), share),
        ray_dot_normal: mixed(four.map(|reading| reading.ray_dot_normal), share),
    }
}

fn color_near(keyframe: &Keyframe, position_px: [f64; 2]) -> [f64; 4] {
    let (at, share) = corners(position_px, keyframe.size_px);
    std::array::from_fn(|part| {
        mixed(
            at.map(|ix| f64::from(keyframe.rgba_srgb[4 * ix + part]) / 255.0),
            share,
        )
    })
}

/// A block of voxels that were never observed.
pub fn unobserved() -> Vec<Voxel> {
    vec![
        Voxel {
            color_srgb: Vector3::zeros().into(),
            ..Voxel::default()
        };
        N_VOXELS
    ]
}
