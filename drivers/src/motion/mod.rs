//! Arms that may be moved: where to, how fast at most, and what becomes of them when their computer falls silent.

mod generator;

pub use generator::{Setpoint, TrajectoryGenerator};

use crate::{Arm, Error};
use kinematics::urdf::JointLimits;
use std::time::Duration;

/// Where joints are to come to rest.
#[derive(Clone, Debug, PartialEq)]
pub struct JointTarget {
    /// Radians or metres, in the order of [`Arm::joint_names`].
    pub position: Vec<f64>,
}

/// What a movable arm does.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Motion {
    /// It is held where it was last sent, or where it was found.
    Holding,
    /// It is on its way.
    Moving,
    /// It stopped by itself or was lost, and takes no target before [`MovableArm::recover`].
    Stopped {
        /// What stopped it, in words.
        reason: String,
    },
}

/// An arm that may also be moved.
///
/// It is opened only after what stops its motors when this computer falls silent was set and read back. Whoever holds it may move
/// it; programs that only watch hold an [`Arm`].
pub trait MovableArm: Arm {
    /// Heads for a target from wherever it is, in whatever motion it is, within the limits of [`MotionConfig`]; a later target
    /// replaces it.
    ///
    /// Returns the target that is headed for: inside the joints' ranges. A target of another arm, one that is no number, and any
    /// target while the arm is [`Motion::Stopped`], are errors and change nothing.
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error>;
    /// What it does now.
    fn motion(&self) -> Motion;
    /// Comes to rest within its limits, wherever that is.
    fn stop(&mut self) -> Result<(), Error>;
    /// Switches an arm that stopped on again, held where it is now: for a person who looked at it to ask for, never for a loop.
    fn recover(&mut self) -> Result<(), Error>;
}

/// What motors do by themselves once their computer falls silent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnLoss {
    /// Stop and keep their places.
    Hold,
    /// Resist being moved, without keeping a place.
    Damp,
    /// Let go: an arm without brakes falls.
    Release,
}

impl OnLoss {
    /// As rig files have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Damp => "damp",
            Self::Release => "release",
        }
    }
}

/// How an arm may be moved, as the rig file has it.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionConfig {
    /// Of each joint.
    pub limits: Vec<MotionLimits>,
    /// What motors are set to do when this computer falls silent; an arm that cannot is not moved.
    pub on_loss: OnLoss,
    /// After how long a silence.
    pub timeout: Duration,
    /// Whether motors that cannot notice the silence are moved all the same.
    pub accept_no_watchdog: bool,
}

/// How a joint may be moved; radians or metres, and seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionLimits {
    /// Smallest and largest position; infinite where a joint turns without end.
    pub position: [f64; 2],
    /// Largest speed.
    pub velocity: f64,
    /// Largest acceleration.
    pub acceleration: f64,
    /// Largest jerk.
    pub jerk: f64,
}

impl MotionLimits {
    /// Of a joint by its description, no faster than `max_speed`, reached within `acceleration_secs` from rest at full acceleration,
    /// which is reached within `jerk_secs`.
    pub fn new(joint: &JointLimits, max_speed: f64, acceleration_secs: f64, jerk_secs: f64) -> Self {
        let velocity = joint.velocity.min(max_speed);
        let acceleration = velocity / acceleration_secs;
        Self { position: [joint.lower, joint.upper], velocity, acceleration, jerk: acceleration / jerk_secs }
    }
}
