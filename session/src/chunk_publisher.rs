//! Publishes the chunks of models that clients draw themselves, without delaying training.

use background::Task;
use model_files::Edits;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{Error, Method, ModelChunks, ModelKind};
use viz::Hub;

/// Minimum time between two versions of a model, because each one is read from the GPU and encoded
/// as a whole.
const MIN_PERIOD: Duration = Duration::from_millis(500);
/// Pause after a failure. Each failure is logged, and its cause, such as a lack of memory, does not
/// pass within one version.
const RETRY_PERIOD: Duration = Duration::from_secs(10);
/// Maximum fraction of the time that encoding takes. Encoding uses processors that training,
/// devices and pictures need, too. With a larger fraction, viewers get large models more often.
const MAX_ENCODE_FRAC: f64 = 0.25;

/// Encodes chunks on another thread, one model at a time.
pub(crate) struct ChunkPublisher {
    hub: Hub,
    task: Option<Encoding>,
    models: BTreeMap<&'static str, Published>,
    /// Models whose last encoding failed.
    failed: BTreeSet<&'static str>,
}

/// A model that is being encoded.
struct Encoding {
    name: &'static str,
    began: Instant,
    thread: Task<Result<ModelChunks, Error>>,
}

/// The last published version of a model.
struct Published {
    step: u64,
    edits: Arc<Edits>,
    next_at: Instant,
}

impl ChunkPublisher {
    /// A publisher for the clients of a hub.
    pub(crate) fn new(hub: Hub) -> Self {
        Self {
            hub,
            task: None,
            models: BTreeMap::new(),
            failed: BTreeSet::new(),
        }
    }

    /// Publishes chunks that are encoded, and starts to encode the model if a client draws it and
    /// it has changed. Returns the time spent, during which the model could not train. A failure
    /// does not affect the run: a lost device is detected by training, too.
    pub(crate) fn publish(
        &mut self,
        kind: ModelKind,
        method: &mut dyn Method,
        edits: &Arc<Edits>,
    ) -> Duration {
        let began = Instant::now();
        self.finish();
        let name = kind.name();
        let Some(period) = self.hub.model_chunks().period(name) else {
            // No client draws this model. It is published at once when a client draws it again.
            self.models.remove(name);
            return began.elapsed();
        };
        // After a failure, the changes since the last version are lost, so all chunks are due.
        let only_changed = self.hub.model_chunks().contains(name) && !self.failed.contains(name);
        let step = method.progress().step;
        let is_due = match self.models.get(name) {
            Some(published) if only_changed => {
                let has_changed = published.step != step || !Arc::ptr_eq(&published.edits, edits);
                has_changed && began >= published.next_at
            }
            Some(published) => began >= published.next_at,
            None => true,
        };
        // One task at a time: several models take turns, because each is due again only after its
        // period.
        if self.task.is_some() || !is_due {
            return began.elapsed();
        }
        let next_at = began + period.max(MIN_PERIOD);
        self.models.insert(
            name,
            Published {
                step,
                edits: Arc::clone(edits),
                next_at,
            },
        );
        match method.queue_chunks(only_changed, edits) {
            Ok(None) => {}
            Ok(Some(pending)) => {
                self.task = Some(Encoding {
                    name,
                    began,
                    thread: Task::start("chunks", || pending.finish()),
                });
            }
            Err(error) => self.fail(name, &error.to_string()),
        }
        began.elapsed()
    }

    /// Waits for chunks that are being encoded, and publishes them.
    pub(crate) fn wait(&mut self) {
        if let Some(encoding) = self.task.take() {
            self.publish_encoded(encoding);
        }
    }

    /// Publishes the chunks that are encoded.
    fn finish(&mut self) {
        if let Some(encoding) = self.task.take_if(|task| task.thread.is_finished()) {
            self.publish_encoded(encoding);
        }
    }

    fn publish_encoded(&mut self, encoding: Encoding) {
        let Encoding {
            name,
            began,
            thread,
        } = encoding;
        // The time from start to start is the time of encoding, divided by its allowed fraction.
        let pause = Duration::from_secs_f64(began.elapsed().as_secs_f64() / MAX_ENCODE_FRAC);
        if let Some(published) = self.models.get_mut(name) {
            published.next_at = published.next_at.max(began + pause);
        }
        match thread.join() {
            Ok(Ok(chunks)) => {
                self.failed.remove(name);
                self.hub.model_chunks().set(name, chunks);
            }
            Ok(Err(error)) => self.fail(name, &error.to_string()),
            Err(_) => self.fail(name, "encoding panicked"),
        }
    }

    /// Tries again later, with all chunks, because the changes since the last version are lost.
    fn fail(&mut self, name: &'static str, reason: &str) {
        log::warn!("cannot send the model {name} to viewers: {reason}");
        self.failed.insert(name);
        if let Some(published) = self.models.get_mut(name) {
            published.next_at = Instant::now() + RETRY_PERIOD;
        }
    }
}
