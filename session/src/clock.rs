//! The clock of training time.

use std::cell::Cell;
use std::rc::Rc;
use std::time::{Duration, Instant};

/// Measures training time, excluding evaluation. Clones share the same time.
#[derive(Clone, Debug, Default)]
pub struct Clock(Rc<Cell<ClockState>>);

#[derive(Clone, Copy, Debug, Default)]
struct ClockState {
    started: Option<Instant>,
    excluded: Duration,
    /// Training time of the earlier runs that this run continues.
    previous_secs: f64,
}

impl Clock {
    /// A clock that continues from the training time of earlier runs.
    pub fn with_elapsed(previous_secs: f64) -> Self {
        Self(Rc::new(Cell::new(ClockState {
            previous_secs,
            ..ClockState::default()
        })))
    }

    /// Starts the clock unless it is already running.
    pub fn start(&self, at: Instant) {
        let state = self.0.get();
        self.0.set(ClockState {
            started: state.started.or(Some(at)),
            ..state
        });
    }

    /// Time at which the clock was started; `None` if it is not running.
    pub fn started(&self) -> Option<Instant> {
        self.0.get().started
    }

    /// Excludes time that was not spent on training.
    pub fn exclude(&self, spent: Duration) {
        let state = self.0.get();
        self.0.set(ClockState {
            excluded: state.excluded + spent,
            ..state
        });
    }

    /// Training time so far, seconds.
    pub fn secs(&self) -> f64 {
        let state = self.0.get();
        let of_this_run = |started: Instant| {
            started
                .elapsed()
                .saturating_sub(state.excluded)
                .as_secs_f64()
        };
        state.previous_secs + state.started.map_or(0.0, of_this_run)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_share_time_and_exclusions() {
        const HOUR: Duration = Duration::from_secs(3600);
        let clock = Clock::with_elapsed(10.0);
        let other = clock.clone();
        assert_eq!(other.secs(), 10.0, "it is not running");
        let started = Instant::now()
            .checked_sub(HOUR)
            .expect("the machine has run for an hour");
        clock.start(started);
        other.start(Instant::now());
        assert_eq!(
            other.started(),
            Some(started),
            "only the first start counts"
        );
        assert!(other.secs() >= 3610.0);
        other.exclude(HOUR);
        assert!((10.0..3610.0).contains(&clock.secs()), "{}", clock.secs());
    }
}
