//! Arms that may be moved: targets, motion limits, and fail-safe behavior if this computer stops
//! sending.

#[cfg(target_os = "linux")]
mod control;
#[cfg(target_os = "linux")]
mod controlled_arm;
pub mod exact;
mod fail_safe;
mod follower;
mod generator;
#[cfg(target_os = "linux")]
mod lock;
#[cfg(target_os = "linux")]
mod mailbox;
mod mover;
mod steered;
#[cfg(feature = "emulation")]
pub mod steering_check;
mod steering_port;
#[cfg(test)]
mod steering_tests;
mod target;
#[cfg(target_os = "linux")]
mod thread;

#[cfg(target_os = "linux")]
pub(crate) use control::{Exchange, idle_cycle};
#[cfg(target_os = "linux")]
pub(crate) use controlled_arm::{ControlledArm, MotionController};
#[cfg(target_os = "linux")]
pub(crate) use fail_safe::CommandedArm;
pub use fail_safe::apply_fail_safe;
pub use follower::{Follower, brake_limits};
pub use generator::{Setpoint, TrajectoryGenerator};
#[cfg(target_os = "linux")]
pub(crate) use lock::MotionLock;
#[cfg(target_os = "linux")]
pub(crate) use mailbox::{Mailbox, MotionCommand};
pub use mover::Mover;
pub use steered::Steered;
pub use steering_port::SteeringPort;
pub(crate) use target::TargetOrder;
pub use target::{ArmState, NotFollowed, Output, Target};
#[cfg(target_os = "linux")]
pub(crate) use thread::{MotionThread, Reply, Request, SharedWithOwner};

use crate::{Arm, Error};
use kinematics::urdf::JointLimits;
use std::time::Duration;

/// Positions at which the joints should come to rest.
#[derive(Clone, Debug, PartialEq)]
pub struct JointTarget {
    /// Radians or meters, in the order of [`Arm::joint_names`].
    pub position: Vec<f64>,
}

/// Motion state of a movable arm.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Motion {
    /// The arm holds its last commanded position or, before the first command, its initial
    /// position.
    Holding,
    /// The arm is moving to its target.
    Moving,
    /// The arm stopped because of a fault, or because the connection to it was lost. The arm
    /// accepts no target until [`MovableArm::recover`] succeeds.
    Stopped {
        /// The reason for the stop.
        reason: String,
    },
}

/// An arm that can also be moved.
///
/// Opening an arm first sets and verifies how its motors react to missing commands. The owner of
/// this trait object may move the arm. Programs that only read joint states use an [`Arm`].
pub trait MovableArm: Arm {
    /// Moves to a target from any position and state of motion, within the limits of
    /// [`MotionConfig`]. A later target replaces this one.
    ///
    /// Returns the accepted target, clamped to the joints' ranges.
    ///
    /// # Errors
    /// If the target is not finite or has the wrong number of joints, or the arm is
    /// [`Motion::Stopped`]. The arm's motion does not change.
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error>;
    /// Current motion state.
    fn motion(&self) -> Motion;
    /// Brings the arm to rest within its limits, as soon as possible.
    fn stop(&mut self) -> Result<(), Error>;
    /// Enables a stopped arm again, holding its current position. Call this only at the request of
    /// a person who has checked the arm, never automatically.
    fn recover(&mut self) -> Result<(), Error>;
    /// Switches the arm to steering. From now on, it follows the targets of the port, brakes when
    /// they expire, and refuses [`MovableArm::command`]. A motion that is under way is braked.
    /// Further calls return the same port.
    ///
    /// * `brake_factor`: acceleration and jerk of braking, as a factor of the limits of motions; at
    ///   least 1.
    ///
    /// # Errors
    /// If the factor is below 1 or not finite, the arm is [`Motion::Stopped`], or its thread has
    /// ended. The arm is then not steered.
    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error>;
}

fn motion_error(reason: String) -> Error {
    Error::Motion { reason }
}

/// Reason of the error, without the prefix "the arm cannot be moved".
#[cfg(target_os = "linux")]
pub(crate) fn reason_of(error: &Error) -> String {
    match error {
        Error::Motion { reason } => reason.clone(),
        other => other.to_string(),
    }
}

/// Action of the motors when commands from this computer stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnLoss {
    /// Stop and hold their positions.
    Hold,
    /// Resist motion without holding a position.
    Damp,
    /// Release the joints. An arm without brakes then falls.
    Release,
}

impl OnLoss {
    /// Name in rig files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Damp => "damp",
            Self::Release => "release",
        }
    }
}

/// How an arm may be moved, as configured in the rig file.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionConfig {
    /// Limits of each joint.
    pub limits: Vec<MotionLimits>,
    /// Action of the motors when commands stop. An arm that does not support it is not moved.
    pub on_loss: OnLoss,
    /// Time without commands after which the motors take this action.
    pub timeout: Duration,
    /// Whether to move motors that cannot detect missing commands.
    pub accept_no_watchdog: bool,
}

/// Motion limits of a joint; radians or meters, and seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionLimits {
    /// Minimum and maximum position; infinite for a joint without limits.
    pub position: [f64; 2],
    /// Maximum velocity.
    pub velocity: f64,
    /// Maximum acceleration.
    pub acceleration: f64,
    /// Maximum jerk.
    pub jerk: f64,
}

impl MotionLimits {
    /// Limits of a joint from its description, with the velocity reduced to at most `max_speed`.
    /// From rest, a joint reaches its full acceleration in `jerk_secs`. At full acceleration, it
    /// reaches its maximum velocity in `acceleration_secs`.
    pub fn new(
        joint: &JointLimits,
        max_speed: f64,
        acceleration_secs: f64,
        jerk_secs: f64,
    ) -> Self {
        let velocity = joint.velocity.min(max_speed);
        // The limits are computed from times, because the same times suit joints of any size. An
        // acceleration would have to be chosen for each joint separately.
        let acceleration = velocity / acceleration_secs;
        Self {
            position: [joint.lower, joint.upper],
            velocity,
            acceleration,
            jerk: acceleration / jerk_secs,
        }
    }

    /// Maximum time for a joint to come to rest.
    fn max_stop_secs(&self) -> f64 {
        // In the worst case, a joint at full velocity still has its full acceleration in the
        // direction of motion. Reducing that acceleration to zero takes `a / j`. Then the joint
        // decelerates from `v` in `v / a`, plus `a / j` for the two ramps of the deceleration.
        self.velocity / self.acceleration + 2.0 * self.acceleration / self.jerk
    }
}

/// Maximum time for all joints of an arm to come to rest. They stop independently, so the slowest
/// joint counts.
#[cfg(target_os = "linux")]
pub(crate) fn max_stop_duration(limits: &[MotionLimits]) -> Duration {
    let max_secs = limits
        .iter()
        .map(MotionLimits::max_stop_secs)
        .fold(0.0, f64::max);
    Duration::try_from_secs_f64(max_secs).unwrap_or(Duration::ZERO)
}
