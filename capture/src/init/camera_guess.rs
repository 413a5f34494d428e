//! Guesses of camera poses and lenses, until they are calibrated.

use super::links::ArmLinks;
use crate::config::Parent;
use kinematics::Transform;
use nalgebra::{Matrix3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};

/// Position of a camera on the flange: above the tool in the image (against y), and ahead of the
/// flange. Meters, in the frame of the camera.
const CAMERA_ON_FLANGE_M: [f64; 3] = [0.0, -0.05, 0.03];
/// Position of a camera on the base, meters: in front, above the ground.
const CAMERA_ON_BASE_M: [f64; 3] = [0.2, 0.0, 0.3];
/// Reach of a robot without an arm, meters, for a camera in the room.
const DEFAULT_REACH_M: f64 = 0.8;

/// A plausible pose of a camera in its parent frame.
pub(super) fn parent_from_camera(parent: Parent, links: Option<&ArmLinks>) -> Transform {
    match parent {
        Parent::Flange => {
            let outward = links.map_or(Vector3::z_axis(), |links| links.outward);
            let rotation = looking_along(outward);
            let position = rotation * Vector3::from(CAMERA_ON_FLANGE_M);
            Transform::from_parts(Translation3::from(position), rotation)
        }
        // It looks ahead: along x of the base.
        Parent::Base => {
            let rotation = upright(Vector3::x_axis());
            Transform::from_parts(Translation3::from(CAMERA_ON_BASE_M), rotation)
        }
        // It stands beside the robot, and looks down at the place in front of it. Simulated scenes
        // have walls on the other side.
        Parent::World => {
            let reach_m = links.map_or(DEFAULT_REACH_M, |links| links.reach_m);
            let position = Vector3::new(0.25, 1.1, 0.9) * reach_m;
            let target = Vector3::new(0.55, 0.0, 0.1) * reach_m;
            let rotation = upright(Unit::new_normalize(target - position));
            Transform::from_parts(Translation3::from(position), rotation)
        }
    }
}

/// Focal length in pixels for a horizontal field of view in degrees.
pub(super) fn focal_px(width_px: u32, field_of_view_deg: f64) -> f64 {
    0.5 * f64::from(width_px) / (0.5 * field_of_view_deg.to_radians()).tan()
}

/// The orientation of a camera that looks along a direction. Its x axis is as near as possible to
/// x of the frame, or to y if it looks along x.
fn looking_along(direction: Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    let side = if direction.x.abs() < 0.7 {
        Vector3::x()
    } else {
        Vector3::y()
    };
    let x = Unit::new_normalize(side - *direction * side.dot(&direction));
    orientation(*x, *direction)
}

/// The orientation of a camera whose images are upright in a frame with z up.
fn upright(direction: Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    let x = Unit::new_normalize(direction.cross(&Vector3::z()));
    orientation(*x, *direction)
}

/// The orientation with these x and z axes, which are perpendicular.
fn orientation(x: Vector3<f64>, z: Vector3<f64>) -> UnitQuaternion<f64> {
    let axes = Matrix3::from_columns(&[x, z.cross(&x), z]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rounding of rotations.
    const TOLERANCE: f64 = 1e-12;

    #[test]
    fn cameras_look_where_their_place_suggests() {
        let ahead = |parent| {
            let pose = parent_from_camera(parent, None);
            let down = pose.rotation * Vector3::y();
            (pose.rotation * Vector3::z(), down, pose.translation.vector)
        };
        let (z, down, _) = ahead(Parent::Flange);
        assert!((z - Vector3::z()).norm() < TOLERANCE && (down - Vector3::y()).norm() < TOLERANCE);
        let (z, down, _) = ahead(Parent::Base);
        assert!((z - Vector3::x()).norm() < TOLERANCE && (down + Vector3::z()).norm() < TOLERANCE);
        let (z, down, position) = ahead(Parent::World);
        // The line of sight meets the floor in front of the robot.
        let on_floor = position - z * (position.z / z.z);
        assert!(
            down.z < 0.0 && (0.2..0.8).contains(&on_floor.x),
            "{on_floor}"
        );
    }

    #[test]
    fn every_direction_gives_a_rotation() {
        for direction in [
            Vector3::x(),
            -Vector3::x(),
            Vector3::y(),
            -Vector3::z(),
            Vector3::new(1.0, 1.0, 1.0),
        ] {
            let direction = Unit::new_normalize(direction);
            let rotation = looking_along(direction);
            assert!((rotation * Vector3::z() - *direction).norm() < TOLERANCE);
            assert!((rotation.norm() - 1.0).abs() < TOLERANCE);
        }
    }

    #[test]
    fn focal_length_follows_from_the_field_of_view() {
        assert!((focal_px(640, 90.0) - 320.0).abs() < 1e-9);
        assert!((focal_px(1280, 65.0) - 1004.6).abs() < 0.1);
    }
}
