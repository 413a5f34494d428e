//! Limits of the motion of a base.

use super::BaseVelocity;
use crate::Error;
use serde::{Deserialize, Serialize};

/// How fast a base may move, and how fast it may change its velocity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseLimits {
    /// Largest speed forward and backward, m/s.
    pub max_forward_m_s: f64,
    /// Largest speed to the sides, m/s; 0 for a base that cannot move sideways.
    pub max_left_m_s: f64,
    /// Largest yaw rate, rad/s.
    pub max_yaw_rad_s: f64,
    /// Largest acceleration over the floor, m/s².
    pub acceleration_m_s2: f64,
    /// Largest yaw acceleration, rad/s².
    pub yaw_acceleration_rad_s2: f64,
    /// Deceleration of braking, m/s²; at least `acceleration_m_s2`.
    pub brake_m_s2: f64,
    /// Yaw deceleration of braking, rad/s²; at least `yaw_acceleration_rad_s2`.
    pub brake_yaw_rad_s2: f64,
}

impl BaseLimits {
    /// Checks the limits.
    ///
    /// # Errors
    /// If a limit is not positive and finite, or the base would brake less than it accelerates.
    pub fn check(&self) -> Result<(), Error> {
        let positive = [
            ("max_forward_m_s", self.max_forward_m_s),
            ("max_yaw_rad_s", self.max_yaw_rad_s),
            ("acceleration_m_s2", self.acceleration_m_s2),
            ("yaw_acceleration_rad_s2", self.yaw_acceleration_rad_s2),
            ("brake_m_s2", self.brake_m_s2),
            ("brake_yaw_rad_s2", self.brake_yaw_rad_s2),
        ];
        // The comparisons are written so that NaN is refused.
        let is_positive = |value: f64| value > 0.0 && value.is_finite();
        if let Some((name, value)) = positive.iter().find(|(_, value)| !is_positive(*value)) {
            return Err(base_error(format!(
                "{name} is {value}, must be a positive number"
            )));
        }
        let value = self.max_left_m_s;
        let is_valid = value >= 0.0 && value.is_finite();
        if !is_valid {
            return Err(base_error(format!(
                "max_left_m_s is {value}, must be 0 or a positive number"
            )));
        }
        let brakes = [
            ("brake_m_s2", self.brake_m_s2, self.acceleration_m_s2),
            (
                "brake_yaw_rad_s2",
                self.brake_yaw_rad_s2,
                self.yaw_acceleration_rad_s2,
            ),
        ];
        match brakes.iter().find(|(_, brake, motion)| brake < motion) {
            Some((name, brake, motion)) => Err(base_error(format!(
                "{name} is {brake}, must be at least the acceleration of {motion}: a base brakes at \
                 least as hard as it accelerates"
            ))),
            None => Ok(()),
        }
    }

    /// Whether the base can move to its sides.
    #[must_use]
    pub fn is_holonomic(&self) -> bool {
        self.max_left_m_s > 0.0
    }

    /// A velocity within the limits, with the same direction over the floor, and the factor on the
    /// speed, 0 to 1. Forward and sideways limits are the half axes of an ellipse. A base that
    /// cannot move sideways keeps only the forward part.
    #[must_use]
    pub fn clamped(&self, velocity: BaseVelocity) -> (BaseVelocity, f64) {
        let left_m_s = if self.is_holonomic() {
            velocity.left_m_s
        } else {
            0.0
        };
        let part = |speed: f64, limit: f64| if limit > 0.0 { speed / limit } else { 0.0 };
        let excess = part(velocity.forward_m_s, self.max_forward_m_s)
            .hypot(part(left_m_s, self.max_left_m_s));
        let scale = 1.0 / excess.max(1.0);
        let yaw_rad_s = velocity
            .yaw_rad_s
            .clamp(-self.max_yaw_rad_s, self.max_yaw_rad_s);
        let yaw_scale = if yaw_rad_s == velocity.yaw_rad_s {
            1.0
        } else {
            yaw_rad_s / velocity.yaw_rad_s
        };
        let clamped = BaseVelocity {
            forward_m_s: velocity.forward_m_s * scale,
            left_m_s: left_m_s * scale,
            yaw_rad_s,
        };
        (clamped, scale.min(yaw_scale))
    }
}

pub(super) fn base_error(reason: String) -> Error {
    Error::BaseMotion { reason }
}
