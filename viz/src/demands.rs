//! What the connected clients receive: their subscriptions and viewpoints.

use crate::pictures::viewpoint::Viewpoint;
use crate::topics::subscriptions::Subscriptions;
use parking_lot::Mutex;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A client gets keyframes and images after its hello, or at the latest this long after it has
/// joined. Before that, the server does not know which of them the client wants, and at which size.
/// With a shorter time, pages on slow links would first get complete lists and large images. With a
/// longer time, clients that send no hello would wait longer.
const HELLO_GRACE: Duration = Duration::from_millis(500);

/// What a client receives.
#[derive(Clone, Debug)]
pub(crate) struct Demand {
    joined: Instant,
    /// Whether it has sent a hello.
    pub(crate) has_hello: bool,
    /// Its subscriptions.
    pub(crate) subscriptions: Arc<Subscriptions>,
    /// Whether it receives only the changes of the keyframe list.
    pub(crate) has_keyframe_changes: bool,
    /// Viewpoint of its newest picture.
    pub(crate) viewpoint: Option<Viewpoint>,
}

impl Demand {
    /// The demand of a client that has sent nothing.
    pub(crate) fn new(joined: Instant) -> Self {
        Self {
            joined,
            has_hello: false,
            subscriptions: Arc::default(),
            has_keyframe_changes: false,
            viewpoint: None,
        }
    }

    /// The time from which the client gets keyframes and images; `None` if this time has passed.
    pub(crate) fn settles_at(&self, now: Instant) -> Option<Instant> {
        let settled = self.joined + HELLO_GRACE;
        (!self.has_hello && settled > now).then_some(settled)
    }
}

/// The demands of the connected clients, by client.
#[derive(Debug, Default)]
pub(crate) struct Demands {
    by_client: Mutex<BTreeMap<u64, Demand>>,
}

impl Demands {
    /// Sets what a client receives.
    pub(crate) fn set(&self, client: u64, demand: Demand) {
        self.by_client.lock().insert(client, demand);
    }

    /// Removes a client.
    pub(crate) fn remove(&self, client: u64) {
        self.by_client.lock().remove(&client);
    }

    /// The demand of each client.
    pub(crate) fn all(&self) -> Vec<Demand> {
        self.by_client.lock().values().cloned().collect()
    }

    /// Whether a client receives a topic.
    pub(crate) fn has_topic(&self, topic: &str) -> bool {
        self.has_subscription(|subscriptions| subscriptions.period(topic).is_some())
    }

    /// Whether the subscriptions of any client fulfill a condition.
    pub(crate) fn has_subscription(&self, condition: impl Fn(&Subscriptions) -> bool) -> bool {
        self.by_client
            .lock()
            .values()
            .any(|demand| condition(&demand.subscriptions))
    }

    /// The minimum period over the subscriptions of all clients; `None` if no client has one.
    pub(crate) fn min_period(
        &self,
        period: impl Fn(&Subscriptions) -> Option<Duration>,
    ) -> Option<Duration> {
        self.by_client
            .lock()
            .values()
            .filter_map(|demand| period(&demand.subscriptions))
            .min()
    }
}
