//! Servo steps. A servo step moves the joints once toward a moving pose, at bounded speeds.

use super::descent::Problem;
use super::least_squares::SelectiveInverse;
use super::solver::InverseSolver;
use super::target::{PoseGap, Target};
use crate::Error;
use nalgebra::Vector6;

/// Largest speed at which a joint approaches an end of its range, as a fraction of the remaining
/// distance per second. With this limit, the joint stops smoothly.
const APPROACH_HZ: f64 = 5.0;
/// Distance that joint 4 of a Franka arm keeps from the angle at which the arm is longest, radians.
/// Beyond that angle, the range of joint 4 ends after 0.4 rad. The arm could not move back from
/// there toward the base, because it would first have to move outward. The margin shortens the
/// reach by less than a millimeter.
const ELBOW_MARGIN_RAD: f64 = 0.03;
/// A step counts as slowed by a singularity if damping removes more than this fraction of the
/// motion.
const SINGULAR_LOSS_FRAC: f64 = 0.05;

/// The largest speeds of servo steps.
#[derive(Clone, Debug, PartialEq)]
pub struct ServoLimits {
    /// Largest speed of each joint, rad/s or m/s.
    pub joint_speeds: Vec<f64>,
    /// Largest speed of the tip, m/s.
    pub linear_m_s: f64,
    /// Largest angular speed of the tip, rad/s.
    pub angular_rad_s: f64,
    /// Rate at which free joints approach the posture and leave the ends of their ranges, per
    /// second. With 0, free joints do not move.
    pub comfort_hz: f64,
}

/// What a servo step did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ServoStep {
    /// Distance from the target before the step.
    pub gap: PoseGap,
    /// Fraction of the wanted speed that the limits of the joint speeds allow, 0 to 1. The tip
    /// stays on its path at any fraction.
    pub speed_frac: f64,
    /// The joint whose speed is at its limit.
    pub fastest_joint_ix: Option<usize>,
    /// A joint that is held back because it is near an end of its range. The other joints
    /// compensate for it as far as possible.
    pub joint_at_limit_ix: Option<usize>,
    /// Whether the arm is nearly singular in the direction of the motion, which slows this part of
    /// the motion.
    pub is_singular: bool,
}

impl InverseSolver {
    /// Computes the next joint values on the way to a pose, `step_secs` after `joints`.
    ///
    /// The tip moves straight toward the target, and its rotation rate has a constant ratio to its
    /// speed. If all speed limits allow it, the tip is at the target after one step, so it follows
    /// a moving target one step behind. No joint is ever faster than its limit, whatever the target
    /// is. Targets that are distant or out of reach are approached within the same limits. Joints
    /// near the ends of their ranges stop smoothly. Joints that start beyond their ranges move
    /// inward. The elbow of a Franka arm never bends to its other side.
    ///
    /// * `joints`: present joint values, radians or meters.
    /// * `next`: output, the next joint values. It is unchanged on error.
    ///
    /// Near singularities, only motions in the nearly singular directions are damped. If a joint is
    /// too fast, all joints are slowed by the same factor, so that the tip stays on its path.
    ///
    /// # Errors
    /// Fails if numbers are not finite, if speeds or times are not positive, or if lists do not
    /// have one value per joint.
    pub fn servo(
        &mut self,
        target: &Target,
        joints: &[f64],
        limits: &ServoLimits,
        step_secs: f64,
        next: &mut [f64],
    ) -> Result<ServoStep, Error> {
        self.check_servo(target, joints, limits, step_secs, next)?;
        let problem = Problem {
            chain: &self.chain,
            bounds: &self.bounds,
            target,
            meters_per_rad: self.meters_per_rad,
        };
        let pose = problem.linearize(joints, &mut self.columns);
        let gap = target.gap(&pose);
        let velocity = problem.error(&pose) * approach_rate_hz(&gap, limits, step_secs);
        let rate_hz = APPROACH_HZ.min(1.0 / step_secs);
        let (joint_at_limit_ix, is_singular) =
            self.choose_velocity(&velocity, joints, limits, rate_hz);
        let (speed_frac, fastest_joint_ix) = slow_down(&mut self.change, &limits.joint_speeds);
        for (joint_ix, value) in joints.iter().enumerate() {
            let [lower, upper] = self.bounds.range(joint_ix);
            let moved = value + self.change[joint_ix] * step_secs;
            // Only rounding could cross an end.
            next[joint_ix] = moved.clamp(lower.min(*value), upper.max(*value));
        }
        Ok(ServoStep {
            gap,
            speed_frac,
            fastest_joint_ix,
            joint_at_limit_ix,
            is_singular,
        })
    }

    /// Computes joint velocities for a velocity of the tip, and stores them in `change`. Returns a
    /// joint that is held at the end of its range, and whether a singularity slows the motion.
    ///
    /// Free joints follow their preferred velocities, and the other joints compensate for the
    /// effect on the tip. A joint that would approach an end of its range too fast gets the largest
    /// allowed velocity, and the others compensate for the difference (Flacco, De Luca and Khatib
    /// 2015, "Control of redundant robots under hard joint constraints: saturation in the null
    /// space", section IV, for position limits).
    fn choose_velocity(
        &mut self,
        velocity: &Vector6<f64>,
        joints: &[f64],
        limits: &ServoLimits,
        rate_hz: f64,
    ) -> (Option<usize>, bool) {
        self.is_held.fill(false);
        for (joint_ix, value) in joints.iter().enumerate() {
            self.change[joint_ix] = self.comfort_velocity(joint_ix, *value, limits);
        }
        let mut joint_at_limit_ix = None;
        // Every round holds one joint more, except the last.
        loop {
            let free = self.columns.iter().zip(&self.is_held);
            let inverse =
                SelectiveInverse::new(free.filter(|(_, is_held)| !**is_held).map(|(it, _)| it));
            let motions = self.columns.iter().zip(&self.change);
            let missing = motions.fold(*velocity, |rest, (column, rate)| rest - column * *rate);
            let multipliers = inverse.multipliers(&missing);
            let mut worst = None;
            let mut most_excess = 0.0;
            for (joint_ix, value) in joints.iter().enumerate() {
                if self.is_held[joint_ix] {
                    continue;
                }
                self.change[joint_ix] += self.columns[joint_ix].dot(&multipliers);
                let rate = self.change[joint_ix];
                let [slowest, fastest] = self.rates_within(joint_ix, *value, rate_hz);
                let excess = (slowest - rate).max(rate - fastest);
                if excess > most_excess {
                    most_excess = excess;
                    worst = Some((joint_ix, rate.clamp(slowest, fastest)));
                }
            }
            let Some((joint_ix, rate)) = worst else {
                let is_singular = inverse.lost_frac(&missing) > SINGULAR_LOSS_FRAC;
                return (joint_at_limit_ix, is_singular);
            };
            self.is_held[joint_ix] = true;
            joint_at_limit_ix.get_or_insert(joint_ix);
            // The free joints start again from their preferred velocities.
            for (other_ix, value) in joints.iter().enumerate() {
                if !self.is_held[other_ix] {
                    self.change[other_ix] = self.comfort_velocity(other_ix, *value, limits);
                }
            }
            self.change[joint_ix] = rate;
        }
    }

    /// Preferred velocity of a joint, at most a quarter of its speed limit, so that most of the
    /// speed is left to the motion of the tip.
    fn comfort_velocity(&self, joint_ix: usize, value: f64, limits: &ServoLimits) -> f64 {
        let wanted = self.comfort.descent_of(&self.bounds, joint_ix, value);
        let most = 0.25 * limits.joint_speeds[joint_ix];
        (limits.comfort_hz * wanted).clamp(-most, most)
    }

    /// The velocities at which a joint does not overshoot its range. Beyond the range, only
    /// velocities back to it are allowed.
    fn rates_within(&self, joint_ix: usize, value: f64, rate_hz: f64) -> [f64; 2] {
        let [lower, upper] = self.servo_range(joint_ix, value);
        [(lower - value) * rate_hz, (upper - value) * rate_hz]
    }

    /// The range of a joint, without the part on the other side of a stretched elbow.
    fn servo_range(&self, joint_ix: usize, value: f64) -> [f64; 2] {
        let [lower, upper] = self.bounds.range(joint_ix);
        let Some(arm) = self.franka_arm().filter(|_| joint_ix == 3) else {
            return [lower, upper];
        };
        let stretched = arm.stretched_q4();
        let end = stretched - ELBOW_MARGIN_RAD;
        if value < stretched && lower < end {
            [lower, upper.min(end)]
        } else {
            [lower, upper]
        }
    }

    fn check_servo(
        &self,
        target: &Target,
        joints: &[f64],
        limits: &ServoLimits,
        step_secs: f64,
        next: &[f64],
    ) -> Result<(), Error> {
        self.chain.check(joints)?;
        self.chain.check(&limits.joint_speeds)?;
        target.check()?;
        if next.len() != joints.len() {
            return Err(Error::JointCount {
                got: next.len(),
                expected: joints.len(),
                joints: self.chain.joint_names().to_vec(),
            });
        }
        let slowest = limits.joint_speeds.iter().copied();
        let positive = [
            ("step_secs", step_secs),
            ("linear_m_s", limits.linear_m_s),
            ("angular_rad_s", limits.angular_rad_s),
            ("slowest joint speed", slowest.fold(f64::INFINITY, f64::min)),
        ];
        for (what, value) in positive {
            // Infinity is allowed, because a chain without joints has an infinite minimum.
            let is_positive = value > 0.0;
            if !is_positive {
                return Err(Error::InverseSetting {
                    what,
                    value,
                    allowed: "above 0",
                });
            }
        }
        for (what, value) in [("step_secs", step_secs), ("comfort_hz", limits.comfort_hz)] {
            if !value.is_finite() || value < 0.0 {
                return Err(Error::InverseSetting {
                    what,
                    value,
                    allowed: "finite and not negative",
                });
            }
        }
        Ok(())
    }
}

/// The rate at which the distance from the target decreases, per second. If the speed limits of the
/// tip allow it, the tip reaches the target in one step.
fn approach_rate_hz(gap: &PoseGap, limits: &ServoLimits, step_secs: f64) -> f64 {
    // Quotients of 0 are infinite and do not limit the rate.
    let linear = limits.linear_m_s / gap.distance_m;
    let angular = limits.angular_rad_s / gap.angle_rad;
    linear.min(angular).min(1.0 / step_secs)
}

/// Slows all joints by the same factor, such that no joint is too fast. Returns the factor and the
/// joint that determines the factor.
fn slow_down(velocities: &mut [f64], speeds: &[f64]) -> (f64, Option<usize>) {
    let mut speed_frac = 1.0;
    let mut fastest_joint_ix = None;
    for (joint_ix, (velocity, speed)) in velocities.iter().zip(speeds).enumerate() {
        if velocity.abs() * speed_frac > *speed {
            speed_frac = speed / velocity.abs();
            fastest_joint_ix = Some(joint_ix);
        }
    }
    for (velocity, speed) in velocities.iter_mut().zip(speeds) {
        *velocity = (*velocity * speed_frac).clamp(-speed, *speed);
    }
    (speed_frac, fastest_joint_ix)
}
