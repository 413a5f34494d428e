//! What lies between whoever commands an arm and the thread that moves it.

use super::MotionStatistics;
use crate::motion::{JointTarget, Motion};
use franka::RobotMode;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Orders go to the thread, what came of them comes back.
#[derive(Debug)]
pub(super) struct Desk {
    board: Mutex<Board>,
    changed: Condvar,
}

#[derive(Debug)]
pub(super) struct Board {
    /// The newest order that the thread has not taken.
    pub(super) order: Option<Order>,
    /// Number of a motion that the robot let begin and the thread has not taken.
    pub(super) begun: Option<u32>,
    /// Whether one runs, or is about to, that takes orders.
    pub(super) takes_orders: bool,
    /// Whether none runs, and the next may begin.
    pub(super) is_idle: bool,
    /// Whether a motion ends as soon as the arm is at rest.
    pub(super) is_leaving: bool,
    /// Whether the robot was lost, for good.
    pub(super) is_lost: bool,
    pub(super) motion: Motion,
    pub(super) mode: RobotMode,
    pub(super) statistics: MotionStatistics,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum Order {
    Head(JointTarget),
    Stop,
}

impl Default for Desk {
    fn default() -> Self {
        let board = Board {
            order: None,
            begun: None,
            takes_orders: false,
            is_idle: true,
            is_leaving: false,
            is_lost: false,
            motion: Motion::Held,
            mode: RobotMode::Other,
            statistics: MotionStatistics::default(),
        };
        Self { board: Mutex::new(board), changed: Condvar::new() }
    }
}

impl Desk {
    /// The board, also after a thread panicked while it held it: no order is left half written.
    pub(super) fn lock(&self) -> MutexGuard<'_, Board> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what the thread tells, and wakes who waits for that.
    pub(super) fn tell(&self, change: impl FnOnce(&mut Board)) {
        change(&mut self.lock());
        self.changed.notify_all();
    }

    /// Waits until something is so; `None` where that takes too long.
    pub(super) fn wait(&self, patience: Duration, is_so: impl Fn(&Board) -> bool) -> Option<MutexGuard<'_, Board>> {
        let until = Instant::now() + patience;
        let mut board = self.lock();
        while !is_so(&board) {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return None;
            }
            board = self.changed.wait_timeout(board, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        Some(board)
    }
}
