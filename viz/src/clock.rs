//! The clock that a server's messages are on.

use std::time::Instant;

/// Milliseconds since the server started.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ServerClock {
    started: Instant,
}

impl ServerClock {
    /// A clock that is 0 now.
    pub(crate) fn start() -> Self {
        Self { started: Instant::now() }
    }

    /// Now.
    pub(crate) fn now_millis(self) -> f64 {
        self.millis(Instant::now())
    }

    /// Time of an instant; negative before the server started.
    pub(crate) fn millis(self, at: Instant) -> f64 {
        let after = at.saturating_duration_since(self.started).as_secs_f64();
        let before = self.started.saturating_duration_since(at).as_secs_f64();
        (after - before) * 1e3
    }
}
