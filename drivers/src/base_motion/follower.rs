//! Turns targets of a base into velocities within its limits.

use super::limits::base_error;
use super::{BaseLimits, BaseTarget, BaseVelocity};
use crate::Error;
use crate::motion::{NotFollowed, TargetOrder};
use kinematics::Stamp;

/// Longest time between two steps for which the velocity changes. After a longer pause, it changes
/// as if the pause had been this long.
const MAX_STEP_SECS: f64 = 0.1;

/// Follows the velocities of targets within the limits of acceleration, and brakes with separate
/// limits when a target expires. It has no clock: every function takes the time.
#[derive(Clone, Debug)]
pub struct BaseFollower {
    limits: BaseLimits,
    velocity: BaseVelocity,
    /// The newest target; `None` while the base brakes or rests.
    target: Option<BaseTarget>,
    order: TargetOrder,
    stepped_at: Option<Stamp>,
}

impl BaseFollower {
    /// A follower of a base at rest.
    ///
    /// # Errors
    /// If the limits are not valid, see [`BaseLimits::check`].
    pub fn new(limits: BaseLimits) -> Result<Self, Error> {
        limits.check()?;
        Ok(Self {
            limits,
            velocity: BaseVelocity::ZERO,
            target: None,
            order: TargetOrder::default(),
            stepped_at: None,
        })
    }

    /// The velocity of the last step.
    #[must_use]
    pub fn velocity(&self) -> BaseVelocity {
        self.velocity
    }

    /// Whether the velocity is zero and no target is followed.
    #[must_use]
    pub fn is_at_rest(&self) -> bool {
        self.target.is_none() && self.velocity == BaseVelocity::ZERO
    }

    /// The greatest number of a motion that has ended; 0 if none has.
    #[must_use]
    pub fn braked_motion(&self) -> u64 {
        self.order.ended_motion()
    }

    /// Follows a target from the next step on.
    ///
    /// # Errors
    /// If the target is not finite, expired, repeated or overtaken, or its motion has ended. The
    /// motion of the base does not change.
    pub fn follow(&mut self, now: Stamp, target: &BaseTarget) -> Result<(), NotFollowed> {
        let serial = target.serial;
        if !target.velocity.is_finite() {
            let why = "its velocity is not finite".to_owned();
            return Err(NotFollowed::Invalid { serial, why });
        }
        self.order.check_numbers(target.motion, serial)?;
        if now > target.expires_at {
            let late_secs = now.secs_since(target.expires_at);
            return Err(NotFollowed::Expired { serial, late_secs });
        }
        self.order.accept_numbers(target.motion, serial);
        self.target = Some(*target);
        Ok(())
    }

    /// Brakes. All motions up to a number have ended.
    pub fn brake(&mut self, up_to_motion: u64) {
        self.order.end_motion(up_to_motion);
        self.end_motion();
    }

    /// Sets the velocity of a base that moved without targets until now, and brakes from there.
    ///
    /// # Errors
    /// If the velocity is not finite.
    pub fn resume(&mut self, now: Stamp, velocity: BaseVelocity) -> Result<(), Error> {
        if !velocity.is_finite() {
            return Err(base_error("its present velocity is not finite".to_owned()));
        }
        self.end_motion();
        self.stepped_at = Some(now);
        self.velocity = velocity;
        Ok(())
    }

    /// The velocity from now on.
    pub fn step(&mut self, now: Stamp) -> BaseVelocity {
        let since_last = self.stepped_at.map_or(0.0, |last| now.secs_since(last));
        let secs = since_last.clamp(0.0, MAX_STEP_SECS);
        // A target would last longer if the clock went back.
        let went_back = since_last < 0.0;
        self.stepped_at = Some(now);
        if self
            .target
            .is_some_and(|target| went_back || now > target.expires_at)
        {
            self.end_motion();
        }
        let limits = &self.limits;
        let (wanted, linear, angular) = match self.target {
            Some(target) => (
                limits.clamped(target.velocity).0,
                limits.acceleration_m_s2,
                limits.yaw_acceleration_rad_s2,
            ),
            None => (
                BaseVelocity::ZERO,
                limits.brake_m_s2,
                limits.brake_yaw_rad_s2,
            ),
        };
        self.velocity = approach(self.velocity, wanted, linear * secs, angular * secs);
        self.velocity
    }

    fn end_motion(&mut self) {
        if let Some(target) = self.target.take() {
            self.order.end_motion(target.motion);
        }
    }
}

/// The velocity after a change toward `wanted` by at most `linear_m_s` over the floor and
/// `angular_rad_s` in yaw.
fn approach(
    velocity: BaseVelocity,
    wanted: BaseVelocity,
    linear_m_s: f64,
    angular_rad_s: f64,
) -> BaseVelocity {
    let forward = wanted.forward_m_s - velocity.forward_m_s;
    let left = wanted.left_m_s - velocity.left_m_s;
    let change_m_s = forward.hypot(left);
    let yaw = wanted.yaw_rad_s - velocity.yaw_rad_s;
    // `wanted` is reached exactly, so that the velocity of a base at rest is exactly zero.
    let (forward_m_s, left_m_s) = if change_m_s <= linear_m_s {
        (wanted.forward_m_s, wanted.left_m_s)
    } else {
        let share = linear_m_s / change_m_s;
        (
            velocity.forward_m_s + forward * share,
            velocity.left_m_s + left * share,
        )
    };
    let yaw_rad_s = if yaw.abs() <= angular_rad_s {
        wanted.yaw_rad_s
    } else {
        velocity.yaw_rad_s + angular_rad_s.copysign(yaw)
    };
    BaseVelocity {
        forward_m_s,
        left_m_s,
        yaw_rad_s,
    }
}
