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
        state.previous_secs + state.secs_of_this_run()
    }
}

impl ClockState {
    /// Training time of this run, seconds; 0 before the start.
    fn secs_of_this_run(self) -> f64 {
        // Excluded time may include time before the start, so the difference may be negative.
        self.started.map_or(0.0, |started| {
            started
                .elapsed()
                .saturating_sub(self.excluded)
                .as_secs_f64()
        })
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
