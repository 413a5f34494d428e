//! What the owner of an arm and its thread exchange, if motions run on the robot's own controller:
//! a motion starts with a request to the controller, and ends some time after the arm has come to
//! rest.

use super::mailbox::{Mailbox, MotionCommand};
use super::mover::{Mover, STEERED};
use super::steered::PANICKED;
use super::steering_port::SteeringPort;
use super::{JointTarget, Motion};
use kinematics::Stamp;

/// Commands to the thread, and its results.
#[derive(Debug, Default)]
pub(crate) struct Exchange<R> {
    pub(crate) control: Control,
    /// What only robots of this kind have.
    pub(crate) robot: R,
}

/// The part that is the same for all robots.
#[derive(Debug)]
pub(crate) struct Control {
    /// The newest command that the thread has not processed yet.
    pub(crate) command: Option<MotionCommand>,
    /// Whether a motion that accepts commands is active or about to start.
    pub(crate) accepts_commands: bool,
    /// Whether no motion is active and the next one may start.
    pub(crate) is_idle: bool,
    /// Whether the motion should end as soon as the arm is at rest.
    pub(crate) is_shutting_down: bool,
    /// Whether the connection to the robot is permanently lost.
    pub(crate) is_lost: bool,
    pub(crate) motion: Motion,
    /// Whether the arm follows a steering port, or will after its present motion.
    is_steered: bool,
    /// A port that the thread has not taken yet.
    port: Option<SteeringPort>,
    /// Whether a target waits at the port for a motion to start.
    pub(super) wants_motion: bool,
}

impl Default for Control {
    fn default() -> Self {
        Self {
            command: None,
            accepts_commands: false,
            is_idle: true,
            is_shutting_down: false,
            is_lost: false,
            motion: Motion::Holding,
            is_steered: false,
            port: None,
            wants_motion: false,
        }
    }
}

impl Control {
    /// The reason why the arm accepts no target.
    pub(crate) fn refusal(&self) -> Option<String> {
        match &self.motion {
            Motion::Stopped { reason } => Some(format!(
                "it accepts no target before it is recovered: {reason}"
            )),
            Motion::Holding | Motion::Moving => None,
        }
    }

    /// Gives a target to the active motion. Returns whether there is one; if not, one must be
    /// started.
    ///
    /// # Errors
    /// The reason why the arm accepts no target.
    pub(super) fn offer(&mut self, target: &JointTarget) -> Result<bool, String> {
        if self.is_steered {
            return Err(STEERED.to_owned());
        }
        if let Some(reason) = self.refusal() {
            return Err(reason);
        }
        if self.accepts_commands {
            self.command = Some(MotionCommand::SetTarget(target.clone()));
            self.motion = Motion::Moving;
        }
        Ok(self.accepts_commands)
    }

    /// Records that a motion is about to start, with its first command if the arm is not steered.
    pub(crate) fn begin(&mut self, command: Option<MotionCommand>) {
        self.accepts_commands = true;
        self.is_idle = false;
        self.wants_motion = false;
        self.command = command;
        // The motion is set here and not by the thread, because a caller may wait for its end as
        // soon as its request returns. If the robot has stopped since the request was sent, the
        // reason must be kept.
        if !matches!(self.motion, Motion::Stopped { .. }) {
            self.motion = Motion::Moving;
        }
    }

    /// Brings the active motion to rest, if there is one.
    pub(super) fn stop(&mut self) {
        if self.accepts_commands {
            self.command = Some(MotionCommand::Stop);
        }
    }

    /// Prepares the end of the arm.
    pub(super) fn shut_down(&mut self) {
        self.is_shutting_down = true;
        // The stop replaces a pending target. Without a motion, the stop is not stored, because it
        // would wait until the next motion.
        self.command = self.accepts_commands.then_some(MotionCommand::Stop);
    }

    /// Switches the arm to steering, as soon as a motion that is under way has ended.
    pub(super) fn steer(&mut self, port: SteeringPort) {
        self.is_steered = true;
        self.port = Some(port);
        self.stop();
    }

    /// Whether a motion should end as soon as the arm is at rest.
    pub(crate) fn is_ending(&self) -> bool {
        self.is_shutting_down || self.port.is_some()
    }

    /// Records that a motion has ended as it should.
    pub(crate) fn rest(&mut self) {
        self.is_idle = true;
        self.accepts_commands = false;
        self.command = None;
        self.motion = Motion::Holding;
    }

    /// Records that the arm stopped because of a problem.
    pub(crate) fn stop_because(&mut self, reason: String) {
        // A command from before the stop must not be executed after the recovery.
        self.command = None;
        self.is_idle = true;
        self.accepts_commands = false;
        self.wants_motion = false;
        self.motion = Motion::Stopped { reason };
    }

    /// Records that the thread of the arm is panicking, so that the arm cannot be moved.
    pub(crate) fn end_after_panic(&mut self) {
        self.is_lost = true;
        self.stop_because(PANICKED.to_owned());
    }

    /// Whether the arm never moves again.
    pub(super) fn is_over(&self) -> bool {
        self.is_shutting_down || self.is_lost
    }

    /// A cycle without an active motion: reports the state of a steered arm, and asks for a motion
    /// if a target waits at the port. `position` is the one that the controller commands.
    fn wait_for_target(&mut self, mover: &mut Mover, now: Stamp, position: &[f64]) {
        if let Motion::Stopped { reason } = &self.motion {
            mover.report_stopped(now, reason);
            return;
        }
        mover.report_rest(now, position);
        self.wants_motion = self.is_idle && !self.is_shutting_down && mover.has_fresh_target(now);
    }
}

/// A cycle of an arm without an active motion. Takes a port that the owner has set.
pub(crate) fn idle_cycle<R>(
    mailbox: &Mailbox<Exchange<R>>,
    mover: &mut Mover,
    now: Stamp,
    position: &[f64],
) {
    let port = mailbox.lock().control.port.take();
    if let Some(port) = port {
        mover.steer_later(port);
    }
    if mover.is_steered() {
        mailbox.update(|exchange| exchange.control.wait_for_target(mover, now, position));
    }
}
