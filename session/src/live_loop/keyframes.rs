//! Passes keyframes on to the models.

use super::{IDLE, LiveLoop, Pace};
use crate::ledger::KeyframeTimes;
use capture::{Change, FeedItem, InputTimes};
use keyframe::{Keyframe, Split};
use kinematics::Stamp;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Polling period while waiting for a keyframe or a picture request. It delays pictures and
/// keyframes by at most this time. A shorter period would use more processor time.
const POLL_PERIOD: Duration = Duration::from_millis(2);

/// Keyframes that were accepted and not evicted.
#[derive(Default)]
pub(super) struct AcceptedKeyframes {
    /// In order of acceptance.
    pub(super) list: Vec<Arc<Keyframe>>,
    /// Number of keyframes evicted so far.
    pub(super) n_evicted: u64,
}

impl AcceptedKeyframes {
    /// Whether there is a training keyframe. With several cameras, the first keyframe of each is a
    /// test keyframe.
    pub(super) fn can_train(&self) -> bool {
        self.list
            .iter()
            .any(|keyframe| keyframe.split == Split::Train)
    }

    /// Number of accepted keyframes and number of evicted keyframes. The length of the list is not
    /// enough to detect a change: in a full store, each new keyframe replaces another one.
    fn n_changes(&self) -> (u64, u64) {
        (self.list.len() as u64 + self.n_evicted, self.n_evicted)
    }

    fn evict(&mut self, camera: &Arc<str>, stamp: Stamp) {
        self.n_evicted += 1;
        self.list
            .retain(|keyframe| keyframe.camera != *camera || keyframe.stamp != stamp);
    }
}

impl LiveLoop {
    /// Pushes new keyframes to the models: all waiting keyframes in real time, or the keyframe that
    /// is due in lockstep. Does nothing during an evaluation.
    pub(super) fn take_keyframes(&mut self) -> anyhow::Result<()> {
        if self.models.is_scoring() {
            return Ok(());
        }
        if self.requests.is_paused && self.pace != Pace::RealTime {
            self.hub.pictures().wait_for_request(IDLE); // The next keyframe is due at a later step.
            return Ok(());
        }
        if self.models.apply_alignments()? {
            self.publishing
                .publish_keyframes(&self.accepted.list, &self.models.sessions[0]);
        }
        // Training time begins with the first image, so it includes the time until the first
        // keyframes.
        if let Some(first_image) = self.feed.first_image() {
            self.models
                .sessions
                .iter()
                .for_each(|session| session.time().start(first_image));
        }
        let before = self.accepted.n_changes();
        match self.pace {
            Pace::RealTime => self.take_waiting_keyframes()?,
            Pace::Lockstep { steps_per_keyframe } => self.take_due_keyframes(steps_per_keyframe)?,
        }
        let accepted = &self.accepted;
        if accepted.n_changes() != before {
            self.publishing
                .publish_keyframes(&accepted.list, &self.models.sessions[0]);
            self.scene.publish(&accepted.list, &self.hub);
        }
        Ok(())
    }

    /// Takes all keyframes that wait in the queue. Waits for one if there is nothing to train.
    fn take_waiting_keyframes(&mut self) -> anyhow::Result<()> {
        if !self.is_training() || self.models.is_idle() || self.requests.is_paused {
            let first = self.wait_for_change();
            first.map_or(Ok(()), |item| self.apply(item))?;
        }
        while let Some(item) = self.feed.next(Duration::ZERO) {
            self.apply(item)?;
        }
        Ok(())
    }

    /// Takes keyframes as long as one is due at the current steps of the models.
    fn take_due_keyframes(&mut self, steps_per_keyframe: u64) -> anyhow::Result<()> {
        while !self.feed.ended() && self.models.is_keyframe_due() {
            let Some(item) = self.wait_for_change() else {
                break;
            };
            let is_new = matches!(item.change, Change::Accepted(_));
            self.apply(item)?;
            // Evictions do not count as new keyframes. Before training starts, keyframes are taken
            // without steps in between.
            if is_new && self.is_training() {
                self.models.schedule_next_keyframe(steps_per_keyframe);
            }
        }
        Ok(())
    }

    /// Waits for the next added or removed keyframe. Returns `None` if a requested picture may be
    /// drawn now, or after [`IDLE`].
    fn wait_for_change(&mut self) -> Option<FeedItem> {
        if self.hub.n_clients() == 0 {
            return self.feed.next(IDLE);
        }
        let started = Instant::now();
        // Keyframes and requests arrive in two queues, and a thread can wait for only one of them.
        // The loop therefore polls the first queue and waits for the second one, or only for
        // keyframes while no picture may be drawn.
        loop {
            let before = Instant::now();
            let timeout = if self.budget.may_render() {
                Duration::ZERO
            } else {
                POLL_PERIOD
            };
            if let Some(item) = self.feed.next(timeout) {
                return Some(item);
            }
            let is_requested =
                self.budget.may_render() && self.hub.pictures().wait_for_request(POLL_PERIOD);
            self.budget.add_training(before.elapsed()); // Training was idle, so drawing does not delay it.
            if started.elapsed() >= IDLE || is_requested {
                return None;
            }
        }
    }

    fn apply(&mut self, FeedItem { change, times }: FeedItem) -> anyhow::Result<()> {
        match change {
            Change::Accepted(keyframe) => self.add_keyframe(keyframe, times),
            Change::Evicted { camera, stamp } => {
                self.accepted.evict(&camera, stamp);
                self.models.remove(&camera, stamp)
            }
        }
    }

    /// Pushes an accepted keyframe to the models.
    fn add_keyframe(
        &mut self,
        keyframe: Arc<Keyframe>,
        times: Option<InputTimes>,
    ) -> anyhow::Result<()> {
        let keyframe = match &mut self.keyframe_change {
            Some(change) => change(keyframe),
            None => keyframe,
        };
        // The steps are read before the push, because the push may wait for queued steps.
        let pushed_at_steps = self.models.steps();
        self.accepted.list.push(keyframe.clone());
        let pushed = self.models.push(&keyframe);
        if let Some(input) = times {
            self.ledger.push(KeyframeTimes {
                camera: keyframe.camera.clone(),
                stamp: keyframe.stamp,
                input,
                pushed: Instant::now(),
                pushed_at_steps,
                trained: None,
                sent: None,
                shown: None,
            });
        }
        pushed
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
