//! Velocities that bring a base to a goal on the floor.
//!
//! A base that can move sideways drives straight to the goal and turns at the same time. Any
//! other base turns toward the goal, drives to it, and turns to the heading there. The velocity
//! depends only on the pose and on whether the goal was reached before. A base that was moved
//! therefore continues from its new pose.

use crate::base_verdict::FloorPose;
use drivers::base_motion::{BaseLimits, BaseVelocity};
use std::f64::consts::{E, PI};

/// A base reaches its goal within the first distance, and leaves it beyond the second one, meters.
/// Localization has noise of this size.
const AT_GOAL_M: f64 = 0.03;
const LEFT_GOAL_M: f64 = 0.08;
/// The same for the heading.
const AT_HEADING_RAD: f64 = 0.03;
/// Fraction of the acceleration limit with which the base slows down before the goal. The rest is
/// a reserve for decelerating later than planned.
const DECELERATION_FRAC: f64 = 0.5;
/// Bearing of the goal, radians, beyond which a base that cannot move sideways only turns.
const TURN_ONLY_RAD: f64 = 0.35;

/// The next velocity toward a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct GoalStep {
    pub(crate) velocity: BaseVelocity,
    /// Whether the place is reached; the heading may not be.
    pub(crate) is_at_place: bool,
    /// Whether place and heading are reached.
    pub(crate) has_arrived: bool,
}

/// The velocity toward a goal.
///
/// * `was_at_place`: whether the place was reached before.
/// * `reaction_secs`: time from the pose until the base follows the velocity.
pub(crate) fn toward(
    goal: &FloorPose,
    pose: &FloorPose,
    limits: &BaseLimits,
    was_at_place: bool,
    reaction_secs: f64,
) -> GoalStep {
    // Close to the goal, the speed is the distance divided by a time. A delayed loop of this kind
    // does not overshoot if the time is at least e times the delay.
    let settle_secs = E * reaction_secs;
    let x = goal.x_m - pose.x_m;
    let y = goal.y_m - pose.y_m;
    let distance_m = x.hypot(y);
    let at_place_m = if was_at_place { LEFT_GOAL_M } else { AT_GOAL_M };
    let is_at_place = distance_m <= at_place_m;
    let heading_error_rad = wrapped(goal.yaw_rad - pose.yaw_rad);
    let has_arrived = is_at_place && heading_error_rad.abs() <= AT_HEADING_RAD;
    let turn = |angle_rad: f64| {
        let speed = pace(
            angle_rad.abs(),
            limits.max_yaw_rad_s,
            limits.yaw_acceleration_rad_s2,
            settle_secs,
        );
        speed.copysign(angle_rad)
    };
    let bearing_rad = wrapped(y.atan2(x) - pose.yaw_rad);
    let speed_of = |max_m_s: f64| pace(distance_m, max_m_s, limits.acceleration_m_s2, settle_secs);
    let velocity = if has_arrived {
        BaseVelocity::ZERO
    } else if is_at_place {
        BaseVelocity {
            yaw_rad_s: turn(heading_error_rad),
            ..BaseVelocity::ZERO
        }
    } else if limits.is_holonomic() {
        let speed_m_s = speed_of(limits.max_forward_m_s);
        let straight = BaseVelocity {
            forward_m_s: speed_m_s * bearing_rad.cos(),
            left_m_s: speed_m_s * bearing_rad.sin(),
            yaw_rad_s: turn(heading_error_rad),
        };
        limits.clamped(straight).0
    } else {
        let alignment = (1.0 - bearing_rad.abs() / TURN_ONLY_RAD).max(0.0);
        BaseVelocity {
            forward_m_s: speed_of(limits.max_forward_m_s) * alignment,
            left_m_s: 0.0,
            yaw_rad_s: turn(bearing_rad),
        }
    };
    GoalStep {
        velocity,
        is_at_place,
        has_arrived,
    }
}

/// Speed at a distance from the goal. From this speed, the base can decelerate to zero. Close to
/// the goal, the speed is proportional to the distance.
fn pace(distance: f64, max_speed: f64, acceleration: f64, settle_secs: f64) -> f64 {
    let decelerated = (2.0 * DECELERATION_FRAC * acceleration * distance).sqrt();
    max_speed.min(decelerated).min(distance / settle_secs)
}

/// An angle between -π and π.
pub(crate) fn wrapped(angle_rad: f64) -> f64 {
    let turns = (angle_rad / (2.0 * PI)).round();
    angle_rad - 2.0 * PI * turns
}
