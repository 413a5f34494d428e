//! Seconds of training.

use std::cell::Cell;
use std::rc::Rc;
use std::time::{Duration, Instant};

/// Seconds of training; evaluation does not count. Clones show the same time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clock(Rc<Cell<Times>>);

#[derive(Clone, Copy, Debug, Default)]
struct Times {
    started: Option<Instant>,
    excluded: Duration,
    /// Of the runs that this one goes on from.
    earlier_secs: f64,
}

impl Clock {
    /// A clock that goes on where earlier runs had trained for so long.
    pub(crate) fn after(earlier_secs: f64) -> Self {
        Self(Rc::new(Cell::new(Times { earlier_secs, ..Times::default() })))
    }

    /// Starts it, unless it runs.
    pub(crate) fn start(&self, at: Instant) {
        let times = self.0.get();
        self.0.set(Times { started: times.started.or(Some(at)), ..times });
    }

    /// When it started, once it runs.
    pub(crate) fn started(&self) -> Option<Instant> {
        self.0.get().started
    }

    /// Leaves out what was no training.
    pub(crate) fn exclude(&self, spent: Duration) {
        let times = self.0.get();
        self.0.set(Times { excluded: times.excluded + spent, ..times });
    }

    /// Seconds so far.
    pub(crate) fn secs(&self) -> f64 {
        let times = self.0.get();
        let of_this_run = |started: Instant| started.elapsed().saturating_sub(times.excluded).as_secs_f64();
        times.earlier_secs + times.started.map_or(0.0, of_this_run)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_show_one_time_and_what_is_excluded_does_not_count() {
        const HOUR: Duration = Duration::from_secs(3600);
        let clock = Clock::after(10.0);
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
