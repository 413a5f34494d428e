//! Compares the flange pose of the rig file with the pose that the controller reports.

use super::config::ArmConfig;
use super::state::{RobotState, transform};
use crate::FlangeDifference;
use crate::flange_difference::FlangePoses;
use kinematics::Transform;
use nalgebra::UnitQuaternion;
use std::f64::consts::PI;

/// Difference between the flange poses of the rig file and of the controller above which the
/// images get wrong poses. A robot that is described by its own calibration is far below.
const MAX_POSE_ERROR_M: f64 = 2e-3;
const MAX_POSE_ERROR_RAD: f64 = 0.5 / 180.0 * PI;
/// Difference up to which a description with the nominal dimensions is the likely cause. Every
/// robot is measured in the factory, and its controller uses the measured dimensions. The two
/// differ by some millimeters at the flange, and by up to a centimeter or two. Source: "Extract
/// calibration information" in the documentation of Universal Robots' ROS driver.
const MAX_NOMINAL_ERROR_M: f64 = 20e-3;
const MAX_NOMINAL_ERROR_RAD: f64 = 2.0 / 180.0 * PI;

/// Result of the comparison, if the poses do not contradict each other.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FlangeCheck {
    /// The difference of the poses.
    pub(super) difference: FlangeDifference,
    /// Why the poses differ, with both poses, the likely cause and the remedy. The description may
    /// still be right. `None` if the poses agree.
    pub(super) doubt: Option<String>,
}

/// Compares the two poses.
///
/// # Errors
/// If the rig file describes another robot or another link. The text states both poses.
pub(super) fn check_flange(config: &ArmConfig, state: &RobotState) -> Result<FlangeCheck, String> {
    let flange_from_tool = state.flange_from_tool.as_ref().map(transform);
    // The controller reports its tool, whose pose is set in the installation.
    let poses = FlangePoses::new(
        &config.chain,
        &config.joint_names,
        &state.position_rad,
        transform(&state.base_from_tool),
        &flange_from_tool.unwrap_or_default(),
    )?;
    let difference = difference(&poses.described, &poses.reported);
    let with_doubt = |doubt: Option<String>| Ok(FlangeCheck { difference, doubt });
    if difference.is_within(MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD) {
        return with_doubt(None);
    }
    let tip = config.chain.tip_link();
    let described = poses.describe(tip, "the controller reports its flange", &difference);
    if difference.is_within(MAX_NOMINAL_ERROR_M, MAX_NOMINAL_ERROR_RAD) {
        return with_doubt(Some(format!(
            "{described}; the likely cause is a URDF with nominal dimensions: export one with the calibration of this robot, see docs/guide/arms.md"
        )));
    }
    if flange_from_tool.is_none() {
        return with_doubt(Some(format!(
            "{described}; this controller does not report the tool of its installation, so the difference may be that tool"
        )));
    }
    Err(format!(
        "{described}; {}",
        likely_cause(tip, &poses, &difference)
    ))
}

/// The likely cause of a large difference.
fn likely_cause(tip: &str, poses: &FlangePoses, flange: &FlangeDifference) -> String {
    let from_tool = difference(&poses.described, &poses.base_from_tool);
    if from_tool.is_within(MAX_NOMINAL_ERROR_M, MAX_NOMINAL_ERROR_RAD) {
        return format!(
            "{tip:?} is at the tool center point: arm.flange_link must name the flange (tool0), without the tool"
        );
    }
    if flange.translation_m <= MAX_NOMINAL_ERROR_M {
        return format!(
            "only the orientation differs: arm.flange_link must name the frame of the controller (tool0, not flange), {tip:?} is another one"
        );
    }
    "likely causes: arm.flange_link is not the flange (tool0), arm.joints is in the wrong order, or arm.urdf is of another robot"
        .to_owned()
}

/// The difference for the base frame that fits better: the one of the controller, or one that is
/// rotated by half a turn about the vertical axis. ROS descriptions rotate `base_link` in this way,
/// so that its x axis points forward. The poses of cameras do not depend on it.
fn difference(described: &Transform, reported: &Transform) -> FlangeDifference {
    let half_turn = Transform::from_parts(
        nalgebra::Translation3::identity(),
        UnitQuaternion::from_euler_angles(0.0, 0.0, PI),
    );
    let same = FlangeDifference::between(described, reported);
    let turned = FlangeDifference::between(&(half_turn * described), reported);
    // Both parts are compared as one number. A straight arm has its flange above the base, so that
    // half a turn of the base changes only the orientation.
    let size = |of: &FlangeDifference| of.translation_m + of.rotation_rad;
    if size(&turned) < size(&same) {
        turned
    } else {
        same
    }
}
