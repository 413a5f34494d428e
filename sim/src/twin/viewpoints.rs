//! Poses that the camera of an arm can reach, and places that it can see from many directions.
//!
//! Postures are sampled at random, and places are rated by the directions from which sampled
//! cameras see them, as in a capability map (Zacharias, Borst and Hirzinger 2007, "Capturing Robot
//! Workspace Structure").

use super::model::TwinModel;
use crate::joints::Joints;
use crate::random::RandomStream;
use kinematics::Transform;
use nalgebra::{Point3, Rotation2, Vector2, Vector3};
use std::f64::consts::PI;

/// A posture with the pose of its camera.
#[derive(Clone, Debug)]
pub(crate) struct Viewpoint {
    pub(crate) position: Joints,
    pub(crate) world_from_camera: Transform,
}

/// Number of sampled postures. With many fewer, small regions that an arm reaches well are missed.
const N_VIEWPOINTS: u64 = 20_000;
/// Identifies the random number stream.
const VIEWPOINTS: u64 = 0x71e2;

/// Random postures within the joint limits.
pub(crate) fn sampled(
    model: &TwinModel,
    world_from_base: &Transform,
    flange_from_camera: &Transform,
) -> Vec<Viewpoint> {
    let ranges = model.ranges();
    // Of joints that can turn more than once, only one turn is sampled, because further turns reach
    // the same poses again.
    let bounds: Vec<[f64; 2]> = ranges
        .iter()
        .map(|range| {
            let [lower, upper] = [range.lower.max(-PI), range.upper.min(PI)];
            if lower < upper {
                [lower, upper]
            } else {
                [range.lower, range.upper]
            }
        })
        .collect();
    (0..N_VIEWPOINTS)
        .map(|ix| {
            // The stream does not depend on the seed of the rig, so that the scene of a rig file is
            // always at the same place.
            let random = RandomStream::new(0, &[VIEWPOINTS, ix]);
            let position = Joints::from_fn(ranges.len(), |joint_ix, _| {
                let [lower, upper] = bounds[joint_ix];
                random.between(joint_ix as u64, lower, upper)
            });
            let world_from_camera =
                world_from_base * model.base_from_flange(&position) * flange_from_camera;
            Viewpoint {
                position,
                world_from_camera,
            }
        })
        .collect()
}

/// How a camera looks at things.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewLimits {
    /// Smallest and largest distance of the scene, meters.
    pub(crate) distance_m: [f64; 2],
    /// Largest angle between the optical axis and the center of the scene, radians.
    pub(crate) off_axis_rad: f64,
}

/// Range of the elevation above the horizontal from which a place may be seen, degrees. The next
/// constant is the largest azimuth relative to the side of the robot. Beyond this azimuth, the
/// walls of the scene block the view.
const ELEVATION_DEGREES: [f64; 2] = [15.0, 87.0];
const MAX_AZIMUTH_DEGREES: f64 = 75.0;
/// Sizes of the bins of directions, degrees.
const AZIMUTH_BIN_DEGREES: f64 = 30.0;
const ELEVATION_BIN_DEGREES: f64 = 18.0;

/// A view of a place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    /// Index of the viewpoint.
    pub(crate) viewpoint_ix: usize,
    pub(crate) azimuth_degrees: f64,
    pub(crate) elevation_degrees: f64,
    pub(crate) distance_m: f64,
}

/// All views of a place.
///
/// * `yaw_rad`: direction about z from the robot to the place.
pub(crate) fn views_of(
    place: &Point3<f64>,
    yaw_rad: f64,
    viewpoints: &[Viewpoint],
    limits: &ViewLimits,
) -> Vec<View> {
    let smallest_cosine = limits.off_axis_rad.cos();
    let [nearest, farthest] = limits.distance_m;
    let scene_from_world = Rotation2::new(-yaw_rad);
    let mut views = Vec::new();
    for (viewpoint_ix, viewpoint) in viewpoints.iter().enumerate() {
        let back = viewpoint.world_from_camera.translation.vector - place.coords;
        let distance_m = back.norm();
        if distance_m < nearest || distance_m > farthest {
            continue;
        }
        let forward = viewpoint.world_from_camera.rotation * Vector3::z();
        if -forward.dot(&back) < smallest_cosine * distance_m {
            continue;
        }
        let elevation_degrees = (back.z / distance_m).asin().to_degrees();
        let [lowest, highest] = ELEVATION_DEGREES;
        if elevation_degrees < lowest || elevation_degrees > highest {
            continue;
        }
        let horizontal = scene_from_world * Vector2::new(back.x, back.y);
        let azimuth_degrees = (-horizontal.y).atan2(-horizontal.x).to_degrees();
        if azimuth_degrees.abs() > MAX_AZIMUTH_DEGREES {
            continue;
        }
        views.push(View {
            viewpoint_ix,
            azimuth_degrees,
            elevation_degrees,
            distance_m,
        });
    }
    views
}

/// Number of different directions of views.
pub(crate) fn n_directions(views: &[View]) -> u32 {
    let mut seen = 0_u64;
    for view in views {
        let bin = |degrees: f64, size: f64| {
            // The ranges have at most six bins.
            (0..6_u32)
                .find(|bin| degrees < f64::from(bin + 1) * size)
                .unwrap_or(5)
        };
        let azimuth_bin = bin(
            view.azimuth_degrees + MAX_AZIMUTH_DEGREES,
            AZIMUTH_BIN_DEGREES,
        );
        let elevation_bin = bin(
            view.elevation_degrees - ELEVATION_DEGREES[0],
            ELEVATION_BIN_DEGREES,
        );
        seen |= 1 << (6 * azimuth_bin + elevation_bin);
    }
    seen.count_ones()
}
