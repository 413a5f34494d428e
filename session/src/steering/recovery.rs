//! Enables an arm that a fault has stopped, without holding up the loop: a recovery may take a
//! minute.

use drivers::motion::{ArmState, SteeringPort};
use kinematics::Stamp;
use std::thread::JoinHandle;
use steering::Operator;

/// Maximum time from the end of a recovery until the arm reports that it has no fault. Arms report
/// their state in each of their cycles.
const MAX_REPORT_SECS: f64 = 1.0;

/// Why motion is not permitted after a recovery that has succeeded.
const STOPPED_SINCE: &str = "the arm was stopped during its recovery: permit motion again";

/// The recovery of one arm.
#[derive(Debug)]
pub(super) struct Recovery {
    port: SteeringPort,
    state: State,
    /// Whether somebody has stopped the arm since the recovery was asked for.
    is_revoked: bool,
}

#[derive(Debug)]
enum State {
    Idle,
    /// The arm is being enabled.
    Running(Operator, JoinHandle<Result<(), String>>),
    /// The arm was enabled, and should report it until a time.
    Enabled(Operator, Stamp),
}

impl Recovery {
    /// No recovery is under way.
    pub(super) fn new(port: SteeringPort) -> Self {
        Self {
            port,
            state: State::Idle,
            is_revoked: false,
        }
    }

    /// Starts a recovery, at the request of an operator.
    ///
    /// # Errors
    ///
    /// Why none was started, in one sentence.
    pub(super) fn start(&mut self, operator: Operator) -> Result<(), String> {
        if !matches!(self.state, State::Idle) {
            return Err("the arm is being recovered already: wait".to_owned());
        }
        let port = self.port.clone();
        let thread = std::thread::Builder::new()
            .name("arm recovery".to_owned())
            .spawn(move || port.recover().map_err(|error| error.to_string()))
            .map_err(|error| format!("the recovery of the arm cannot be started: {error}"))?;
        self.state = State::Running(operator, thread);
        self.is_revoked = false;
        Ok(())
    }

    /// Notes that somebody has stopped the arm. Whoever asked for the recovery that is under way did
    /// not know this, so the arm is enabled, but motion must be permitted again.
    pub(super) fn revoke(&mut self) {
        self.is_revoked = true;
    }

    /// The result of a recovery that has ended since the last call, and who asked for it.
    pub(super) fn take_result(
        &mut self,
        now: Stamp,
        arm: &ArmState,
    ) -> Option<(Operator, Result<(), String>)> {
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Idle => None,
            State::Running(operator, thread) if !thread.is_finished() => {
                self.state = State::Running(operator, thread);
                None
            }
            State::Running(operator, thread) => {
                let panicked =
                    |_| Err("the recovery of the arm panicked: this is a bug".to_owned());
                match thread.join().unwrap_or_else(panicked) {
                    Ok(()) => {
                        self.state = State::Enabled(operator, now.plus_secs(MAX_REPORT_SECS));
                        None
                    }
                    Err(reason) => Some((operator, Err(reason))),
                }
            }
            State::Enabled(operator, until) => match &arm.stopped {
                None if self.is_revoked => Some((operator, Err(STOPPED_SINCE.to_owned()))),
                None => Some((operator, Ok(()))),
                Some(reason) if now > until => Some((operator, Err(reason.clone()))),
                Some(_) => {
                    self.state = State::Enabled(operator, until);
                    None
                }
            },
        }
    }
}
