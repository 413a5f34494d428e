//! Serves the page, the status and the WebSocket on one port, on a separate thread.

use crate::admission::{Admission, Connection, GuardedStream, Limits};
use crate::broadcast::broadcast;
use crate::clock::ServerClock;
use crate::page::{FILES, has_version};
use crate::protocol::MAX_MESSAGE_BYTES;
use crate::server_context::ServerContext;
use crate::session;
use crate::{Error, Hub, Status};
use axum::extract::{Extension, Path, Request, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Router, body::Body};
use hyper::server::conn::http1;
use hyper::service::Service;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::sync::watch;

/// Maximum time that a stopping server waits until its clients have received the goodbye.
const GOODBYE_TIMEOUT: Duration = Duration::from_millis(500);
/// A connection is closed if the headers of a request take longer than this, or the next request arrives later than
/// this.
const HEADER_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum size of a request including its headers, bytes.
const MAX_REQUEST_BYTES: usize = 32 * 1024;
/// Period of checking connections for timeouts.
const SWEEP_PERIOD: Duration = Duration::from_millis(250);
/// Pause after a failed accept.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// Size of the kernel's send buffer per connection, bytes; Linux doubles it. For slow clients, data in a larger buffer
/// would only become outdated.
#[cfg(unix)]
const SEND_BUFFER_BYTES: usize = 64 * 1024;
/// Maximum number of connections waiting to be accepted.
#[cfg(unix)]
const BACKLOG: i32 = 1024;
/// Sources that the page may load, and sites that may embed it.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'none'";

/// Configuration of the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServerConfig {
    /// A loopback address; port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self { listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7007) }
    }
}

/// A running server. Dropping it sends a goodbye to all clients and frees the port.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts listening, and serves the hub's data until dropped.
    pub fn start(config: ServerConfig, hub: Hub) -> Result<Self, Error> {
        let listen_address = config.listen;
        if !listen_address.ip().is_loopback() {
            return Err(Error::NotLoopback { address: listen_address });
        }
        let (listener, address) = listen(listen_address)?;
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| Error::Thread { source })?;
        let thread = std::thread::Builder::new()
            .name("viz-server".to_owned())
            .spawn(move || {
                if let Err(error) = runtime.block_on(serve(listener, hub, stopped)) {
                    log::error!("the server on {address} stopped: {error}");
                }
                // Does not wait for pictures that are still being encoded.
                runtime.shutdown_background();
            })
            .map_err(|source| Error::Thread { source })?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// The actual address, with the selected port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The URL to open in a browser.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            log::error!("the server thread on {} panicked", self.address);
        }
    }
}

fn listen(address: SocketAddr) -> Result<(TcpListener, SocketAddr), Error> {
    let listen_error = |source: std::io::Error| match source.kind() {
        std::io::ErrorKind::AddrInUse => Error::AddressInUse { address },
        _ => Error::Listen { address, source },
    };
    let listener = TcpListener::bind(address).map_err(listen_error)?;
    listener.set_nonblocking(true).map_err(listen_error)?;
    let bound = listener.local_addr().map_err(listen_error)?;
    Ok((listener, bound))
}

async fn serve(listener: TcpListener, hub: Hub, mut stopped: watch::Receiver<bool>) -> std::io::Result<()> {
    #[cfg(unix)]
    set_socket_options(&listener);
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let clock = ServerClock::start();
    let (latest_messages_sender, latest_messages) = watch::channel(crate::broadcast::LatestMessages::default());
    tokio::spawn(broadcast(hub.clone(), clock, latest_messages_sender));
    let admission = Admission::new(Limits::of_process());
    let server_context = ServerContext { hub: hub.clone(), clock, latest_messages, stopped: stopped.clone() };
    let app = TowerToHyperService::new(router(AppState { server_context, admission: Arc::clone(&admission) }));
    tokio::select! {
        () = accept(&listener, &admission, &app) => {}
        () = sweep(&admission) => {}
        _ = stopped.changed() => {}
    }
    drop(listener);
    let all_disconnected = async {
        while hub.n_clients() > 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    if tokio::time::timeout(GOODBYE_TIMEOUT, all_disconnected).await.is_err() {
        log::debug!("{} clients did not disconnect in time", hub.n_clients());
    }
    Ok(())
}

/// Sets options that accepted sockets inherit. A failure affects only latency.
#[cfg(unix)]
fn set_socket_options(listener: &TcpListener) {
    let tuned = rustix::net::sockopt::set_socket_send_buffer_size(listener, SEND_BUFFER_BYTES)
        .and_then(|()| rustix::net::listen(listener, BACKLOG));
    if let Err(error) = tuned {
        log::debug!("cannot set the socket's buffer and backlog: {error}");
    }
}

/// Accepts connections and serves each in a separate task. Never returns.
async fn accept(listener: &tokio::net::TcpListener, admission: &Arc<Admission>, app: &TowerToHyperService<Router>) {
    let mut is_failing = false;
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                is_failing = false;
                // Small messages must not wait for the acknowledgment of large ones. A failure affects only latency.
                if let Err(error) = stream.set_nodelay(true) {
                    log::debug!("cannot disable Nagle's algorithm: {error}");
                }
                let (stream, has_evicted) = admission.admit(stream);
                tokio::spawn(serve_connection(stream, app.clone()));
                if has_evicted {
                    // Lets the task of the closed connection release its descriptor before the next accept.
                    tokio::task::yield_now().await;
                }
            }
            // The peer has already disconnected.
            Err(error) if matches!(error.kind(), ErrorKind::ConnectionAborted | ErrorKind::ConnectionReset) => {}
            Err(error) => {
                // Most likely all file descriptors are in use: free one, and pause to avoid a busy loop.
                if !is_failing {
                    log::warn!("cannot accept a connection: {error}");
                }
                is_failing = true;
                admission.evict();
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Enforces the time limits of connections. Never returns.
async fn sweep(admission: &Admission) {
    loop {
        tokio::time::sleep(SWEEP_PERIOD).await;
        admission.sweep();
    }
}

async fn serve_connection(stream: GuardedStream, app: TowerToHyperService<Router>) {
    let connection = Arc::clone(stream.connection());
    let service = hyper::service::service_fn(|request: hyper::Request<hyper::body::Incoming>| {
        connection.requested();
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(Arc::clone(&connection));
        app.call(request)
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        .max_buf_size(MAX_REQUEST_BYTES)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades()
        .await;
    if let Err(error) = served {
        log::debug!("a connection failed: {error}");
    }
}

/// State shared by the handlers.
#[derive(Clone)]
struct AppState {
    server_context: ServerContext,
    admission: Arc<Admission>,
}

fn router(app_state: AppState) -> Router {
    let mut router =
        Router::new().route("/status", get(status)).route("/robot/{mesh}", get(robot_mesh)).route("/ws", get(connect));
    for file in FILES {
        router = router.route(file.path, get(move |headers: HeaderMap| async move { file.response(&headers) }));
    }
    router.layer(from_fn(reject_foreign_origins)).layer(from_fn(add_security_headers)).with_state(app_state)
}

async fn status(State(app_state): State<AppState>) -> Response {
    let latest = app_state.server_context.hub.status().borrow().clone();
    let json = match latest {
        Some(status) => serde_json::to_string(&*status),
        None => serde_json::to_string(&Status::default()),
    };
    match json {
        Ok(json) => {
            let headers = [(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-store")];
            (headers, json).into_response()
        }
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

/// A mesh file of the robot, or 304 if the client has this version. Names are numbers in a list, so that no other file
/// can be requested.
async fn robot_mesh(Path(name): Path<String>, State(app_state): State<AppState>, request: HeaderMap) -> Response {
    let robot = app_state.server_context.hub.robot().borrow().clone();
    let mesh = robot.as_deref().and_then(|robot| robot.mesh_at(&name));
    let Some((format, bytes)) = mesh.map(|mesh| (mesh.format, Arc::clone(&mesh.bytes))) else {
        return (StatusCode::NOT_FOUND, "the robot has no mesh with this name").into_response();
    };
    let hashed = Arc::clone(&bytes);
    let etag = match tokio::task::spawn_blocking(move || etag(&hashed)).await {
        Ok(etag) => etag,
        Err(error) => return (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    };
    let shared = [(header::ETAG, etag.as_str()), (header::CACHE_CONTROL, "no-cache")];
    if has_version(&request, &etag) {
        return (StatusCode::NOT_MODIFIED, shared).into_response();
    }
    let content_type = [(header::CONTENT_TYPE, format.content_type())];
    (shared, content_type, Body::from(axum::body::Bytes::from_owner(bytes))).into_response()
}

/// A checksum that only this program needs to reproduce.
fn etag(bytes: &[u8]) -> String {
    let mut hasher = DefaultHasher::new();
    bytes.hash(&mut hasher);
    format!("\"{:016x}\"", hasher.finish())
}

async fn connect(
    upgrade: WebSocketUpgrade,
    Extension(connection): Extension<Arc<Connection>>,
    State(app_state): State<AppState>,
) -> Response {
    if !app_state.admission.admit_client(&connection) {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many clients are connected, try again later").into_response();
    }
    upgrade
        .max_message_size(MAX_MESSAGE_BYTES)
        .on_upgrade(move |socket| session::serve(socket, connection, app_state.server_context))
}

/// Adds headers that keep other web sites from embedding or reading the responses.
async fn add_security_headers(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    let policies: [(HeaderName, &'static str); 4] = [
        (header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ];
    headers.extend(policies.map(|(name, value)| (name, HeaderValue::from_static(value))));
    response
}

/// Allows only pages of this server: other web sites in the same browser can also reach loopback addresses.
async fn reject_foreign_origins(request: Request, next: Next) -> Response {
    if is_same_origin(request.headers()) {
        next.run(request).await
    } else {
        (StatusCode::FORBIDDEN, "only pages of this server, opened under localhost, may use it").into_response()
    }
}

fn is_same_origin(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let Some(host) = text(header::HOST) else { return false };
    let name = host.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok()).map_or(host, |(name, _)| name);
    let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    let is_local = name.eq_ignore_ascii_case("localhost") || address.is_ok_and(|address| address.is_loopback());
    let has_same_origin = match headers.get(header::ORIGIN) {
        None => true, // Not a browser.
        Some(_) => text(header::ORIGIN).and_then(|origin| origin.strip_prefix("http://")) == Some(host),
    };
    is_local && has_same_origin
}

#[cfg(test)]
mod tests {
    use super::is_same_origin;
    use axum::http::{HeaderMap, HeaderValue, header};

    #[test]
    fn foreign_origins_and_hosts_are_rejected() {
        let cases = [
            ("127.0.0.1:7007", None, true),
            ("localhost:8080", Some("http://localhost:8080"), true),
            ("[::1]:7007", Some("http://[::1]:7007"), true),
            ("127.0.0.1:7007", Some("http://example.com"), false),
            ("127.0.0.1:7007", Some("http://127.0.0.1:9999"), false),
            ("127.0.0.1:7007", Some("null"), false),
            ("example.com:7007", Some("http://example.com:7007"), false),
            ("example.com", None, false),
            ("192.168.0.5:7007", None, false),
        ];
        for (host, origin, expected) in cases {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, HeaderValue::from_static(host));
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, HeaderValue::from_static(origin));
            }
            assert_eq!(is_same_origin(&headers), expected, "{host} {origin:?}");
        }
        assert!(!is_same_origin(&HeaderMap::new()));
    }
}
