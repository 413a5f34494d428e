//! What the caller that commands a Franka arm and the thread that moves it exchange.

use super::MotionStatistics;
use crate::motion::{Mailbox, Motion, MotionCommand};
use franka::RobotMode;

/// Commands to the thread, and its results.
pub(super) type MotionMailbox = Mailbox<MailboxState>;

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

impl Default for MailboxState {
    fn default() -> Self {
        Self {
            command: None,
            started_motion: None,
            accepts_commands: false,
            is_idle: true,
            is_shutting_down: false,
            is_lost: false,
            motion: Motion::Holding,
            mode: RobotMode::Other,
            statistics: MotionStatistics::default(),
        }
    }
}
