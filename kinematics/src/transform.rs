//! Rigid motions and velocities.

use nalgebra::{Isometry3, Vector3};

/// Rigid motion; `a_from_b` maps coordinates in frame b to coordinates in frame a, in metres.
pub type Transform = Isometry3<f64>;

/// Velocity of a frame relative to the world, expressed in that frame's own axes.
///
/// A point at rest in the world moves in the frame by `-(linear_m_s + angular_rad_s x point_in_frame)` per second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twist {
    /// Velocity of the frame's origin, metres per second.
    pub linear_m_s: Vector3<f64>,
    /// Angular velocity, radians per second.
    pub angular_rad_s: Vector3<f64>,
}
