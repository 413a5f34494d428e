//! The behavior of motors when commands of this computer stop, and its configuration.

use crate::motion::OnLoss;
use crate::wire::can::canopen;
use std::time::Duration;

/// Watchdog configuration of all motors of an arm.
#[derive(Clone, Debug)]
pub struct WatchdogPlan {
    /// Action of the motors when commands stop.
    pub on_loss: OnLoss,
    /// Time without commands after which the motors take this action.
    pub timeout: Duration,
    /// Whether to move motors without a watchdog.
    pub accept_no_watchdog: bool,
    /// Our CANopen node number, whose heartbeat the drives monitor.
    pub host: canopen::Node,
    /// Cycle period.
    pub period: Duration,
}

/// Ability of a motor to detect missing commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watchdog {
    /// The watchdog of the motor can be set to take one of these actions.
    Available(&'static [OnLoss]),
    /// The motor has no watchdog and executes its last command forever.
    Missing {
        /// The reason, as the start of a sentence.
        reason: &'static str,
        /// Actions that this computer can command while it is still running.
        actions: &'static [OnLoss],
    },
}

impl Watchdog {
    /// Actions that are possible when commands stop.
    pub fn actions(&self) -> &'static [OnLoss] {
        match self {
            Self::Available(actions) | Self::Missing { actions, .. } => actions,
        }
    }

    /// Whether the motor detects missing commands.
    pub fn is_available(&self) -> bool {
        matches!(self, Self::Available(_))
    }
}
