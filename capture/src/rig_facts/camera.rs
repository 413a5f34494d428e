//! Where a camera or a range scanner is, and what it sees.

use super::robot::{ArmFacts, RobotAtRest};
use crate::config::{Camera, Parent, Scanner};
use kinematics::{Intrinsics, Transform};
use nalgebra::{Point3, Vector3};
use std::sync::Arc;

/// Radius within which the last link of an arm is assumed, meters. It is about the radius of the
/// thinnest wrists, so that a camera on a bracket is outside.
const ARM_RADIUS_M: f64 = 0.03;

/// Angles of view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldOfView {
    /// From the left to the right edge, radians.
    pub horizontal_rad: f64,
    /// From the upper to the lower edge, radians.
    pub vertical_rad: f64,
    /// From corner to corner, radians; `None` if the corners see half of the space or more.
    pub diagonal_rad: Option<f64>,
}

/// Facts about a camera.
#[derive(Clone, Debug)]
pub struct CameraFacts {
    /// Name in the rig file.
    pub name: Arc<str>,
    /// Frame to which it is attached.
    pub parent: Parent,
    /// Pose in the frame of its parent; `None` if it is unknown.
    pub parent_from_camera: Option<Transform>,
    /// Pose in the world with all joints at rest, and with a moving base at the origin; `None` if it
    /// is unknown.
    pub world_from_camera: Option<Transform>,
    /// Width and height of the color images, pixels.
    pub size_px: [u32; 2],
    /// Images per second.
    pub rate_hz: f64,
    /// Exposure time, seconds; `None` with automatic exposure.
    pub exposure_secs: Option<f64>,
    /// Whether the camera reports its lens when it is opened.
    pub reports_lens: bool,
    /// Lens and size; `None` if the lens is unknown.
    pub intrinsics: Option<Intrinsics>,
    /// Angles of view; `None` if the lens is unknown or sees half of the space or more.
    pub field_of_view: Option<FieldOfView>,
    /// Nearest and farthest depth that is used, meters; `None` without depth.
    pub depth_range_m: Option<[f64; 2]>,
    /// Which way the arm is: a unit vector from the flange to the arm, in the flange frame. `None`
    /// for cameras that are not on the flange, and if the arm has no length.
    pub toward_arm_in_flange: Option<Vector3<f64>>,
    /// Distance along the optical axis at which the camera looks into the flange, meters. `None` if
    /// it does not.
    pub looks_into_flange_at_m: Option<f64>,
    /// Distance along the optical axis to the plane z = 0 of the world, meters. `None` if the camera
    /// is on the flange or does not look down.
    pub ground_at_m: Option<f64>,
    /// Fraction of the positions that the flange reaches which are inside the image. `None` if the
    /// camera is on the flange, or its calibration is unknown, or there is no arm.
    pub seen_reach_frac: Option<f64>,
}

/// Facts about a range scanner.
#[derive(Clone, Debug)]
pub struct ScannerFacts {
    /// Name in the rig file.
    pub name: Arc<str>,
    /// Pose on the base.
    pub base_from_scanner: Transform,
    /// Scans per second.
    pub rate_hz: f64,
    /// Nearest and farthest range that is used, meters.
    pub range_m: [f64; 2],
}

impl ScannerFacts {
    pub(super) fn of(scanner: &Scanner) -> Self {
        Self {
            name: Arc::clone(&scanner.name),
            base_from_scanner: scanner.base_from_scanner,
            rate_hz: scanner.rate_hz,
            range_m: [scanner.min_m, scanner.max_m],
        }
    }
}

impl CameraFacts {
    pub(super) fn of(
        camera: &Camera,
        world_from_base: &Transform,
        robot: &RobotAtRest,
        arm: Option<&ArmFacts>,
    ) -> Self {
        let unknown = camera.unknown;
        let parent_from_camera = (!unknown.parent_from_camera).then_some(camera.parent_from_camera);
        let world_from_parent = match camera.parent {
            Parent::Flange => world_from_base * robot.base_from_flange,
            Parent::Base => *world_from_base,
            Parent::World => Transform::identity(),
        };
        let world_from_camera = parent_from_camera.map(|pose| world_from_parent * pose);
        let intrinsics = (!unknown.intrinsics).then(|| camera.intrinsics.clone());
        let is_on_flange = camera.parent == Parent::Flange;
        let arm_in_flange = robot.arm_in_flange.filter(|_| is_on_flange);
        let off_flange = world_from_camera.filter(|_| !is_on_flange);
        Self {
            name: Arc::clone(&camera.name),
            parent: camera.parent,
            parent_from_camera,
            world_from_camera,
            size_px: camera.intrinsics.size_px,
            rate_hz: camera.rate_hz,
            exposure_secs: camera.exposure_micros.map(|micros| micros * 1e-6),
            reports_lens: camera.reports_lenses(),
            field_of_view: intrinsics.as_ref().and_then(FieldOfView::of),
            depth_range_m: camera
                .depth
                .as_ref()
                .map(|depth| [depth.min_m, depth.max_m]),
            toward_arm_in_flange: arm_in_flange.and_then(|arm| arm.coords.try_normalize(1e-9)),
            looks_into_flange_at_m: parent_from_camera
                .zip(arm_in_flange)
                .and_then(|(pose, arm)| flange_at_m(&pose, &arm)),
            ground_at_m: off_flange.as_ref().and_then(ground_at_m),
            seen_reach_frac: off_flange.zip(intrinsics.as_ref()).zip(arm).map(
                |((pose, lens), arm)| {
                    let base_from_camera = world_from_base.inverse() * pose;
                    seen_frac(&base_from_camera, lens, &arm.reached_in_base)
                },
            ),
            intrinsics,
        }
    }

    /// The optical axis in the frame of the parent; `None` if the pose is unknown.
    #[must_use]
    pub fn axis_in_parent(&self) -> Option<Vector3<f64>> {
        self.parent_from_camera
            .map(|pose| pose.rotation * Vector3::z())
    }
}

impl FieldOfView {
    fn of(lens: &Intrinsics) -> Option<Self> {
        let [width, height] = lens.size_px.map(f64::from);
        let angle = |one: [f64; 2], other: [f64; 2]| {
            Some(lens.unproject(one)?.angle(&lens.unproject(other)?))
        };
        Some(Self {
            horizontal_rad: angle([0.0, 0.5 * height], [width, 0.5 * height])?,
            vertical_rad: angle([0.5 * width, 0.0], [0.5 * width, height])?,
            diagonal_rad: angle([0.0, 0.0], [width, height]),
        })
    }
}

/// Distance along the optical axis at which a camera on the flange looks into the last link of the
/// arm, a capsule from `arm_in_flange` to the flange. A camera inside the capsule looks into it if
/// its axis points toward the arm.
fn flange_at_m(flange_from_camera: &Transform, arm_in_flange: &Point3<f64>) -> Option<f64> {
    /// Distance between points on the optical axis that are compared with the capsule. It is below
    /// the radius of the capsule.
    const STEP_M: f64 = 0.005;
    let eye = flange_from_camera * Point3::origin();
    let axis = flange_from_camera.rotation * Vector3::z();
    let is_inside =
        |point: &Point3<f64>| distance_to_segment_m(point, arm_in_flange) < ARM_RADIUS_M;
    if is_inside(&eye) {
        let toward_arm = arm_in_flange - eye;
        return (axis.angle(&toward_arm) < 0.25 * std::f64::consts::PI).then_some(0.0);
    }
    let farthest_m = eye.coords.norm() + arm_in_flange.coords.norm();
    let mut distance_m = STEP_M;
    while distance_m <= farthest_m {
        if is_inside(&(eye + axis * distance_m)) {
            return Some(distance_m);
        }
        distance_m += STEP_M;
    }
    None
}

/// Distance of a point from the segment between the origin and `end`.
fn distance_to_segment_m(point: &Point3<f64>, end: &Point3<f64>) -> f64 {
    let length_squared = end.coords.norm_squared().max(f64::MIN_POSITIVE);
    let along_frac = (point.coords.dot(&end.coords) / length_squared).clamp(0.0, 1.0);
    (point.coords - end.coords * along_frac).norm()
}

/// Distance along the optical axis to the plane z = 0.
fn ground_at_m(world_from_camera: &Transform) -> Option<f64> {
    /// Flatter axes meet the ground far away, if at all.
    const MIN_DESCENT_FRAC: f64 = 0.02;
    let height_m = world_from_camera.translation.z;
    let descent_frac = -(world_from_camera.rotation * Vector3::z()).z;
    (descent_frac > MIN_DESCENT_FRAC && height_m > 0.0).then(|| height_m / descent_frac)
}

/// Fraction of points that are inside the image.
fn seen_frac(
    base_from_camera: &Transform,
    lens: &Intrinsics,
    points_in_base: &[Point3<f64>],
) -> f64 {
    let camera_from_base = base_from_camera.inverse();
    let n_seen = points_in_base
        .iter()
        .filter_map(|point| lens.project(&(camera_from_base * point).coords))
        .filter(|pixel| lens.contains(*pixel))
        .count();
    n_seen as f64 / points_in_base.len().max(1) as f64
}
