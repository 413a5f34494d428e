//! What the caller that commands a Franka arm and the thread that moves it exchange.

use super::MotionStatistics;
use crate::motion::{Exchange, Mailbox};
use franka::RobotMode;

/// Commands to the thread, and its results.
pub(super) type MotionMailbox = Mailbox<Exchange<RobotExchange>>;

#[derive(Debug)]
pub(super) struct RobotExchange {
    /// ID of a motion that the robot has accepted and the thread has not processed yet.
    pub(super) started_motion: Option<u32>,
    pub(super) mode: RobotMode,
    pub(super) statistics: MotionStatistics,
}

impl Default for RobotExchange {
    fn default() -> Self {
        Self {
            started_motion: None,
            mode: RobotMode::Other,
            statistics: MotionStatistics::default(),
        }
    }
}
