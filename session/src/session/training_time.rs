//! Time accounting of a session: training time, its limits, and the use of a shared device.

use crate::training_clock::Clock;
use std::time::{Duration, Instant};

/// Limits of training, which stops when the first one is reached.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Maximum training time, seconds.
    pub seconds: Option<f64>,
    /// Maximum number of optimizer steps.
    pub steps: Option<u64>,
}

impl Limits {
    /// The limits as text, such as `8 s` or `500 steps`.
    pub fn describe(self) -> String {
        let parts = [
            self.seconds.map(|seconds| format!("{seconds} s")),
            self.steps.map(|steps| format!("{steps} steps")),
        ];
        parts.into_iter().flatten().collect::<Vec<_>>().join(" or ")
    }
}

/// Training time, its limits, and device time.
pub struct TrainingTime {
    limits: Limits,
    clock: Clock,
    /// Time for which this session has used a shared device.
    device_time: Duration,
    /// Training time at which this session finished, seconds. Other sessions may still train at
    /// this time.
    finished_secs: Option<f64>,
}

impl TrainingTime {
    /// The time of a new session.
    pub(super) fn new(limits: Limits, clock: Clock) -> Self {
        Self {
            limits,
            clock,
            device_time: Duration::ZERO,
            finished_secs: None,
        }
    }

    /// Starts the clock unless it is already running.
    pub(crate) fn start(&self, at: Instant) {
        self.clock.start(at);
    }

    /// Time at which the clock was started; `None` if it is not running.
    pub fn started(&self) -> Option<Instant> {
        self.clock.started()
    }

    /// Training time so far, seconds.
    pub fn secs(&self) -> f64 {
        self.clock.secs()
    }

    /// Excludes a duration from the training time.
    pub(crate) fn exclude(&self, spent: Duration) {
        self.clock.exclude(spent);
    }

    /// Whether a limit is reached after `n_steps` steps.
    pub(super) fn is_over(&self, n_steps: u64) -> bool {
        self.limits.seconds.is_some_and(|secs| self.secs() >= secs)
            || self.has_finished_steps(n_steps)
    }

    /// Number of steps left after `n_steps` steps; `None` without a step limit.
    pub(crate) fn n_steps_remaining(&self, n_steps: u64) -> Option<u64> {
        Some(self.limits.steps?.saturating_sub(n_steps))
    }

    /// Whether the step limit is reached after `n_steps` steps.
    pub(super) fn has_finished_steps(&self, n_steps: u64) -> bool {
        self.n_steps_remaining(n_steps) == Some(0)
    }

    /// Time for which this session has used a shared device.
    pub(crate) fn device_time(&self) -> Duration {
        self.device_time
    }

    /// Adds time on a shared device.
    pub(crate) fn add_device_time(&mut self, spent: Duration) {
        self.device_time += spent;
    }

    /// Raises the device time to at least `device_time`, so that an idle session does not catch up
    /// later.
    pub(crate) fn raise_device_time(&mut self, device_time: Duration) {
        self.device_time = self.device_time.max(device_time);
    }

    /// Marks the session as finished at the current training time, unless it is already finished.
    pub(crate) fn mark_finished(&mut self) {
        // Only the first mark counts: the session may be asked again while others still train.
        let secs = self.secs();
        self.finished_secs.get_or_insert(secs);
    }

    /// Whether the session was marked as finished.
    pub(super) fn is_finished(&self) -> bool {
        self.finished_secs.is_some()
    }

    /// Removes the mark of a finished session, so that it continues.
    pub(super) fn unmark_finished(&mut self) {
        self.finished_secs = None;
    }

    /// Training time at which the session finished, or the current one if it has not finished,
    /// seconds.
    pub(super) fn end_secs(&self) -> f64 {
        self.finished_secs.unwrap_or_else(|| self.secs())
    }
}
