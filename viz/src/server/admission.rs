//! Limits the number of open connections, so that enough file descriptors remain and connections in
//! use stay open.
//!
//! Addresses do not distinguish viewers from idle sockets, because all clients on this computer
//! have the same address. At a limit, a new connection replaces the least active one.

use parking_lot::Mutex;
use std::cmp::Reverse;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::time::timeout_at;

/// Maximum number of open connections. The number is lower if the limit on open files requires it.
/// A page needs one connection for the WebSocket, and a few for its files while it is loaded.
const MAX_CONNECTIONS: usize = 256;
/// Maximum number of WebSocket clients. Each client may use memory for pictures that are not sent
/// yet (see `pictures/queue.rs`).
const MAX_CLIENTS: usize = 32;
/// Maximum number of clients of `/steer`. They have their own places, so that no number of pages can
/// keep an operator from the arm.
const MAX_STEERING_CLIENTS: usize = 16;
/// Number of file descriptors that must be available per connection. Connections therefore use at
/// most a quarter of the limit on open files.
const DESCRIPTORS_PER_CONNECTION: usize = 4;
/// A client that does not answer a ping within this time is disconnected. It is longer than the time
/// limit of a write, because the answer may wait behind data of a slow link.
const PONG_TIMEOUT: Duration = Duration::from_secs(8);
/// A client that has not answered a ping for this long may be replaced by a new one.
const UNRESPONSIVE_AFTER: Duration = Duration::from_secs(1);
/// A client that has sent no message for this long may be replaced by a new one. The page sends two
/// messages per second.
const IDLE_CLIENT_AFTER: Duration = Duration::from_secs(3);

/// Limits on the number of connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// Maximum number of open connections.
    pub(crate) connections: usize,
    /// Maximum number of clients of `/ws` among them.
    pub(crate) clients: usize,
    /// Maximum number of clients of `/steer` among them.
    pub(crate) steering_clients: usize,
}

impl Limits {
    /// The limits of a process that may open this many files.
    pub(crate) fn of_descriptors(n_descriptors: usize) -> Self {
        // Even with few descriptors, one page must be able to load its files.
        let connections = (n_descriptors / DESCRIPTORS_PER_CONNECTION).clamp(8, MAX_CONNECTIONS);
        Self {
            connections,
            // Clients never take all connections, so the files of a page can always be loaded.
            clients: MAX_CLIENTS.min(connections / 2),
            steering_clients: MAX_STEERING_CLIENTS.min(connections / 4),
        }
    }

    /// The limits of this process.
    pub(crate) fn of_process() -> Self {
        Self::of_descriptors(max_descriptors())
    }
}

#[cfg(unix)]
fn max_descriptors() -> usize {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
    // `None` means that there is no limit.
    limit.map_or(usize::MAX, |limit| {
        usize::try_from(limit).unwrap_or(usize::MAX)
    })
}

#[cfg(not(unix))]
fn max_descriptors() -> usize {
    usize::MAX
}

/// All open connections.
#[derive(Debug)]
pub(crate) struct Admission {
    limits: Limits,
    connections: Mutex<Vec<Arc<Connection>>>,
}

/// One open connection, from accept to close.
#[derive(Debug)]
pub(crate) struct Connection {
    peer: Option<SocketAddr>,
    /// Size that the kernel's send buffer should have, bytes; 0 if it should not change.
    send_buffer_bytes: AtomicUsize,
    /// Whether another thread polls the stream from now on.
    has_new_thread: AtomicBool,
    /// Becomes true when the task that serves the connection must drop it.
    is_closed: watch::Sender<bool>,
    activity: Mutex<Activity>,
}

#[derive(Debug)]
struct Activity {
    /// Whether a complete request has arrived.
    has_requested: bool,
    /// Time of the last activity. This is when the last request arrived, or when the kernel last
    /// accepted data for the peer. Before that, it is the time when the connection was opened.
    active_at: Instant,
    /// When the connection was accepted as a WebSocket client. The fields below are used from then
    /// on.
    client_since: Option<Instant>,
    is_operator: bool,
    socket: Socket,
    /// Time of the last message. Pongs do not count, because libraries send them automatically.
    last_message: Option<Instant>,
    /// Time of the ping that has not been answered yet.
    pinged: Option<Instant>,
    /// Whether the client has ever answered a ping, which shows that it reads.
    has_answered: bool,
}

/// Which WebSocket a client uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Socket {
    /// `/ws`.
    Page,
    /// `/steer`.
    Steering,
}

/// Importance of a client. The least important client is replaced first. Within a variant, the
/// times decide.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Importance {
    /// It has not answered the ping of this time.
    Unresponsive(Instant),
    /// It was admitted at this time, and has never answered a ping or has never sent a message. It
    /// may be a socket that somebody has left open.
    NeverUsed(Instant),
    /// It sent its last message at this time.
    Idle(Instant),
    /// A viewer in use, admitted at this time. Earlier viewers are more important.
    Viewer(Reverse<Instant>),
    /// An operator in use.
    Operator,
}

impl Admission {
    /// Creates an admission without connections.
    pub(crate) fn new(limits: Limits) -> Arc<Self> {
        Arc::new(Self {
            limits,
            connections: Mutex::default(),
        })
    }

    /// Adds a connection. At the limit, it replaces another one.
    pub(crate) fn admit(&self, peer: Option<SocketAddr>) -> Arc<Connection> {
        if self.connections.lock().len() >= self.limits.connections {
            // The task of the evicted connection drops it later. Until then, there may be one more
            // connection than the limit.
            self.evict();
        }
        let connection = Arc::new(Connection::new(peer));
        self.connections.lock().push(Arc::clone(&connection));
        connection
    }

    /// Closes the oldest connection without a complete request, or else the connection that has
    /// been idle longest. WebSocket clients are never evicted here; only other clients replace
    /// them.
    pub(crate) fn evict(&self) {
        let connections = self.connections.lock();
        let candidates =
            open(&connections).filter_map(|connection| Some((connection.last_use()?, connection)));
        if let Some((_, oldest)) = candidates.min_by_key(|(last_use, _)| *last_use) {
            oldest.close("replaced by a new connection");
        }
    }

    /// Registers a WebSocket client on its connection. At the limit, it replaces the least
    /// important client. If all are in use, an operator replaces the viewer that connected last, so
    /// that viewers cannot lock operators out.
    pub(crate) fn admit_client(&self, connection: &Connection, is_operator: bool) -> bool {
        self.admit_to(Socket::Page, connection, is_operator)
    }

    /// Registers a client of `/steer` on its connection, with the same rules. In addition, a viewer
    /// never replaces an operator, who may be holding the lease over a bad connection.
    pub(crate) fn admit_steering_client(&self, connection: &Connection, is_operator: bool) -> bool {
        self.admit_to(Socket::Steering, connection, is_operator)
    }

    fn admit_to(&self, socket: Socket, connection: &Connection, is_operator: bool) -> bool {
        let max_clients = match socket {
            Socket::Page => self.limits.clients,
            Socket::Steering => self.limits.steering_clients,
        };
        // Locked until the client is registered, so that two clients cannot take the same place.
        let connections = self.connections.lock();
        let now = Instant::now();
        let clients: Vec<_> = open(&connections)
            .filter(|other| other.activity.lock().socket == socket)
            .filter_map(|other| Some((other.importance(now)?, other)))
            .collect();
        if clients.len() >= max_clients {
            let is_protected = |other: &Connection| {
                socket == Socket::Steering && !is_operator && other.activity.lock().is_operator
            };
            let least = clients
                .iter()
                .filter(|(_, other)| !is_protected(other))
                .min_by_key(|(importance, _)| *importance);
            let replaced = least.filter(|(importance, _)| match importance {
                Importance::Operator => false,
                Importance::Viewer(_) => is_operator,
                _ => true,
            });
            let Some((_, other)) = replaced else {
                return false;
            };
            other.close("replaced by a new client");
        }
        let mut activity = connection.activity.lock();
        activity.client_since = Some(now);
        activity.is_operator = is_operator;
        activity.socket = socket;
        true
    }

    /// Removes a connection whose stream is dropped.
    pub(crate) fn remove(&self, connection: &Arc<Connection>) {
        self.connections
            .lock()
            .retain(|other| !Arc::ptr_eq(other, connection));
    }
}

/// The connections that are not about to be closed.
fn open(connections: &[Arc<Connection>]) -> impl Iterator<Item = &Arc<Connection>> {
    connections
        .iter()
        .filter(|connection| !connection.is_closed())
}

impl Connection {
    fn new(peer: Option<SocketAddr>) -> Self {
        Self {
            peer,
            send_buffer_bytes: AtomicUsize::new(0),
            has_new_thread: AtomicBool::new(false),
            is_closed: watch::Sender::new(false),
            activity: Mutex::new(Activity {
                has_requested: false,
                active_at: Instant::now(),
                client_since: None,
                is_operator: false,
                socket: Socket::Page,
                last_message: None,
                pinged: None,
                has_answered: false,
            }),
        }
    }

    /// Whether the peer has a loopback address. The peer may still be the end of a tunnel. Unknown
    /// peers count as remote, and their data is then compressed without need.
    pub(crate) fn is_loopback(&self) -> bool {
        self.peer
            .is_some_and(|peer| peer.ip().to_canonical().is_loopback())
    }

    /// Records that a complete request has arrived.
    pub(crate) fn record_request(&self) {
        self.activity.lock().has_requested = true;
        self.record_progress();
    }

    /// Records that the peer sends or receives data, for example during a long download.
    pub(crate) fn record_progress(&self) {
        self.activity.lock().active_at = Instant::now();
    }

    /// Records that the client has sent a message.
    pub(crate) fn record_message(&self) {
        self.activity.lock().last_message = Some(Instant::now());
    }

    /// Time since the client's last message, or since it was admitted.
    pub(crate) fn silence(&self) -> Duration {
        let activity = self.activity.lock();
        // A new client has the same time for its first message.
        let since = activity.last_message.or(activity.client_since);
        since.map_or(Duration::ZERO, |since| since.elapsed())
    }

    /// Sets the size of the kernel's send buffer from the next write on.
    pub(crate) fn set_send_buffer(&self, n_bytes: usize) {
        // The size is only stored here. The writer cannot set it, because the socket is inside the
        // WebSocket and TLS layers.
        self.send_buffer_bytes.store(n_bytes, Ordering::Relaxed);
    }

    /// The size of the kernel's send buffer, if it was set since the last call.
    #[cfg(unix)]
    pub(crate) fn take_send_buffer(&self) -> Option<usize> {
        let n_bytes = self.send_buffer_bytes.swap(0, Ordering::Relaxed);
        (n_bytes > 0).then_some(n_bytes)
    }

    /// Says that the thread that calls this polls the stream from now on.
    pub(crate) fn change_thread(&self) {
        // Like the size of the buffer, this is only stored here.
        self.has_new_thread.store(true, Ordering::Relaxed);
    }

    /// Whether the thread has changed since the last call.
    #[cfg(unix)]
    pub(crate) fn take_thread_change(&self) -> bool {
        self.has_new_thread.swap(false, Ordering::Relaxed)
    }

    /// Returns whether a ping is due. At most one ping is unanswered at a time, so that the time
    /// limit starts with the first one.
    pub(crate) fn start_ping(&self) -> bool {
        let mut activity = self.activity.lock();
        let is_due = activity.pinged.is_none();
        activity.pinged.get_or_insert_with(Instant::now);
        is_due
    }

    /// Records that the client has answered a ping, which shows that it reads.
    pub(crate) fn record_pong(&self) {
        let mut activity = self.activity.lock();
        activity.pinged = None;
        activity.has_answered = true;
    }

    /// Waits until the connection is closed, which happens at the latest when a ping is not answered
    /// in time. The task that serves the connection must then drop it.
    pub(crate) async fn closed(&self) {
        let mut is_closed = self.is_closed.subscribe();
        loop {
            let pong_due = self.pong_due();
            if pong_due <= Instant::now() {
                self.close("it does not answer pings");
            }
            let closed = is_closed.wait_for(|is_closed| *is_closed);
            if timeout_at(pong_due.into(), closed).await.is_ok() {
                return;
            }
        }
    }

    /// Ends [`Self::closed`].
    pub(crate) fn close(&self, reason: &str) {
        let was_closed = self.is_closed.send_replace(true);
        if !was_closed {
            log::debug!("closed the connection of {:?}: {reason}", self.peer);
        }
    }

    pub(crate) fn is_closed(&self) -> bool {
        *self.is_closed.borrow()
    }

    /// Latest time of the next pong. A client may be silent as long as it answers, for example to
    /// watch without sending anything.
    fn pong_due(&self) -> Instant {
        // If no ping is unanswered, the next one is sent later than now.
        self.activity.lock().pinged.unwrap_or_else(Instant::now) + PONG_TIMEOUT
    }

    /// Whether the connection has ever sent a request, and when it was last active; `None` for a
    /// client. `false` is less than `true`, so connections without a request are evicted first.
    fn last_use(&self) -> Option<(bool, Instant)> {
        let activity = self.activity.lock();
        let last_use = (activity.has_requested, activity.active_at);
        activity.client_since.is_none().then_some(last_use)
    }

    /// `None` for a connection without a client.
    fn importance(&self, now: Instant) -> Option<Importance> {
        let activity = self.activity.lock();
        let client_since = activity.client_since?;
        let unanswered = activity.pinged.filter(|at| now - *at >= UNRESPONSIVE_AFTER);
        // A page answers pings and sends messages.
        let last_message = activity.last_message.filter(|_| activity.has_answered);
        Some(match (unanswered, last_message) {
            (Some(pinged), _) => Importance::Unresponsive(pinged),
            (None, None) => Importance::NeverUsed(client_since),
            (None, Some(at)) if now - at >= IDLE_CLIENT_AFTER => Importance::Idle(at),
            (None, Some(_)) if activity.is_operator => Importance::Operator,
            (None, Some(_)) => Importance::Viewer(Reverse(client_since)),
        })
    }
}

#[cfg(test)]
mod tests;
