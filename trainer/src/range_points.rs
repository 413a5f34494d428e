//! One turn of a range scanner as a trainer takes it: points in the world.

use kinematics::{Stamp, Transform};
use std::sync::Arc;

/// Echoes of one turn, each put into the world with the scanner's pose at its own instant.
#[derive(Clone, Debug, PartialEq)]
pub struct RangePoints {
    /// Name of the scanner.
    pub scanner: Arc<str>,
    /// When the turn began.
    pub stamp: Stamp,
    /// Where the scanner was then; it saw each point from near there.
    pub world_from_scanner: Transform,
    /// The points, metres.
    pub points_in_world_m: Arc<[[f32; 3]]>,
}
