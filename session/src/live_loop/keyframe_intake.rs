//! Takes keyframes from the input, and keeps those that were accepted and not evicted.

use super::IDLE;
use super::keyframe_warning::KeyframeWarning;
use crate::advice::ImageFlow;
use crate::render_budget::RenderBudget;
use capture::{Feed, FeedItem, StoreUse};
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use messages::counted;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use viz::{Hub, ImageCounts, KeyframeStore, StateProgress};

/// Polling period while waiting for a keyframe or a picture request. It delays pictures and
/// keyframes by at most this time. A shorter period would use more processor time.
const POLL_PERIOD: Duration = Duration::from_millis(2);

/// Changes a keyframe before the models receive it.
pub type KeyframeChange = Box<dyn FnMut(Arc<Keyframe>) -> Arc<Keyframe>>;

/// The input of a run, and its accepted keyframes.
pub(super) struct KeyframeIntake {
    pub(super) feed: Feed,
    pub(super) accepted: AcceptedKeyframes,
    /// Number of keyframes with which training starts.
    pub(super) start_keyframes: usize,
    pub(super) change: Option<KeyframeChange>,
    warning: KeyframeWarning,
    /// Number of images that did not become keyframes in earlier parts of the run, by reason.
    earlier_rejected: BTreeMap<String, u64>,
}

impl KeyframeIntake {
    pub(super) fn new(
        feed: Feed,
        start_keyframes: usize,
        earlier_rejected: BTreeMap<String, u64>,
    ) -> Self {
        Self {
            feed,
            accepted: AcceptedKeyframes::default(),
            start_keyframes,
            change: None,
            warning: KeyframeWarning::start(),
            earlier_rejected,
        }
    }

    /// Whether there are enough keyframes to train. After the end of the input, one training
    /// keyframe is enough.
    pub(super) fn has_enough(&self) -> bool {
        let can_start = self.accepted.list.len() >= self.start_keyframes || self.feed.ended();
        self.accepted.can_train() && can_start
    }

    /// Whether there will be nothing to train on, because the devices failed or the input ended.
    pub(super) fn is_over_without_data(&self) -> bool {
        self.feed.source_failed() || (self.feed.ended() && !self.accepted.can_train())
    }

    /// Warns, at growing intervals, that the run has no keyframe yet.
    pub(super) fn warn_if_empty(&mut self) {
        if self.accepted.list.is_empty() {
            self.warning.warn_when_due(&self.feed);
        }
    }

    /// Waits for the next added or removed keyframe. Returns `None` if a requested picture may be
    /// drawn now, or after [`IDLE`].
    pub(super) fn wait_for_change(
        &mut self,
        hub: &Hub,
        budget: &mut RenderBudget,
    ) -> Option<FeedItem> {
        if hub.n_clients() == 0 {
            return self.feed.next(IDLE);
        }
        let started = Instant::now();
        // Keyframes and requests arrive in two queues, and a thread can wait for only one of them.
        // The loop therefore polls the first queue and waits for the second one, or only for
        // keyframes while no picture may be drawn.
        loop {
            let before = Instant::now();
            let timeout = if budget.may_render() {
                Duration::ZERO
            } else {
                POLL_PERIOD
            };
            if let Some(item) = self.feed.next(timeout) {
                return Some(item);
            }
            let is_requested = budget.may_render() && hub.pictures().wait_for_request(POLL_PERIOD);
            budget.add_training(before.elapsed()); // Training was idle, so drawing does not delay it.
            if started.elapsed() >= IDLE || is_requested {
                return None;
            }
        }
    }

    /// Adds an accepted keyframe. Returns it as the models receive it.
    pub(super) fn accept(&mut self, keyframe: Arc<Keyframe>) -> Arc<Keyframe> {
        let keyframe = self.changed(keyframe);
        self.accepted.list.push(keyframe.clone());
        keyframe
    }

    /// Replaces an accepted keyframe. Returns it as the models receive it.
    pub(super) fn revise(&mut self, keyframe: Arc<Keyframe>) -> Arc<Keyframe> {
        let keyframe = self.changed(keyframe);
        self.accepted.revise(&keyframe);
        keyframe
    }

    fn changed(&mut self, keyframe: Arc<Keyframe>) -> Arc<Keyframe> {
        match &mut self.change {
            Some(change) => change(keyframe),
            None => keyframe,
        }
    }

    /// Progress until training starts.
    pub(super) fn progress(&self) -> StateProgress {
        if self.feed.first_image().is_none() {
            return StateProgress {
                text: "no image has arrived yet".to_owned(),
                ..StateProgress::default()
            };
        }
        let n_keyframes = self.accepted.list.len();
        let n_start = self.start_keyframes.max(1);
        let n_rejected: u64 = self.feed.rejected().values().sum();
        // Before the first keyframe, rejected images are the only sign that images arrive.
        let rejected = match (n_keyframes, n_rejected) {
            (_, 0) | (1.., _) => String::new(),
            (0, n) => format!("; {} rejected", counted(n, "image")),
        };
        let text = format!(
            "{} of {n_start} keyframes{rejected}",
            n_keyframes.min(n_start)
        );
        StateProgress::of_parts(text, n_keyframes, n_start)
    }

    /// Number of rejected images of all parts of the run, by reason.
    pub(super) fn rejected(&self) -> BTreeMap<String, u64> {
        let mut sums = self.earlier_rejected.clone();
        for (reason, n) in self.feed.rejected() {
            *sums.entry(reason).or_default() += n;
        }
        sums
    }

    /// The counts of this part of the run, all of the same time.
    pub(super) fn counts(&self) -> IntakeCounts {
        let counts = self.feed.counts();
        let store = counts.store;
        IntakeCounts {
            flow: ImageFlow {
                received: counts.images,
                dropped: counts.dropped,
                accepted: counts.accepted,
                rejected: self.feed.rejected(),
            },
            images: ImageCounts {
                received: counts.images,
                dropped: counts.dropped,
                accepted: counts.accepted,
                evicted: counts.evicted,
            },
            store,
            shown_store: KeyframeStore {
                keyframes: store.keyframes as u64,
                max_keyframes: store.max_keyframes as u64,
                bytes: store.bytes,
                max_bytes: store.max_bytes,
                is_full: store.is_full(),
            },
        }
    }
}

/// Counts of images and keyframes.
pub(super) struct IntakeCounts {
    /// What has become of the images.
    pub(super) flow: ImageFlow,
    /// The same for viewers, with the evicted keyframes.
    pub(super) images: ImageCounts,
    /// How full the keyframe store is.
    pub(super) store: StoreUse,
    /// The same for viewers.
    pub(super) shown_store: KeyframeStore,
}

/// Keyframes that were accepted and not evicted.
#[derive(Default)]
pub(super) struct AcceptedKeyframes {
    /// In order of acceptance.
    pub(super) list: Vec<Arc<Keyframe>>,
    /// Number of keyframes evicted so far.
    pub(super) n_evicted: u64,
    n_revised: u64,
}

impl AcceptedKeyframes {
    /// Whether there is a training keyframe. With several cameras, the first keyframe of each is a
    /// test keyframe.
    pub(super) fn can_train(&self) -> bool {
        self.list
            .iter()
            .any(|keyframe| keyframe.split == Split::Train)
    }

    /// Number of accepted, of evicted and of revised keyframes. The length of the list is not enough
    /// to detect a change: in a full store, each new keyframe replaces another one.
    pub(super) fn n_changes(&self) -> [u64; 3] {
        [
            self.list.len() as u64 + self.n_evicted,
            self.n_evicted,
            self.n_revised,
        ]
    }

    fn revise(&mut self, revised: &Arc<Keyframe>) {
        self.n_revised += 1;
        let is_same = |keyframe: &&mut Arc<Keyframe>| {
            keyframe.camera == revised.camera && keyframe.stamp == revised.stamp
        };
        if let Some(keyframe) = self.list.iter_mut().find(is_same) {
            *keyframe = Arc::clone(revised);
        }
    }

    pub(super) fn evict(&mut self, camera: &Arc<str>, stamp: Stamp) {
        self.n_evicted += 1;
        self.list
            .retain(|keyframe| keyframe.camera != *camera || keyframe.stamp != stamp);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;

    fn keyframe(nanos: i64) -> Arc<Keyframe> {
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(nanos),
            size_px: [1, 1],
            focal_px: [1.0; 2],
            principal_px: [0.5; 2],
            rgba_srgb: [0; 4].into(),
            depth: None,
            world_from_camera: Transform::identity(),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        })
    }

    #[test]
    fn replacing_a_keyframe_of_a_full_store_is_a_change() {
        let mut accepted = AcceptedKeyframes::default();
        accepted.list.push(keyframe(1));
        let before = accepted.n_changes();
        accepted.evict(&"wrist".into(), Stamp(1));
        accepted.list.push(keyframe(2));
        assert_eq!(accepted.list.len(), 1);
        assert_ne!(accepted.n_changes(), before);
    }
}
