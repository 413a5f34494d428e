//! Extent of the scene, estimated from the keyframes.

use crate::view::Camera;
use keyframe::{Keyframe, Shutter};
use kinematics::{Transform, Twist};
use model_files::Aabb;
use nalgebra::{Matrix3, Matrix4, Point3, Vector3};
use numbers::quantile::{Rank, quantile, trimmed_range};
use serde::{Deserialize, Serialize};

/// Depth readings per keyframe that are used to estimate the extent. The extent is a quantile over
/// all keyframes, so a few readings per keyframe are sufficient.
const SAMPLES_PER_KEYFRAME: usize = 64;
/// Fraction of the readings, on each side along each axis, that may be outside. With a larger
/// fraction, walls would be contracted. With a smaller fraction, a few wrong readings would enlarge
/// the cube and thus the cells.
const OUTSIDE_FRAC: f64 = 0.02;
/// Readings beyond this multiple of the median depth are ignored, because contraction covers them.
const FAR_OVER_MEDIAN: f64 = 2.0;
/// Radius if there is no information, meters.
const DEFAULT_RADIUS_M: f64 = 1.0;
/// Minimum radius, meters. It keeps divisions finite if all cameras and readings are at one place.
const MIN_RADIUS_M: f64 = 0.01;
/// A scene that extends beyond this many radii needs a new field, because contraction leaves too
/// little resolution there.
const MAX_REACH: f64 = 2.0;

/// The cube modeled at full resolution. The space outside is contracted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extent {
    /// Center of the cube in world, meters.
    pub center_m: [f64; 3],
    /// Half the edge length, meters.
    pub radius_m: f64,
}

impl Extent {
    /// Extent around the cameras and nearly all of their depth readings.
    ///
    /// Without depth, the center is the point closest to all optical axes, and the cameras are at
    /// the border.
    pub fn of<'a>(keyframes: impl Iterator<Item = &'a Keyframe> + Clone) -> Self {
        let cameras: Vec<Vector3<f64>> = keyframes
            .clone()
            .map(|keyframe| keyframe.world_from_camera.translation.vector)
            .collect();
        let mut visible_points: Vec<(f64, Vector3<f64>)> =
            keyframes.clone().flat_map(depth_samples).collect();
        let mut depths_m: Vec<f64> = visible_points.iter().map(|(z_m, _)| *z_m).collect();
        let Some(median_m) = quantile(&mut depths_m, 0.5, Rank::Upper) else {
            return Self::without_depth(keyframes, &cameras);
        };
        visible_points.retain(|(z_m, _)| *z_m <= FAR_OVER_MEDIAN * median_m);
        let ranges = [0, 1, 2].map(|axis| range_along(axis, &visible_points, &cameras));
        let radius_m = ranges
            .iter()
            .map(|[low, high]| 0.5 * (high - low))
            .fold(MIN_RADIUS_M, f64::max);
        Self {
            center_m: ranges.map(|[low, high]| 0.5 * (low + high)),
            radius_m,
        }
    }

    fn without_depth<'a>(
        keyframes: impl Iterator<Item = &'a Keyframe>,
        cameras: &[Vector3<f64>],
    ) -> Self {
        // The center is the point with the smallest sum of squared distances to the optical axes.
        // The sum is weakly regularized toward the mean position of the cameras.
        const CENTER_REGULARIZATION: f64 = 1e-3;
        let mean = cameras.iter().sum::<Vector3<f64>>() / cameras.len().max(1) as f64;
        let mut normal = Matrix3::identity() * CENTER_REGULARIZATION;
        let mut right = mean * CENTER_REGULARIZATION;
        // Normal equations: `across` projects an offset from the camera onto the plane
        // perpendicular to the axis. The regularization is needed because parallel axes alone would
        // give a singular matrix.
        for keyframe in keyframes {
            let axis = keyframe.world_from_camera.rotation * Vector3::z();
            let across = Matrix3::identity() - axis * axis.transpose();
            normal += across;
            right += across * keyframe.world_from_camera.translation.vector;
        }
        let center = normal.try_inverse().map_or(mean, |inverse| inverse * right);
        let max_offset = cameras
            .iter()
            .map(|camera| (camera - center).amax())
            .fold(0.0, f64::max);
        let radius_m = if max_offset > MIN_RADIUS_M {
            max_offset
        } else {
            DEFAULT_RADIUS_M
        };
        Self {
            center_m: center.into(),
            radius_m,
        }
    }

    /// Whether the scene has outgrown this extent, so that a field trained with it has too little
    /// resolution for the extent `other`.
    pub fn is_outgrown_by(&self, other: &Self) -> bool {
        let offset = Vector3::from(self.center_m) - Vector3::from(other.center_m);
        offset.amax() + other.radius_m > MAX_REACH * self.radius_m
    }

    /// Converts a pose to scene units. Its position becomes relative to the center, in units of the
    /// radius.
    pub(crate) fn in_scene_units(&self, world_from_other: &Transform) -> Transform {
        let mut pose = *world_from_other;
        pose.translation.vector =
            (pose.translation.vector - Vector3::from(self.center_m)) / self.radius_m;
        pose
    }

    /// Maps positions that are relative to the center, in units of the radius, to world coordinates
    /// in meters.
    pub(crate) fn world_from_scene(&self) -> Matrix4<f64> {
        Matrix4::new_translation(&self.center_m.into()) * Matrix4::new_scaling(self.radius_m)
    }

    /// Converts all lengths of a camera to units of the radius. Erased space stays in world
    /// coordinates.
    pub(crate) fn camera_in_scene_units(&self, camera: &Camera) -> Camera {
        let shutter = camera.shutter.map(|shutter| Shutter {
            twist: Twist {
                linear_m_s: shutter.twist.linear_m_s / self.radius_m,
                ..shutter.twist
            },
            ..shutter
        });
        let crop = camera.crop.map(|crop| Aabb {
            world_from_box: self.in_scene_units(&crop.world_from_box),
            min_m: crop.min_m.map(|along| along / self.radius_m),
            max_m: crop.max_m.map(|along| along / self.radius_m),
        });
        Camera {
            world_from_camera: self.in_scene_units(&camera.world_from_camera),
            near_m: camera.near_m / self.radius_m,
            far_m: camera.far_m / self.radius_m,
            shutter,
            crop,
            ..camera.clone()
        }
    }
}

/// A sample of a keyframe's depth readings. Each has the depth along z in meters and the position
/// in world.
fn depth_samples(keyframe: &Keyframe) -> Vec<(f64, Vector3<f64>)> {
    let Some(depth) = &keyframe.depth else {
        return Vec::new();
    };
    let width = depth.size_px[0].max(1);
    // The step is odd, so that samples cover all columns and rows.
    let step = (depth.depth_m.len() / SAMPLES_PER_KEYFRAME).max(1) | 1;
    let valid = (0u32..)
        .zip(depth.depth_m.iter())
        .step_by(step)
        .filter(|(_, z)| **z > 0.0 && z.is_finite());
    valid
        .map(|(ix, z)| {
            let in_camera = depth.point(ix % width, ix / width, f64::from(*z));
            let in_world = depth.world_from_camera * Point3::from(in_camera);
            (f64::from(*z), in_world.coords)
        })
        .collect()
}

/// Range along an axis that contains all cameras and nearly all points. The depths of the points
/// are not used.
fn range_along(
    axis: usize,
    visible_points: &[(f64, Vector3<f64>)],
    cameras: &[Vector3<f64>],
) -> [f64; 2] {
    let mut along: Vec<f64> = visible_points
        .iter()
        .map(|(_, point)| point[axis])
        .collect();
    let of_points =
        trimmed_range(&mut along, OUTSIDE_FRAC).expect("readings at the median depth remain");
    // All cameras are inside, because rays begin at cameras, and steps must be short there.
    let camera_coords = cameras.iter().map(|camera| camera[axis]);
    camera_coords.fold(of_points, |range, camera| {
        [range[0].min(camera), range[1].max(camera)]
    })
}

/// Size of a pixel in the scene, meters. It is the median over the keyframes.
pub(crate) fn pixel_size_m<'a>(
    keyframes: impl Iterator<Item = &'a Keyframe>,
    extent: &Extent,
) -> f64 {
    let size = |keyframe: &Keyframe| {
        let typical_depth_m = crate::view::median_depth_m(keyframe).unwrap_or(extent.radius_m);
        typical_depth_m / keyframe.focal_px[0].max(1.0)
    };
    let mut sizes: Vec<f64> = keyframes.map(size).collect();
    quantile(&mut sizes, 0.5, Rank::Upper).unwrap_or(extent.radius_m / 512.0)
}
