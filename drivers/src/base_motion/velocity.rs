//! Velocity of a base.

use serde::{Deserialize, Serialize};

/// Velocity of a base in its own frame: x forward, y left, z up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BaseVelocity {
    /// Forward, m/s.
    pub forward_m_s: f64,
    /// To the left, m/s.
    pub left_m_s: f64,
    /// Counterclockwise seen from above, rad/s.
    pub yaw_rad_s: f64,
}

impl BaseVelocity {
    /// No motion.
    pub const ZERO: Self = Self {
        forward_m_s: 0.0,
        left_m_s: 0.0,
        yaw_rad_s: 0.0,
    };

    /// A velocity from its three numbers: forward, left, yaw.
    #[must_use]
    pub fn from_array([forward_m_s, left_m_s, yaw_rad_s]: [f64; 3]) -> Self {
        Self {
            forward_m_s,
            left_m_s,
            yaw_rad_s,
        }
    }

    /// The three numbers: forward, left, yaw.
    #[must_use]
    pub fn to_array(self) -> [f64; 3] {
        [self.forward_m_s, self.left_m_s, self.yaw_rad_s]
    }

    /// Speed of the base's origin over the floor, m/s.
    #[must_use]
    pub fn speed_m_s(self) -> f64 {
        self.forward_m_s.hypot(self.left_m_s)
    }

    /// Whether all numbers are finite.
    #[must_use]
    pub fn is_finite(self) -> bool {
        self.to_array().iter().all(|number| number.is_finite())
    }

    /// Whether a base that measures this velocity counts as standing still. Odometry has noise, and
    /// a robot on legs sways.
    #[must_use]
    pub fn is_rest(self) -> bool {
        const REST_M_S: f64 = 0.03;
        const REST_RAD_S: f64 = 0.05;
        // Written so that NaN does not count as rest.
        self.speed_m_s() <= REST_M_S && self.yaw_rad_s.abs() <= REST_RAD_S
    }
}
