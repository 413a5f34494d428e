//! Joint states.

use crate::Stamp;

/// Joint readings of one arm at one instant, in the order of the chain's moving joints.
#[derive(Clone, Debug, PartialEq)]
pub struct JointState {
    /// Time of the reading.
    pub stamp: Stamp,
    /// Positions, radians or meters.
    pub position: Vec<f64>,
    /// Velocities, radians or meters per second. The list is empty if the device does not report
    /// velocities.
    pub velocity: Vec<f64>,
    /// Efforts, newton meters or newtons. The list is empty if the device does not report efforts.
    pub effort: Vec<f64>,
}
