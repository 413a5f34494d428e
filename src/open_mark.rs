//! A mark whose test images are scored one at a time, so that pictures can be drawn in between.

use crate::evaluate::ImageScores;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;
use trainer::Keyframe;

/// Where drawing takes longer, a mark scores fewer test images: a neural field takes seconds for each on a processor.
const MAX_SCORING: Duration = Duration::from_secs(60);

/// A mark that was reached and is being scored.
pub(crate) struct OpenMark {
    /// Seconds of training at which it was reached.
    pub(crate) seconds: f64,
    /// However many of them are scored, they are spread evenly over all.
    left: VecDeque<Arc<Keyframe>>,
    images: Vec<ImageScores>,
    spent: Duration,
}

impl OpenMark {
    /// A mark reached at `seconds` that scores at most `max_images` of these test keyframes.
    pub(crate) fn new<'a>(
        seconds: f64,
        tests: impl ExactSizeIterator<Item = &'a Arc<Keyframe>>,
        max_images: usize,
    ) -> Self {
        let stride = tests.len().div_ceil(max_images).max(1);
        let mut picked: Vec<(usize, &Arc<Keyframe>)> = tests.step_by(stride).enumerate().collect();
        picked.sort_by_key(|(ix, _)| ix.reverse_bits());
        let left = picked.into_iter().map(|(_, keyframe)| keyframe.clone()).collect();
        Self { seconds, left, images: Vec::new(), spent: Duration::ZERO }
    }

    /// The next test keyframe to score; `None` where all are scored, or scoring took too long.
    pub(crate) fn take_next(&mut self) -> Option<Arc<Keyframe>> {
        if self.spent < MAX_SCORING { self.left.pop_front() } else { None }
    }

    /// Adds what scoring the last keyframe found and how long it took.
    pub(crate) fn add(&mut self, scores: ImageScores, spent: Duration) {
        self.images.push(scores);
        self.spent += spent;
    }

    /// Whether there is nothing left to score.
    pub(crate) fn is_complete(&self) -> bool {
        self.left.is_empty() || self.spent >= MAX_SCORING
    }

    /// The scores found.
    pub(crate) fn into_images(self) -> Vec<ImageScores> {
        self.images
    }
}
