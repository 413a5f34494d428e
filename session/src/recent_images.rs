//! What happened to the images of the last seconds, from counts since the start of the run.

use crate::advice::ImageFlow;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Length of the window. In a shorter window, a camera at 1 Hz has too few images for advice. With
/// a longer window, advice stays visible long after the operator has followed it.
const WINDOW: Duration = Duration::from_secs(10);

/// Counts of the last seconds.
#[derive(Debug, Default)]
pub(crate) struct RecentImages {
    /// Counts since the start of the run and when they were taken, the oldest first.
    totals: VecDeque<(Instant, ImageFlow)>,
}

impl RecentImages {
    /// Adds counts since the start of the run, and returns what was added to them within the
    /// window.
    pub(crate) fn push(&mut self, now: Instant, total: ImageFlow) -> ImageFlow {
        // Before the first counts, there was no image.
        if self.totals.is_empty() {
            self.totals.push_back((now, ImageFlow::default()));
        }
        // The oldest counts that are kept lie just outside the window, so that the whole window is
        // covered.
        let is_old = |(at, _): &(Instant, ImageFlow)| now.saturating_duration_since(*at) >= WINDOW;
        while self.totals.get(1).is_some_and(is_old) {
            self.totals.pop_front();
        }
        let recent = match self.totals.front() {
            Some((_, before)) => difference(&total, before),
            None => total.clone(),
        };
        self.totals.push_back((now, total));
        recent
    }
}

fn difference(total: &ImageFlow, before: &ImageFlow) -> ImageFlow {
    let rejected = total.rejected.iter().map(|(why, n)| {
        let n_before = before.rejected.get(why).copied().unwrap_or_default();
        (why.clone(), n.saturating_sub(n_before))
    });
    ImageFlow {
        received: total.received.saturating_sub(before.received),
        dropped: total.dropped.saturating_sub(before.dropped),
        accepted: total.accepted.saturating_sub(before.accepted),
        rejected: rejected.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn old_images_leave_the_window() {
        let mut recent = RecentImages::default();
        let began = Instant::now();
        let at = |secs| began + Duration::from_secs(secs);
        let total = |received, blurred| ImageFlow {
            received,
            rejected: [("blur".to_owned(), blurred)].into(),
            ..ImageFlow::default()
        };
        assert_eq!(recent.push(at(0), total(3, 3)), total(3, 3));
        assert_eq!(recent.push(at(5), total(10, 4)), total(10, 4));
        assert_eq!(recent.push(at(14), total(50, 4)), total(47, 1));
        assert_eq!(recent.push(at(15), total(50, 4)), total(40, 0));
        assert_eq!(recent.push(at(40), total(50, 4)), total(0, 0));
    }
}
