//! Requests to a controller over TCP and motion commands over UDP, in both versions of FCI.

use super::N_JOINTS;
use super::connection::{Connection, answer, error_text};
use franka::wire::robot::{v5, v10};
use franka::wire::{HeaderLayout, f64s_to_wire, message_payload};
use franka::{FciVersion, FrankaError, RobotMode};
use std::time::Duration;
use zerocopy::IntoBytes;
use zerocopy::little_endian::U64;

/// Maximum time for answers; settings and descriptions are answered within milliseconds.
const MAX_ANSWER: Duration = Duration::from_secs(2);
/// Maximum time for a recovery, which releases brakes.
const MAX_RECOVERY: Duration = Duration::from_secs(10);
/// Maximum deviation of a motion from the command, in meters, in radians, and in radians of the
/// elbow. As in libfranka, these values allow any deviation.
const ANY_DEVIATION: (f64, f64, f64) = (10.0, 3.12, std::f64::consts::TAU);

/// Collision thresholds and stiffness of a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct ContactConfig {
    /// External torques at which the robot stops, Nm, from the base to the flange.
    pub torque_nm: [f64; N_JOINTS],
    /// External forces on the end effector at which the robot stops, along x, y and z of its base,
    /// N.
    pub force_n: [f64; 3],
    /// External moments about the same axes at which the robot stops, Nm.
    pub moment_nm: [f64; 3],
    /// Stiffness of its joints, Nm/rad; `None` leaves it unchanged.
    pub stiffness_nm_rad: Option<[f64; N_JOINTS]>,
}

impl Default for ContactConfig {
    /// The thresholds of libfranka's examples of joint motions
    /// (`generate_joint_position_motion.cpp`).
    fn default() -> Self {
        Self {
            torque_nm: [20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0],
            force_n: [20.0; 3],
            moment_nm: [25.0; 3],
            stiffness_nm_rad: None,
        }
    }
}

/// Response of the robot to a motion request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum MotionResponse {
    Started,
    Finished,
    Rejected(String),
}

/// The URDF that an FCI 10 robot serves.
pub(super) fn description(connection: &Connection) -> Result<String, String> {
    let payload = ask(
        connection,
        v10::Command::GetRobotModel.to_u32(),
        &[],
        MAX_ANSWER,
    )?;
    match payload.split_first() {
        Some((0, text)) => Ok(String::from_utf8_lossy(text).into_owned()),
        Some((status, _)) => Err(format!(
            "it refused to send its robot description: {}",
            status_text(v10::CommandStatus::from_u8(*status))
        )),
        None => Err("its answer to the request for the robot description is empty".to_owned()),
    }
}

/// Sets the collision thresholds and the stiffness, and checks each answer.
pub(super) fn set(connection: &Connection, contact: &ContactConfig) -> Result<(), String> {
    let [x, y, z] = contact.force_n;
    let [about_x, about_y, about_z] = contact.moment_nm;
    let torque = &contact.torque_nm;
    let force = &[x, y, z, about_x, about_y, about_z];
    // If a lower threshold is exceeded, the robot only reports this. The same thresholds apply with
    // and without acceleration.
    let collision = v10::SetCollisionBehaviorRequest::new(
        torque, torque, torque, torque, force, force, force, force,
    );
    let command = command_number(
        connection,
        v5::Command::SetCollisionBehavior,
        v10::Command::SetCollisionBehavior,
    );
    apply(
        connection,
        "it rejected the collision thresholds",
        command,
        collision.as_bytes(),
    )?;
    let Some(stiffness) = &contact.stiffness_nm_rad else {
        return Ok(());
    };
    let command = command_number(
        connection,
        v5::Command::SetJointImpedance,
        v10::Command::SetJointImpedance,
    );
    apply(
        connection,
        "it rejected the joint stiffness",
        command,
        v10::SetJointImpedanceRequest::new(stiffness).as_bytes(),
    )
}

/// The number of a command in the robot's FCI version. The versions number them differently.
fn command_number(connection: &Connection, v5: v5::Command, v10: v10::Command) -> u32 {
    match connection.version {
        FciVersion::V5 => v5.to_u32(),
        FciVersion::V10 => v10.to_u32(),
    }
}

/// Changes a setting, and checks the answer. `problem` starts the error message.
fn apply(
    connection: &Connection,
    problem: &str,
    number: u32,
    payload: &[u8],
) -> Result<(), String> {
    let answer = ask(connection, number, payload, MAX_ANSWER)?;
    match (connection.version, first(&answer)?) {
        (_, 0) => Ok(()),
        (FciVersion::V5, status) => Err(format!(
            "{problem}: {}",
            status_text(v5::GetterSetterStatus::from_u8(status))
        )),
        (FciVersion::V10, status) => Err(format!(
            "{problem}: {}",
            status_text(v10::GetterSetterStatus::from_u8(status))
        )),
    }
}

/// Requests a joint position motion under the robot's joint impedance controller. Returns its ID
/// once the robot has accepted it.
pub(super) fn start_motion(connection: &Connection) -> Result<u32, String> {
    let (translation, rotation, elbow) = ANY_DEVIATION;
    let deviation = || v10::Deviation::new(translation, rotation, elbow);
    let impedance_mode = v10::MoveControllerMode::JointImpedance;
    let request = match connection.version {
        FciVersion::V5 => {
            let mode = v5::MoveMotionGeneratorMode::JointPosition;
            v5::MoveRequest::new(impedance_mode, mode, deviation(), deviation())
                .as_bytes()
                .to_vec()
        }
        FciVersion::V10 => {
            let mode = v10::MoveMotionGeneratorMode::JointPosition;
            v10::MoveRequest::new(impedance_mode, mode, deviation(), deviation())
                .as_bytes()
                .to_vec()
        }
    };
    // The number of this command and of `StopMove` is the same in both versions. A motion has two
    // answers with the same ID: one when it is accepted, and one when it ends.
    let id = send(connection, v10::Command::Move.to_u32(), &request)?;
    match decode_response(connection.version, &wait(connection, id, MAX_ANSWER)?) {
        MotionResponse::Started => Ok(id),
        MotionResponse::Finished => Err("it ended the motion before it started".to_owned()),
        MotionResponse::Rejected(why) => Err(why),
    }
}

/// Ends a motion at once: the robot brakes.
pub(super) fn halt(connection: &Connection) -> Result<(), String> {
    send(connection, v10::Command::StopMove.to_u32(), &[]).map(drop)
}

/// Result of a motion, if the robot has reported it.
pub(super) fn outcome(connection: &Connection, id: u32) -> Result<Option<MotionResponse>, String> {
    let message = connection
        .network
        .tcp
        .try_receive_response(id)
        .map_err(|error| error_text(&error))?;
    Ok(message.map(|message| {
        decode_response(
            connection.version,
            message_payload(HeaderLayout::Robot, &message),
        )
    }))
}

/// Clears a reflex.
pub(super) fn recover(connection: &Connection) -> Result<(), String> {
    let number = command_number(
        connection,
        v5::Command::AutomaticErrorRecovery,
        v10::Command::AutomaticErrorRecovery,
    );
    let answer = ask(connection, number, &[], MAX_RECOVERY)?;
    let why = match (connection.version, first(&answer)?) {
        (_, 0) => return Ok(()),
        (FciVersion::V5, status) => status_text(v5::AutomaticErrorRecoveryStatus::from_u8(status)),
        (FciVersion::V10, status) => {
            status_text(v10::AutomaticErrorRecoveryStatus::from_u8(status))
        }
    };
    Err(format!("the recovery failed: {why}"))
}

/// Encodes the joint positions for the millisecond after a state as a datagram.
pub(super) fn command(
    version: FciVersion,
    number: u64,
    position_rad: &[f64; N_JOINTS],
    is_last: bool,
) -> Vec<u8> {
    // This is the number of the state that is answered. The robot computes from it for which
    // millisecond the positions are.
    let message_id = U64::new(number);
    let q_c = f64s_to_wire(position_rad);
    let motion_generation_finished = u8::from(is_last);
    match version {
        FciVersion::V5 => {
            let motion = v5::MotionGeneratorCommand {
                q_c,
                motion_generation_finished,
                ..Default::default()
            };
            v5::RobotCommand {
                message_id,
                motion,
                ..Default::default()
            }
            .as_bytes()
            .to_vec()
        }
        FciVersion::V10 => {
            let motion = v10::MotionGeneratorCommand {
                q_c,
                motion_generation_finished,
                ..Default::default()
            };
            v10::RobotCommand {
                message_id,
                motion,
                ..Default::default()
            }
            .as_bytes()
            .to_vec()
        }
    }
}

/// The reason why a robot in this mode accepts no motion, and the remedy; `None` if the robot is
/// ready.
pub(super) fn blocking_reason(mode: RobotMode) -> Option<&'static str> {
    match mode {
        RobotMode::Idle => None,
        RobotMode::Guiding => Some("it is guided by hand: release the buttons at its hand"),
        RobotMode::UserStopped => {
            Some("its user stop is pressed: release it; for an FR3 also unlock the joints in Desk")
        }
        RobotMode::Reflex => Some("it is stopped by a reflex: look at the arm, then recover"),
        RobotMode::AutomaticErrorRecovery => Some("it is recovering from a reflex"),
        RobotMode::Move => Some("a motion is active"),
        RobotMode::Other => Some("it is not ready: unlock its joints and activate FCI in Desk"),
    }
}

/// Meaning of the status of a motion.
fn decode_response(version: FciVersion, payload: &[u8]) -> MotionResponse {
    let Some(status) = payload.first() else {
        return MotionResponse::Rejected("its answer to the motion request is empty".to_owned());
    };
    // The versions number the statuses differently, but name them alike.
    let name = match version {
        FciVersion::V5 => v5::MoveStatus::from_u8(*status).map(|status| format!("{status:?}")),
        FciVersion::V10 => franka::MoveStatus::from_u8(*status).map(|status| format!("{status:?}")),
    };
    match name.as_deref() {
        Some("MotionStarted") => MotionResponse::Started,
        Some("Success") => MotionResponse::Finished,
        Some(name) => MotionResponse::Rejected(split_words(name)),
        None => MotionResponse::Rejected(format!("status {status}")),
    }
}

fn ask(
    connection: &Connection,
    command: u32,
    payload: &[u8],
    timeout: Duration,
) -> Result<Vec<u8>, String> {
    let id = send(connection, command, payload)?;
    wait(connection, id, timeout)
}

fn send(connection: &Connection, command: u32, payload: &[u8]) -> Result<u32, String> {
    connection
        .network
        .tcp
        .send_request(command, payload)
        .map_err(|error| error_text(&error))
}

/// Waits for the payload of the answer.
fn wait(connection: &Connection, id: u32, timeout: Duration) -> Result<Vec<u8>, String> {
    let response = answer(&connection.network, id, timeout)
        .map_err(|error: FrankaError| error_text(&error))?;
    let message = response.ok_or_else(|| format!("it did not answer within {timeout:?}"))?;
    Ok(message_payload(HeaderLayout::Robot, &message).to_vec())
}

fn first(payload: &[u8]) -> Result<u8, String> {
    payload
        .first()
        .copied()
        .ok_or_else(|| "its answer is empty".to_owned())
}

/// A status as text, from libfranka's name for it.
fn status_text<T: std::fmt::Debug>(status: Option<T>) -> String {
    status.map_or_else(
        || "an unknown status".to_owned(),
        |status| split_words(&format!("{status:?}")),
    )
}

/// `CommandNotPossibleRejected` as "command not possible rejected".
fn split_words(name: &str) -> String {
    let mut words = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() && !words.is_empty() {
            words.push(' ');
        }
        words.extend(letter.to_lowercase());
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_numbers_differ_between_versions() {
        assert_eq!(
            decode_response(FciVersion::V5, &[1]),
            MotionResponse::Started
        );
        assert_eq!(
            decode_response(FciVersion::V10, &[0]),
            MotionResponse::Finished
        );
        let refused = |version, status| match decode_response(version, &[status]) {
            MotionResponse::Rejected(why) => why,
            other => panic!("{other:?}"),
        };
        assert_eq!(refused(FciVersion::V5, 3), "command not possible rejected");
        assert_eq!(refused(FciVersion::V5, 6), "reflex aborted");
        assert!(refused(FciVersion::V10, 3).contains("safety functions"));
        assert_eq!(refused(FciVersion::V10, 99), "status 99");
        assert!(matches!(
            decode_response(FciVersion::V10, &[]),
            MotionResponse::Rejected(_)
        ));
    }
}
