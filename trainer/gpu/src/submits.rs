//! The training submit in flight, and the measured duration of a step.

use crate::{Error, Gpu, PendingRead};
use std::time::Instant;

/// Weight of the latest submit in the smoothed step time. With a larger weight, the step time
/// follows the growth of a model faster. With a smaller weight, a single slow submit, for example
/// one that competes with a render, shortens the following submits less.
const NEW_WEIGHT: f64 = 0.2;
/// Maximum GPU time of a training submit. It is short enough for checkpoints, keyframes and Ctrl-C
/// to be handled soon.
const SUBMIT_MILLIS: f64 = 20.0;
/// Maximum GPU time while pictures are requested. It is shorter, because each picture waits for the
/// running submit and the queued submit.
const SUBMIT_MILLIS_WATCHED: f64 = 2.0;

/// Tracks training submits. At most one submit is in flight while the next submit is recorded.
#[derive(Debug)]
pub struct Submits {
    in_flight: Option<InFlight>,
    /// Time at which the last submit was found to be complete.
    idle_since: Instant,
    step_millis: f64,
    /// Whether pictures are requested.
    is_watched: bool,
}

#[derive(Debug)]
struct InFlight {
    counters: PendingRead,
    n_steps: u64,
    since: Instant,
}

impl Default for Submits {
    /// No submit is in flight, and none has been timed.
    fn default() -> Self {
        Self {
            in_flight: None,
            idle_since: Instant::now(),
            step_millis: 0.0,
            is_watched: false,
        }
    }
}

impl Submits {
    /// Registers a submit that returns counters at its end. Recording of the submit began at
    /// `since`.
    pub fn begin(&mut self, counters: PendingRead, n_steps: u64, since: Instant) {
        self.in_flight = Some(InFlight {
            counters,
            n_steps,
            since,
        });
    }

    /// Waits for the submit in flight and returns its counters, if there is one.
    ///
    /// # Errors
    ///
    /// Fails if the device failed.
    pub fn finish(&mut self, gpu: &Gpu) -> Result<Option<Vec<u32>>, Error> {
        let Some(InFlight {
            counters,
            n_steps,
            since,
        }) = self.in_flight.take()
        else {
            return Ok(None);
        };
        let counters = counters.finish(gpu)?;
        let completed = Instant::now();
        // The GPU executes submits one after another, and the previous submit may still have been
        // running at `since`.
        let began = since.max(self.idle_since);
        self.idle_since = completed;
        let millis = (completed - began).as_secs_f64() * 1e3 / n_steps.max(1) as f64;
        // The first measurement has nothing to be averaged with.
        self.step_millis = match self.step_millis {
            0.0 => millis,
            smoothed => (1.0 - NEW_WEIGHT) * smoothed + NEW_WEIGHT * millis,
        };
        Ok(Some(counters))
    }

    /// Number of steps in the submit in flight.
    #[must_use]
    pub fn n_steps_in_flight(&self) -> u64 {
        self.in_flight
            .as_ref()
            .map_or(0, |in_flight| in_flight.n_steps)
    }

    /// Number of steps that fit into the time limit of a submit. `None` until a submit has been
    /// timed.
    #[must_use]
    pub fn n_steps_in_limit(&self) -> Option<u64> {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "rounded down on purpose"
        )]
        let n_steps = |step_millis: f64| (submit_millis(self.is_watched) / step_millis) as u64;
        (self.step_millis > 0.0).then(|| n_steps(self.step_millis))
    }

    /// Smoothed GPU time of a step, milliseconds. It is 0 until a submit has been timed.
    #[must_use]
    pub fn step_millis(&self) -> f64 {
        self.step_millis
    }

    /// Replaces the measured time of a step.
    #[cfg(any(test, feature = "testing"))]
    pub fn assume_step_millis(&mut self, millis: f64) {
        self.step_millis = millis;
    }

    /// Whether pictures are requested.
    #[must_use]
    pub fn is_watched(&self) -> bool {
        self.is_watched
    }

    /// Sets whether pictures are requested. If they are, submits must be short.
    pub fn set_watched(&mut self, watched: bool) {
        self.is_watched = watched;
    }
}

/// Maximum GPU time of a training submit, milliseconds.
fn submit_millis(is_watched: bool) -> f64 {
    if is_watched {
        SUBMIT_MILLIS_WATCHED
    } else {
        SUBMIT_MILLIS
    }
}
