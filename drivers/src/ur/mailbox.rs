//! What the caller that commands an arm and the thread that moves it exchange.

use super::statistics::MotionStatistics;
use crate::motion::{Exchange, Mailbox};

/// Commands to the thread, and its results.
pub(super) type MotionMailbox = Mailbox<Exchange<RobotExchange>>;

#[derive(Debug, Default)]
pub(super) struct RobotExchange {
    /// Number of a motion that should start.
    pub(super) requested_session: Option<i32>,
    /// The reason why the requested motion cannot start.
    pub(super) start_error: Option<String>,
    /// Whether the program of the requested motion runs.
    pub(super) is_running: bool,
    /// The reason why the robot accepts no motion, according to its newest state.
    pub(super) blocking_reason: Option<String>,
    /// Whether the robot is in a protective stop.
    pub(super) is_protective_stop: bool,
    pub(super) statistics: MotionStatistics,
}
