//! One revolution of a range scanner as training input: points in world.

use kinematics::{Stamp, Transform};
use std::sync::Arc;

/// Echoes of one revolution, each transformed to world with the scanner's pose at its own stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct RangePoints {
    /// Name of the scanner.
    pub scanner: Arc<str>,
    /// Begin of the revolution.
    pub stamp: Stamp,
    /// Pose of the scanner at `stamp`. It is close to the poses from which the points were
    /// observed.
    pub world_from_scanner: Transform,
    /// The points in world, meters.
    pub points_in_world_m: Arc<[[f32; 3]]>,
}
