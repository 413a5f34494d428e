//! What the caller that commands an arm and the thread that moves it exchange.

use super::statistics::MotionStatistics;
use crate::motion::{Mailbox, Motion, MotionCommand};

/// Commands to the thread, and its results.
pub(super) type MotionMailbox = Mailbox<MailboxState>;

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
