//! Joint states.

use crate::Stamp;

/// Joint readings of one arm at one instant, in the order of the chain's moving joints.
#[derive(Clone, Debug, PartialEq)]
pub struct JointState {
    /// Time of the reading.
    pub stamp: Stamp,
    /// Radians or meters.
    pub position: Vec<f64>,
    /// Radians or meters per second; empty if the device does not report velocities.
    pub velocity: Vec<f64>,
    /// Newton meters or newtons; empty if the device does not report efforts.
    pub effort: Vec<f64>,
}
