//! The kinds of data that clients receive besides pictures, each of which is a topic.
//!
//! A topic has two halves. [`Topic`] takes new data from the hub, and encodes it once for all
//! clients. [`Feed`] decides what one client receives next. The data that both halves share are
//! private to the topic.
//!
//! To add a topic, write a module and an entry of [`TOPICS`]. If all clients receive the same
//! messages, implement [`SharedTopic`](shared_topic::SharedTopic), as `base_path.rs` does.
//! ARCHITECTURE.md lists the other files of a topic, and `docs/reference/protocol.md` describes all
//! topics.

mod base_path;
pub(crate) mod chunk_list;
mod chunk_sender;
pub(crate) mod client_updates;
pub(crate) mod edit_status;
mod keyframe_log;
mod keyframe_points;
pub(crate) mod keyframes;
pub(crate) mod live_images;
pub(crate) mod model_chunks;
pub(crate) mod observations;
pub(crate) mod operator_status;
pub(crate) mod photograph_coverage;
mod positions;
pub(crate) mod preview_status;
pub(crate) mod published_data;
pub(crate) mod range_scans;
pub(crate) mod robot_description;
pub(crate) mod robot_state;
mod scene;
pub(crate) mod shared_topic;
pub(crate) mod status;
pub(crate) mod subscriptions;
#[cfg(test)]
mod test_topic;

use crate::Hub;
use crate::clock::ServerClock;
use crate::demands::Demand;
use crate::pictures::viewpoint::Viewpoint;
use crate::topics::keyframe_log::ListPosition;
use crate::topics::subscriptions::Subscriptions;
use axum::extract::ws::Message;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// All topics. Within a priority, a client receives them in this order.
pub(crate) const TOPICS: &[TopicEntry] = &[
    shared_topic::entry::<scene::SceneTopic>(),
    shared_topic::entry::<status::StatusTopic>(),
    shared_topic::entry::<base_path::BasePathTopic>(),
    shared_topic::entry::<robot_state::RobotDescriptionTopic>(),
    live_images::ENTRY,
    shared_topic::entry::<range_scans::RangeScanTopic>(),
    keyframes::ENTRY,
    keyframe_points::ENTRY,
    shared_topic::entry::<observations::ObservationTopic>(),
    model_chunks::ENTRY,
    #[cfg(test)]
    shared_topic::entry::<test_topic::Weather>(),
];

/// A topic in the list of all topics.
pub(crate) struct TopicEntry {
    /// Name in `subscribe`.
    pub(crate) name: &'static str,
    /// What a client receives before it subscribes.
    pub(crate) default: DefaultRate,
    /// When it is sent.
    pub(crate) priority: Priority,
    /// Capability of servers that have the topic; `None` if all servers have it.
    pub(crate) capability: Option<&'static str>,
    /// Starts the half that encodes.
    start: fn(&Hub) -> Arc<dyn Topic>,
}

/// What a client receives before it subscribes to a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DefaultRate {
    /// Every message. Clients cannot subscribe.
    Always,
    /// A message per period.
    Period(Duration),
    /// Nothing.
    Off,
}

/// When messages are sent, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Priority {
    /// Short messages, before pictures.
    Short,
    /// Long messages about what the devices see now. They take turns with keyframes, so that
    /// neither delays the other for long.
    Live,
    /// Long messages about keyframes.
    Keyframes,
    /// Long messages that can wait.
    Background,
}

/// The half of a topic that encodes new data once for all clients. It runs on the server's thread,
/// outside the tasks of clients.
pub(crate) trait Topic: Send + Sync {
    /// Encodes data that are new and due, if a client receives them. Work that takes more than a
    /// millisecond belongs on a thread for blocking tasks.
    fn encode(&self, context: &EncodeContext<'_>);

    /// Forgets the encoded messages when no client is connected. The next client receives newly
    /// encoded ones.
    fn clear(&self);

    /// The half for a client that has received nothing.
    fn feed(self: Arc<Self>) -> Box<dyn Feed>;
}

/// The half of a topic that decides what one client receives next.
pub(crate) trait Feed: Send {
    /// The next message, which counts as sent. If it is not due yet, `timer` records the due time.
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message>;

    /// Whether the client has received anything.
    fn has_sent(&self) -> bool {
        true
    }
}

/// Data that topics need for encoding.
pub(crate) struct EncodeContext<'a> {
    pub(crate) hub: &'a Hub,
    pub(crate) clock: ServerClock,
    pub(crate) publisher: &'a Publisher,
    pub(crate) now: Instant,
    /// What the clients receive.
    pub(crate) demands: Vec<Demand>,
}

impl EncodeContext<'_> {
    /// The demands of clients that have sent a hello, and of clients that have had enough time to
    /// send one.
    pub(crate) fn settled(&self) -> impl Iterator<Item = &Demand> {
        self.demands
            .iter()
            .filter(|demand| demand.settles_at(self.now).is_none())
    }

    /// Whether a client receives a topic.
    pub(crate) fn is_wanted(&self, topic: &str) -> bool {
        self.demands
            .iter()
            .any(|demand| demand.subscriptions.period(topic).is_some())
    }
}

/// Data about a client that its feeds need.
pub(crate) struct ClientState<'a> {
    pub(crate) subscriptions: &'a Subscriptions,
    /// Whether it receives only the changes of the keyframe list.
    pub(crate) has_keyframe_changes: bool,
    /// Viewpoint of its newest picture.
    pub(crate) viewpoint: Option<&'a Viewpoint>,
    /// The part of the keyframe list that it has.
    pub(crate) keyframes: &'a mut KeyframeProgress,
}

/// The part of the keyframe list that a client has.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct KeyframeProgress {
    pub(crate) position: ListPosition,
    /// How often a complete list was begun for this client. When it begins, the client discards its
    /// keyframes and their points.
    pub(crate) n_lists: u64,
}

/// Numbers new messages, and wakes up the writers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Publisher {
    n_messages: Arc<AtomicU64>,
    changed: watch::Sender<()>,
}

impl Publisher {
    /// Calls `store` with the number of a new message, and then wakes up the writers. Later
    /// messages have larger numbers.
    pub(crate) fn publish(&self, store: impl FnOnce(u64)) {
        // `Relaxed` is enough: only the order of the numbers matters, and the locks of the topics
        // order the messages. Number 0 is reserved for clients that have received nothing.
        store(1 + self.n_messages.fetch_add(1, Ordering::Relaxed));
        // Writers are woken up after the message is stored. A writer that is woken up earlier would
        // find nothing, and then sleep until the next message.
        self.changed.send_replace(());
    }

    /// Notices when messages are published.
    pub(crate) fn changed(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }
}

/// An encoded message; clones share the bytes.
#[derive(Clone, Debug)]
pub(crate) struct EncodedMessage {
    pub(crate) number: u64,
    pub(crate) message: Message,
}

/// Number of the last message of a kind that a client has received, and when it was sent.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LastSent {
    pub(crate) number: u64,
    pub(crate) at: Option<Instant>,
}

/// Decides which messages are due, and remembers when the next one is.
#[derive(Debug)]
pub(crate) struct Timer {
    pub(crate) now: Instant,
    earliest: Option<Instant>,
}

impl Timer {
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            now,
            earliest: None,
        }
    }

    /// Whether a message may be sent after this period since the last one.
    pub(crate) fn is_due(&mut self, last: Option<Instant>, period: Duration) -> bool {
        // The first message is due at once. A message whose due time cannot be represented is also
        // due at once.
        let due = last
            .and_then(|at| at.checked_add(period))
            .unwrap_or(self.now);
        if due > self.now {
            // The message exists but is not due yet. Without this time, the writer would sleep
            // until something else changes.
            self.wait_until(due);
        }
        due <= self.now
    }

    /// Records that a message is due at this time.
    pub(crate) fn wait_until(&mut self, due: Instant) {
        // All feeds of a client share the timer, and its writer sleeps only once.
        self.earliest = Some(self.earliest.map_or(due, |earliest| earliest.min(due)));
    }

    /// When the next message is due; `None` if there is none.
    pub(crate) fn earliest(&self) -> Option<Instant> {
        self.earliest
    }
}

/// Allows an event at most once per period.
#[derive(Debug)]
pub(crate) struct Throttle {
    period: Duration,
    last: Option<Instant>,
}

impl Throttle {
    pub(crate) fn new(period: Duration) -> Self {
        Self { period, last: None }
    }

    pub(crate) fn is_due(&self, now: Instant) -> bool {
        self.last
            .is_none_or(|last| now.saturating_duration_since(last) >= self.period)
    }

    pub(crate) fn begin(&mut self, now: Instant) {
        self.last = Some(now);
    }

    pub(crate) fn reset(&mut self) {
        self.last = None;
    }
}

/// Period of checking the hub for new data. A message is delayed by at most this time. With a
/// shorter period, the topics are asked more often whether they have something to encode.
const CHECK_PERIOD: Duration = Duration::from_millis(20);

/// What a client receives before it subscribes.
///
/// This is here and not in `subscriptions.rs`, because the hub stores subscriptions, and the topics
/// use the hub: the files would import each other in a cycle.
impl Default for Subscriptions {
    fn default() -> Self {
        Self::new(TOPICS.iter().filter_map(|entry| match entry.default {
            // Clients cannot subscribe to these topics, so `subscribe` must reject their names.
            DefaultRate::Always => None,
            DefaultRate::Period(period) => Some((entry.name, Some(period))),
            DefaultRate::Off => Some((entry.name, None)),
        }))
    }
}

/// Starts all topics for the data of a hub.
pub(crate) fn start_all(hub: &Hub) -> Arc<[Arc<dyn Topic>]> {
    TOPICS.iter().map(|entry| (entry.start)(hub)).collect()
}

/// Encodes new data while clients are connected. Runs until the server stops.
pub(crate) async fn encode_all(
    hub: Hub,
    clock: ServerClock,
    topics: Arc<[Arc<dyn Topic>]>,
    publisher: Publisher,
) {
    let mut check = tokio::time::interval(CHECK_PERIOD);
    // A check that is late, because the machine is busy, must not be followed by a burst of checks.
    check.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        check.tick().await;
        if hub.n_clients() == 0 {
            // Messages may take much memory, and the next client must not receive old ones.
            topics.iter().for_each(|topic| topic.clear());
            continue;
        }
        let demands = hub.demands().all();
        // All topics use the same time, so that their periods end in the same check.
        let now = Instant::now();
        let context = EncodeContext {
            hub: &hub,
            clock,
            publisher: &publisher,
            now,
            demands,
        };
        for topic in topics.iter() {
            topic.encode(&context);
        }
    }
}

/// Returns the value if it changed since the last call. An error would mean that the hub was
/// dropped, but the hub outlives the server.
fn take_if_changed<T: Clone>(receiver: &mut watch::Receiver<T>) -> Option<T> {
    receiver
        .has_changed()
        .unwrap_or(false)
        .then(|| receiver.borrow_and_update().clone())
}

/// A receiver of data of the hub that also returns a value that was set earlier.
fn receiver<T: Default + Send + Sync + 'static>(hub: &Hub) -> watch::Receiver<T> {
    let mut receiver = hub.latest::<T>().subscribe();
    // A new receiver counts the present value as seen, but no client has received it.
    receiver.mark_changed();
    receiver
}

#[cfg(test)]
mod tests {
    use super::{DefaultRate, TOPICS};
    use std::path::Path;

    #[test]
    fn every_topic_is_in_the_docs_and_on_the_page_under_the_same_name() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        let read = |path: &str| {
            std::fs::read_to_string(folder.join(path))
                .unwrap_or_else(|error| panic!("{path}: {error}"))
        };
        let docs = read("../docs/reference/protocol.md");
        let page = read("web/src/main.ts");
        // The topic of `test_topic.rs` exists only in tests.
        for entry in TOPICS.iter().filter(|entry| entry.name != "weather") {
            let name = entry.name;
            assert!(
                folder.join(format!("src/topics/{name}.rs")).is_file(),
                "src/topics/{name}.rs is missing"
            );
            if entry.default == DefaultRate::Always {
                // Clients cannot subscribe to this topic, and the page handles its message
                // directly.
                assert!(page.contains(&format!("case \"{name}\"")), "{name}");
                continue;
            }
            assert!(
                docs.contains(&format!("\n| `{name}` | [")),
                "{name} is not in the table of topics in docs/reference/protocol.md"
            );
            assert!(
                page.contains(&format!("\"./topics/{name}\"")),
                "{name} is not imported by web/src/main.ts"
            );
            let module = read(&format!("web/src/topics/{name}.ts"));
            let has = |field: &str, value: &str| {
                module.contains(&format!("{field}: \"{value}\""))
                    || module.contains(&format!("{field} = \"{value}\""))
            };
            assert!(has("name", name), "web/src/topics/{name}.ts: name");
            match entry.capability {
                Some(value) => assert!(
                    has("capability", value) && docs.contains(&format!("`{value}`")),
                    "{name}: capability {value}"
                ),
                None => assert!(!module.contains("capability"), "{name}: no capability"),
            }
        }
    }
}
