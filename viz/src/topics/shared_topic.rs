//! Topics of which all clients receive the same messages: the latest one, or the latest one per
//! key.

use crate::Hub;
use crate::clock::ServerClock;
use crate::topics::{
    ClientState, DefaultRate, EncodeContext, EncodedMessage, Feed, LastSent, Priority, Throttle,
    Timer, Topic, TopicEntry, receiver, take_if_changed,
};
use axum::extract::ws::Message;
use parking_lot::Mutex;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// A topic of which all clients receive the same messages.
pub(crate) trait SharedTopic: Default + Send + 'static {
    /// Name in `subscribe`.
    const NAME: &'static str;
    /// What a client receives before it subscribes.
    const DEFAULT: DefaultRate;
    /// When it is sent.
    const PRIORITY: Priority;
    /// Minimum time between two versions. A topic needs one if its data change more often than
    /// clients can use them.
    const PERIOD: Duration = Duration::ZERO;
    /// Capability of servers that have the topic; `None` if all servers have it.
    const CAPABILITY: Option<&'static str> = Some(Self::NAME);
    /// The data in the hub, which [`Hub::latest`] finds by this type.
    type Source: Clone + Default + Send + Sync + 'static;

    /// The messages to send for these data, by key. A client receives the latest message of each
    /// key. A topic with several keys, such as one for each scanner, returns only the messages that
    /// have changed since the last call. A topic with one message returns [`only_message`].
    fn encode(&mut self, source: &Self::Source, clock: ServerClock) -> Vec<(Arc<str>, Message)>;
}

/// The messages of a topic that has only one.
pub(crate) fn only_message(message: Option<Message>) -> Vec<(Arc<str>, Message)> {
    message
        .map(|message| ("".into(), message))
        .into_iter()
        .collect()
}

/// The entry of a topic.
pub(crate) const fn entry<T: SharedTopic>() -> TopicEntry {
    TopicEntry {
        name: T::NAME,
        default: T::DEFAULT,
        priority: T::PRIORITY,
        capability: T::CAPABILITY,
        start: |hub| Arc::new(LatestMessages::<T>::new(hub)),
    }
}

/// The latest messages of a topic.
pub(crate) struct LatestMessages<T: SharedTopic> {
    state: Mutex<State<T>>,
}

struct State<T: SharedTopic> {
    topic: T,
    source: watch::Receiver<T::Source>,
    encoded: Throttle,
    messages: BTreeMap<Arc<str>, EncodedMessage>,
}

impl<T: SharedTopic> LatestMessages<T> {
    /// A topic for the data of a hub.
    pub(crate) fn new(hub: &Hub) -> Self {
        Self {
            state: Mutex::new(State {
                topic: T::default(),
                source: receiver(hub),
                encoded: Throttle::new(T::PERIOD),
                messages: BTreeMap::new(),
            }),
        }
    }

    /// Sets a message without encoding.
    #[cfg(test)]
    pub(crate) fn set(&self, key: &str, item: EncodedMessage) {
        self.state.lock().messages.insert(key.into(), item);
    }
}

impl<T: SharedTopic> Topic for LatestMessages<T> {
    fn encode(&self, context: &EncodeContext<'_>) {
        // Without a client, the data stays marked as changed, so that it is encoded as soon as a
        // client subscribes.
        if T::DEFAULT != DefaultRate::Always && !context.is_wanted(T::NAME) {
            return;
        }
        let mut state = self.state.lock();
        let State {
            topic,
            source,
            encoded,
            messages,
        } = &mut *state;
        // The period is checked before the data, because changed data must stay marked until the
        // period is over.
        if !encoded.is_due(context.now) {
            return;
        }
        let Some(source) = take_if_changed(source) else {
            return;
        };
        encoded.begin(context.now);
        // The messages are numbered in the order of their keys. The feed first sends the keys whose
        // last message was sent longest ago, so that no key is preferred for long.
        for (key, message) in topic.encode(&source, context.clock) {
            context
                .publisher
                .publish(|number| _ = messages.insert(key, EncodedMessage { number, message }));
        }
    }

    fn clear(&self) {
        let mut state = self.state.lock();
        // Topics remember what they have encoded, and would not encode it again.
        state.topic = T::default();
        state.source.mark_changed();
        state.encoded.reset();
        state.messages.clear();
    }

    fn feed(self: Arc<Self>) -> Box<dyn Feed> {
        Box::new(LatestMessageFeed {
            messages: self,
            sent: BTreeMap::new(),
        })
    }
}

/// What a client has received of a topic.
struct LatestMessageFeed<T: SharedTopic> {
    messages: Arc<LatestMessages<T>>,
    sent: BTreeMap<Arc<str>, LastSent>,
}

impl<T: SharedTopic> Feed for LatestMessageFeed<T> {
    /// The message with the key whose last message was sent longest ago.
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message> {
        let period = match T::DEFAULT {
            DefaultRate::Always => Duration::ZERO,
            _ => client.subscriptions.period(T::NAME)?,
        };
        // Writers and the encoder run on the same thread, so this lock is usually free.
        let state = self.messages.state.lock();
        let waiting = state.messages.iter().filter_map(|(key, item)| {
            let sent = self.sent.get(key).copied().unwrap_or_default();
            // The timer is asked only about new messages, because it records the due time of each
            // message that it rejects.
            let is_next = item.number > sent.number && timer.is_due(sent.at, period);
            is_next.then_some((sent.number, key, item))
        });
        let (_, key, item) = waiting.min_by_key(|(number, ..)| *number)?;
        self.sent.insert(
            Arc::clone(key),
            LastSent {
                number: item.number,
                at: Some(timer.now),
            },
        );
        Some(item.message.clone())
    }

    fn has_sent(&self) -> bool {
        !self.sent.is_empty()
    }
}
