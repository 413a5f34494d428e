//! What lies between whoever commands an arm and the thread that moves it.

use super::MotionStatistics;
use crate::motion::{JointTarget, Motion};
use franka::RobotMode;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Orders go to the thread, what came of them comes back.
#[derive(Debug)]
pub(super) struct MotionMailbox {
    mailbox_state: Mutex<MailboxState>,
    changed: Condvar,
}

#[derive(Debug)]
pub(super) struct MailboxState {
    /// The newest order that the thread has not taken.
    pub(super) order: Option<MotionOrder>,
    /// Number of a motion that the robot let begin and the thread has not taken.
    pub(super) started_motion: Option<u32>,
    /// Whether one runs, or is about to, that takes orders.
    pub(super) accepts_orders: bool,
    /// Whether none runs, and the next may begin.
    pub(super) is_idle: bool,
    /// Whether a motion ends as soon as the arm is at rest.
    pub(super) is_shutting_down: bool,
    /// Whether the robot was lost, for good.
    pub(super) is_lost: bool,
    pub(super) motion: Motion,
    pub(super) mode: RobotMode,
    pub(super) statistics: MotionStatistics,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum MotionOrder {
    SetTarget(JointTarget),
    Stop,
}

impl Default for MotionMailbox {
    fn default() -> Self {
        let mailbox_state = MailboxState {
            order: None,
            started_motion: None,
            accepts_orders: false,
            is_idle: true,
            is_shutting_down: false,
            is_lost: false,
            motion: Motion::Holding,
            mode: RobotMode::Other,
            statistics: MotionStatistics::default(),
        };
        Self { mailbox_state: Mutex::new(mailbox_state), changed: Condvar::new() }
    }
}

impl MotionMailbox {
    /// The board, also after a thread panicked while it held it: no order is left half written.
    pub(super) fn lock(&self) -> MutexGuard<'_, MailboxState> {
        self.mailbox_state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what the thread tells, and wakes who waits for that.
    pub(super) fn update(&self, change: impl FnOnce(&mut MailboxState)) {
        change(&mut self.lock());
        self.changed.notify_all();
    }

    /// Waits until something is so; `None` where that takes too long.
    pub(super) fn wait(
        &self,
        timeout: Duration,
        condition: impl Fn(&MailboxState) -> bool,
    ) -> Option<MutexGuard<'_, MailboxState>> {
        let deadline = Instant::now() + timeout;
        let mut mailbox_state = self.lock();
        while !condition(&mailbox_state) {
            let remaining = deadline.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return None;
            }
            mailbox_state =
                self.changed.wait_timeout(mailbox_state, remaining).unwrap_or_else(PoisonError::into_inner).0;
        }
        Some(mailbox_state)
    }
}
