//! Emulates a Franka controller whose arm follows a script until a client moves it.

use super::JointTrack;
use crate::MotorHistory;
use drivers::Error;
use drivers::franka::emulated::{CommandedJoints, EmulatedRobot, Joints, RobotConfig};
use kinematics::JointState;
use std::time::Duration;

/// Accepts clients until it is dropped. Once a client has moved the arm, it follows client commands
/// only.
///
/// * `answer_wait`: as in [`EmulatedRobot::start_waiting`]; zero on a real robot
/// * `motors`: gets the joints once per millisecond.
pub fn emulate_fci(
    track: JointTrack,
    config: RobotConfig,
    answer_wait: Duration,
    motors: Option<MotorHistory>,
) -> Result<EmulatedRobot, Error> {
    let mut is_client_controlled = false;
    let mut simulate_joints = move |now, client_target: &CommandedJoints| {
        if client_target.is_moving && !std::mem::replace(&mut is_client_controlled, true) {
            log::info!("a client controls the arm: it no longer follows the script");
        }
        if is_client_controlled {
            let (position_rad, velocity_rad_s) =
                (client_target.position_rad, client_target.velocity_rad_s);
            return Joints {
                position_rad,
                velocity_rad_s,
                ..Joints::default()
            };
        }
        let state = track.at(now);
        let to_joint_array =
            |numbers: Vec<f64>| std::array::from_fn(|ix| numbers.get(ix).copied().unwrap_or(0.0));
        Joints {
            position_rad: to_joint_array(state.position),
            velocity_rad_s: to_joint_array(state.velocity),
            torque_nm: to_joint_array(state.effort),
            ..Joints::default()
        }
    };
    let joint_simulator = move |now, client_target: &CommandedJoints| {
        let joints = simulate_joints(now, client_target);
        if let Some(motors) = &motors {
            let (position, velocity) =
                (joints.position_rad.to_vec(), joints.velocity_rad_s.to_vec());
            motors.record(JointState {
                stamp: now,
                position,
                velocity,
                effort: Vec::new(),
            });
        }
        joints
    };
    EmulatedRobot::start_waiting(config, answer_wait, Box::new(joint_simulator))
}
