//! The server's clock, which stamps its messages.

use std::time::{Duration, Instant};

/// A clock that counts milliseconds since the server started.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ServerClock {
    started: Instant,
}

impl ServerClock {
    /// A clock that starts at 0 now.
    pub(crate) fn start() -> Self {
        Self {
            started: Instant::now(),
        }
    }

    /// The current time.
    pub(crate) fn now_millis(self) -> f64 {
        self.millis(Instant::now())
    }

    /// The time of an instant; negative before the server started.
    pub(crate) fn millis(self, at: Instant) -> f64 {
        // Durations cannot be negative, so one of the two differences is 0.
        let after = at.saturating_duration_since(self.started).as_secs_f64();
        let before = self.started.saturating_duration_since(at).as_secs_f64();
        (after - before) * 1e3
    }

    /// The instant of a time; `None` if it is before the server started, or not representable.
    pub(crate) fn instant(self, millis: f64) -> Option<Instant> {
        // The number comes from a client, so it may be negative, NaN, or too large to add.
        self.started
            .checked_add(Duration::try_from_secs_f64(millis * 1e-3).ok()?)
    }
}
