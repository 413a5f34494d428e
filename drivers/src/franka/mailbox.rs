//! Exchanges commands and results between the caller that commands an arm and the thread that moves
//! it.

use super::MotionStatistics;
use crate::motion::{JointTarget, Motion};
use franka::RobotMode;
use parking_lot::{Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Commands to the thread, and its results.
#[derive(Debug)]
pub(super) struct MotionMailbox {
    mailbox_state: Mutex<MailboxState>,
    changed: Condvar,
}

#[derive(Debug)]
pub(super) struct MailboxState {
    /// The newest command that the thread has not processed yet.
    pub(super) command: Option<MotionCommand>,
    /// ID of a motion that the robot has accepted and the thread has not processed yet.
    pub(super) started_motion: Option<u32>,
    /// Whether a motion that accepts commands is active or about to start.
    pub(super) accepts_commands: bool,
    /// Whether no motion is active and the next one may start.
    pub(super) is_idle: bool,
    /// Whether the motion should end as soon as the arm is at rest.
    pub(super) is_shutting_down: bool,
    /// Whether the connection to the robot is permanently lost.
    pub(super) is_lost: bool,
    pub(super) motion: Motion,
    pub(super) mode: RobotMode,
    pub(super) statistics: MotionStatistics,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum MotionCommand {
    SetTarget(JointTarget),
    Stop,
}

impl Default for MotionMailbox {
    fn default() -> Self {
        let mailbox_state = MailboxState {
            command: None,
            started_motion: None,
            accepts_commands: false,
            is_idle: true,
            is_shutting_down: false,
            is_lost: false,
            motion: Motion::Holding,
            mode: RobotMode::Other,
            statistics: MotionStatistics::default(),
        };
        Self {
            mailbox_state: Mutex::new(mailbox_state),
            changed: Condvar::new(),
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
        // The lock is released at the end of this line, so that the callers that wake up do not
        // wait for it.
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
