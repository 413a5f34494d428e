//! Configuration of arms whose joints are servos on a serial bus.

use super::protocol::ServoProtocol;
use super::serial::PortConfig;
use crate::can::FollowingLimits;
use crate::motion::MotionConfig;

/// Configuration of an arm from the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct ServoArmConfig {
    /// The protocol of all servos.
    pub protocol: &'static dyn ServoProtocol,
    /// The port of the bus.
    pub port: PortConfig,
    /// One servo per joint, in the order of the readings.
    pub servos: Vec<ServoConfig>,
    /// Rate at which the servos are read, Hz. It is lower if the bus or the adapter is too slow.
    pub rate_hz: f64,
}

impl ServoArmConfig {
    /// IDs of the servos.
    pub(super) fn ids(&self) -> Vec<u8> {
        self.servos.iter().map(|servo| servo.id).collect()
    }

    /// Names of the joints.
    pub(super) fn joint_names(&self) -> Vec<String> {
        self.servos
            .iter()
            .map(|servo| servo.joint.clone())
            .collect()
    }
}

/// Configuration of an arm that may be moved.
#[derive(Clone, Debug, PartialEq)]
pub struct MovableServoArmConfig {
    /// Port and servos.
    pub arm: ServoArmConfig,
    /// Limits of each joint, in the order of the servos, and the fail-safe behavior if this
    /// computer stops sending.
    pub motion: MotionConfig,
}

/// A servo and its joint: `joint = direction * (counts - zero_counts) * 2 pi / 4096 / gear_ratio`,
/// where the direction is -1 if the servo is reversed.
#[derive(Clone, Debug, PartialEq)]
pub struct ServoConfig {
    /// Name of the joint that it moves.
    pub joint: String,
    /// Its ID on the bus.
    pub id: u8,
    /// Position that the servo reports at joint angle 0, counts.
    pub zero_counts: i32,
    /// Whether it turns in the opposite direction to its joint.
    pub is_reversed: bool,
    /// Revolutions of the servo per revolution of the joint.
    pub gear_ratio: f64,
    /// Following limits of this joint.
    pub following: FollowingLimits,
}
