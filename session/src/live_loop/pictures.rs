//! Draws the pictures that viewers request.

use super::models::Models;
use super::{LiveLoop, Pace};
use crate::ledger::Ledger;
use crate::session::Session;
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::QueuedPicture;
use viz::PendingRender;

/// Maximum number of pictures in the GPU's queue. Eight viewers, as in the benchmarks of live runs,
/// fill it with one picture each. With fewer pictures, the GPU is idle more often while they are
/// delivered. Each queued picture holds memory for its read-back until it is delivered.
const MAX_QUEUED_PICTURES: usize = 8;
/// Maximum time for which pictures are drawn before other work continues. New keyframes, controls
/// and the status are delayed by up to this time.
const MAX_RENDER_TIME: Duration = Duration::from_millis(100);

/// A requested picture that the GPU may still be drawing.
struct QueuedRender {
    pending: PendingRender,
    session_ix: usize,
    queued: Result<QueuedPicture, trainer::Error>,
}

impl QueuedRender {
    /// Starts to draw a requested picture. A request that cannot be drawn is answered.
    fn start(mut pending: PendingRender, models: &mut Models, ledger: &Ledger) -> Option<Self> {
        let session_ix = match models.session_ix(pending.method()) {
            Ok(session_ix) => session_ix,
            Err(reason) => {
                pending.fail(&reason);
                return None;
            }
        };
        let session = &mut models.sessions[session_ix];
        pending.request.edits = Arc::clone(session.edits());
        let mut model = session.viewed();
        let queued = model.queue_picture(&pending.request, pending.packing());
        let pending = model.label(pending);
        // The keyframes are determined now, because steps that are queued behind the picture do not
        // affect it.
        let trained_on = ledger.trained_keyframes(session_ix, session.progress().step);
        Some(Self {
            pending: pending.of_keyframes(trained_on),
            session_ix,
            queued,
        })
    }

    /// Waits for the picture, whose rendering began at `began`, and sends it to its client.
    fn deliver(self, session: &mut Session, began: Instant) {
        let pending = self.pending.began_at(began);
        let drawn = self.queued.and_then(|queued| {
            session
                .viewed()
                .finish_picture(queued, &pending.request, pending.packing())
        });
        match drawn {
            Ok(picture) => pending.deliver(picture),
            Err(error) => pending.fail(&error.to_string()),
        }
    }
}

impl LiveLoop {
    /// Draws requested pictures as long as training keeps its share of the time.
    pub(super) fn render(&mut self) -> anyhow::Result<()> {
        let started = Instant::now();
        if !self.intake.has_enough() || self.models.is_idle() || self.requests.is_paused {
            self.budget.refill(); // Training is idle, so drawing does not delay it.
        }
        while started.elapsed() < MAX_RENDER_TIME && self.budget.is_picture_due(&self.hub) {
            // Work queued before the pictures counts as training time.
            let before = Instant::now();
            for session in &mut self.models.sessions {
                session.n_total_steps()?;
            }
            self.budget.add_training(before.elapsed());
            let before = Instant::now();
            let (queued, is_any_on_gpu) = self.queue_pictures();
            // Steps are queued before the pictures are delivered, so that the GPU does not become
            // idle.
            let trained = if is_any_on_gpu {
                self.queue_steps()
            } else {
                Ok(())
            };
            let mut began = before;
            for picture in queued {
                let session = &mut self.models.sessions[picture.session_ix];
                picture.deliver(session, began);
                // The GPU draws the pictures one after the other. The time of the next one begins
                // when this one is complete.
                began = Instant::now();
            }
            self.budget.add_render(before.elapsed());
            // An error of training is returned only now, because the clients of the queued pictures
            // wait for an answer in any case.
            trained?;
        }
        Ok(())
    }

    /// Starts to draw the next requested pictures, so that the GPU draws some of them while others
    /// are delivered. Returns them, and whether the GPU may still be drawing one.
    fn queue_pictures(&mut self) -> (Vec<QueuedRender>, bool) {
        let mut queued = Vec::new();
        let mut is_any_on_gpu = false;
        while let Some(pending) = self.hub.pictures().next_request() {
            if self.intake.accepted.list.is_empty() {
                pending.fail("no keyframe yet");
                continue;
            }
            let started = QueuedRender::start(pending, &mut self.models, &self.ledger);
            let Some(picture) = started else {
                continue;
            };
            let is_on_gpu = picture
                .queued
                .as_ref()
                .is_ok_and(|queued| !queued.is_ready());
            is_any_on_gpu |= is_on_gpu;
            queued.push(picture);
            // A picture that is already complete is delivered before the next one is drawn. Methods
            // that return complete pictures draw them one by one, which may take long.
            if !is_on_gpu || queued.len() == MAX_QUEUED_PICTURES {
                break;
            }
        }
        (queued, is_any_on_gpu)
    }

    /// Queues steps behind pictures, which keeps the GPU busy while the pictures are delivered.
    ///
    /// Steps are queued only for a single model in real time, where no other decision is needed.
    /// With several models, the next model would have to be chosen. In lockstep, the loop would
    /// have to check whether a keyframe is due.
    fn queue_steps(&mut self) -> anyhow::Result<()> {
        let is_training = self.intake.has_enough()
            && !self.models.is_idle()
            && !self.models.is_scoring()
            && !self.requests.is_paused;
        if self.pace != Pace::RealTime || !is_training {
            return Ok(());
        }
        let [session] = &mut self.models.sessions[..] else {
            return Ok(());
        };
        if !session.is_over() {
            session.train_steps(u64::MAX)?;
        }
        Ok(())
    }

    /// Records which pictures of the first model clients have shown.
    pub(super) fn record_shown_pictures(&mut self) {
        for picture in self.hub.pictures().take_shown() {
            // The ledger has one time per keyframe, so only the first model is recorded. Several
            // models receive different shares of the training time, so their times must not be
            // mixed.
            if self.models.session_ix(picture.method.as_deref()) == Ok(0) {
                self.ledger.shown(&picture);
            }
        }
    }
}
