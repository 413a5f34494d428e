//! An evaluation that scores one test image at a time, so that pictures can be drawn in between.

use crate::evaluate::ImageScores;
use keyframe::Keyframe;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// Time limit for scoring. Fewer images are scored if rendering is slow: on a CPU, a neural field takes seconds per
/// image.
const MAX_SCORING: Duration = Duration::from_secs(60);

/// An evaluation in progress.
pub(crate) struct PendingEvaluation {
    /// Training time at which the evaluation was due, seconds.
    pub seconds: f64,
    /// Images left to score, ordered so that the scored ones are evenly spread at any time.
    remaining: VecDeque<Arc<Keyframe>>,
    images: Vec<ImageScores>,
    spent: Duration,
}

impl PendingEvaluation {
    /// An evaluation due at `seconds` that scores at most `max_images` of the test keyframes.
    pub(crate) fn new<'a>(
        seconds: f64,
        tests: impl ExactSizeIterator<Item = &'a Arc<Keyframe>>,
        max_images: usize,
    ) -> Self {
        let stride = tests.len().div_ceil(max_images).max(1);
        let mut selected: Vec<(usize, &Arc<Keyframe>)> = tests.step_by(stride).enumerate().collect();
        selected.sort_by_key(|(ix, _)| ix.reverse_bits());
        let remaining = selected.into_iter().map(|(_, keyframe)| keyframe.clone()).collect();
        Self { seconds, remaining, images: Vec::new(), spent: Duration::ZERO }
    }

    /// The next test keyframe to score; `None` if all are scored or the time limit is reached.
    pub(crate) fn take_next(&mut self) -> Option<Arc<Keyframe>> {
        if self.spent < MAX_SCORING { self.remaining.pop_front() } else { None }
    }

    /// Adds the scores of the last keyframe and the time that scoring took.
    pub(crate) fn add(&mut self, scores: ImageScores, spent: Duration) {
        self.images.push(scores);
        self.spent += spent;
    }

    /// Whether no image is left to score.
    pub(crate) fn is_complete(&self) -> bool {
        self.remaining.is_empty() || self.spent >= MAX_SCORING
    }

    /// The scores so far.
    pub(crate) fn into_images(self) -> Vec<ImageScores> {
        self.images
    }
}
