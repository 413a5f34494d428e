//! Times at which each keyframe of a live run passed the stages from the camera to the model.

use capture::InputTimes;
use kinematics::Stamp;
use std::sync::Arc;
use std::time::Instant;

/// The times of one keyframe, all on the clock of this process.
#[derive(Clone, Debug)]
pub struct KeyframeTimes {
    /// Name of its camera.
    pub camera: Arc<str>,
    /// Its stamp.
    pub stamp: Stamp,
    /// Times in the input.
    pub input: InputTimes,
    /// Time at which it was added to the model.
    pub pushed: Instant,
    /// Number of steps of the model at `pushed`, including queued steps.
    pub pushed_at_step: u64,
    /// Time at which the first steps after `pushed` were complete; `None` until then.
    pub trained: Option<Instant>,
}

/// The keyframes of a live run in the order in which the model received them.
#[derive(Debug, Default)]
pub struct Ledger {
    keyframes: Vec<KeyframeTimes>,
    /// Number of keyframes, from the first, whose [`KeyframeTimes::trained`] is known.
    n_trained: usize,
}

impl Ledger {
    /// The keyframes so far.
    #[must_use]
    pub fn keyframes(&self) -> &[KeyframeTimes] {
        &self.keyframes
    }

    /// Number of keyframes, from the first, that were available in at least one of the first `step` steps.
    #[must_use]
    pub fn n_in_model(&self, step: u64) -> usize {
        self.keyframes.partition_point(|keyframe| keyframe.pushed_at_step < step)
    }

    /// Adds a keyframe that was just pushed.
    pub(crate) fn push(&mut self, keyframe: KeyframeTimes) {
        self.keyframes.push(keyframe);
    }

    /// Records that the model has completed `step` steps.
    pub(crate) fn completed(&mut self, step: u64) {
        let n_trained = self.n_in_model(step).max(self.n_trained);
        let now = Instant::now();
        self.keyframes[self.n_trained..n_trained].iter_mut().for_each(|keyframe| keyframe.trained = Some(now));
        self.n_trained = n_trained;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keyframe(pushed_at_step: u64) -> KeyframeTimes {
        let now = Instant::now();
        KeyframeTimes {
            camera: "wrist".into(),
            stamp: Stamp(0),
            input: InputTimes { captured: Some(now), arrived: now, queued: now },
            pushed: now,
            pushed_at_step,
            trained: None,
        }
    }

    #[test]
    fn keyframes_are_trained_by_the_first_step_after_their_push() {
        let mut ledger = Ledger::default();
        let trained =
            |ledger: &Ledger| ledger.keyframes().iter().map(|keyframe| keyframe.trained.is_some()).collect::<Vec<_>>();
        ledger.push(keyframe(0));
        ledger.completed(0);
        assert_eq!(trained(&ledger), [false]);
        ledger.completed(5);
        ledger.push(keyframe(5));
        ledger.completed(5);
        assert_eq!(trained(&ledger), [true, false]);
        assert_eq!([0, 1, 5, 6].map(|step| ledger.n_in_model(step)), [0, 1, 1, 2]);
        let first = ledger.keyframes()[0].trained;
        ledger.completed(6);
        assert_eq!(trained(&ledger), [true, true]);
        assert_eq!(ledger.keyframes()[0].trained, first);
    }
}
