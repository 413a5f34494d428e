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
    /// Set by the first Ctrl-C. While it is set, the next Ctrl-C ends the process at once.
    interrupted: Arc<AtomicBool>,
    /// Whether the signal was logged.
    logged: Arc<AtomicBool>,
    /// Message that is logged after a signal.
    message: &'static str,
}

impl Stop {
    /// Creates a stop and two flags for signal handlers. Setting the first flag requests the stop.
    /// The next query then logs the message. The second flag records a Ctrl-C, so that the next
    /// Ctrl-C ends the process at once.
    #[must_use]
    pub fn with_signal_flags(message: &'static str) -> (Self, [Arc<AtomicBool>; 2]) {
        let stop = Self {
            message,
            ..Self::default()
        };
        let flags = [stop.signaled.clone(), stop.interrupted.clone()];
        (stop, flags)
    }

    /// Withdraws all requests. The next signal then requests a stop again, with another message.
    /// The next Ctrl-C does not end the process at once.
    pub fn rearm(&mut self, message: &'static str) {
        self.message = message;
        // A signal that arrives during this loop still requests a stop, because its handler sets
        // `interrupted` first.
        for flag in [
            &self.signaled,
            &self.requested,
            &self.logged,
            &self.interrupted,
        ] {
            flag.store(false, Ordering::Relaxed);
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rearmed_stop_waits_for_the_next_signal() {
        let (mut stop, [signaled, interrupted]) = Stop::with_signal_flags("stopping");
        interrupted.store(true, Ordering::Relaxed);
        signaled.store(true, Ordering::Relaxed);
        stop.request();
        assert!(stop.requested() && stop.signaled());
        stop.rearm("ending");
        assert!(!stop.requested() && !stop.signaled());
        assert!(
            !interrupted.load(Ordering::Relaxed),
            "the next Ctrl-C would end the process at once"
        );
        signaled.store(true, Ordering::Relaxed);
        assert!(stop.requested() && stop.signaled());
    }
}
