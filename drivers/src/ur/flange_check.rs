//! Compares the flange pose of the rig file with the pose that the controller reports.

use super::config::ArmConfig;
use super::state::{RobotState, transform};
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
pub(super) enum FlangeCheck {
    /// The poses agree.
    Same,
    /// The difference does not prove that the description is wrong. The text describes it, with the
    /// likely cause and the remedy.
    Doubtful(String),
}

/// Compares the two poses.
///
/// # Errors
/// If the rig file describes another robot or another link. The text states both poses.
pub(super) fn check_flange(config: &ArmConfig, state: &RobotState) -> Result<FlangeCheck, String> {
    let chain = &config.chain;
    let chain_error = |error: kinematics::Error| error.to_string();
    let sequence = chain.order_in(&config.joint_names).map_err(chain_error)?;
    // The chain may list the joints in another order than the robot.
    let q: Vec<f64> = sequence.iter().map(|ix| state.position_rad[*ix]).collect();
    let ours = chain.forward(&q).map_err(chain_error)?;
    let base_from_tool = transform(&state.base_from_tool);
    let flange_from_tool = state.flange_from_tool.as_ref().map(transform);
    // The controller reports its tool, whose pose is set in the installation. Without the tool, the
    // result depends only on the joints.
    let reported = base_from_tool * flange_from_tool.unwrap_or_default().inverse();
    let error = Difference::between(&ours, &reported);
    if error.is_within(MAX_POSE_ERROR_M, MAX_POSE_ERROR_RAD) {
        return Ok(FlangeCheck::Same);
    }
    let tip = chain.tip_link();
    let difference = format!(
        "the rig file puts {tip:?} at {}, but the controller reports its flange at {}, {} away",
        format_pose(&ours),
        format_pose(&reported),
        error
    );
    if error.is_within(MAX_NOMINAL_ERROR_M, MAX_NOMINAL_ERROR_RAD) {
        return Ok(FlangeCheck::Doubtful(format!(
            "{difference}; the likely cause is a URDF with nominal dimensions: export one with the calibration of this robot, see docs/guide/arms.md"
        )));
    }
    if flange_from_tool.is_none() {
        return Ok(FlangeCheck::Doubtful(format!(
            "{difference}; this controller does not report the tool of its installation, so the difference may be that tool"
        )));
    }
    Err(format!(
        "{difference}; {}",
        likely_cause(tip, &ours, &base_from_tool, &error)
    ))
}

/// The likely cause of a large difference.
fn likely_cause(
    tip: &str,
    ours: &Transform,
    base_from_tool: &Transform,
    error: &Difference,
) -> String {
    let from_tool = Difference::between(ours, base_from_tool);
    if from_tool.is_within(MAX_NOMINAL_ERROR_M, MAX_NOMINAL_ERROR_RAD) {
        return format!(
            "{tip:?} is at the tool center point: arm.flange_link must name the flange (tool0), without the tool"
        );
    }
    if error.translation_m <= MAX_NOMINAL_ERROR_M {
        return format!(
            "only the orientation differs: arm.flange_link must name the frame of the controller (tool0, not flange), {tip:?} is another one"
        );
    }
    "likely causes: arm.flange_link is not the flange (tool0), arm.joints is in the wrong order, or arm.urdf is of another robot"
        .to_owned()
}

/// Difference between two poses.
struct Difference {
    translation_m: f64,
    rotation_rad: f64,
}

impl Difference {
    /// The difference for the base frame that fits better: the one of the controller, or one that
    /// is rotated by half a turn about the vertical axis. ROS descriptions rotate `base_link` in
    /// this way, so that its x axis points forward. The poses of cameras do not depend on it.
    fn between(ours: &Transform, reported: &Transform) -> Self {
        let half_turn = Transform::from_parts(
            nalgebra::Translation3::identity(),
            UnitQuaternion::from_euler_angles(0.0, 0.0, PI),
        );
        let [same, turned] = [*ours, half_turn * ours].map(|ours| {
            let ours_from_reported = ours.inverse() * reported;
            Self {
                translation_m: ours_from_reported.translation.vector.norm(),
                rotation_rad: ours_from_reported.rotation.angle(),
            }
        });
        if turned.size() < same.size() {
            turned
        } else {
            same
        }
    }

    /// Both parts in one number. A straight arm has its flange above the base, so that half a turn
    /// of the base changes only the orientation.
    fn size(&self) -> f64 {
        self.translation_m + self.rotation_rad
    }

    fn is_within(&self, max_m: f64, max_rad: f64) -> bool {
        self.translation_m <= max_m && self.rotation_rad <= max_rad
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{:.1} mm and {:.2} degrees",
            self.translation_m * 1e3,
            self.rotation_rad.to_degrees()
        )
    }
}

fn format_pose(pose: &Transform) -> String {
    let [x, y, z] = pose.translation.vector.into();
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
    format!("({x:.4}, {y:.4}, {z:.4}) m, roll {roll:.2}, pitch {pitch:.2}, yaw {yaw:.2} degrees")
}
