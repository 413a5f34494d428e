//! Messages between a chain of decisions and the thread of a base.

use super::BaseVelocity;
use crate::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// A velocity that the base may have until it expires.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BaseTarget {
    /// Number of the motion: a new one for every grip that moves the base. A base that braked does
    /// not follow targets of the same motion any more.
    pub motion: u64,
    /// Number of the target. It increases, so that repeated and overtaken targets can be dropped.
    pub serial: u64,
    /// The velocity.
    pub velocity: BaseVelocity,
    /// When the base must brake, if no newer target has arrived.
    #[serde(with = "exact::stamp")]
    pub expires_at: Stamp,
}

/// What the base should do.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum BaseOutput {
    /// Move at a velocity.
    Drive(BaseTarget),
    /// Come to rest with the brake limits, and stay there.
    Brake,
}

/// State of the base, as its thread reports it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BaseState {
    /// Time of the newest report of the base itself.
    #[serde(with = "exact::stamp")]
    pub reported_at: Stamp,
    /// Measured velocity.
    pub velocity: BaseVelocity,
    /// Whether the base was commanded to stand still, has confirmed this, and measures no motion.
    pub is_at_rest: bool,
    /// The greatest number of a motion that ended because the base braked; 0 if it never did.
    pub braked_motion: u64,
    /// Why the base cannot move, if it reports a fault.
    pub fault: Option<String>,
    /// Why the base refused the newest velocity, if it did.
    pub refusal: Option<String>,
}
