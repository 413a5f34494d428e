//! Draws the pictures that viewers request.

use super::{Live, Pace, session_for_method};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::QueuedPicture;
use viz::PendingRender;

/// Maximum number of pictures in the GPU's queue.
const MAX_QUEUED_PICTURES: usize = 8;
/// Maximum time for which pictures are drawn before other work continues.
const MAX_RENDER_TIME: Duration = Duration::from_millis(100);

/// A requested picture that the GPU may still be drawing.
struct QueuedRender {
    pending: PendingRender,
    session_ix: usize,
    queued: Result<QueuedPicture, trainer::Error>,
}

impl Live {
    /// Whether a picture is requested and may be drawn now.
    pub(super) fn is_render_pending(&self) -> bool {
        self.budget.may_render() && self.hub.wait_for_request(Duration::ZERO)
    }

    /// Draws requested pictures as long as training keeps its share of the time.
    pub(super) fn render(&mut self) -> crate::Result<()> {
        let started = Instant::now();
        if !self.is_training() || self.is_idle() || self.requests.is_paused {
            self.budget.refill(); // Training is idle, so drawing does not delay it.
        }
        while started.elapsed() < MAX_RENDER_TIME && self.is_render_pending() {
            // Work queued before the pictures counts as training time.
            let before = Instant::now();
            for session in &mut self.sessions {
                session.n_total_steps()?;
            }
            self.budget.add_training(before.elapsed());
            let before = Instant::now();
            // The GPU draws the next pictures while the first ones are delivered.
            let mut queued = Vec::new();
            let mut is_any_on_gpu = false;
            while let Some(picture) = self.queue_picture() {
                let is_on_gpu = picture
                    .queued
                    .as_ref()
                    .is_ok_and(|queued| !queued.is_ready());
                is_any_on_gpu |= is_on_gpu;
                queued.push(picture);
                if !is_on_gpu || queued.len() == MAX_QUEUED_PICTURES {
                    break;
                }
            }
            let trained = if is_any_on_gpu {
                self.queue_steps()
            } else {
                Ok(())
            };
            let mut began = before;
            for picture in queued {
                self.deliver(picture, began);
                began = Instant::now();
            }
            self.budget.add_render(before.elapsed());
            trained?;
        }
        Ok(())
    }

    /// Queues steps behind pictures, which keeps the GPU busy while the pictures are delivered.
    /// Only for a single model in real time, where this needs no other work.
    fn queue_steps(&mut self) -> crate::Result<()> {
        let is_training =
            self.is_training() && !self.is_idle() && !self.is_scoring() && !self.requests.is_paused;
        let (Pace::RealTime, [session], true) = (self.pace, &mut self.sessions[..], is_training)
        else {
            return Ok(());
        };
        if !session.is_over() {
            session.train_steps(u64::MAX)?;
        }
        Ok(())
    }

    /// Starts to draw the next requested picture. Requests that cannot be drawn are answered.
    fn queue_picture(&mut self) -> Option<QueuedRender> {
        loop {
            let mut pending = self.hub.next_request()?;
            if self.keyframes.is_empty() {
                pending.fail("no keyframe yet");
                continue;
            }
            let Some(session_ix) = session_for_method(&self.sessions, pending.method()) else {
                let reason = self.unknown_method(pending.method());
                pending.fail(&reason);
                continue;
            };
            let session = &mut self.sessions[session_ix];
            pending.request.edits = Arc::clone(session.edits());
            let queued = session.queue_picture(&pending.request, pending.packing());
            let trained_on = self
                .ledger
                .trained_keyframes(session_ix, session.progress().step);
            return Some(QueuedRender {
                pending: pending.of_keyframes(trained_on),
                session_ix,
                queued,
            });
        }
    }

    /// Waits for a picture, whose rendering began at `began`, and sends it to its client.
    fn deliver(
        &mut self,
        QueuedRender {
            pending,
            session_ix,
            queued,
        }: QueuedRender,
        began: Instant,
    ) {
        let pending = pending.began_at(began);
        let session = &mut self.sessions[session_ix];
        match queued
            .and_then(|queued| session.finish_picture(queued, &pending.request, pending.packing()))
        {
            Ok(picture) => pending.deliver(picture),
            Err(error) => pending.fail(&error.to_string()),
        }
    }

    /// Records which pictures of the first model clients have shown.
    pub(super) fn record_shown_pictures(&mut self) {
        for picture in self.hub.take_shown_pictures() {
            if session_for_method(&self.sessions, picture.method.as_deref()) == Some(0) {
                self.ledger.shown(&picture);
            }
        }
    }
}
