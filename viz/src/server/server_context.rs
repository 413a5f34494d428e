//! What all sessions of a server share.

use crate::Hub;
use crate::clock::ServerClock;
use crate::server::client_log::ClientLog;
use crate::topics::broadcast::LatestMessages;
use std::sync::Arc;
use tokio::sync::watch;

/// Shared by all sessions.
#[derive(Clone)]
pub(crate) struct ServerContext {
    /// Takes requests and returns pictures.
    pub(crate) hub: Hub,
    /// The server's clock.
    pub(crate) clock: ServerClock,
    /// The latest encoded messages.
    pub(crate) latest_messages: watch::Receiver<LatestMessages>,
    /// Log of client activity.
    pub(crate) log: Arc<ClientLog>,
    /// Becomes true when the server stops.
    pub(crate) stopped: watch::Receiver<bool>,
}
