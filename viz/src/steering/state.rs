//! State of a steered arm, as clients receive it.

use serde::Serialize;
use std::time::Instant;

/// State of the arm and of its operators. All poses are in the frame of the arm's base: x, y, z in
/// meters, and a quaternion x, y, z, w.
#[derive(Clone, Debug, PartialEq)]
pub struct SteeringState {
    /// Time of the positions.
    pub at: Instant,
    /// The client that may move the arm.
    pub holder: Option<u64>,
    /// Time until the lease ends if its holder is silent.
    pub lease_left_secs: Option<f64>,
    /// The client that may take the lease over.
    pub offered_to: Option<u64>,
    /// Why the arm stays at rest until an operator permits motion, if it does.
    pub stop: Option<String>,
    /// Number of the newest stop while `stop` is set. A permission names it.
    pub stop_number: Option<u64>,
    /// Whether the arm is being enabled after a fault. When this succeeds, motion is permitted,
    /// unless somebody stops the arm meanwhile.
    pub is_recovering: bool,
    /// Whether the robot moves or brakes.
    pub is_moving: bool,
    /// The part that the operator moves; `None` while no dead-man switch is held.
    pub moved_part: Option<SteeredPart>,
    /// Position of each joint, radians or meters.
    pub position: Vec<f64>,
    /// The joint positions to which the arm moves, if it follows a target.
    pub target: Option<Vec<f64>>,
    /// Pose of the tip.
    pub base_from_tip: [f64; 7],
    /// Pose of the tip at `target`.
    pub base_from_target: Option<[f64; 7]>,
    /// The limits that are applied now, in the order of the links.
    pub limits: Vec<AppliedLimit>,
    /// The command that the last setpoint came from, if the arm follows one.
    pub applied: Option<AppliedCommand>,
    /// Contacts of the robot with the scene so far; `None` if they are not known, as for a real arm.
    pub contacts: Option<u64>,
    /// State of the base, if it is steered.
    pub base: Option<SteeredBaseState>,
}

/// State of a base that is steered, as clients receive it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SteeredBaseState {
    /// Pose on the floor of the world: x and y in meters, and the heading in radians; `None` if it is
    /// not known.
    pub world_from_base: Option<[f64; 3]>,
    /// Measured velocity: forward and left in m/s, and the yaw rate in rad/s.
    pub velocity: [f64; 3],
    /// Whether the base moves or brakes.
    pub is_moving: bool,
    /// The velocity that the base should have, if it follows an operator.
    pub target: Option<[f64; 3]>,
    /// The goal of the operator: x and y in meters, and the heading in radians, in the world.
    pub goal: Option<[f64; 3]>,
    /// Whether the base is at the goal.
    pub has_arrived: bool,
}

/// A part of a robot that operators move.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SteeredPart {
    /// The arm.
    Arm,
    /// The base.
    Base,
}

/// A limit that slows the robot down or keeps it from moving.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AppliedLimit {
    /// The part that is limited.
    pub part: SteeredPart,
    /// What limits it.
    pub link: LimitLink,
    /// What it does.
    pub effect: LimitEffect,
    /// Fraction of the requested speed that is left, 0 to 1.
    pub speed_scale: f64,
    /// Why, in one sentence.
    pub text: String,
    /// Where: for limits of the arm in the frame of its base, for limits of the base in the world,
    /// meters.
    pub place: Option<[f64; 3]>,
}

/// A link in the chain of decisions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LimitLink {
    /// Who may move the arm.
    Lease,
    /// Whether the operator wants the arm to move now.
    Clutch,
    /// How fast and how far the arm may move.
    Limits,
    /// Distance between parts of the robot.
    SelfCollision,
    /// Distance from the scene.
    Clearance,
    /// The arm itself, also while the base moves.
    Arm,
    /// The base itself.
    Base,
}

/// What a limit does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LimitEffect {
    /// The motion is slower than requested.
    Slowed,
    /// The motion, or a part of it, was refused.
    Refused,
    /// The arm brakes, and does not move before a new grip.
    Braked,
}

/// A command that became a setpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AppliedCommand {
    /// Device of the holder.
    pub device: u64,
    /// Number of the command.
    pub sequence: u64,
    /// When the device was read, as in the command.
    pub captured_at: Instant,
    /// When the setpoint was given to the arm.
    pub applied_at: Instant,
}
