//! Publishes the chunks of models that clients draw themselves, without delaying training.

use std::collections::BTreeMap;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use trainer::{Error, Method, ModelChunks, ModelKind};
use viz::Hub;

/// Minimum time between two versions of a model, because each one is read from the GPU and encoded as a whole.
const MIN_PERIOD: Duration = Duration::from_millis(500);
/// Maximum fraction of the time that encoding takes.
const MAX_ENCODE_FRAC: f64 = 0.25;

/// Encodes chunks on another thread, one model at a time.
pub(crate) struct ChunkPublisher {
    hub: Hub,
    task: Option<Encoding>,
    models: BTreeMap<&'static str, Published>,
}

/// A model that is being encoded.
struct Encoding {
    name: &'static str,
    began: Instant,
    thread: JoinHandle<Result<ModelChunks, Error>>,
}

/// The last published version of a model.
#[derive(Clone, Copy)]
struct Published {
    step: u64,
    next_at: Instant,
}

impl ChunkPublisher {
    /// A publisher for the clients of a hub.
    pub(crate) fn new(hub: Hub) -> Self {
        Self { hub, task: None, models: BTreeMap::new() }
    }

    /// Publishes chunks that are encoded, and starts to encode the model if a client draws it and it has changed.
    /// Returns the time spent, during which the model could not train.
    pub(crate) fn publish(&mut self, kind: ModelKind, method: &mut dyn Method) -> Result<Duration, Error> {
        let began = Instant::now();
        self.finish()?;
        let name = kind.name();
        let Some(period) = self.hub.chunk_period(name) else {
            self.models.remove(name);
            return Ok(began.elapsed());
        };
        let only_changed = self.hub.has_model_chunks(name);
        let step = method.progress().step;
        let is_due = match self.models.get(name) {
            Some(published) if only_changed => published.step != step && began >= published.next_at,
            Some(published) => began >= published.next_at,
            None => true,
        };
        if self.task.is_some() || !is_due {
            return Ok(began.elapsed());
        }
        self.models.insert(name, Published { step, next_at: began + period.max(MIN_PERIOD) });
        if let Some(pending) = method.queue_chunks(only_changed)? {
            self.task = Some(Encoding { name, began, thread: std::thread::spawn(|| pending.finish()) });
        }
        Ok(began.elapsed())
    }

    /// Publishes the chunks that are encoded.
    fn finish(&mut self) -> Result<(), Error> {
        let Some(Encoding { name, began, thread }) = self.task.take_if(|task| task.thread.is_finished()) else {
            return Ok(());
        };
        let pause = Duration::from_secs_f64(began.elapsed().as_secs_f64() / MAX_ENCODE_FRAC);
        if let Some(published) = self.models.get_mut(name) {
            published.next_at = published.next_at.max(began + pause);
        }
        match thread.join() {
            Ok(Ok(chunks)) => self.hub.set_model_chunks(name, chunks),
            Ok(Err(error)) if error.is_gpu_error() => return Err(error),
            Ok(Err(error)) => log::error!("cannot send the model to viewers: {error}"),
            Err(_) => log::error!("encoding the model for viewers panicked"),
        }
        Ok(())
    }
}
