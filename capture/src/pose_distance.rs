//! Distance between two poses.

use kinematics::Transform;
use serde::Serialize;

/// Distance between two poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PoseDistance {
    /// Between their positions, meters.
    pub m: f64,
    /// Angle between their orientations, radians.
    pub rad: f64,
}

impl PoseDistance {
    pub(crate) fn between(one: &Transform, other: &Transform) -> Self {
        Self {
            m: (one.translation.vector - other.translation.vector).norm(),
            rad: one.rotation.angle_to(&other.rotation),
        }
    }
}

impl std::fmt::Display for PoseDistance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let degrees = self.rad.to_degrees();
        write!(f, "{:.1} mm and {degrees:.2} degrees", 1e3 * self.m)
    }
}
