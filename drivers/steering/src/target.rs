//! What passes between the chain of decisions and the thread that moves the arm.

use crate::exact;
use crate::reason::{Effect, Limit};
use drivers::motion::JointTarget;
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
    /// When the arm must brake, if no newer target has arrived.
    #[serde(with = "exact::stamp")]
    pub expires_at: Stamp,
}

impl Target {
    /// The target for [`MovableArm::command`](drivers::MovableArm::command).
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

/// The decision of one cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// What the arm should do.
    pub output: Output,
    /// The limits that were applied, in the order of the links.
    pub limits: Vec<Limit>,
}

impl Verdict {
    /// Smallest fraction of the requested speed that a link left, 0 to 1: 0 if a link refused the
    /// motion or a part of it.
    pub fn speed_scale(&self) -> f64 {
        let scale = |limit: &Limit| match limit.effect {
            Effect::Slowed(scale) => scale,
            Effect::Refused | Effect::Braked => 0.0,
        };
        self.limits.iter().map(scale).fold(1.0, f64::min)
    }

    /// The target, if the arm should follow one.
    pub fn target(&self) -> Option<&Target> {
        match &self.output {
            Output::Follow(target) => Some(target),
            Output::Brake => None,
        }
    }
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
    /// The highest number of a motion after which the arm braked without an order; 0 if it never did.
    pub braked_motion: u64,
    /// Why the arm accepts no targets, if it does not.
    pub stopped: Option<String>,
}
