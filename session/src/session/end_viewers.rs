//! Serves the viewers of a live run while its input is closed and its models are saved and scored.

use super::viewed_model::ViewedModel;
use crate::chunk_publisher::ChunkPublisher;
use crate::methods;
use crate::render_budget::RenderBudget;
use std::time::{Duration, Instant};
use viz::{Hub, PendingRender, StateProgress};

/// Period of checking whether work on another thread is done. It delays the end of a run by at most
/// this time. A shorter period would use more processor time.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// Viewers of a run that ends. Between other work, they get pictures, and the chunks of the models
/// that they draw themselves.
///
/// The first of the models is drawn for requests that name no method. Models are only drawn, never
/// trained, so that files and scores do not depend on the viewers.
pub struct EndViewers {
    hub: Hub,
    budget: RenderBudget,
    chunks: ChunkPublisher,
    /// When viewers were last served. The time since then was spent on other work.
    served: Instant,
}

impl EndViewers {
    /// The viewers of a hub. Continues with the budget and the chunks of the run.
    pub(crate) fn new(hub: Hub, budget: RenderBudget, chunks: ChunkPublisher) -> Self {
        Self {
            hub,
            budget,
            chunks,
            served: Instant::now(),
        }
    }

    /// Shows viewers what is being done.
    pub(crate) fn show(&self, state: &str, progress: StateProgress) {
        self.hub.set_state_and_progress(state, Some(progress));
    }

    /// Draws requested pictures as long as other work keeps its share of the time, and publishes
    /// chunks that are due. Returns the time spent.
    pub(crate) fn serve(&mut self, models: &mut [ViewedModel<'_>]) -> Duration {
        let began = Instant::now();
        self.budget.add_training(began - self.served);
        while self.budget.may_render()
            && let Some(pending) = self.hub.pictures().next_request()
        {
            let before = Instant::now();
            answer(pending, models);
            self.budget.add_render(before.elapsed());
        }
        if self.budget.may_render() {
            for model in models {
                self.budget
                    .add_render(model.publish_chunks(&mut self.chunks));
            }
        }
        self.served = Instant::now();
        self.served - began
    }

    /// Serves viewers for a moment, while work on another thread is in progress. Returns the time
    /// spent on viewers.
    pub(crate) fn serve_waiting(&mut self, models: &mut [ViewedModel<'_>]) -> Duration {
        if self.hub.pictures().wait_for_request(POLL_PERIOD) {
            self.budget.refill(); // This thread has nothing else to do.
        }
        self.serve(models)
    }

    /// Publishes chunks that are still being encoded. Otherwise, viewers would miss the changes in
    /// them, because the next chunks contain only later changes.
    pub(crate) fn finish_chunks(&mut self) {
        self.chunks.wait();
    }
}

/// Draws a requested picture, or sends the reason why this is not possible.
fn answer(pending: PendingRender, models: &mut [ViewedModel<'_>]) {
    let method = pending.method().map(str::to_owned);
    let requested = models.iter_mut().find(|model| {
        method
            .as_deref()
            .is_none_or(|name| model.kind().name() == name)
    });
    match requested {
        Some(model) => model.answer(pending),
        None => {
            let kinds = models.iter().map(|model| model.kind());
            pending.fail(&methods::unknown(kinds, method.as_deref()));
        }
    }
}
