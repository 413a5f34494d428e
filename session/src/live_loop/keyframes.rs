//! Passes keyframes on to the models.

use super::{IDLE, LiveLoop, Pace};
use crate::ledger::KeyframeTimes;
use capture::{Change, FeedItem, InputTimes};
use keyframe::Keyframe;
use std::sync::Arc;
use std::time::{Duration, Instant};

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
                .publish_keyframes(&self.intake.accepted.list, &self.models.sessions[0]);
        }
        // Training time begins with the first image, so it includes the time until the first
        // keyframes.
        if let Some(first_image) = self.intake.feed.first_image() {
            self.models
                .sessions
                .iter()
                .for_each(|session| session.time().start(first_image));
        }
        let before = self.intake.accepted.n_changes();
        match self.pace {
            Pace::RealTime => self.take_waiting_keyframes()?,
            Pace::Lockstep { steps_per_keyframe } => self.take_due_keyframes(steps_per_keyframe)?,
        }
        let accepted = &self.intake.accepted;
        if accepted.n_changes() != before {
            self.publishing
                .publish_keyframes(&accepted.list, &self.models.sessions[0]);
            self.scene.publish(&accepted.list, &self.hub);
        }
        Ok(())
    }

    /// Takes all keyframes that wait in the queue. Waits for one if there is nothing to train.
    fn take_waiting_keyframes(&mut self) -> anyhow::Result<()> {
        if !self.intake.has_enough() || self.models.is_idle() || self.requests.is_paused {
            let first = self.intake.wait_for_change(&self.hub, &mut self.budget);
            first.map_or(Ok(()), |item| self.apply(item))?;
        }
        while let Some(item) = self.intake.feed.next(Duration::ZERO) {
            self.apply(item)?;
        }
        Ok(())
    }

    /// Takes keyframes as long as one is due at the current steps of the models.
    fn take_due_keyframes(&mut self, steps_per_keyframe: u64) -> anyhow::Result<()> {
        while !self.intake.feed.ended() && self.models.is_keyframe_due() {
            let Some(item) = self.intake.wait_for_change(&self.hub, &mut self.budget) else {
                break;
            };
            let is_new = matches!(item.change, Change::Accepted(_));
            self.apply(item)?;
            // Evictions do not count as new keyframes. Before training starts, keyframes are taken
            // without steps in between.
            if is_new && self.intake.has_enough() {
                self.models.schedule_next_keyframe(steps_per_keyframe);
            }
        }
        Ok(())
    }

    fn apply(&mut self, FeedItem { change, times }: FeedItem) -> anyhow::Result<()> {
        match change {
            Change::Accepted(keyframe) => self.add_keyframe(keyframe, times),
            Change::Revised(keyframe) => {
                let keyframe = self.intake.revise(keyframe);
                self.models.revise(&keyframe)
            }
            Change::Evicted { camera, stamp } => {
                self.intake.accepted.evict(&camera, stamp);
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
        let keyframe = self.intake.accept(keyframe);
        // The steps are read before the push, because the push may wait for queued steps.
        let pushed_at_steps = self.models.steps();
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
