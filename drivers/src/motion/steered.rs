//! The arm's side of a steering port: setpoints that follow the port, and reports of the arm's
//! state.

use super::MotionLimits;
use super::follower::{Follower, brake_limits};
use super::generator::Setpoint;
use super::steering_port::{SteeringPort, position_in};
use super::target::{ArmState, Output};
use crate::{Error, clock};
use kinematics::Stamp;
use std::time::Duration;

/// The setpoints of an arm that is steered. It belongs to the arm's own thread, so that the arm
/// brakes whatever happens to the program that steers it.
#[derive(Debug)]
pub struct Steered {
    port: SteeringPort,
    follower: Follower,
    /// The position in the newest report.
    position: Vec<f64>,
    /// Whether the arm takes no more targets, because it is shut down.
    is_closed: bool,
}

/// Why an arm stays stopped after its thread has panicked.
pub(crate) const PANICKED: &str =
    "the thread of the arm panicked, which is a bug: check the arm, then start the program again";

impl Steered {
    /// An arm at rest at `position`, with one setpoint per `period`.
    ///
    /// # Errors
    /// For the reasons of [`Follower::new`].
    pub fn new(port: SteeringPort, position: &[f64], period: Duration) -> Result<Self, Error> {
        let follower = Follower::new(port.limits(), port.brake_limits(), position, period)?;
        Ok(Self {
            port,
            follower,
            position: position.to_vec(),
            is_closed: false,
        })
    }

    /// An arm that does not move until [`Steered::rest_at`] sets its position.
    #[cfg(target_os = "linux")]
    pub(super) fn waiting(port: SteeringPort) -> Self {
        let position = position_in(port.limits());
        // The period is replaced together with the position.
        Self::new(port, &position, Duration::from_millis(1))
            .expect("the port has checked its limits, and the position is inside them")
    }

    /// The port that is followed.
    pub fn port(&self) -> &SteeringPort {
        &self.port
    }

    /// Takes what was sent to the port, and returns the setpoint of the next cycle. Reports the
    /// state.
    ///
    /// # Errors
    /// If not even braking succeeds. The arm must then apply its fail-safe.
    pub fn step(&mut self, now: Stamp) -> Result<Setpoint, Error> {
        self.obey(now);
        let setpoint = self.follower.step(now)?;
        self.position.clone_from(&setpoint.position);
        self.port.note_setpoint(now, &setpoint);
        self.report(now, None);
        Ok(setpoint)
    }

    /// Continues from a different state of motion, see [`Follower::resume`].
    ///
    /// # Errors
    /// If a value is not finite, or their number is wrong.
    pub fn resume(&mut self, from: &Setpoint) -> Result<(), Error> {
        self.follower.resume(from)
    }

    /// Rests at another position, because the arm stopped or was guided by hand. The motion has
    /// ended. `limits` replace those of the port.
    ///
    /// # Errors
    /// For the reasons of [`Follower::new`].
    pub fn rest_at(&mut self, limits: &[MotionLimits], position: &[f64]) -> Result<(), Error> {
        let brake_limits = brake_limits(limits, self.port.brake_factor());
        self.follower.rest_at(limits, &brake_limits, position)?;
        self.position = position.to_vec();
        Ok(())
    }

    /// Like [`Steered::rest_at`], with another period.
    #[cfg(target_os = "linux")]
    pub(super) fn rest_with_period(
        &mut self,
        limits: &[MotionLimits],
        position: &[f64],
        period: Duration,
    ) -> Result<(), Error> {
        self.follower.set_period(period);
        self.rest_at(limits, position)
    }

    /// Brakes and ends the motion. The arm moves again with a new motion.
    pub fn brake(&mut self) {
        self.follower.end_motion(self.port.end_motions());
    }

    /// Brakes, and takes no more targets.
    pub fn close(&mut self) {
        self.is_closed = true;
        self.brake();
    }

    /// Discards what was sent to the port, and reports why the arm is stopped.
    pub fn report_stopped(&mut self, now: Stamp, reason: &str) {
        // A target from before a stop must not be followed after the recovery.
        self.brake();
        self.report(now, Some(reason.to_owned()));
    }

    /// Reports that the arm rests at `position`, which may change while a person guides the arm.
    /// What was sent to the port is kept until the next [`Steered::step`].
    pub fn report_rest(&mut self, now: Stamp, position: &[f64]) {
        self.position = position.to_vec();
        self.port.report(ArmState {
            reported_at: now,
            position: position.to_vec(),
            is_at_rest: true,
            braked_motion: self.follower.braked_motion(),
            stopped: None,
        });
    }

    /// Reports that something else moves the arm, which is at `position`. What was sent to the port
    /// is discarded.
    pub fn report_moving(&mut self, now: Stamp, position: &[f64]) {
        self.follower.end_motion(self.port.end_motions());
        self.port.report(ArmState {
            reported_at: now,
            position: position.to_vec(),
            is_at_rest: false,
            braked_motion: self.follower.braked_motion(),
            stopped: None,
        });
    }

    /// Whether a target waits to be followed.
    pub fn has_target(&self) -> bool {
        !self.is_closed && self.port.has_target()
    }

    /// Whether a target waits to be followed, and has not expired.
    pub fn has_fresh_target(&self, now: Stamp) -> bool {
        !self.is_closed && self.port.has_fresh_target(now)
    }

    /// Whether the arm is at rest.
    pub fn is_at_rest(&self) -> bool {
        self.follower.is_at_rest()
    }

    /// Whether the arm follows a target, also if it has arrived there.
    pub fn is_following(&self) -> bool {
        self.follower.is_following()
    }

    fn obey(&mut self, now: Stamp) {
        let orders = self.port.take_orders();
        if let Some(motion) = orders.brake_motion {
            self.follower.end_motion(motion);
        }
        let Some(target) = orders.target.filter(|_| !self.is_closed) else {
            return;
        };
        if let Err(why) = self.follower.obey(now, &Output::Follow(target)) {
            log::debug!("steering: {why}");
        }
    }

    fn report(&self, now: Stamp, stopped: Option<String>) {
        self.port.report(ArmState {
            reported_at: now,
            position: self.position.clone(),
            is_at_rest: self.follower.is_at_rest(),
            braked_motion: self.follower.braked_motion(),
            stopped,
        });
    }
}

impl Drop for Steered {
    /// Reports a panic of the arm's thread. The newest report would otherwise look as if the arm
    /// only was slow, and nobody would be asked to check it.
    fn drop(&mut self) {
        if !std::thread::panicking() {
            return;
        }
        // The follower may be in any state, so nothing is asked of it.
        let braked_motion = self.port.end_motions();
        self.port.report(ArmState {
            reported_at: clock::now(),
            position: std::mem::take(&mut self.position),
            is_at_rest: false,
            braked_motion,
            stopped: Some(PANICKED.to_owned()),
        });
    }
}
