//! When lines about the progress of work are printed, if there is no progress bar.

use std::time::{Duration, Instant};

/// Lines about progress, for outputs without a progress bar, that is, outputs that are not a
/// terminal.
#[derive(Clone, Debug)]
pub struct ProgressLines {
    is_shown: bool,
    n_last: usize,
    last_at: Instant,
}

impl ProgressLines {
    /// After this time, a line is printed even if less than a tenth was done.
    const MAX_PERIOD: Duration = Duration::from_secs(10);
    /// Work that takes less time than this needs no lines.
    const MIN_PERIOD: Duration = Duration::from_secs(1);

    /// Lines for work that begins at `now`. They replace a hidden progress bar.
    #[must_use]
    pub fn new(is_shown: bool, now: Instant) -> Self {
        Self {
            is_shown,
            n_last: 0,
            last_at: now,
        }
    }

    /// Whether a line is due at `now`. A line is due if some work remains, and if since the last
    /// line a tenth of the whole was done, or a period has passed in which anything was done.
    pub fn is_due(&mut self, n_done: usize, n_all: usize, now: Instant) -> bool {
        let elapsed = now.duration_since(self.last_at);
        let is_tenth = n_done.saturating_sub(self.n_last) >= n_all.div_ceil(10);
        let min_period = if is_tenth {
            Self::MIN_PERIOD
        } else {
            Self::MAX_PERIOD
        };
        let is_due =
            self.is_shown && n_done > self.n_last && n_done < n_all && elapsed >= min_period;
        if is_due {
            self.n_last = n_done;
            self.last_at = now;
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_lines_are_due_every_tenth_or_ten_seconds() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        let mut lines = ProgressLines::new(true, start);
        for (n_done, millis, expected) in [
            // Fast work needs no lines.
            (10, 900, false),
            (10, 1000, true),
            (19, 9000, false),
            (20, 9500, true),
            // Slow work has a line if anything was done.
            (20, 40_000, false),
            (21, 40_100, true),
            (22, 50_000, false),
            (22, 50_100, true),
            (99, 60_000, true),
            // The result follows.
            (100, 99_000, false),
        ] {
            assert_eq!(
                lines.is_due(n_done, 100, at(millis)),
                expected,
                "{n_done} after {millis} ms"
            );
        }
        let mut hidden = ProgressLines::new(false, start);
        assert!(!hidden.is_due(10, 100, at(60_000)));
    }
}
