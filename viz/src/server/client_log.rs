//! A log of client activity with a limited rate, so that clients cannot fill the disk.

use parking_lot::Mutex;
use std::fmt::Arguments;
use std::time::{Duration, Instant};

/// Maximum number of lines per [`PERIOD`]. It applies to all clients together, because a client
/// with its own limit could reconnect to log more lines.
const MAX_LINES: u32 = 100;
const PERIOD: Duration = Duration::from_secs(10);

/// Logs client activity, at most [`MAX_LINES`] lines per [`PERIOD`].
#[derive(Debug)]
pub(crate) struct ClientLog {
    budget: Mutex<Budget>,
}

#[derive(Debug)]
struct Budget {
    since: Instant,
    n_lines: u32,
}

impl ClientLog {
    pub(crate) fn new() -> Self {
        Self {
            budget: Mutex::new(Budget {
                since: Instant::now(),
                n_lines: 0,
            }),
        }
    }

    /// Logs a line, unless there were too many lines in this period. The first line of the next
    /// period is preceded by the number of omitted lines.
    pub(crate) fn line(&self, text: Arguments<'_>) {
        // The lock is released before logging, which may wait for a disk or a terminal.
        let (n_omitted, is_logged) = self.budget.lock().count(Instant::now());
        if n_omitted > 0 {
            log::info!(
                "{n_omitted} lines about clients were not logged: more than {MAX_LINES} in {} s",
                PERIOD.as_secs()
            );
        }
        if is_logged {
            log::info!("{text}");
        }
    }
}

impl Budget {
    /// Counts a line. Returns whether this line is logged. If a new period begins, also returns how
    /// many lines of the last period were left out.
    fn count(&mut self, now: Instant) -> (u32, bool) {
        let mut n_omitted = 0;
        if now.saturating_duration_since(self.since) >= PERIOD {
            n_omitted = self.n_lines.saturating_sub(MAX_LINES);
            *self = Self {
                since: now,
                n_lines: 0,
            };
        }
        // Lines that are left out are also counted, because their number is logged.
        self.n_lines = self.n_lines.saturating_add(1);
        (n_omitted, self.n_lines <= MAX_LINES)
    }
}

#[cfg(test)]
mod tests {
    use super::{Budget, MAX_LINES, PERIOD};
    use std::time::{Duration, Instant};

    #[test]
    fn lines_beyond_the_limit_are_counted_and_left_out() {
        let start = Instant::now();
        let mut budget = Budget {
            since: start,
            n_lines: 0,
        };
        let logged = (0..5000)
            .filter(|n| budget.count(start + Duration::from_millis(n % 9999)).1)
            .count();
        assert_eq!(logged, MAX_LINES as usize);
        assert_eq!(budget.count(start + PERIOD), (4900, true));
        assert_eq!(budget.count(start + PERIOD), (0, true));
    }
}
