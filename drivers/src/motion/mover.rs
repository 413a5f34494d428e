//! The setpoints of an arm, toward the targets of its owner or of a steering port.

use super::generator::{Setpoint, TrajectoryGenerator};
use super::steered::Steered;
use super::steering_port::SteeringPort;
use super::{JointTarget, Motion, MotionLimits, motion_error};
use crate::Error;
use kinematics::Stamp;
use std::time::Duration;

/// Generates the setpoints of an enabled arm. They lead to the targets of the arm's owner and, once
/// the arm is steered, follow its port.
///
/// The value outlives stops of the arm. After a recovery, an arm that was steered is steered again,
/// and follows no target from before the stop.
#[derive(Debug, Default)]
pub struct Mover {
    /// `None` until the arm is enabled for the first time.
    source: Option<Source>,
    /// Limits of the motors that were enabled last.
    limits: Vec<MotionLimits>,
    period: Duration,
    /// The last setpoint.
    last: Setpoint,
}

#[derive(Debug)]
enum Source {
    Targets(Box<TrajectoryGenerator>),
    Port(Box<Steered>),
}

impl Mover {
    /// Rests at `position`, with one setpoint per `period`.
    ///
    /// # Errors
    /// If a joint is far outside its range, or a limit is not positive and finite.
    pub fn hold_at(
        &mut self,
        limits: Vec<MotionLimits>,
        position: Vec<f64>,
        period: Duration,
    ) -> Result<(), Error> {
        if let Some(Source::Port(steered)) = &mut self.source {
            steered.rest_with_period(&limits, &position, period)?;
        } else {
            let generator =
                TrajectoryGenerator::new(&limits, &position, period).map_err(motion_error)?;
            self.source = Some(Source::Targets(Box::new(generator)));
        }
        self.limits = limits;
        self.period = period;
        self.last = Setpoint::at_rest(position);
        Ok(())
    }

    /// Follows a port from now on. The arm does not move until [`Mover::hold_at`] sets its
    /// position.
    #[cfg(target_os = "linux")]
    pub(crate) fn steer_later(&mut self, port: SteeringPort) {
        self.source = Some(Source::Port(Box::new(Steered::waiting(port))));
    }

    /// Whether the arm follows a port.
    #[cfg(target_os = "linux")]
    pub(crate) fn is_steered(&self) -> bool {
        matches!(self.source, Some(Source::Port(_)))
    }

    /// Whether a target waits at the port, and has not expired.
    #[cfg(target_os = "linux")]
    pub(crate) fn has_fresh_target(&self, now: Stamp) -> bool {
        match &self.source {
            Some(Source::Port(steered)) => steered.has_fresh_target(now),
            _ => false,
        }
    }

    /// Limits of the arm, as of the last [`Mover::hold_at`].
    pub fn limits(&self) -> &[MotionLimits] {
        &self.limits
    }

    /// The last setpoint. An arm that is being enabled rests there.
    pub fn held(&self) -> Setpoint {
        self.last.clone()
    }

    /// The setpoint of the next cycle.
    ///
    /// # Errors
    /// If there is none. The arm must then apply its fail-safe.
    pub fn step(&mut self, now: Stamp) -> Result<Setpoint, Error> {
        let setpoint = match &mut self.source {
            Some(Source::Targets(generator)) => generator.step().map_err(motion_error)?,
            Some(Source::Port(steered)) => steered.step(now)?,
            None => return Err(motion_error("the arm has not been enabled yet".to_owned())),
        };
        self.last.clone_from(&setpoint);
        Ok(setpoint)
    }

    /// Continues from a different state of motion, because the reference of the arm differs from
    /// the last setpoint.
    #[cfg(target_os = "linux")]
    pub(crate) fn resume(&mut self, from: &Setpoint) -> Result<(), Error> {
        match &mut self.source {
            Some(Source::Targets(generator)) => generator.resume(from).map_err(motion_error)?,
            Some(Source::Port(steered)) => steered.resume(from)?,
            None => {}
        }
        self.last.clone_from(from);
        Ok(())
    }

    /// Whether the arm is at rest, and nobody holds it there: a steered arm may rest while the
    /// operator's hand rests.
    #[cfg(target_os = "linux")]
    pub(crate) fn is_resting(&self) -> bool {
        let is_held = match &self.source {
            Some(Source::Port(steered)) => steered.is_following() || steered.has_target(),
            _ => false,
        };
        self.is_at_rest() && !is_held
    }

    /// Whether the arm moves.
    pub fn motion(&self) -> Motion {
        if self.is_at_rest() {
            Motion::Holding
        } else {
            Motion::Moving
        }
    }

    /// Comes to rest for a shutdown, and takes no more targets. Returns whether the arm rests.
    #[cfg(target_os = "linux")]
    pub(crate) fn come_to_rest(&mut self) -> bool {
        match &mut self.source {
            Some(Source::Targets(generator)) => generator.stop(),
            Some(Source::Port(steered)) => steered.close(),
            None => {}
        }
        self.is_at_rest()
    }

    /// Reports through the port why the arm is stopped. Discards targets that wait there.
    pub fn report_stopped(&mut self, now: Stamp, reason: &str) {
        if let Some(Source::Port(steered)) = &mut self.source {
            steered.report_stopped(now, reason);
        }
    }

    /// Reports through the port that the arm rests at `position`, without a motion. Targets wait
    /// until there is one.
    #[cfg(target_os = "linux")]
    pub(crate) fn report_rest(&mut self, now: Stamp, position: &[f64]) {
        self.last = Setpoint::at_rest(position.to_vec());
        if let Some(Source::Port(steered)) = &mut self.source {
            steered.report_rest(now, position);
        }
    }

    /// Whether the arm is at rest.
    pub fn is_at_rest(&self) -> bool {
        match &self.source {
            Some(Source::Targets(generator)) => generator.is_at_rest(),
            Some(Source::Port(steered)) => steered.is_at_rest(),
            None => true,
        }
    }

    /// Moves to a target, see [`MovableArm::command`](super::MovableArm::command).
    ///
    /// # Errors
    /// If the target is not valid, or the arm is steered.
    pub fn set_target(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        match &mut self.source {
            Some(Source::Targets(generator)) => generator.set_target(target).map_err(motion_error),
            Some(Source::Port(_)) => Err(motion_error(STEERED.to_owned())),
            None => Err(motion_error("the arm has not been enabled yet".to_owned())),
        }
    }

    /// Comes to rest. An arm that is steered moves again with a new motion.
    pub fn stop(&mut self) {
        match &mut self.source {
            Some(Source::Targets(generator)) => generator.stop(),
            Some(Source::Port(steered)) => steered.brake(),
            None => {}
        }
    }

    /// Follows a port from now on. A motion that is under way is braked.
    ///
    /// # Errors
    /// For the reasons of [`Steered::new`].
    pub fn steer(&mut self, port: SteeringPort) -> Result<(), Error> {
        let mut steered = Steered::new(port, &self.last.position, self.period)?;
        steered.resume(&self.last)?;
        self.source = Some(Source::Port(Box::new(steered)));
        Ok(())
    }
}

/// Why a steered arm refuses the targets of its owner.
pub(super) const STEERED: &str =
    "it is steered: it follows the targets of its steering port, and no others";
