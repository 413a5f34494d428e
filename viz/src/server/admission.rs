//! Limits the number of open connections, so that enough file descriptors remain and connections in
//! use stay open.
//!
//! Addresses do not distinguish viewers from idle sockets: on this computer, all are the same. At a
//! limit, a new connection replaces the least active one.

use parking_lot::{Mutex, MutexGuard};
use std::collections::BTreeMap;
use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;

/// Maximum number of open connections; lower if the limit on open files requires it. A page needs
/// one connection for the WebSocket, and a few for its files while it is loaded.
const MAX_CONNECTIONS: usize = 256;
/// Maximum number of WebSocket clients. Each one may use memory for pictures that are not sent yet:
/// see `pictures/queue.rs`.
const MAX_CLIENTS: usize = 32;
/// The process may open this many files per connection: connections use at most a quarter of the
/// limit.
const DESCRIPTORS_PER_CONNECTION: usize = 4;
/// A connection whose peer accepts no bytes for this long is closed.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// An HTTP connection that has neither received a request nor sent data for this long is closed. It
/// is longer than the time that the server waits for the next request, so it matters mostly
/// for responses that make no progress.
const IDLE_TIMEOUT: Duration = Duration::from_secs(10);
/// A client that does not answer a ping within this time is disconnected. It is longer than
/// [`WRITE_TIMEOUT`], because the answer may wait behind data of a slow link.
const PONG_TIMEOUT: Duration = Duration::from_secs(8);
/// A client that has not answered a ping for this long may be replaced by a new one.
const UNRESPONSIVE_AFTER: Duration = Duration::from_secs(1);
/// A client that has sent no message for this long may be replaced by a new one; the page sends two
/// per second.
const IDLE_CLIENT_AFTER: Duration = Duration::from_secs(3);

/// Limits on the number of connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// Maximum number of open connections.
    pub(crate) connections: usize,
    /// Maximum number of WebSocket clients among them.
    pub(crate) clients: usize,
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
    registry: Mutex<Registry>,
}

#[derive(Debug, Default)]
struct Registry {
    connections: BTreeMap<u64, Arc<Connection>>,
    n_opened: u64,
}

/// One open connection, from accept to close.
#[derive(Debug)]
pub(crate) struct Connection {
    number: u64,
    /// Whether the peer has a loopback address. It may still be the end of a tunnel.
    is_loopback: bool,
    /// Size that the kernel's send buffer should have, bytes; 0 if it should not change.
    send_buffer_bytes: AtomicUsize,
    state: Mutex<ConnectionState>,
}

#[derive(Debug)]
struct ConnectionState {
    /// If set, reads and writes fail.
    is_closed: bool,
    reader: Option<Waker>,
    writer: Option<Waker>,
    /// Start of the current write that is blocked because the peer does not read.
    blocked_since: Option<Instant>,
    /// Time at which the last request was complete; `None` before the first.
    requested: Option<Instant>,
    /// Time at which the kernel last accepted data for the peer.
    written: Option<Instant>,
    opened: Instant,
    /// The WebSocket client, if the connection was accepted as one.
    client: Option<Client>,
}

#[derive(Debug)]
struct Client {
    /// Operators are replaced only if they are inactive. Active viewers are replaced if an operator
    /// needs the place.
    is_operator: bool,
    admitted: Instant,
    /// Time of the last message. Pongs do not count, because libraries send them automatically.
    last_message: Option<Instant>,
    /// Time of the ping that has not been answered yet.
    pinged: Option<Instant>,
    /// Whether the client has ever answered a ping, which shows that it reads.
    has_answered: bool,
}

impl ConnectionState {
    /// Time of the last request or of the last bytes of a response; of the connection before the
    /// first request.
    fn idle_since(&self) -> Instant {
        self.requested.max(self.written).unwrap_or(self.opened)
    }
}

/// Eviction order of clients: unresponsive first, then never used, then idle; within a group by
/// time.
type Dispensability = (u8, Duration);

impl Admission {
    /// Creates an admission without connections.
    pub(crate) fn new(limits: Limits) -> Arc<Self> {
        Arc::new(Self {
            limits,
            registry: Mutex::default(),
        })
    }

    /// Adds an accepted connection. Returns whether another one was closed to make room.
    pub(crate) fn admit(self: &Arc<Self>, stream: TcpStream) -> (GuardedStream, bool) {
        // Unknown peers count as remote, which only costs compression.
        let is_loopback = stream
            .peer_addr()
            .is_ok_and(|peer| peer.ip().to_canonical().is_loopback());
        // The evicted connection closes later, when its task notices. Until then, there may be one
        // more connection than the limit.
        let has_evicted =
            self.registry().connections.len() >= self.limits.connections && self.evict();
        let mut registry = self.registry();
        registry.n_opened += 1;
        let connection = Arc::new(Connection::new(registry.n_opened, is_loopback));
        registry
            .connections
            .insert(connection.number, Arc::clone(&connection));
        drop(registry);
        (
            GuardedStream {
                stream,
                connection,
                admission: Arc::clone(self),
            },
            has_evicted,
        )
    }

    /// Closes the connection without a client that has been idle longest. Half-open requests come
    /// first.
    pub(crate) fn evict(&self) -> bool {
        let registry = self.registry();
        let candidates = registry.connections.values().filter_map(|connection| {
            let state = connection.state();
            // Clients are replaced only by other clients. Closed connections are about to leave.
            let is_candidate = !state.is_closed && state.client.is_none();
            is_candidate.then_some((state.requested.is_some(), state.idle_since(), connection))
        });
        // Connections that have never sent a complete request come first: `false` is less than
        // `true`.
        let oldest = candidates.min_by_key(|(has_requested, since, _)| (*has_requested, *since));
        oldest
            .inspect(|(.., connection)| connection.close("replaced by a new connection"))
            .is_some()
    }

    /// Registers a WebSocket client on its connection. At the limit, it replaces the most
    /// dispensable client. If all are active, an operator replaces the viewer that connected last,
    /// so that viewers cannot lock operators out.
    pub(crate) fn admit_client(&self, connection: &Connection, is_operator: bool) -> bool {
        // Held until the client is registered, so that two clients cannot take the same free slot.
        let registry = self.registry();
        let now = Instant::now();
        let admitted = registry
            .connections
            .values()
            .filter(|other| other.is_admitted());
        let mut n_admitted = 0;
        let mut most_dispensable: Option<(Dispensability, &Arc<Connection>)> = None;
        let mut last_viewer: Option<(Instant, &Arc<Connection>)> = None;
        for other in admitted {
            n_admitted += 1;
            // The viewer that came last loses its place, because those before it were there first.
            if let Some(since) = other.viewer_since()
                && last_viewer.is_none_or(|(last, _)| since >= last)
            {
                last_viewer = Some((since, other));
            }
            if let Some(dispensability) = other.dispensability(now)
                && most_dispensable.is_none_or(|(worst_so_far, _)| dispensability > worst_so_far)
            {
                most_dispensable = Some((dispensability, other));
            }
        }
        if n_admitted >= self.limits.clients {
            // An inactive operator is replaced before an active viewer.
            let last_viewer = last_viewer.filter(|_| is_operator).map(|(_, other)| other);
            let Some(other) = most_dispensable.map(|(_, other)| other).or(last_viewer) else {
                return false;
            };
            other.close("replaced by a new client");
        }
        connection.state().client = Some(Client {
            is_operator,
            admitted: now,
            last_message: None,
            pinged: None,
            has_answered: false,
        });
        true
    }

    /// Closes connections whose peers have stopped reading, requesting or answering.
    pub(crate) fn sweep(&self) {
        let now = Instant::now();
        for connection in self.registry().connections.values() {
            // Closing only wakes up tasks: they remove the connection when this lock is free again.
            if let Some(reason) = connection.timeout_reason(now) {
                connection.close(reason);
            }
        }
    }

    /// Number of open connections.
    #[cfg(test)]
    fn n_open(&self) -> usize {
        self.registry().connections.len()
    }

    /// Locks the registry. It holds plain values that are valid after every statement, so it stays
    /// usable after a panic elsewhere.
    fn registry(&self) -> MutexGuard<'_, Registry> {
        self.registry.lock()
    }
}

impl Connection {
    fn new(number: u64, is_loopback: bool) -> Self {
        let state = ConnectionState {
            is_closed: false,
            reader: None,
            writer: None,
            blocked_since: None,
            requested: None,
            written: None,
            opened: Instant::now(),
            client: None,
        };
        Self {
            number,
            is_loopback,
            send_buffer_bytes: AtomicUsize::new(0),
            state: Mutex::new(state),
        }
    }

    /// Whether the peer has a loopback address.
    pub(crate) fn is_loopback(&self) -> bool {
        self.is_loopback
    }

    /// Records that a complete request has arrived.
    pub(crate) fn requested(&self) {
        self.state().requested = Some(Instant::now());
    }

    /// Records that the client has sent a message.
    pub(crate) fn last_message(&self) {
        if let Some(client) = &mut self.state().client {
            client.last_message = Some(Instant::now());
        }
    }

    /// Time since the client's last message, or since it was admitted.
    pub(crate) fn silence(&self) -> Duration {
        let state = self.state();
        let client = state.client.as_ref();
        client.map_or(Duration::ZERO, |client| {
            // A new client has the same time for its first message.
            client.last_message.unwrap_or(client.admitted).elapsed()
        })
    }

    /// Sets the size of the kernel's send buffer from the next write on.
    pub(crate) fn set_send_buffer(&self, n_bytes: usize) {
        // The session does not have the socket: it is inside the WebSocket and TLS layers.
        self.send_buffer_bytes.store(n_bytes, Ordering::Relaxed);
    }

    /// Returns whether a ping is due. At most one ping is unanswered at a time.
    pub(crate) fn start_ping(&self) -> bool {
        // The time of an unanswered ping stays that of the first one, so that the time-out is
        // reached.
        match &mut self.state().client {
            Some(client) if client.pinged.is_none() => {
                client.pinged = Some(Instant::now());
                true
            }
            _ => false,
        }
    }

    /// Records that the client has answered a ping, which shows that it reads.
    pub(crate) fn record_pong(&self) {
        if let Some(client) = &mut self.state().client {
            client.pinged = None;
            client.has_answered = true;
        }
    }

    fn is_admitted(&self) -> bool {
        let state = self.state();
        state.client.is_some() && !state.is_closed
    }

    /// Time at which the client was admitted as a viewer; `None` if it is an operator.
    fn viewer_since(&self) -> Option<Instant> {
        let state = self.state();
        state
            .client
            .as_ref()
            .filter(|client| !client.is_operator)
            .map(|client| client.admitted)
    }

    /// Eviction order of the client; `None` for a client in use.
    fn dispensability(&self, now: Instant) -> Option<Dispensability> {
        let state = self.state();
        let client = state.client.as_ref()?;
        // A client does not react if it does not answer, or if the kernel can send it nothing.
        let stuck_for = [client.pinged, state.blocked_since]
            .into_iter()
            .flatten()
            .map(|since| now - since)
            .max();
        if let Some(stuck_for) = stuck_for.filter(|time| *time >= UNRESPONSIVE_AFTER) {
            return Some((2, stuck_for));
        }
        // A page answers pings and sends messages. A program that does only one of both may be a
        // socket that somebody has left open.
        match client.last_message.filter(|_| client.has_answered) {
            None => Some((1, now - client.admitted)),
            Some(last_message) if now - last_message >= IDLE_CLIENT_AFTER => {
                Some((0, now - last_message))
            }
            Some(_) => None,
        }
    }

    /// Returns the reason to close the connection now, if any.
    fn timeout_reason(&self, now: Instant) -> Option<&'static str> {
        let state = self.state();
        let is_timed_out =
            |since: Option<Instant>, timeout| since.is_some_and(|since| now - since > timeout);
        if is_timed_out(state.blocked_since, WRITE_TIMEOUT) {
            return Some("its peer does not read");
        }
        // A client may be silent as long as it answers, for example to watch without sending
        // anything.
        match &state.client {
            Some(client) => {
                is_timed_out(client.pinged, PONG_TIMEOUT).then_some("it does not answer pings")
            }
            None => is_timed_out(Some(state.idle_since()), IDLE_TIMEOUT)
                .then_some("it has been idle for too long"),
        }
    }

    /// Makes all reads and writes fail, so that the task serving the connection drops it.
    fn close(&self, reason: &str) {
        let mut state = self.state();
        if state.is_closed {
            return;
        }
        log::debug!("closed connection {}: {reason}", self.number);
        state.is_closed = true;
        // Woken up after the lock is released, because the tasks take it at once.
        let wakers = [state.reader.take(), state.writer.take()];
        drop(state);
        wakers.into_iter().flatten().for_each(Waker::wake);
    }

    /// See [`Admission::registry`].
    fn state(&self) -> MutexGuard<'_, ConnectionState> {
        self.state.lock()
    }
}

/// A TCP stream that [`Admission`] can close. Dropping it removes it from the [`Admission`].
#[derive(Debug)]
pub(crate) struct GuardedStream {
    stream: TcpStream,
    connection: Arc<Connection>,
    admission: Arc<Admission>,
}

impl GuardedStream {
    /// Its entry in the [`Admission`].
    pub(crate) fn connection(&self) -> &Arc<Connection> {
        &self.connection
    }

    /// Waits for the first byte from the peer, which stays unread.
    pub(crate) async fn first_byte(&self) -> io::Result<u8> {
        let mut byte = [0];
        let n_bytes = poll_fn(|context| {
            // Checked and registered under one lock, so that closing in between is not missed.
            let mut state = self.connection.state();
            if state.is_closed {
                return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
            }
            state.reader = Some(context.waker().clone());
            self.stream.poll_peek(context, &mut ReadBuf::new(&mut byte))
        })
        .await?;
        // The peer has closed the connection without sending anything.
        if n_bytes == 0 {
            Err(io::ErrorKind::UnexpectedEof.into())
        } else {
            Ok(byte[0])
        }
    }

    /// Applies [`Connection::set_send_buffer`]. A failure affects only latency.
    #[cfg(unix)]
    fn resize_send_buffer(&self) {
        // Taken out, so that the system call is made only after a change.
        let n_bytes = self.connection.send_buffer_bytes.swap(0, Ordering::Relaxed);
        if n_bytes == 0 {
            return;
        }
        if let Err(error) = rustix::net::sockopt::set_socket_send_buffer_size(&self.stream, n_bytes)
        {
            log::debug!("cannot resize a socket's buffer: {error}");
        }
    }

    #[cfg(not(unix))]
    fn resize_send_buffer(&self) {}

    /// Runs a write unless the connection is closed, and records whether the peer reads.
    fn write(
        &mut self,
        context: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut TcpStream>, &mut Context<'_>) -> Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if self.connection.state().is_closed {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        self.resize_send_buffer();
        let written = write(Pin::new(&mut self.stream), context);
        let mut state = self.connection.state();
        match &written {
            Poll::Pending => {
                // The start of the whole blocked time: writes are polled again and again.
                state.blocked_since.get_or_insert_with(Instant::now);
                state.writer = Some(context.waker().clone());
            }
            Poll::Ready(result) => {
                state.blocked_since = None;
                // Shows that a download makes progress, even if no request follows.
                if result.as_ref().is_ok_and(|n_bytes| *n_bytes > 0) {
                    state.written = Some(Instant::now());
                }
            }
        }
        drop(state);
        written
    }
}

impl AsyncRead for GuardedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.connection.state().is_closed {
            return Poll::Ready(Err(io::ErrorKind::ConnectionAborted.into()));
        }
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        // Remembers whom to wake up if the connection is closed.
        if read.is_pending() {
            self.connection.state().reader = Some(context.waker().clone());
        }
        read
    }
}

impl AsyncWrite for GuardedStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.write(context, |stream, context| stream.poll_write(context, bytes))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.write(context, |stream, context| {
            stream.poll_write_vectored(context, slices)
        })
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

impl Drop for GuardedStream {
    fn drop(&mut self) {
        if self.connection.state().is_closed {
            // Unread data is discarded; otherwise the kernel would keep it for minutes.
            if let Err(error) = self.stream.set_zero_linger() {
                log::debug!("cannot discard unread bytes: {error}");
            }
        }
        self.admission
            .registry()
            .connections
            .remove(&self.connection.number);
    }
}

#[cfg(test)]
mod tests {
    use super::{
        Admission, GuardedStream, IDLE_CLIENT_AFTER, IDLE_TIMEOUT, Limits, PONG_TIMEOUT,
        UNRESPONSIVE_AFTER, WRITE_TIMEOUT,
    };
    use std::sync::Arc;
    use std::time::{Duration, Instant};
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    const LIMITS: Limits = Limits {
        connections: 4,
        clients: 2,
    };

    /// An admission and a listening port that creates both ends of connections.
    struct Port {
        admission: Arc<Admission>,
        listener: std::net::TcpListener,
    }

    impl Port {
        fn open() -> Self {
            let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port exists");
            Self {
                admission: Admission::new(LIMITS),
                listener,
            }
        }

        /// Both ends of a new connection.
        fn connect(&self) -> (GuardedStream, TcpStream) {
            let address = self.listener.local_addr().expect("bound");
            let peer = std::net::TcpStream::connect(address).expect("it listens");
            let (stream, _) = self.listener.accept().expect("a peer waits");
            for stream in [&peer, &stream] {
                stream.set_nonblocking(true).expect("a socket");
            }
            let stream = TcpStream::from_std(stream).expect("a runtime");
            (
                self.admission.admit(stream).0,
                TcpStream::from_std(peer).expect("a runtime"),
            )
        }
    }

    fn run(test: impl Future<Output = ()>) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        runtime.expect("a runtime").block_on(test);
    }

    /// Sends what a page sends as soon as it is connected.
    fn act_like_page(stream: &GuardedStream) {
        stream.connection().last_message();
        assert!(stream.connection().start_ping());
        stream.connection().record_pong();
    }

    fn is_closed(stream: &GuardedStream) -> bool {
        stream.connection().state().is_closed
    }

    #[test]
    fn connections_leave_descriptors_for_files() {
        assert_eq!(
            Limits::of_descriptors(1024),
            Limits {
                connections: 256,
                clients: 32
            }
        );
        assert_eq!(
            Limits::of_descriptors(1_000_000),
            Limits {
                connections: 256,
                clients: 32
            }
        );
        assert_eq!(
            Limits::of_descriptors(128),
            Limits {
                connections: 32,
                clients: 16
            }
        );
        assert_eq!(
            Limits::of_descriptors(16),
            Limits {
                connections: 8,
                clients: 4
            }
        );
    }

    #[test]
    fn oldest_half_open_request_is_evicted() {
        run(async {
            let port = Port::open();
            let (served, _a) = port.connect();
            served.connection().requested();
            let (mut half_open, _b) = port.connect();
            let (_newer, _c) = port.connect();
            let (_newest, _d) = port.connect();
            let (_one_more, _e) = port.connect();
            assert!(is_closed(&half_open) && !is_closed(&served));
            assert!(
                half_open.read_u8().await.is_err(),
                "the serving task sees the end"
            );
            drop(half_open);
            assert_eq!(port.admission.n_open(), 4);
        });
    }

    #[test]
    fn downloads_are_not_idle() {
        run(async {
            let port = Port::open();
            let (mut downloading, mut peer) = port.connect();
            let (idle, _b) = port.connect();
            downloading.connection().requested();
            idle.connection().requested();
            let requested = Instant::now();
            tokio::time::sleep(Duration::from_millis(50)).await;
            downloading
                .write_all(b"the next bytes of a mesh")
                .await
                .expect("the peer reads");
            assert_eq!(peer.read_u8().await.expect("a byte"), b't');
            assert!(
                idle.connection()
                    .timeout_reason(requested + IDLE_TIMEOUT + Duration::from_millis(10))
                    .is_some()
            );
            let connection = downloading.connection();
            assert_eq!(
                connection.timeout_reason(requested + IDLE_TIMEOUT + Duration::from_millis(10)),
                None
            );
            assert!(
                connection
                    .timeout_reason(Instant::now() + IDLE_TIMEOUT + Duration::from_millis(10))
                    .is_some()
            );
            assert!(port.admission.evict());
            assert!(
                is_closed(&idle) && !is_closed(&downloading),
                "the connection in use stays"
            );
        });
    }

    #[test]
    fn client_slots_are_counted_and_released() {
        run(async {
            let port = Port::open();
            let (a, _a) = port.connect();
            let (b, _b) = port.connect();
            let (c, _c) = port.connect();
            for stream in [&a, &b] {
                assert!(port.admission.admit_client(stream.connection(), false));
                act_like_page(stream);
            }
            assert!(
                !port.admission.admit_client(c.connection(), false),
                "both clients are in use"
            );
            drop(a);
            assert!(port.admission.admit_client(c.connection(), false));
            assert!(!is_closed(&b));
        });
    }

    #[test]
    fn viewers_make_room_for_operators() {
        run(async {
            let port = Port::open();
            let (a, _a) = port.connect();
            let (b, _b) = port.connect();
            let [(c, _c), (d, _d), (e, _e)] = [port.connect(), port.connect(), port.connect()];
            for viewer in [&a, &b] {
                assert!(port.admission.admit_client(viewer.connection(), false));
                act_like_page(viewer);
            }
            for operator in [&c, &d] {
                assert!(
                    port.admission.admit_client(operator.connection(), true),
                    "a viewer makes room"
                );
                act_like_page(operator);
            }
            assert!(is_closed(&a) && is_closed(&b));
            assert!(
                !port.admission.admit_client(e.connection(), true),
                "operators in use stay"
            );
            assert!(!port.admission.admit_client(e.connection(), false));
            assert!(!is_closed(&c) && !is_closed(&d));
        });
    }

    #[test]
    fn most_dispensable_client_is_evicted() {
        run(async {
            let port = Port::open();
            let (speaking, _a) = port.connect();
            let (other, _b) = port.connect();
            let (newcomer, _c) = port.connect();
            assert!(
                port.admission.admit_client(speaking.connection(), false)
                    && port.admission.admit_client(other.connection(), false)
            );
            act_like_page(&speaking);
            other.connection().last_message(); // It does not read.
            assert!(
                port.admission.admit_client(newcomer.connection(), false),
                "the other client never answered a ping"
            );
            assert!(is_closed(&other) && !is_closed(&speaking));

            let now = Instant::now();
            let connection = speaking.connection();
            assert_eq!(connection.dispensability(now), None);
            let idle = connection
                .dispensability(now + IDLE_CLIENT_AFTER)
                .expect("idle");
            let silent = newcomer.connection().dispensability(now).expect("silent");
            assert!(
                connection.start_ping() && !connection.start_ping(),
                "one ping at a time"
            );
            let unresponsive = connection
                .dispensability(Instant::now() + UNRESPONSIVE_AFTER)
                .expect("unresponsive");
            assert!(idle < silent && silent < unresponsive);
            connection.record_pong();
            assert_eq!(connection.dispensability(now), None);
        });
    }

    #[test]
    fn unresponsive_peers_time_out() {
        run(async {
            let port = Port::open();
            let (mut stuck, _a) = port.connect();
            let filling = async { while stuck.write_all(&[0; 65536]).await.is_ok() {} };
            assert!(
                tokio::time::timeout(Duration::from_millis(500), filling)
                    .await
                    .is_err(),
                "the peer never reads"
            );
            let soon = Instant::now() + Duration::from_millis(100);
            assert_eq!(stuck.connection().timeout_reason(soon), None);
            assert!(
                stuck
                    .connection()
                    .timeout_reason(soon + WRITE_TIMEOUT)
                    .is_some()
            );

            let (client, _b) = port.connect();
            assert!(
                port.admission.admit_client(client.connection(), false)
                    && client.connection().start_ping()
            );
            assert_eq!(client.connection().timeout_reason(soon), None);
            assert!(
                client
                    .connection()
                    .timeout_reason(soon + PONG_TIMEOUT)
                    .is_some()
            );
            client.connection().record_pong();
            assert_eq!(
                client.connection().timeout_reason(soon + 2 * PONG_TIMEOUT),
                None,
                "a quiet client may stay"
            );
        });
    }
}
