//! Enables an arm that a fault has stopped, without holding up the loop: a recovery may take a
//! minute.

use drivers::motion::{ArmState, SteeringPort};
use kinematics::Stamp;
use std::thread::JoinHandle;
use steering::Operator;

/// Maximum time from the end of a recovery until the arm reports that it has no fault. Arms report
/// their state in each of their cycles.
const MAX_REPORT_SECS: f64 = 1.0;

/// An operator wants the arm to move again after a stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Permission {
    pub(super) operator: Operator,
    /// Number of the newest stop that the operator has seen.
    pub(super) stop: u64,
}

/// The recovery of one arm.
#[derive(Debug)]
pub(super) struct Recovery {
    port: SteeringPort,
    state: State,
}

#[derive(Debug)]
enum State {
    Idle,
    /// The arm is being enabled.
    Running(Permission, JoinHandle<Result<(), String>>),
    /// The arm was enabled, and should report it until a time.
    Enabled(Permission, Stamp),
}

impl Recovery {
    /// No recovery is under way.
    pub(super) fn new(port: SteeringPort) -> Self {
        Self {
            port,
            state: State::Idle,
        }
    }

    /// Starts a recovery, for the permission of an operator.
    ///
    /// # Errors
    ///
    /// Why none was started, in one sentence.
    pub(super) fn start(&mut self, permission: Permission) -> Result<(), String> {
        if self.is_running() {
            return Err("the arm is being recovered already: wait".to_owned());
        }
        let port = self.port.clone();
        let thread = std::thread::Builder::new()
            .name("arm recovery".to_owned())
            .spawn(move || port.recover().map_err(|error| error.to_string()))
            .map_err(|error| format!("the recovery of the arm cannot be started: {error}"))?;
        self.state = State::Running(permission, thread);
        Ok(())
    }

    /// Whether a recovery is under way.
    pub(super) fn is_running(&self) -> bool {
        !matches!(self.state, State::Idle)
    }

    /// The result of a recovery that has ended since the last call, and the permission that asked
    /// for it.
    pub(super) fn take_result(
        &mut self,
        now: Stamp,
        arm: &ArmState,
    ) -> Option<(Permission, Result<(), String>)> {
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Idle => None,
            State::Running(permission, thread) if !thread.is_finished() => {
                self.state = State::Running(permission, thread);
                None
            }
            State::Running(permission, thread) => {
                let panicked =
                    |_| Err("the recovery of the arm panicked: this is a bug".to_owned());
                match thread.join().unwrap_or_else(panicked) {
                    Ok(()) => {
                        self.state = State::Enabled(permission, now.plus_secs(MAX_REPORT_SECS));
                        None
                    }
                    Err(reason) => Some((permission, Err(reason))),
                }
            }
            State::Enabled(permission, until) => match &arm.stopped {
                None => Some((permission, Ok(()))),
                Some(reason) if now > until => Some((permission, Err(reason.clone()))),
                Some(_) => {
                    self.state = State::Enabled(permission, until);
                    None
                }
            },
        }
    }
}
