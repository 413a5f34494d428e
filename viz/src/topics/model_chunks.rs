//! Chunks of the models that clients draw themselves.

use crate::Hub;
use crate::topics::chunk_list::ChunkList;
use crate::topics::chunk_sender::{ChunkSender, NextChunk};
use crate::topics::subscriptions::MODEL_CHUNKS;
use crate::topics::{
    ClientState, DefaultRate, EncodeContext, Feed, Priority, Timer, Topic, TopicEntry, receiver,
    take_if_changed,
};
use axum::extract::ws::Message;
use kinematics::Transform;
use parking_lot::Mutex;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;
use trainer::ModelChunks;

/// The topic in the table.
pub(crate) const ENTRY: TopicEntry = TopicEntry {
    name: MODEL_CHUNKS,
    default: DefaultRate::Off,
    priority: Priority::Background,
    capability: Some(MODEL_CHUNKS),
    start: |hub| {
        Arc::new(ChunkTopic {
            lists: Mutex::new(receiver(hub)),
        })
    },
};

/// Maximum time for which chunks wait until the client has requested a picture. Its request
/// contains the view, and the chunks in this view are sent first. A page requests a picture as soon
/// as it is connected. Other programs may never request one.
const MAX_WAIT_FOR_VIEW: Duration = Duration::from_secs(1);

/// Chunks of models by method.
type ModelLists = BTreeMap<Arc<str>, Arc<ChunkList>>;

/// Pose of the models in the world of the clients; the identity if `None`.
type WorldFromModel = Option<Transform>;

/// The topic. Chunks are encoded for each client, because each client has its own budget.
struct ChunkTopic {
    lists: Mutex<watch::Receiver<ModelLists>>,
}

impl Topic for ChunkTopic {
    fn encode(&self, context: &EncodeContext<'_>) {
        if take_if_changed(&mut self.lists.lock()).is_some() {
            // There is no message to store. The call only wakes up the writers, whose feeds compare
            // versions.
            context.publisher.publish(|_| ());
        }
    }

    // Without clients, the hub has no chunks: see `drop_unused`.
    fn clear(&self) {}

    fn feed(self: Arc<Self>) -> Box<dyn Feed> {
        Box::new(ChunkFeed {
            lists: self.lists.lock().clone(),
            sender: ChunkSender::default(),
            awaits_view_since: None,
        })
    }
}

/// What a client has received.
struct ChunkFeed {
    lists: watch::Receiver<ModelLists>,
    sender: ChunkSender,
    /// When the first chunk was due while the view of the client was not known.
    awaits_view_since: Option<Instant>,
}

impl ChunkFeed {
    /// Whether chunks should still wait for the view of the client.
    fn awaits_view(&mut self, client: &ClientState<'_>, timer: &mut Timer) -> bool {
        if client.viewpoint.is_some() {
            return false;
        }
        let since = *self.awaits_view_since.get_or_insert(timer.now);
        let until = since + MAX_WAIT_FOR_VIEW;
        let is_early = timer.now < until;
        if is_early {
            timer.wait_until(until);
        }
        is_early
    }
}

impl Feed for ChunkFeed {
    /// A chunk of the model that the client draws, or the ids of removed chunks.
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message> {
        let subscription = client.subscriptions.model_chunks.as_ref()?;
        // The run may not have made chunks since the client has subscribed.
        let list = self.lists.borrow().get(&subscription.method).cloned()?;
        if self.awaits_view(client, timer) {
            return None;
        }
        match self
            .sender
            .next(&list, subscription, client.viewpoint, timer.now)
        {
            NextChunk::Send(message) => Some(message),
            // The budget is used up.
            NextChunk::WaitUntil(due) => {
                timer.wait_until(due);
                None
            }
            NextChunk::Wait => None,
        }
    }
}

impl Hub {
    /// The chunks of models.
    pub fn model_chunks(&self) -> PublishedChunks<'_> {
        PublishedChunks { hub: self }
    }
}

/// The chunks of models in a hub, for clients that draw models themselves.
#[derive(Clone, Copy, Debug)]
pub struct PublishedChunks<'a> {
    hub: &'a Hub,
}

impl PublishedChunks<'_> {
    /// The minimum time between two calls of [`Self::set`] for a model; `None` if no client draws
    /// it.
    pub fn period(&self, method: &str) -> Option<Duration> {
        self.hub.demands().min_period(|subscriptions| {
            let chunks = subscriptions
                .model_chunks
                .as_ref()
                .filter(|chunks| &*chunks.method == method);
            chunks.map(|chunks| chunks.period)
        })
    }

    /// Whether clients have the chunks of this model, so that only changed chunks are needed.
    pub fn contains(&self, method: &str) -> bool {
        self.hub
            .latest::<ModelLists>()
            .borrow()
            .contains_key(method)
    }

    /// Sets the chunks of a model, or those that have changed. They are kept only while a client
    /// draws the model.
    pub fn set(&self, method: &str, chunks: ModelChunks) {
        // The client may have left while the chunks were encoded on another thread. The chunks
        // would then never be freed.
        if self.period(method).is_none() {
            return;
        }
        let world_from_model = self
            .hub
            .latest::<WorldFromModel>()
            .borrow()
            .unwrap_or_default();
        self.hub.latest::<ModelLists>().send_modify(|lists| {
            // Feeds may be reading the present list, so the new one is a copy. Copies share the
            // chunks.
            let mut list = lists
                .get(method)
                .map(|list| (**list).clone())
                .unwrap_or_default();
            list.world_from_model = world_from_model;
            // Changes of chunks that were dropped in the meantime are discarded. If `contains`
            // returns false, the run sends all chunks.
            if list.apply(chunks) {
                lists.insert(method.into(), Arc::new(list));
            }
        });
    }

    /// Sets the pose of the models in the world of the clients. Chunks are sent with this pose. By
    /// default, the two frames are the same.
    pub fn set_world_from_model(&self, world_from_model: Transform) {
        self.hub
            .latest::<WorldFromModel>()
            .send_replace(Some(world_from_model));
    }

    /// Frees the chunks of models that no client draws any longer.
    pub(crate) fn drop_unused(&self) {
        self.hub.latest::<ModelLists>().send_if_modified(|lists| {
            // Called whenever a subscription changes. Writers must wake up only if a list was
            // removed.
            let n_before = lists.len();
            lists.retain(|method, _| self.period(method).is_some());
            lists.len() < n_before
        });
    }
}
