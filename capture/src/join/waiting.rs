//! Images of one camera that wait until all their data have arrived.
//!
//! Color, depth and ground truth come in any order. Joint readings may come before or after the
//! images. Decisions depend only on the order of the samples, never on a clock, so that a replay
//! makes the same decisions.

use drivers::{Image, TruthImage};
use kinematics::Stamp;
use std::collections::VecDeque;

/// Maximum number of waiting images of each kind, two seconds at 30 Hz. The limit bounds memory if
/// joint states stop arriving while images continue.
const MAX_WAITING: usize = 64;

/// Samples of one camera, each kind in stamp order.
#[derive(Debug)]
pub(super) struct Waiting {
    color: VecDeque<Image>,
    depth: VecDeque<(Stamp, Image)>,
    truth: VecDeque<TruthImage>,
    /// Whether ground truth is expected.
    expects_truth: bool,
}

/// State of the matching depth image or ground truth of a color image.
#[derive(Clone, Copy, Debug)]
pub(super) enum Partner<T> {
    /// The image has arrived.
    Available(T),
    /// The image may still arrive.
    NotYet,
    /// The image will never arrive.
    Never,
}

impl Waiting {
    pub(super) fn new(expects_truth: bool) -> Self {
        Self {
            color: VecDeque::new(),
            depth: VecDeque::new(),
            truth: VecDeque::new(),
            expects_truth,
        }
    }

    /// Queues a color image. If too many wait, removes and returns the oldest.
    pub(super) fn push_color(&mut self, image: Image) -> Option<Image> {
        let dropped_image = if self.color.len() == MAX_WAITING {
            self.color.pop_front()
        } else {
            None
        };
        self.color.push_back(image);
        dropped_image
    }

    /// Queues a depth image; `stamp` is its mid-exposure.
    pub(super) fn push_depth(&mut self, stamp: Stamp, image: Image) {
        push(&mut self.depth, (stamp, image));
    }

    pub(super) fn push_truth(&mut self, truth: TruthImage) {
        // Ground truth has arrived after all, so later images wait for it again.
        self.expects_truth = true;
        push(&mut self.truth, truth);
    }

    pub(super) fn oldest(&self) -> Option<&Image> {
        self.color.front()
    }

    pub(super) fn take_oldest(&mut self) -> Option<Image> {
        self.color.pop_front()
    }

    /// Mid-exposure of the depth image that is nearest to a stamp and at most `max_difference_secs`
    /// away. Also returns whether no nearer image can follow.
    pub(super) fn depth_near(
        &self,
        stamp: Stamp,
        max_difference_secs: f64,
    ) -> (Option<Stamp>, bool) {
        let nearest = self
            .depth
            .iter()
            .map(|(at, _)| *at)
            .min_by_key(|at| at.nanos_since(stamp).unsigned_abs());
        // Depth images arrive in order, so no nearer one follows an image at or after the stamp.
        let is_final = self
            .depth
            .back()
            .is_some_and(|(newest, _)| *newest >= stamp);
        (
            nearest.filter(|at| at.secs_since(stamp).abs() <= max_difference_secs),
            is_final,
        )
    }

    /// The depth image with this mid-exposure. It stays queued, because the next color image may
    /// use it too.
    pub(super) fn depth_at(&self, stamp: Stamp) -> Option<&Image> {
        self.depth
            .iter()
            .find(|(at, _)| *at == stamp)
            .map(|(_, image)| image)
    }

    /// The ground truth of a color image, found by its device stamp.
    pub(super) fn truth_of(&self, device_stamp: Stamp) -> Partner<&TruthImage> {
        match self
            .truth
            .iter()
            .find(|truth| truth.image.stamp == device_stamp)
        {
            Some(truth) => Partner::Available(truth),
            None if self.expects_truth => Partner::NotYet,
            None => Partner::Never,
        }
    }

    /// Stops expecting ground truth, because it did not arrive in time.
    pub(super) fn stop_waiting_for_truth(&mut self) {
        self.expects_truth = false;
    }

    /// Removes depth and truth that only earlier color images needed.
    pub(super) fn forget_before(&mut self, stamp: Stamp, device_stamp: Stamp, period_secs: f64) {
        // Truth belongs to exactly one image, which is found by its device stamp. Truth of an image
        // that was dropped is removed here, too.
        self.truth.retain(|truth| truth.image.stamp > device_stamp);
        self.depth
            .retain(|(at, _)| stamp.secs_since(*at) <= period_secs);
    }
}

fn push<T>(queue: &mut VecDeque<T>, item: T) {
    if queue.len() == MAX_WAITING {
        queue.pop_front();
    }
    queue.push_back(item);
}
