//! The command of an operator that a robot follows, for the state that clients receive.

use std::time::Instant;
use steering::Reason;
use viz::{AppliedCommand, SteeringCommand};

/// The newest commands that move a robot.
#[derive(Debug, Default)]
pub(super) struct FollowedCommand {
    /// Was received, and no cycle has applied it yet.
    pending: Option<Source>,
    /// A cycle has applied it.
    applied: Option<AppliedCommand>,
}

/// Where a target comes from.
#[derive(Clone, Copy, Debug)]
struct Source {
    device: u64,
    sequence: u64,
    captured_at: Instant,
}

impl FollowedCommand {
    /// Takes an accepted command.
    pub(super) fn receive(&mut self, command: &SteeringCommand) {
        if command.grip.is_some() {
            self.pending = Some(Source {
                device: command.device,
                sequence: command.sequence,
                captured_at: command.captured_at,
            });
        }
    }

    /// Notes a cycle.
    ///
    /// * `has_target`: whether the robot has a target. If not, it follows no command.
    pub(super) fn note_cycle(&mut self, has_target: bool, applied_at: Instant) {
        if !has_target {
            *self = Self::default();
        } else if let Some(source) = self.pending.take() {
            self.applied = Some(AppliedCommand {
                device: source.device,
                sequence: source.sequence,
                captured_at: source.captured_at,
                applied_at,
            });
        }
    }

    /// The command that the robot follows.
    pub(super) fn applied(&self) -> Option<AppliedCommand> {
        self.applied
    }
}

/// Why a robot is stopped: the first reason, because it is the cause, and the newest, because
/// operators must see that their own stop has arrived, for example during a recovery.
pub(super) fn stop_text(first: Option<&Reason>, newest: Option<&Reason>) -> Option<String> {
    let first = first?;
    Some(match newest {
        Some(newest) => format!("{first}; since then: {newest}"),
        None => first.to_string(),
    })
}
