//! Data that all clients of a server share.

use crate::Hub;
use crate::clock::ServerClock;
use crate::server::client_log::ClientLog;
use crate::topics::{Publisher, Topic};
use std::sync::Arc;
use tokio::sync::{Semaphore, watch};

/// Shared by the tasks of all clients.
#[derive(Clone)]
pub(crate) struct ServerContext {
    /// Takes requests and returns pictures.
    pub(crate) hub: Hub,
    /// The server's clock.
    pub(crate) clock: ServerClock,
    /// The topics, which are all data that clients receive besides pictures.
    pub(crate) topics: Arc<[Arc<dyn Topic>]>,
    /// Notices new messages of the topics.
    pub(crate) publisher: Publisher,
    /// Limits the work on photographs of keyframes.
    pub(crate) photographs: Arc<Semaphore>,
    /// Log of client activity.
    pub(crate) log: Arc<ClientLog>,
    /// Becomes true when the server stops.
    pub(crate) stopped: watch::Receiver<bool>,
}
