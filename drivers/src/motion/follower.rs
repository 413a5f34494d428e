//! Turns targets that expire into setpoints. This belongs into the thread that moves the arm.
//!
//! It needs nothing but targets and the time. The arm therefore brakes whatever happens to the
//! program that sends the targets.

use super::generator::{Setpoint, TrajectoryGenerator};
use super::target::{NotFollowed, Output, Target, TargetOrder};
use super::{MotionLimits, motion_error};
use crate::Error;
use kinematics::Stamp;
use std::time::Duration;

/// Rounding of a setpoint, relative to its limits. The generator sets velocities of up to 1e-8 to
/// zero at the end of a trajectory.
const TOLERANCE: f64 = 1.0 + 1e-4;
/// Longest time for which a target is followed, whatever its expiry: a program with a wrong clock
/// must not keep the arm moving.
const MAX_VALIDITY: Duration = Duration::from_secs(1);
/// Fractions of the jerk with which the brake is planned if its plan cannot be used.
const BRAKE_JERK_FRACS: [f64; 5] = [1.0, 1.0 - 1e-6, 1.0 - 1e-4, 0.99, 0.9];

/// Generates one setpoint per cycle, and brakes when targets expire.
#[derive(Debug)]
pub struct Follower {
    generator: TrajectoryGenerator,
    /// Generator with the brake limits, while the arm brakes.
    brake: Option<TrajectoryGenerator>,
    limits: Vec<MotionLimits>,
    brake_limits: Vec<MotionLimits>,
    period: Duration,
    setpoint: Setpoint,
    /// Target of the generator, before it was clamped.
    target: Vec<f64>,
    order: TargetOrder,
    /// When the newest target expires; `None` if no target is followed.
    expires_at: Option<Stamp>,
}

impl Follower {
    /// A follower at rest at `position`.
    ///
    /// * `limits`: limits of motions.
    /// * `brake_limits`: limits of braking; at least as high.
    ///
    /// # Errors
    /// If a brake limit is lower than the limit of motions, because the arm could then be in a
    /// state from which it cannot brake within its limits; or for the reasons of
    /// [`TrajectoryGenerator::new`].
    pub fn new(
        limits: &[MotionLimits],
        brake_limits: &[MotionLimits],
        position: &[f64],
        period: Duration,
    ) -> Result<Self, Error> {
        check_brake_limits(limits, brake_limits)?;
        let generator = TrajectoryGenerator::new(limits, position, period).map_err(motion_error)?;
        Ok(Self {
            generator,
            brake: None,
            limits: limits.to_vec(),
            brake_limits: brake_limits.to_vec(),
            period,
            setpoint: Setpoint::at_rest(position.to_vec()),
            target: position.to_vec(),
            order: TargetOrder::default(),
            expires_at: None,
        })
    }

    /// Rests at `position` with other limits, because the arm stopped or was guided by hand. Ends
    /// the motion: no target of it is followed any more.
    ///
    /// # Errors
    /// For the reasons of [`Follower::new`]. The follower then does not change.
    pub fn rest_at(
        &mut self,
        limits: &[MotionLimits],
        brake_limits: &[MotionLimits],
        position: &[f64],
    ) -> Result<(), Error> {
        let mut order = self.order;
        order.end_motion(order.motion);
        *self = Self {
            order,
            ..Self::new(limits, brake_limits, position, self.period)?
        };
        Ok(())
    }

    /// Sets the time between setpoints. The next call must be [`Follower::rest_at`].
    #[cfg(target_os = "linux")]
    pub(super) fn set_period(&mut self, period: Duration) {
        self.period = period;
    }

    /// Continues from a different state of motion. Use it if the reference of the arm differs from
    /// the last setpoint.
    ///
    /// # Errors
    /// If a value is not finite, or their number is wrong. The follower then does not change.
    pub fn resume(&mut self, from: &Setpoint) -> Result<(), Error> {
        // While the arm brakes, this generator is not used, but it checks the values.
        self.generator.resume(from).map_err(motion_error)?;
        self.setpoint.clone_from(from);
        if self.expires_at.is_none() {
            self.brake = brake_from(from, &self.brake_limits, self.period).ok();
        }
        Ok(())
    }

    /// Brakes, and ends all motions up to a number, whether a target of them has arrived or not.
    pub fn end_motion(&mut self, motion: u64) {
        self.start_brake();
        self.order.end_motion(motion);
    }

    /// Takes the output of the chain of decisions.
    ///
    /// # Errors
    /// If the target is not followed. Unless the error is [`NotFollowed::Generator`], the motion
    /// does not change.
    pub fn obey(&mut self, now: Stamp, output: &Output) -> Result<(), NotFollowed> {
        match output {
            Output::Follow(target) => self.follow(now, target),
            Output::Brake => {
                self.start_brake();
                Ok(())
            }
        }
    }

    /// The setpoint of the next cycle.
    ///
    /// # Errors
    /// If not even braking succeeds. The arm must then apply its fail-safe.
    pub fn step(&mut self, now: Stamp) -> Result<Setpoint, Error> {
        // Written so that a target without expiry counts as expired.
        let is_fresh = self.expires_at.is_some_and(|expires_at| now <= expires_at);
        if !is_fresh {
            self.start_brake();
        }
        if self.expires_at.is_some() {
            let next = self.generator.step();
            match next {
                Ok(next) if self.excess(&next, &self.limits).is_none() => {
                    self.setpoint = next.clone();
                    return Ok(next);
                }
                // A plan that fails must not keep the arm moving.
                _ => self.start_brake(),
            }
        }
        self.step_brake()
    }

    /// The last setpoint.
    pub fn setpoint(&self) -> &Setpoint {
        &self.setpoint
    }

    /// Whether all joints are at rest.
    pub fn is_at_rest(&self) -> bool {
        let is_zero = |values: &[f64]| values.iter().all(|value| *value == 0.0);
        is_zero(&self.setpoint.velocity) && is_zero(&self.setpoint.acceleration)
    }

    /// Whether the arm follows a target, also if it has arrived there.
    pub fn is_following(&self) -> bool {
        self.expires_at.is_some()
    }

    /// The greatest number of a motion that ended because the arm braked; 0 at first.
    pub fn braked_motion(&self) -> u64 {
        self.order.ended_motion
    }

    fn follow(&mut self, now: Stamp, target: &Target) -> Result<(), NotFollowed> {
        self.order.check(target, self.limits.len())?;
        let serial = target.serial;
        if now > target.expires_at {
            let late_secs = now.secs_since(target.expires_at);
            return Err(NotFollowed::Expired { serial, late_secs });
        }
        if self.expires_at.is_none() && !self.is_at_rest() {
            let motion = target.motion;
            return Err(NotFollowed::MotionEnded { motion });
        }
        if self.expires_at.is_none() {
            self.restart()
                .map_err(|why| NotFollowed::Generator { why })?;
        }
        self.order.accept(target);
        self.expires_at = Some(target.expires_at.min(now + MAX_VALIDITY));
        // An equal target only lasts longer. Planning again from a state on the way to it could
        // fail because of rounding, and an arm that holds its position would plan in every cycle.
        if target.position == self.target {
            return Ok(());
        }
        if let Err(why) = self.generator.set_target(&target.joint_target()) {
            self.start_brake();
            return Err(NotFollowed::Generator { why });
        }
        self.target.clone_from(&target.position);
        Ok(())
    }

    /// A new generator at the position at which the arm rests.
    fn restart(&mut self) -> Result<(), String> {
        let position = &self.setpoint.position;
        self.generator = TrajectoryGenerator::new(&self.limits, position, self.period)?;
        self.target.clone_from(position);
        self.brake = None;
        Ok(())
    }

    /// Ends the motion. The arm continues from its state of motion with the brake limits.
    fn start_brake(&mut self) {
        self.expires_at = None;
        self.order.end_motion(self.order.motion);
        if self.brake.is_some() || self.is_at_rest() {
            return;
        }
        self.brake = brake_from(&self.setpoint, &self.brake_limits, self.period).ok();
    }

    fn step_brake(&mut self) -> Result<Setpoint, Error> {
        if self.is_at_rest() {
            return Ok(self.setpoint.clone());
        }
        let planned = self.brake.as_mut().map(TrajectoryGenerator::step);
        let next = match planned {
            Some(Ok(next)) if self.excess(&next, &self.brake_limits).is_none() => next,
            _ => self.brake_anew()?,
        };
        self.setpoint = next.clone();
        Ok(next)
    }

    /// Plans the brake again with slightly less jerk, and returns the next setpoint.
    fn brake_anew(&mut self) -> Result<Setpoint, Error> {
        let mut why = String::new();
        for jerk_frac in BRAKE_JERK_FRACS {
            let limits = with_jerk(&self.brake_limits, jerk_frac);
            let planned = brake_from(&self.setpoint, &limits, self.period)
                .and_then(|mut brake| brake.step().map(|next| (brake, next)));
            match planned {
                Ok((brake, next)) => match self.excess(&next, &self.brake_limits) {
                    None => {
                        self.brake = Some(brake);
                        return Ok(next);
                    }
                    Some(excess) => why = excess,
                },
                Err(error) => why = error,
            }
        }
        Err(motion_error(why))
    }

    /// Returns what is wrong with a setpoint that does not continue from the last one within
    /// velocity, acceleration and jerk. Plans are checked because their sources of errors, such as
    /// rounding near degenerate profiles, are not all known, and because a robot's controller would
    /// stop at such a setpoint.
    fn excess(&self, next: &Setpoint, limits: &[MotionLimits]) -> Option<String> {
        let secs = self.period.as_secs_f64();
        let last = &self.setpoint;
        limits.iter().enumerate().find_map(|(ix, joint)| {
            let [velocity, acceleration] = allowed_rates(joint, last, ix);
            let changes = [
                ("position", &last.position, &next.position, velocity),
                ("velocity", &last.velocity, &next.velocity, acceleration),
                (
                    "acceleration",
                    &last.acceleration,
                    &next.acceleration,
                    joint.jerk,
                ),
            ];
            let (what, last, next, _) = changes.into_iter().find(|(_, last, next, limit)| {
                // Written so that NaN is an excess.
                let is_within = (next[ix] - last[ix]).abs() <= limit * secs * TOLERANCE;
                !is_within
            })?;
            Some(format!(
                "the {what} of joint {} would change from {} to {} in one cycle",
                ix + 1,
                last[ix],
                next[ix]
            ))
        })
    }
}

/// Velocity and acceleration that a joint may have after its last setpoint. They exceed its limits
/// only if they must after [`Follower::resume`]: while a joint reduces an acceleration `a` with the
/// jerk `j`, it gains the velocity `a² / 2j`.
fn allowed_rates(joint: &MotionLimits, last: &Setpoint, ix: usize) -> [f64; 2] {
    let velocity = last.velocity[ix];
    let acceleration = last.acceleration[ix];
    let gained = if velocity * acceleration >= 0.0 {
        acceleration.powi(2) / (2.0 * joint.jerk)
    } else {
        0.0
    };
    [
        joint.velocity.max(velocity.abs() + gained),
        joint.acceleration.max(acceleration.abs()),
    ]
}

fn with_jerk(limits: &[MotionLimits], frac: f64) -> Vec<MotionLimits> {
    limits
        .iter()
        .map(|joint| MotionLimits {
            jerk: joint.jerk * frac,
            ..*joint
        })
        .collect()
}

/// A generator that brings the arm to rest from a state of motion.
fn brake_from(
    setpoint: &Setpoint,
    brake_limits: &[MotionLimits],
    period: Duration,
) -> Result<TrajectoryGenerator, String> {
    // A stop is the shortest way to rest, wherever it ends. A generator with ranges would refuse to
    // start outside of them.
    let without_ranges: Vec<MotionLimits> = brake_limits
        .iter()
        .map(|joint| MotionLimits {
            position: [f64::NEG_INFINITY, f64::INFINITY],
            ..*joint
        })
        .collect();
    let mut brake = TrajectoryGenerator::new(&without_ranges, &setpoint.position, period)?;
    brake.resume(setpoint)?;
    brake.stop();
    Ok(brake)
}

fn check_brake_limits(limits: &[MotionLimits], brake_limits: &[MotionLimits]) -> Result<(), Error> {
    if brake_limits.len() != limits.len() {
        return Err(motion_error(format!(
            "brake limits are given for {} joints, but the arm has {}",
            brake_limits.len(),
            limits.len()
        )));
    }
    for (ix, (limits, brake)) in limits.iter().zip(brake_limits).enumerate() {
        for (what, limit, brake) in [
            ("velocity", limits.velocity, brake.velocity),
            ("acceleration", limits.acceleration, brake.acceleration),
            ("jerk", limits.jerk, brake.jerk),
        ] {
            // Written so that NaN is refused.
            let is_sufficient = brake >= limit && brake.is_finite();
            if !is_sufficient {
                return Err(motion_error(format!(
                    "the {what} of joint {} for braking is {brake}, must be at least {limit}, that of its motions",
                    ix + 1
                )));
            }
        }
    }
    Ok(())
}

/// Brake limits from motion limits: the same velocity, and `factor` times the acceleration and the
/// jerk.
pub fn brake_limits(limits: &[MotionLimits], factor: f64) -> Vec<MotionLimits> {
    limits
        .iter()
        .map(|joint| MotionLimits {
            acceleration: joint.acceleration * factor,
            jerk: joint.jerk * factor,
            ..*joint
        })
        .collect()
}
