//! Exchanges commands and results between the caller that commands an arm and the thread that moves
//! it.

use super::statistics::MotionStatistics;
use crate::motion::{JointTarget, Motion};
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Commands to the thread, and its results.
#[derive(Debug, Default)]
pub(super) struct MotionMailbox {
    mailbox_state: Mutex<MailboxState>,
    changed: Condvar,
}

#[derive(Debug)]
pub(super) struct MailboxState {
    /// The newest command that the thread has not processed yet.
    pub(super) command: Option<MotionCommand>,
    /// Number of a motion that should start.
    pub(super) requested_session: Option<i32>,
    /// The reason why the requested motion cannot start.
    pub(super) start_error: Option<String>,
    /// Whether a motion that accepts commands is active or about to start.
    pub(super) accepts_commands: bool,
    /// Whether no motion is active and the next one may start.
    pub(super) is_idle: bool,
    /// Whether the program of the requested motion runs.
    pub(super) is_running: bool,
    /// Whether the motion should end as soon as the arm is at rest.
    pub(super) is_shutting_down: bool,
    /// Whether the connection to the controller is permanently lost.
    pub(super) is_lost: bool,
    pub(super) motion: Motion,
    /// The reason why the robot accepts no motion, according to its newest state.
    pub(super) blocking_reason: Option<String>,
    /// Whether the robot is in a protective stop.
    pub(super) is_protective_stop: bool,
    pub(super) statistics: MotionStatistics,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum MotionCommand {
    SetTarget(JointTarget),
    Stop,
}

impl Default for MailboxState {
    fn default() -> Self {
        Self {
            command: None,
            requested_session: None,
            start_error: None,
            accepts_commands: false,
            is_idle: true,
            is_running: false,
            is_shutting_down: false,
            is_lost: false,
            motion: Motion::Holding,
            blocking_reason: None,
            is_protective_stop: false,
            statistics: MotionStatistics::default(),
        }
    }
}

impl MotionMailbox {
    /// Locks the state.
    pub(super) fn lock(&self) -> MutexGuard<'_, MailboxState> {
        self.mailbox_state.lock()
    }

    /// Changes the state, and wakes up all waiting callers.
    pub(super) fn update(&self, change: impl FnOnce(&mut MailboxState)) {
        change(&mut self.lock());
        self.changed.notify_all();
    }

    /// Waits until a condition holds; `None` if the timeout expires first.
    pub(super) fn wait(
        &self,
        timeout: Duration,
        condition: impl Fn(&MailboxState) -> bool,
    ) -> Option<MutexGuard<'_, MailboxState>> {
        let deadline = Instant::now() + timeout;
        let mut mailbox_state = self.lock();
        // The condition is checked in a loop, because a condition variable may wake up without a
        // change, or for a change of another field.
        while !condition(&mailbox_state) {
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return None;
            }
            self.changed.wait_for(&mut mailbox_state, remaining);
        }
        Some(mailbox_state)
    }
}
