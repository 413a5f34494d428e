//! Requests to stop a run.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Whether a stop was requested. Clones share the state.
#[derive(Clone, Debug, Default)]
pub struct Stop {
    /// Set if the program requested the stop.
    requested: Arc<AtomicBool>,
    /// Set if a signal requested the stop.
    signaled: Arc<AtomicBool>,
    /// Whether the signal was logged.
    logged: Arc<AtomicBool>,
    /// Message that is logged after a signal.
    message: &'static str,
}

impl Stop {
    /// Creates a stop and a flag that a signal handler may set. Setting the flag requests the stop; the next query then
    /// logs the message.
    #[must_use]
    pub fn with_signal_flag(message: &'static str) -> (Self, Arc<AtomicBool>) {
        let stop = Self { message, ..Self::default() };
        let flag = stop.signaled.clone();
        (stop, flag)
    }

    /// Requests a stop.
    pub fn request(&self) {
        self.requested.store(true, Ordering::Relaxed);
    }

    /// Whether a stop was requested.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.requested.load(Ordering::Relaxed) || self.signaled()
    }

    /// Whether a signal requested a stop.
    #[must_use]
    pub fn signaled(&self) -> bool {
        let signaled = self.signaled.load(Ordering::Relaxed);
        if signaled && !self.logged.swap(true, Ordering::Relaxed) {
            log::info!("{}", self.message);
        }
        signaled
    }
}
