//! Emulates a controller of Universal Robots whose arm follows a script until a client moves it.

use super::JointTrack;
use drivers::Error;
use drivers::ur::emulated::{CommandedJoints, ControllerConfig, EmulatedController, Joints};
use kinematics::Stamp;

/// Accepts clients until it is dropped. Once a client has moved the arm, it follows client commands
/// only.
pub fn emulate_ur(
    track: JointTrack,
    config: ControllerConfig,
) -> Result<EmulatedController, Error> {
    let mut is_client_controlled = false;
    let joint_simulator = move |now: Stamp, commanded: &CommandedJoints| {
        if commanded.is_moving && !std::mem::replace(&mut is_client_controlled, true) {
            log::info!("a client controls the arm: it no longer follows the script");
        }
        if is_client_controlled {
            // The arm follows its target without error, as with a perfect controller.
            Joints {
                position_rad: commanded.position_rad,
                velocity_rad_s: commanded.velocity_rad_s,
                ..Joints::default()
            }
        } else {
            scripted_joints(&track, now)
        }
    };
    EmulatedController::start(config, Box::new(joint_simulator))
}

/// The joints of the script at a time.
fn scripted_joints(track: &JointTrack, now: Stamp) -> Joints {
    let state = track.at(now);
    let to_joint_array =
        |numbers: Vec<f64>| std::array::from_fn(|ix| numbers.get(ix).copied().unwrap_or(0.0));
    Joints {
        position_rad: to_joint_array(state.position),
        velocity_rad_s: to_joint_array(state.velocity),
        torque_nm: to_joint_array(state.effort),
    }
}
