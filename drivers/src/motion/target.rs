//! What passes between a chain of decisions and the thread of an arm that is steered.

use super::{JointTarget, exact};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// A target that the arm may follow until it expires.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Target {
    /// Number of the motion: a new one for every grip that moves the arm. An arm that braked does
    /// not follow targets of the same motion any more.
    pub motion: u64,
    /// Number of the target. It increases, so that an arm can drop repeated and overtaken targets.
    pub serial: u64,
    /// Joint positions, radians or meters.
    pub position: Vec<f64>,
    /// When the arm must brake, if no newer target has arrived. An arm brakes after one second at
    /// the latest.
    #[serde(with = "exact::stamp")]
    pub expires_at: Stamp,
}

impl Target {
    /// The target for [`MovableArm::command`](crate::MovableArm::command).
    pub fn joint_target(&self) -> JointTarget {
        JointTarget {
            position: self.position.clone(),
        }
    }
}

/// What the arm should do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Output {
    /// Follow a target.
    Follow(Target),
    /// Come to rest with the brake limits, and stay there.
    Brake,
}

/// State of the arm, as its thread reports it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmState {
    /// Time of the report.
    #[serde(with = "exact::stamp")]
    pub reported_at: Stamp,
    /// Position of each joint that the generator commands now, radians or meters. Measured
    /// positions sag under load: with them, each grip would lower the arm.
    #[serde(with = "exact::list")]
    pub position: Vec<f64>,
    /// Whether the generator is at rest.
    pub is_at_rest: bool,
    /// The greatest number of a motion that ended because the arm braked; 0 if it never did.
    pub braked_motion: u64,
    /// Why the arm accepts no targets, if it does not.
    pub stopped: Option<String>,
}

/// Why a target was not followed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotFollowed {
    /// The target has the wrong number of joints, or a position that is not finite.
    #[error("target {serial} is not valid: {why}")]
    Invalid {
        /// Number of the target.
        serial: u64,
        /// What is wrong with it.
        why: String,
    },
    /// The target arrived after its expiry.
    #[error("target {serial} expired {late_secs:.3} s before it arrived")]
    Expired {
        /// Number of the target.
        serial: u64,
        /// Time since its expiry.
        late_secs: f64,
    },
    /// The target was repeated or overtaken by a newer one.
    #[error("target {serial} came after target {newest}")]
    OutOfOrder {
        /// Number of the target.
        serial: u64,
        /// Number of the newest target of the motion.
        newest: u64,
    },
    /// The arm braked during this motion, or still brakes.
    #[error("motion {motion} ended when the arm braked: it moves again with a new grip")]
    MotionEnded {
        /// Number of the motion.
        motion: u64,
    },
    /// The generator cannot use the target. The arm brakes.
    #[error("the arm brakes: {why}")]
    Generator {
        /// Message of the generator.
        why: String,
    },
}

/// The newest target that was accepted, and the motions that have ended.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct TargetOrder {
    /// Number of the newest motion.
    pub(super) motion: u64,
    /// Number of the newest target of this motion.
    serial: u64,
    /// The greatest number of a motion that has ended.
    pub(super) ended_motion: u64,
}

impl TargetOrder {
    /// Checks that a target is valid, and newer than those accepted before it. A new motion may
    /// count its targets from the start: the program that sends them may have been restarted.
    pub(super) fn check(&self, target: &Target, n_joints: usize) -> Result<(), NotFollowed> {
        let serial = target.serial;
        if let Some(why) = position_problem(&target.position, n_joints) {
            return Err(NotFollowed::Invalid { serial, why });
        }
        self.check_numbers(target.motion, serial)
    }

    /// Checks that a target is newer than those accepted before it.
    pub(crate) fn check_numbers(&self, motion: u64, serial: u64) -> Result<(), NotFollowed> {
        if motion == self.motion && serial <= self.serial {
            let newest = self.serial;
            return Err(NotFollowed::OutOfOrder { serial, newest });
        }
        if motion <= self.ended_motion || motion < self.motion {
            return Err(NotFollowed::MotionEnded { motion });
        }
        Ok(())
    }

    /// Records an accepted target.
    pub(super) fn accept(&mut self, target: &Target) {
        self.accept_numbers(target.motion, target.serial);
    }

    /// Records the numbers of an accepted target.
    pub(crate) fn accept_numbers(&mut self, motion: u64, serial: u64) {
        self.motion = motion;
        self.serial = serial;
    }

    /// The greatest number of a motion that has ended; 0 if none has.
    pub(crate) fn ended_motion(&self) -> u64 {
        self.ended_motion
    }

    /// Ends all motions up to a number.
    pub(crate) fn end_motion(&mut self, motion: u64) {
        self.ended_motion = self.ended_motion.max(motion);
    }
}

fn position_problem(position: &[f64], n_joints: usize) -> Option<String> {
    if position.len() != n_joints {
        return Some(format!("{} joints instead of {n_joints}", position.len()));
    }
    let ix = position.iter().position(|q| !q.is_finite())?;
    Some(format!(
        "the position of joint {} is {}, which is not finite",
        ix + 1,
        position[ix]
    ))
}
