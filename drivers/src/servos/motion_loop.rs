//! The thread that moves an arm of servos. It enables the servos, sends setpoints, and stops
//! permanently on any fault.
//!
//! It follows the same rules as the thread for CAN motors (`can::arm_loop`): it stops the arm if a
//! servo is silent, reports a fault, was disabled, or does not follow its commands, if the port was
//! disconnected, or if this computer stalled for longer than 80 % of the watchdog timeout. After a
//! stop, it sends no setpoints until it receives [`Request::Recover`]. It applies the fail-safe
//! before it ends, even if it panics.

use super::config::MovableServoArmConfig;
use super::moved_servos::MovedServos;
use super::plan;
use crate::motion::{
    CommandedArm, Motion, Mover, OnLoss, Request, SharedWithOwner, max_stop_duration, reason_of,
};
use crate::{Error, clock};
use kinematics::{JointState, Stamp};
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::time::Duration;

/// Fraction of the watchdog timeout after which this thread stops the arm, so that it does not
/// command some servos while others have already stopped.
const SILENCE_FRAC: f64 = 0.8;
/// Interval at which an idle thread checks for requests.
const POLL: Duration = Duration::from_millis(20);
/// Additional time in which an arm must come to rest on shutdown. It covers late cycles and a
/// target that was set just before the shutdown. Without a limit, an arm that never comes to rest
/// would keep the program from ending.
const STOP_MARGIN: Duration = Duration::from_secs(1);
/// Maximum time, in addition to the watchdog timeout, in which the fail-safe is repeated until each
/// servo has confirmed it.
const MAX_CONFIRMATION: Duration = Duration::from_secs(2);

/// State of the arm.
#[derive(Debug)]
enum ArmState {
    /// No setpoints are sent.
    Stopped { reason: String },
    /// The servos follow the setpoints.
    Moving,
}

/// The thread's state.
#[derive(Debug)]
pub(super) struct MotionLoop {
    config: MovableServoArmConfig,
    requests: Receiver<Request>,
    states: SyncSender<Result<JointState, Error>>,
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    /// The servos, once they were enabled. They stay open after a stop, so that a stopped arm can
    /// still be read. `None` after the port was disconnected.
    servos: Option<MovedServos>,
    arm_state: ArmState,
    mover: Mover,
    /// Start of the last cycle, on a clock that keeps counting while the computer is suspended.
    last_cycle: Stamp,
    max_stall: Duration,
}

impl MotionLoop {
    /// Creates the loop without sending anything.
    ///
    /// # Errors
    /// If the arm cannot be moved as planned.
    pub(super) fn new(
        config: &MovableServoArmConfig,
        shared: SharedWithOwner,
        states: SyncSender<Result<JointState, Error>>,
    ) -> Result<Self, Error> {
        let SharedWithOwner {
            requests,
            motion,
            is_shutting_down,
        } = shared;
        plan::check(config)?;
        Ok(Self {
            config: config.clone(),
            requests,
            states,
            motion,
            is_shutting_down,
            servos: None,
            arm_state: ArmState::Stopped {
                reason: String::new(),
            },
            mover: Mover::default(),
            last_cycle: clock::now_including_suspend(),
            max_stall: Duration::ZERO,
        })
    }

    /// Runs until the owner drops the arm or calls
    /// [`apply_fail_safe`](crate::motion::apply_fail_safe).
    pub(super) fn run(mut self) {
        let mut next_cycle = clock::now();
        let mut shutdown_deadline = None;
        loop {
            // The program is about to exit without an orderly stop, so this comes first.
            if CommandedArm::is_fail_safe_due() {
                break;
            }
            if self.is_shutting_down.load(Ordering::Relaxed) {
                // The deadline is fixed at the first pass. Computing it anew in each pass would
                // move it into the future forever.
                let shutdown_by = *shutdown_deadline.get_or_insert_with(|| {
                    clock::now() + max_stop_duration(&self.config.motion.limits) + STOP_MARGIN
                });
                if self.is_at_rest() || clock::now() > shutdown_by {
                    break;
                }
            }
            let remaining = next_cycle.duration_since(clock::now()).min(POLL);
            match self.requests.recv_timeout(remaining) {
                Ok(request) => self.handle_request(request),
                Err(RecvTimeoutError::Timeout) => {}
                // The owner is being dropped. The flag above ends the loop.
                Err(RecvTimeoutError::Disconnected) => std::thread::sleep(remaining),
            }
            let now = clock::now();
            if now >= next_cycle {
                if let Err(error) = self.cycle() {
                    self.abort(&reason_of(&error));
                }
                // Missed cycles are not made up for.
                let period = self.servos.as_ref().map_or(POLL, MovedServos::period);
                next_cycle = (next_cycle + period).max(now);
            }
        }
        self.end();
    }

    fn handle_request(&mut self, request: Request) {
        match (request, &self.arm_state) {
            (Request::Recover(answer), ArmState::Stopped { .. }) => {
                let recovered = self.recover();
                if let Err(error) = &recovered {
                    self.stopped(&reason_of(error));
                }
                // The requester may have gone away.
                let _ = answer.try_send(recovered);
            }
            (request, ArmState::Stopped { reason }) => {
                let reason = format!("the arm stopped and has not been recovered: {reason}");
                request.refuse(motion_error(reason));
            }
            (request, ArmState::Moving) => self.mover.handle(request, &self.motion),
        }
    }

    /// Finds and enables the servos. They hold their positions.
    fn recover(&mut self) -> Result<(), Error> {
        // The port is released first, because it can be opened only once.
        self.servos = None;
        let mut servos = MovedServos::find(&self.config)?;
        let limits = servos.limits(&self.config.motion.limits);
        let positions = servos.positions().unwrap_or_default();
        let period = servos.period();
        // A position outside the limits is refused before anything is changed in the servos.
        self.mover.hold_at(limits.clone(), positions, period)?;
        servos.enable(&limits, self.config.motion.timeout)?;
        // The joints may have moved until they were enabled.
        let positions = servos.positions().unwrap_or_default();
        if let Err(error) = self.mover.hold_at(limits, positions, period) {
            servos.apply(OnLoss::Release, false);
            return Err(error);
        }
        log::info!(
            "the arm is enabled and holds its position; {:.0} setpoints per second",
            1.0 / servos.period().as_secs_f64()
        );
        self.servos = Some(servos);
        self.arm_state = ArmState::Moving;
        *self.motion.lock() = Motion::Holding;
        // Enabling takes longer than a watchdog timeout, but it is not a stall of this thread.
        self.last_cycle = clock::now_including_suspend();
        Ok(())
    }

    /// Runs one cycle in the current state.
    fn cycle(&mut self) -> Result<(), Error> {
        // This clock counts the time in which a laptop is suspended. The watchdogs of the servos
        // expire then, but the monotonic clock stands still.
        let now = clock::now_including_suspend();
        let stall = now.duration_since(self.last_cycle);
        self.last_cycle = now;
        let max_silence = self.config.motion.timeout.mul_f64(SILENCE_FRAC);
        if let ArmState::Stopped { reason } = &self.arm_state {
            self.mover.report_stopped(clock::now(), reason);
        }
        let Some(servos) = &mut self.servos else {
            return Ok(());
        };
        if let ArmState::Stopped { .. } = self.arm_state {
            // A stopped arm is still read. If that fails, only a recovery opens the port again.
            match servos.read() {
                Ok(Some(state)) => drop(self.states.try_send(Ok(state))),
                Ok(None) => {}
                Err(_) => self.servos = None,
            }
            return Ok(());
        }
        self.max_stall = self.max_stall.max(stall);
        // Setpoints from before a long stall must not be sent, because the servos have stopped or
        // are about to.
        if stall > max_silence {
            let millis = 1e3 * stall.as_secs_f64();
            return Err(motion_error(format!(
                "this computer stalled for {millis:.0} ms"
            )));
        }
        // The checks come first, because after a fault of one servo, the others must not get
        // another setpoint.
        if let Some(state) = servos.read_and_check(max_silence)? {
            // If the reader is slow, the newest state is dropped.
            let _ = self.states.try_send(Ok(state));
        }
        let setpoint = self.mover.step(clock::now())?;
        servos.command(&setpoint)?;
        *self.motion.lock() = self.mover.motion();
        Ok(())
    }

    /// Stops the arm: applies the fail-safe to each servo, and logs the reason.
    fn abort(&mut self, reason: &str) {
        if let ArmState::Stopped { .. } = self.arm_state {
            return;
        }
        self.stopped(reason);
        self.apply_fail_safe(true);
    }

    fn stopped(&mut self, reason: &str) {
        log::warn!("the arm stopped: {reason}");
        self.mover.report_stopped(clock::now(), reason);
        let reason = reason.to_owned();
        *self.motion.lock() = Motion::Stopped {
            reason: reason.clone(),
        };
        self.arm_state = ArmState::Stopped { reason };
    }

    /// Applies `on_loss`. Repeats it for a limited time until each servo has confirmed it, because
    /// a servo that misses it would keep its last goal.
    fn apply_fail_safe(&mut self, is_blocked: bool) {
        let on_loss = self.config.motion.on_loss;
        let Some(servos) = &mut self.servos else {
            return;
        };
        let deadline = clock::now() + self.config.motion.timeout + MAX_CONFIRMATION;
        let mut unconfirmed = servos.apply(on_loss, is_blocked);
        while !unconfirmed.is_empty()
            && plan::needs_confirmation(on_loss)
            && clock::now() < deadline
        {
            std::thread::sleep(servos.period());
            unconfirmed = servos.apply(on_loss, is_blocked);
        }
        for joint in unconfirmed {
            log::error!(
                "joint {joint:?}: its servo has not confirmed {:?}; it may still hold its last goal: cut its power",
                on_loss.name()
            );
        }
    }

    /// Returns whether the arm is at rest. If it moves, starts to bring it to rest.
    fn is_at_rest(&mut self) -> bool {
        match self.arm_state {
            ArmState::Moving => self.mover.come_to_rest(),
            ArmState::Stopped { .. } => true,
        }
    }

    /// Applies the fail-safe at the end, unless the arm has already stopped.
    fn end(&mut self) {
        if let ArmState::Moving = self.arm_state {
            self.apply_fail_safe(false);
            let reason = "it was shut down".to_owned();
            self.mover.report_stopped(clock::now(), &reason);
            self.arm_state = ArmState::Stopped { reason };
        }
        if let Some(servos) = &self.servos {
            log::info!(
                "the arm was shut down with on_loss = {:?}; {} cycles, longest stall {:.1} ms; {}",
                self.config.motion.on_loss.name(),
                servos.n_cycles(),
                1e3 * self.max_stall.as_secs_f64(),
                servos.counts()
            );
        }
    }
}

impl Drop for MotionLoop {
    fn drop(&mut self) {
        // After an orderly end, the servos have their fail-safe command. After a panic, they would
        // keep their last goal.
        if std::thread::panicking() {
            self.abort("the thread of the arm failed; this is a bug, please report it");
        }
    }
}

fn motion_error(reason: String) -> Error {
    Error::Motion { reason }
}
