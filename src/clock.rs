//! Seconds of training.

use std::cell::Cell;
use std::rc::Rc;
use std::time::{Duration, Instant};

/// Seconds of training; evaluation does not count. Clones show the same time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clock(Rc<Cell<ClockState>>);

#[derive(Clone, Copy, Debug, Default)]
struct ClockState {
    started: Option<Instant>,
    excluded: Duration,
    /// Of the runs that this one goes on from.
    previous_secs: f64,
}

impl Clock {
    /// A clock that goes on where earlier runs had trained for so long.
    pub(crate) fn with_elapsed(previous_secs: f64) -> Self {
        Self(Rc::new(Cell::new(ClockState { previous_secs, ..ClockState::default() })))
    }

    /// Starts it, unless it runs.
    pub(crate) fn start(&self, at: Instant) {
        let state = self.0.get();
        self.0.set(ClockState { started: state.started.or(Some(at)), ..state });
    }

    /// When it started, once it runs.
    pub(crate) fn started(&self) -> Option<Instant> {
        self.0.get().started
    }

    /// Leaves out what was no training.
    pub(crate) fn exclude(&self, spent: Duration) {
        let state = self.0.get();
        self.0.set(ClockState { excluded: state.excluded + spent, ..state });
    }

    /// Seconds so far.
    pub(crate) fn secs(&self) -> f64 {
        let state = self.0.get();
        let of_this_run = |started: Instant| started.elapsed().saturating_sub(state.excluded).as_secs_f64();
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
        assert_eq!(other.secs(), 10.0, "it stands still");
        let started = Instant::now().checked_sub(HOUR).expect("the machine has run for an hour");
        clock.start(started);
        other.start(Instant::now());
        assert_eq!(other.started(), Some(started), "it starts once");
        assert!(other.secs() >= 3610.0);
        other.exclude(HOUR);
        assert!((10.0..3610.0).contains(&clock.secs()), "{}", clock.secs());
    }
}
