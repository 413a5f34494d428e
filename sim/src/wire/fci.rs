//! Emulates a Franka controller whose arm follows a script until a client moves it.

use super::JointTrack;
use crate::MotorHistory;
use drivers::Error;
use drivers::franka::emulated::{CommandedJoints, EmulatedRobot, Joints, RobotConfig};
use kinematics::{JointState, Stamp};
use std::time::Duration;

/// Accepts clients until it is dropped. Once a client has moved the arm, it follows client commands
/// only.
///
/// * `answer_wait`: as in [`EmulatedRobot::start_waiting`]. It is zero on a real robot
/// * `motors`: gets the joints once per millisecond.
pub fn emulate_fci(
    track: JointTrack,
    config: RobotConfig,
    answer_wait: Duration,
    motors: Option<MotorHistory>,
) -> Result<EmulatedRobot, Error> {
    let mut arm = ScriptedArm {
        track,
        motors,
        is_client_controlled: false,
    };
    let joint_simulator = move |now: Stamp, client_target: &CommandedJoints| {
        let joints = arm.joints_at(now, client_target);
        arm.record(now, &joints);
        joints
    };
    EmulatedRobot::start_waiting(config, answer_wait, Box::new(joint_simulator))
}

/// An arm that follows a script until a client moves it.
struct ScriptedArm {
    track: JointTrack,
    motors: Option<MotorHistory>,
    is_client_controlled: bool,
}

impl ScriptedArm {
    fn joints_at(&mut self, now: Stamp, client_target: &CommandedJoints) -> Joints {
        if client_target.is_moving && !std::mem::replace(&mut self.is_client_controlled, true) {
            log::info!("a client controls the arm: it no longer follows the script");
        }
        // In this case, the arm follows its target without error, as with a perfect controller.
        if self.is_client_controlled {
            return Joints {
                position_rad: client_target.position_rad,
                velocity_rad_s: client_target.velocity_rad_s,
                ..Joints::default()
            };
        }
        let state = self.track.at(now);
        let to_joint_array =
            |numbers: Vec<f64>| std::array::from_fn(|ix| numbers.get(ix).copied().unwrap_or(0.0));
        Joints {
            position_rad: to_joint_array(state.position),
            velocity_rad_s: to_joint_array(state.velocity),
            torque_nm: to_joint_array(state.effort),
            ..Joints::default()
        }
    }

    /// Moves the simulated arm, if there is one, to the same joints.
    fn record(&self, now: Stamp, joints: &Joints) {
        if let Some(motors) = &self.motors {
            motors.record(JointState {
                stamp: now,
                position: joints.position_rad.to_vec(),
                velocity: joints.velocity_rad_s.to_vec(),
                effort: Vec::new(),
            });
        }
    }
}
