//! Warns that a live run has no keyframe yet.

use capture::Feed;
use std::time::{Duration, Instant};

/// Time without any keyframe until it is reported. With a shorter time, the warning would appear
/// when a robot has only just begun to move. With a longer time, an operator would wait in vain.
const WARN_AFTER: Duration = Duration::from_secs(10);

/// When to report that there is still no keyframe.
pub(super) struct KeyframeWarning {
    started: Instant,
    warn_after: Duration,
}

impl KeyframeWarning {
    /// Begins with the first interval now.
    pub(super) fn start() -> Self {
        Self {
            started: Instant::now(),
            warn_after: WARN_AFTER,
        }
    }

    /// Reports, at growing intervals, that the run has no keyframe yet, and why.
    pub(super) fn warn_when_due(&mut self, feed: &Feed) {
        if feed.ended() || self.started.elapsed() < self.warn_after {
            return;
        }
        let rejected: Vec<String> = feed
            .rejected()
            .iter()
            .map(|(why, n)| format!("{n} {why}"))
            .collect();
        let reason = if rejected.is_empty() {
            "no image has been joined with a pose".to_owned()
        } else {
            format!("images rejected: {}", rejected.join(", "))
        };
        log::warn!(
            "no keyframe after {} s, so nothing is trained: {reason}",
            self.warn_after.as_secs()
        );
        self.warn_after *= 2;
    }
}
