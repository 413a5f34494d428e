//! Exchanges commands and results between the caller that commands an arm and the thread that moves
//! it.

use super::JointTarget;
use super::mover::Mover;
use crate::Error;
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Commands to the thread, and its results: a state `S` that both sides change.
#[derive(Debug, Default)]
pub(crate) struct Mailbox<S> {
    state: Mutex<S>,
    changed: Condvar,
}

/// A command to the thread.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum MotionCommand {
    SetTarget(JointTarget),
    Stop,
}

impl MotionCommand {
    /// Changes the setpoints of an arm.
    ///
    /// # Errors
    /// If the target is not valid, or the arm is steered.
    pub(crate) fn apply(&self, mover: &mut Mover) -> Result<(), Error> {
        match self {
            Self::SetTarget(target) => mover.set_target(target).map(drop),
            Self::Stop => {
                mover.stop();
                Ok(())
            }
        }
    }
}

impl<S> Mailbox<S> {
    /// Locks the state.
    pub(crate) fn lock(&self) -> MutexGuard<'_, S> {
        self.state.lock()
    }

    /// Changes the state, and wakes up all waiting callers.
    pub(crate) fn update(&self, change: impl FnOnce(&mut S)) {
        // The lock is released at the end of this line, so that the callers that wake up do not
        // wait for it.
        change(&mut self.lock());
        self.changed.notify_all();
    }

    /// Waits until a condition holds; `None` if the timeout expires first.
    pub(crate) fn wait(
        &self,
        timeout: Duration,
        condition: impl Fn(&S) -> bool,
    ) -> Option<MutexGuard<'_, S>> {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        // The condition is checked in a loop, because a condition variable may wake up without a
        // change, or for a change of another field.
        while !condition(&state) {
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return None;
            }
            self.changed.wait_for(&mut state, remaining);
        }
        Some(state)
    }
}
