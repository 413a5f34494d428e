//! The poses of the keyframes. Clients receive the changes of the list. Clients that do not support
//! changes receive the complete list.

use crate::Hub;
use crate::client::server_message::{KeyframeMessage, ServerMessage};
use crate::topics::keyframe_log::{KeyframeListUpdate, KeyframeLog, ListPosition};
use crate::topics::published_data::KeyframePose;
use crate::topics::{
    ClientState, DefaultRate, EncodeContext, EncodedMessage, Feed, LastSent, Priority, Publisher,
    Throttle, Timer, Topic, TopicEntry, receiver, take_if_changed,
};
use axum::extract::ws::Message;
use parking_lot::Mutex;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// Name in `subscribe`.
const NAME: &str = "keyframes";
/// Minimum time between two versions of the keyframe list. Each version is compared with the
/// previous one, keyframe by keyframe.
const LOG_PERIOD: Duration = Duration::from_millis(200);
/// Minimum time between two complete lists, which are long: about 600 bytes for each keyframe. It
/// is slightly shorter than 1 s, the period at which clients receive the lists, so that a new list
/// is ready when it is due.
const LIST_PERIOD: Duration = Duration::from_millis(950);

/// The topic in the table.
pub(crate) const ENTRY: TopicEntry = TopicEntry {
    name: NAME,
    default: DefaultRate::Period(Duration::from_secs(1)),
    priority: Priority::Keyframes,
    capability: None,
    start: |hub| Arc::new(KeyframeTopic::new(hub)),
};

/// The poses of all keyframes.
pub(crate) type KeyframePoses = Arc<[KeyframePose]>;

/// The source of changes of the list; `None` before the first list. Points follow their keyframes,
/// so their topic uses it, too.
pub(crate) type SharedLog = Option<Arc<KeyframeLog>>;

/// The topic.
pub(crate) struct KeyframeTopic {
    state: Mutex<State>,
    shared_log: watch::Sender<SharedLog>,
    list: Arc<Mutex<List>>,
}

struct State {
    source: watch::Receiver<KeyframePoses>,
    log: KeyframeLog,
    log_made: Throttle,
    list_made: Throttle,
    is_list_outdated: bool,
}

/// The complete list. It is encoded only if a client needs it.
#[derive(Default)]
struct List {
    item: Option<EncodedMessage>,
    is_running: bool,
}

impl KeyframeTopic {
    /// A topic for the keyframes of a hub.
    pub(crate) fn new(hub: &Hub) -> Self {
        let state = State {
            source: receiver(hub),
            log: KeyframeLog::default(),
            log_made: Throttle::new(LOG_PERIOD),
            list_made: Throttle::new(LIST_PERIOD),
            is_list_outdated: true,
        };
        Self {
            state: Mutex::new(state),
            shared_log: hub.latest(),
            list: Arc::default(),
        }
    }

    /// Sets the complete list without encoding.
    #[cfg(test)]
    pub(crate) fn set_list(&self, item: EncodedMessage) {
        self.list.lock().item = Some(item);
    }
}

impl Topic for KeyframeTopic {
    fn encode(&self, context: &EncodeContext<'_>) {
        let mut guard = self.state.lock();
        let state = &mut *guard;
        if state.log_made.is_due(context.now)
            && let Some(list) = take_if_changed(&mut state.source)
        {
            state.log_made.begin(context.now);
            state.log.set(&list);
            state.is_list_outdated = true;
            // Feeds and tasks read the shared copy while this one changes.
            let log = Arc::new(state.log.clone());
            context
                .publisher
                .publish(|_| _ = self.shared_log.send_replace(Some(log)));
        }
        // Clients that support changes need no complete list. Whether a client supports them is
        // known only after its hello.
        let needs_list = context.settled().any(|demand| !demand.has_keyframe_changes);
        let is_due = state.is_list_outdated && state.list_made.is_due(context.now);
        // At most one list is encoded at a time. On a busy machine, tasks would pile up, and an
        // older list could be published after a newer one.
        if needs_list && is_due && !std::mem::replace(&mut self.list.lock().is_running, true) {
            state.list_made.begin(context.now);
            state.is_list_outdated = false;
            let task = ListTask {
                list: Arc::clone(&self.list),
                publisher: context.publisher.clone(),
            };
            let keyframes = state.source.borrow().clone();
            // While a long list was encoded on this thread, no client could receive anything.
            tokio::task::spawn_blocking(move || task.run(&keyframes));
        }
    }

    fn clear(&self) {
        let mut state = self.state.lock();
        state.source.mark_changed();
        state.log_made.reset();
        state.list_made.reset();
        state.is_list_outdated = true;
        self.list.lock().item = None;
        // The numbers of the keyframes stay the same, because `state.log` is kept.
        self.shared_log.send_if_modified(|log| log.take().is_some());
    }

    fn feed(self: Arc<Self>) -> Box<dyn Feed> {
        Box::new(KeyframeFeed {
            topic: self,
            n_subscriptions: 0,
            list: LastSent::default(),
            changes_at: None,
        })
    }
}

/// Encodes a complete list. When it is dropped, the next one may be encoded, even after a panic.
struct ListTask {
    list: Arc<Mutex<List>>,
    publisher: Publisher,
}

impl ListTask {
    fn run(self, keyframes: &[KeyframePose]) {
        let keyframes = keyframes.iter().map(KeyframeMessage::from).collect();
        let message = ServerMessage::Keyframes { keyframes }.to_message();
        self.publisher
            .publish(|number| self.list.lock().item = Some(EncodedMessage { number, message }));
    }
}

impl Drop for ListTask {
    fn drop(&mut self) {
        self.list.lock().is_running = false;
    }
}

/// What a client has received.
struct KeyframeFeed {
    topic: Arc<KeyframeTopic>,
    /// Number of the subscription that the list belongs to.
    n_subscriptions: u64,
    list: LastSent,
    /// When the client's list was last up to date.
    changes_at: Option<Instant>,
}

impl Feed for KeyframeFeed {
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message> {
        let n_subscriptions = client.subscriptions.number(NAME);
        if n_subscriptions > self.n_subscriptions {
            // A new subscription begins with the complete list. This is how a client whose list is
            // inconsistent, for example after an error in the page, gets a new one.
            self.n_subscriptions = n_subscriptions;
            self.list = LastSent::default();
            self.changes_at = None;
            client.keyframes.position = ListPosition::default();
        }
        let period = client.subscriptions.period(NAME)?;
        if client.has_keyframe_changes {
            self.next_changes(client, period, timer)
        } else {
            self.next_list(period, timer)
        }
    }
}

impl KeyframeFeed {
    fn next_list(&mut self, period: Duration, timer: &mut Timer) -> Option<Message> {
        let list = self.topic.list.lock();
        let item = list
            .item
            .as_ref()
            .filter(|item| item.number > self.list.number)?;
        if !timer.is_due(self.list.at, period) {
            return None;
        }
        self.list = LastSent {
            number: item.number,
            at: Some(timer.now),
        };
        Some(item.message.clone())
    }

    fn next_changes(
        &mut self,
        client: &mut ClientState<'_>,
        period: Duration,
        timer: &mut Timer,
    ) -> Option<Message> {
        let log = self.topic.shared_log.borrow();
        let log = log
            .as_ref()
            .filter(|log| !log.is_up_to_date(client.keyframes.position))?;
        if !timer.is_due(self.changes_at, period) {
            return None;
        }
        let KeyframeListUpdate {
            json,
            position,
            is_new_list,
        } = log.next_changes(client.keyframes.position)?;
        // The points depend on both values. Points are sent only after their keyframe. Clients
        // discard all points when they receive a new list, so the points are then sent again.
        client.keyframes.n_lists += u64::from(is_new_list);
        client.keyframes.position = position;
        // The period begins at the end of the last complete list, so that the parts of a long list
        // follow each other without a pause.
        self.changes_at = log.is_up_to_date(position).then_some(timer.now);
        Some(Message::text(json))
    }
}

impl Hub {
    /// The keyframes.
    pub fn keyframes(&self) -> PublishedKeyframes<'_> {
        PublishedKeyframes { hub: self }
    }
}

/// The keyframes in a hub: their frustums, and where clients get their photographs and points from.
#[derive(Clone, Copy, Debug)]
pub struct PublishedKeyframes<'a> {
    pub(crate) hub: &'a Hub,
}

impl PublishedKeyframes<'_> {
    /// Replaces the frustums. Call this when the keyframes have changed.
    pub fn set(&self, keyframes: Vec<KeyframePose>) {
        self.hub
            .latest::<KeyframePoses>()
            .send_replace(keyframes.into());
    }

    /// The frustums.
    #[must_use]
    pub fn poses(&self) -> Vec<KeyframePose> {
        self.hub.latest::<KeyframePoses>().borrow().to_vec()
    }
}
