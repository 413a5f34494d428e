//! The target of inverse kinematics: a pose, the parts of its orientation that count, and the
//! distance of other poses from it.

use crate::{Error, Transform};
use nalgebra::{Unit, Vector3, Vector6};

/// A pose of the tip, some of which may be free.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Pose of the tip in the base.
    pub base_from_tip: Transform,
    /// The part of the orientation that counts.
    pub orientation: Orientation,
}

/// The part of the orientation that a target prescribes. Arms with fewer than six joints reach most
/// poses only if a part is free.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Orientation {
    /// The complete orientation.
    Full,
    /// The direction of an axis of the tip, in the frame of the tip. The rotation about the axis is
    /// free.
    Axis(Unit<Vector3<f64>>),
    /// No part of the orientation, so that only the position counts.
    Free,
}

/// Distance between two poses. A free part of the orientation does not count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseGap {
    /// Distance between the origins, meters.
    pub distance_m: f64,
    /// Angle between the orientations, or between the directions of the axis, radians.
    pub angle_rad: f64,
}

impl Target {
    /// A target whose full pose counts.
    pub fn pose(base_from_tip: Transform) -> Self {
        Self {
            base_from_tip,
            orientation: Orientation::Full,
        }
    }

    /// Distance of a pose of the tip from the target.
    pub fn gap(&self, base_from_tip: &Transform) -> PoseGap {
        PoseGap::of(&self.error(base_from_tip))
    }

    /// Number of degrees of freedom that are prescribed.
    pub(super) fn n_constraints(&self) -> usize {
        match self.orientation {
            Orientation::Full => 6,
            Orientation::Axis(_) => 5,
            Orientation::Free => 3,
        }
    }

    /// # Errors
    /// Fails if the pose or the axis contains NaN or infinity.
    pub(super) fn check(&self) -> Result<(), Error> {
        let rows = crate::transform::to_rows(&self.base_from_tip);
        if let Some(at) = rows.iter().position(|value| !value.is_finite()) {
            return Err(Error::TransformNotFinite {
                row: at / 4,
                column: at % 4,
                value: rows[at],
            });
        }
        if let Orientation::Axis(axis) = self.orientation {
            let is_unit = (axis.norm() - 1.0).abs() < 1e-6;
            if !is_unit {
                return Err(Error::InverseSetting {
                    what: "length of the axis whose direction counts",
                    value: axis.norm(),
                    allowed: "1",
                });
            }
        }
        Ok(())
    }

    /// Translation (meters) and rotation (radians) from an actual pose to the target, in base axes.
    pub(super) fn error(&self, actual: &Transform) -> Vector6<f64> {
        match self.orientation {
            Orientation::Full => pose_error(&self.base_from_tip, actual),
            Orientation::Axis(axis) => {
                let wanted = self.base_from_tip.rotation * axis;
                let rotation = rotation_between(&(actual.rotation * axis), &wanted);
                stack(&self.translation_from(actual), &rotation)
            }
            Orientation::Free => stack(&self.translation_from(actual), &Vector3::zeros()),
        }
    }

    /// Removes the velocities that do not count from the columns of a Jacobian.
    ///
    /// * `columns`: linear velocity (rows 0 to 2) and angular velocity (3 to 5) in base axes.
    pub(super) fn remove_free(&self, actual: &Transform, columns: &mut [Vector6<f64>]) {
        let axis_in_base = match self.orientation {
            Orientation::Full => return,
            Orientation::Axis(axis) => Some(actual.rotation * axis),
            Orientation::Free => None,
        };
        for column in columns {
            let angular: Vector3<f64> = column.fixed_rows::<3>(3).into();
            let kept = match axis_in_base {
                Some(axis) => angular - axis.into_inner() * axis.dot(&angular),
                None => Vector3::zeros(),
            };
            column.fixed_rows_mut::<3>(3).copy_from(&kept);
        }
    }

    fn translation_from(&self, actual: &Transform) -> Vector3<f64> {
        self.base_from_tip.translation.vector - actual.translation.vector
    }
}

impl PoseGap {
    /// * `error`: translation (meters) and rotation (radians).
    pub(super) fn of(error: &Vector6<f64>) -> Self {
        Self {
            distance_m: error.fixed_rows::<3>(0).norm(),
            angle_rad: error.fixed_rows::<3>(3).norm(),
        }
    }
}

/// Translation and rotation from the actual pose to the target, in base axes. Rows 0 to 2 are the
/// translation in meters. Rows 3 to 5 are the rotation vector in radians.
pub fn pose_error(target: &Transform, actual: &Transform) -> Vector6<f64> {
    let translation = target.translation.vector - actual.translation.vector;
    let rotation = (target.rotation * actual.rotation.inverse()).scaled_axis();
    stack(&translation, &rotation)
}

fn stack(linear: &Vector3<f64>, angular: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z,
    )
}

/// The smallest rotation from one direction to another, as a vector along its axis. Between
/// opposite directions, it is half a turn about any perpendicular axis.
fn rotation_between(from: &Unit<Vector3<f64>>, to: &Unit<Vector3<f64>>) -> Vector3<f64> {
    let cross = from.cross(to.as_ref());
    let angle = cross.norm().atan2(from.dot(to.as_ref()));
    match Unit::try_new(cross, f64::MIN_POSITIVE) {
        Some(axis) => axis.into_inner() * angle,
        None if angle > 1.0 => perpendicular_to(from) * angle,
        None => Vector3::zeros(),
    }
}

fn perpendicular_to(direction: &Unit<Vector3<f64>>) -> Vector3<f64> {
    let least_aligned = match direction.iamin() {
        0 => Vector3::x(),
        1 => Vector3::y(),
        _ => Vector3::z(),
    };
    direction.cross(&least_aligned).normalize()
}
