//! The state of a robot in one cycle of its controller.

use super::N_JOINTS;
use kinematics::Transform;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// Maximum joint angle. The joints turn by up to a revolution in both directions; the wrist of a
/// UR3e turns without end, and its controller counts revolutions.
const MAX_RAD: f64 = 1000.0;

/// Values of one data package.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct RobotState {
    /// Time since the controller was started.
    pub(super) timestamp_secs: f64,
    /// Measured joint angles, from the base to the flange.
    pub(super) position_rad: [f64; N_JOINTS],
    pub(super) velocity_rad_s: [f64; N_JOINTS],
    /// Joint torques from the motor currents. Controllers before PolyScope 5.23 report no torques.
    pub(super) torque_nm: Option<[f64; N_JOINTS]>,
    /// Joint angles that the controller commands to the joints.
    pub(super) target_rad: [f64; N_JOINTS],
    /// Pose of the tool center point: meters, and a rotation vector in radians.
    pub(super) base_from_tool: [f64; 6],
    /// Pose of the tool that is set in the controller, relative to the flange.
    pub(super) flange_from_tool: Option<[f64; 6]>,
    pub(super) robot_mode: i32,
    pub(super) safety_mode: i32,
    /// Like the safety mode, with more values. Reported since PolyScope 3.10 and 5.4.
    pub(super) safety_status: Option<i32>,
    pub(super) runtime_state: u32,
    pub(super) status_bits: u32,
    /// Output registers that our program writes: the motion that it runs, and why it ended. Zero
    /// unless the arm may be moved.
    pub(super) program: [i32; 2],
}

impl RobotState {
    /// Whether all numbers are plausible. TCP detects damage, but a controller that is starting may
    /// report values that are not numbers, which would give an image a wrong pose.
    pub(super) fn is_plausible(&self) -> bool {
        let is_angle = |angle: &f64| angle.abs() <= MAX_RAD;
        let numbers = self
            .velocity_rad_s
            .iter()
            .chain(self.torque_nm.iter().flatten())
            .chain(&self.base_from_tool)
            .chain(self.flange_from_tool.iter().flatten());
        // NaN fails both comparisons.
        self.timestamp_secs.is_finite()
            && self.timestamp_secs >= 0.0
            && self
                .position_rad
                .iter()
                .chain(&self.target_rad)
                .all(is_angle)
            && numbers.into_iter().all(|number| number.is_finite())
    }
}

/// The transform of a pose vector: a translation in meters and a rotation vector in radians.
pub(super) fn transform(pose: &[f64; 6]) -> Transform {
    let [x, y, z, about_x, about_y, about_z] = *pose;
    Transform::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_scaled_axis(Vector3::new(about_x, about_y, about_z)),
    )
}
