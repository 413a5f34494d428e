//! An evaluation that scores one test image at a time, so that pictures can be drawn in between.

use crate::evaluate::ImageScores;
use keyframe::Keyframe;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// An evaluation in progress.
pub(crate) struct PendingEvaluation {
    /// Training time at which the evaluation was due, seconds.
    pub seconds: f64,
    /// Images left to score, ordered so that the scored ones are evenly spread at any time.
    remaining: VecDeque<Arc<Keyframe>>,
    images: Vec<ImageScores>,
    spent: Duration,
    /// Time limit for scoring. One image is scored in any case.
    max_spent: Duration,
}

impl PendingEvaluation {
    /// An evaluation due at `seconds` that scores at most `max_images` of the test keyframes. It
    /// scores fewer if `max_spent` is reached first. On a CPU, for example, rendering a neural
    /// field takes seconds per image.
    pub(crate) fn new<'a>(
        seconds: f64,
        tests: impl ExactSizeIterator<Item = &'a Arc<Keyframe>>,
        max_images: usize,
        max_spent: Duration,
    ) -> Self {
        let stride = tests.len().div_ceil(max_images).max(1);
        let mut selected: Vec<(usize, &Arc<Keyframe>)> =
            tests.step_by(stride).enumerate().collect();
        // Bit-reversed indices are the van der Corput sequence. Every prefix of this sequence is
        // spread evenly over all images. If the time limit ends the evaluation early, the scored
        // images still represent the whole scene.
        selected.sort_by_key(|(ix, _)| ix.reverse_bits());
        let remaining = selected
            .into_iter()
            .map(|(_, keyframe)| keyframe.clone())
            .collect();
        Self {
            seconds,
            remaining,
            images: Vec::new(),
            spent: Duration::ZERO,
            max_spent,
        }
    }

    /// The next test keyframe to score; `None` if all are scored or the time limit is reached.
    pub(crate) fn take_next(&mut self) -> Option<Arc<Keyframe>> {
        if self.is_complete() {
            None
        } else {
            self.remaining.pop_front()
        }
    }

    /// Adds the scores of the last keyframe and the time that scoring took.
    pub(crate) fn add(&mut self, scores: ImageScores, spent: Duration) {
        self.images.push(scores);
        self.spent += spent;
    }

    /// Whether no image is left to score.
    pub(crate) fn is_complete(&self) -> bool {
        // One image is scored in any case. Otherwise, a slow model would have no scores at all.
        self.remaining.is_empty() || !self.images.is_empty() && self.spent >= self.max_spent
    }

    /// Number of scored images, and of all images.
    pub(crate) fn progress(&self) -> (usize, usize) {
        let n_scored = self.images.len();
        (n_scored, n_scored + self.remaining.len())
    }

    /// The time that scoring has taken.
    pub(crate) fn spent(&self) -> Duration {
        self.spent
    }

    /// The scores so far.
    pub(crate) fn into_images(self) -> Vec<ImageScores> {
        self.images
    }
}
