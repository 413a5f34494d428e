//! One revolution of a range scanner as training input: points in the world frame.

use kinematics::{Stamp, Transform};
use std::sync::Arc;

/// Points of one revolution. Each point was transformed to the world frame with the scanner's pose
/// at the point's own stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct RangePoints {
    /// Name of the scanner.
    pub scanner: Arc<str>,
    /// Begin of the revolution.
    pub stamp: Stamp,
    /// Pose of the scanner at `stamp`. The points were observed from poses that are close to this
    /// one.
    pub world_from_scanner: Transform,
    /// The points in world, meters.
    pub points_in_world_m: Arc<[[f32; 3]]>,
}
