//! Joint states.

use crate::Stamp;

/// Joint readings of one arm at one instant, in the order of the chain's moving joints.
#[derive(Clone, Debug, PartialEq)]
pub struct JointState {
    /// When the joints were so.
    pub stamp: Stamp,
    /// Radians or metres.
    pub position: Vec<f64>,
    /// Radians or metres per second; empty when the device does not tell.
    pub velocity: Vec<f64>,
    /// Newton metres or newtons; empty when the device does not tell.
    pub effort: Vec<f64>,
}
