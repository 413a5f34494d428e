//! Serves the page, the status and the WebSocket on one port, on a separate thread.

pub(crate) mod access;
pub(crate) mod admission;
pub(crate) mod certificate;
pub(crate) mod client_log;
pub(crate) mod downloads;
mod guarded_stream;
mod page;
pub(crate) mod served_page;
pub(crate) mod server_context;
mod tls;

use crate::client::protocol::MAX_MESSAGE_BYTES;
use crate::clock::ServerClock;
use crate::server::access::{Access, Role, Tokens};
use crate::server::admission::{Admission, Connection, Limits};
use crate::server::certificate::Certificate;
use crate::server::client_log::ClientLog;
use crate::server::downloads::FileServer;
use crate::server::guarded_stream::GuardedStream;
use crate::server::page::{FILES, has_version};
use crate::server::server_context::ServerContext;
use crate::steering::client_message;
use crate::steering::socket::SteeringSocket;
use crate::steering::steering_server::steered_arm;
use crate::steering::steering_thread::{SteeringSpawner, SteeringThread};
use crate::topics::robot_description::RobotDescription;
use crate::topics::{self, Publisher};
use crate::{Error, Hub, Status, client};
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Extension, Path, Request, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
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
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{Semaphore, watch};
use tokio_rustls::TlsAcceptor;

/// Maximum time that a stopping server waits until its clients have received the goodbye. A client
/// that does not read must not delay the end of the program for longer.
const GOODBYE_TIMEOUT: Duration = Duration::from_millis(500);
/// A connection is closed if the headers of a request take longer than this, or the next request
/// arrives later than this.
const HEADER_TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum size of the headers of a request including its first line, bytes. Longer ones get 431.
const MAX_HEADER_BYTES: usize = 32 * 1024;
/// Pause after a failed accept, so that a permanent failure does not keep a processor busy.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);
/// Size of the kernel's send buffer per connection, bytes; Linux doubles it. For slow clients, data
/// in a larger buffer would only become outdated.
#[cfg(unix)]
const SEND_BUFFER_BYTES: usize = 64 * 1024;
/// Maximum number of connections waiting to be accepted.
#[cfg(unix)]
const BACKLOG: i32 = 1024;
/// Maximum number of photographs of keyframes that are encoded at the same time, for all clients.
/// Each one takes a processor away from training for some milliseconds.
const MAX_PHOTOGRAPHS: usize = 2;
/// Sources that the page may load, and sites that may embed it.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'none'";

/// Configuration of the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServerConfig {
    /// Port 0 selects a free port.
    pub listen: SocketAddr,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7007),
        }
    }
}

/// The certificate and the tokens that make a server safe to reach from other machines.
#[derive(Debug)]
pub struct Sharing {
    /// Encrypts all connections.
    pub certificate: Certificate,
    /// Clients need one of these tokens.
    pub tokens: Tokens,
}

/// A thread of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ServerThread {
    /// The thread that accepts clients, and sends pages, pictures and data.
    Pages,
    /// The thread of the clients of `/steer`.
    Steering,
}

/// A running server. Dropping it sends a goodbye to all clients and frees the port.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    scheme: &'static str,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    runtime: tokio::runtime::Handle,
    steering_thread: SteeringThread,
}

impl Server {
    /// Starts listening on a loopback address, and serves the hub's data to everybody on this
    /// computer until dropped.
    pub fn start(config: ServerConfig, hub: Hub) -> Result<Self, Error> {
        let address = config.listen;
        if !address.ip().is_loopback() {
            return Err(Error::NotLoopback { address });
        }
        Self::spawn(address, hub, Access::Local, None)
    }

    /// Starts listening on any address, and serves the hub's data over TLS to clients with a token
    /// until dropped.
    pub fn start_shared(config: ServerConfig, sharing: Sharing, hub: Hub) -> Result<Self, Error> {
        let tls = sharing
            .certificate
            .server_config()
            .map_err(|source| Error::Tls { source })?;
        Self::spawn(
            config.listen,
            hub,
            Access::Tokens(sharing.tokens),
            Some(tls.into()),
        )
    }

    fn spawn(
        listen_address: SocketAddr,
        hub: Hub,
        access: Access,
        tls: Option<TlsAcceptor>,
    ) -> Result<Self, Error> {
        // The socket is bound here and not on the thread, so that errors are returned to the
        // caller.
        let (listener, address) = listen(listen_address)?;
        let scheme = if tls.is_some() { "https" } else { "http" };
        let (stop, stopped) = watch::channel(false);
        let steering_thread = SteeringThread::start(stopped.clone())?;
        let steering = steering_thread.spawner();
        // Except for steering, the server needs only one thread, because clients mostly wait, and
        // computations run on threads for blocking tasks.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| Error::Thread { source })?;
        let handle = runtime.handle().clone();
        let thread = std::thread::Builder::new()
            .name("viz-server".to_owned())
            .spawn(move || {
                let services = Services {
                    access,
                    tls,
                    steering,
                };
                let served = serve(listener, hub, services, stopped);
                if let Err(error) = runtime.block_on(served) {
                    log::error!("the server on {address} stopped: {error}");
                }
                // Does not wait for pictures that are still being encoded.
                runtime.shutdown_background();
            })
            .map_err(|source| Error::Thread { source })?;
        Ok(Self {
            address,
            scheme,
            stop,
            thread: Some(thread),
            runtime: handle,
            steering_thread,
        })
    }

    /// The actual address, with the selected port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The URL to open in a browser on this computer. Clients of a shared server also need a token.
    pub fn url(&self) -> String {
        format!("{}://{}/", self.scheme, self.address)
    }

    /// Blocks a thread of the server for a time, as a slow operation would. A bench calls this
    /// function to measure whether the other threads continue.
    pub fn block(&self, thread: ServerThread, time: Duration) {
        let runtime = match thread {
            ServerThread::Pages => &self.runtime,
            ServerThread::Steering => self.steering_thread.runtime(),
        };
        runtime.spawn(async move { std::thread::sleep(time) });
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        // The port must be free, and the goodbyes sent, before the program ends.
        if self
            .thread
            .take()
            .is_some_and(|thread| thread.join().is_err())
        {
            log::error!("the server thread on {} panicked", self.address);
        }
        if !self.steering_thread.join() {
            log::error!("the steering thread on {} panicked", self.address);
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

/// What connections of a server need.
struct Services {
    access: Access,
    tls: Option<TlsAcceptor>,
    steering: SteeringSpawner,
}

async fn serve(
    listener: TcpListener,
    hub: Hub,
    services: Services,
    mut stopped: watch::Receiver<bool>,
) -> std::io::Result<()> {
    #[cfg(unix)]
    set_socket_options(&listener);
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let clock = ServerClock::start();
    let topics = topics::start_all(&hub);
    let publisher = Publisher::default();
    tokio::spawn(topics::encode_all(
        hub.clone(),
        clock,
        Arc::clone(&topics),
        publisher.clone(),
    ));
    let admission = Admission::new(Limits::of_process());
    let log = Arc::new(ClientLog::new());
    let server_context = ServerContext {
        hub: hub.clone(),
        clock,
        topics,
        publisher,
        photographs: Arc::new(Semaphore::new(MAX_PHOTOGRAPHS)),
        log,
        stopped: stopped.clone(),
    };
    let app = TowerToHyperService::new(router(AppState {
        server_context,
        admission: Arc::clone(&admission),
        access: Arc::new(services.access),
        files: FileServer::new(hub.clone()),
        steering: services.steering,
    }));
    tokio::select! {
        () = accept(&listener, &admission, services.tls.as_ref(), &app) => {}
        _ = stopped.changed() => {}
    }
    // The server accepts no new connections while the clients receive the goodbye.
    drop(listener);
    let all_disconnected = async {
        while hub.n_clients() > 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    if tokio::time::timeout(GOODBYE_TIMEOUT, all_disconnected)
        .await
        .is_err()
    {
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
async fn accept(
    listener: &tokio::net::TcpListener,
    admission: &Arc<Admission>,
    tls: Option<&TlsAcceptor>,
    app: &TowerToHyperService<Router>,
) {
    let mut is_failing = false;
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                is_failing = false;
                // Small messages must not wait for the acknowledgment of large ones. A failure
                // affects only latency.
                if let Err(error) = stream.set_nodelay(true) {
                    log::debug!("cannot disable Nagle's algorithm: {error}");
                }
                let stream = GuardedStream::new(stream, Arc::clone(admission));
                tokio::spawn(serve_connection(stream, tls.cloned(), app.clone()));
                // A new connection may have replaced an older one. The task of the older one now
                // gets the chance to close its socket, before the next accept needs a descriptor.
                tokio::task::yield_now().await;
            }
            // The peer has already disconnected.
            Err(error)
                if matches!(
                    error.kind(),
                    ErrorKind::ConnectionAborted | ErrorKind::ConnectionReset
                ) => {}
            Err(error) => {
                // Most likely, all file descriptors are in use. One is freed, and a pause avoids a
                // busy loop.
                if !is_failing {
                    log::warn!("cannot accept a connection: {error}");
                }
                // There is one warning per series of failures, because a series may last for hours.
                is_failing = true;
                admission.evict();
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

/// Serves a connection until either side closes it.
async fn serve_connection(
    stream: GuardedStream,
    tls: Option<TlsAcceptor>,
    app: TowerToHyperService<Router>,
) {
    let connection = Arc::clone(stream.connection());
    tokio::select! {
        () = serve_stream(stream, tls, app) => {}
        () = connection.closed() => {}
    }
}

async fn serve_stream(
    stream: GuardedStream,
    tls: Option<TlsAcceptor>,
    app: TowerToHyperService<Router>,
) {
    let connection = Arc::clone(stream.connection());
    match tls {
        None => serve_requests(stream, connection, app).await,
        Some(acceptor) => match tls::accept(&acceptor, stream).await {
            Ok(stream) => serve_requests(stream, connection, app).await,
            Err(error) => log::debug!("a connection failed: {error}"),
        },
    }
}

async fn serve_requests<S>(stream: S, connection: Arc<Connection>, app: TowerToHyperService<Router>)
where
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    let service = hyper::service::service_fn(|request: hyper::Request<hyper::body::Incoming>| {
        connection.record_request();
        let mut request = request.map(Body::new);
        // The handler of the WebSocket needs the connection to count the client.
        request.extensions_mut().insert(Arc::clone(&connection));
        app.call(request)
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        // The last read may exceed the maximum, so the buffer can become slightly larger.
        .max_header_size(MAX_HEADER_BYTES)
        .max_buf_size(MAX_HEADER_BYTES)
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
    access: Arc<Access>,
    files: FileServer,
    steering: SteeringSpawner,
}

fn router(app_state: AppState) -> Router {
    let mut router = Router::new()
        .route("/status", get(status))
        .route("/workspace", get(workspace))
        .route("/robot/{mesh}", get(robot_mesh))
        .route("/files/{name}", get(file))
        .route("/ws", get(connect))
        .route("/steer", get(steer))
        .route_layer(from_fn_with_state(app_state.clone(), require_token));
    // The files of the page need no token. They contain no data, and the page needs them before it
    // can send the token. The page reads the token from the fragment of the address, which browsers
    // do not send.
    for file in FILES {
        router = router.route(
            file.path,
            get(move |headers: HeaderMap| async move { file.response(&headers) }),
        );
    }
    // The last layer is the outermost, so refusals have the security headers, too.
    router
        .layer(from_fn_with_state(
            app_state.clone(),
            reject_foreign_origins,
        ))
        .layer(from_fn(add_security_headers))
        .with_state(app_state)
}

async fn status(State(app_state): State<AppState>) -> Response {
    let latest = app_state.server_context.hub.status();
    let json = match latest {
        Some(status) => serde_json::to_string(&*status),
        None => serde_json::to_string(&Status::default()),
    };
    match json {
        Ok(json) => {
            let headers = [
                (header::CONTENT_TYPE, "application/json"),
                (header::CACHE_CONTROL, "no-store"),
            ];
            (headers, json).into_response()
        }
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

/// The workspace with which pages start.
async fn workspace(State(app_state): State<AppState>) -> Response {
    match app_state.server_context.hub.workspace() {
        Some(workspace) => {
            let headers = [
                (header::CONTENT_TYPE, "application/json"),
                (header::CACHE_CONTROL, "no-store"),
            ];
            (headers, workspace.text().to_owned()).into_response()
        }
        None => (StatusCode::NOT_FOUND, "the server has no workspace").into_response(),
    }
}

/// A mesh file of the robot, or 304 if the client has this version. Names are numbers in a list, so
/// that no other file can be requested.
async fn robot_mesh(
    Path(name): Path<String>,
    State(app_state): State<AppState>,
    request: HeaderMap,
) -> Response {
    let robot = app_state
        .server_context
        .hub
        .latest::<Option<Arc<RobotDescription>>>()
        .borrow()
        .clone();
    let mesh = robot.as_deref().and_then(|robot| robot.mesh_at(&name));
    let Some((format, bytes)) = mesh.map(|mesh| (mesh.format, Arc::clone(&mesh.bytes))) else {
        return (
            StatusCode::NOT_FOUND,
            "the robot has no mesh with this name",
        )
            .into_response();
    };
    // Meshes can have many megabytes. Hashing them on this thread would delay all clients.
    let hashed = Arc::clone(&bytes);
    let etag = match tokio::task::spawn_blocking(move || etag(&hashed)).await {
        Ok(etag) => etag,
        Err(error) => {
            return (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response();
        }
    };
    let shared = [
        (header::ETAG, etag.as_str()),
        (header::CACHE_CONTROL, "no-cache"),
    ];
    if has_version(&request, &etag) {
        return (StatusCode::NOT_MODIFIED, shared).into_response();
    }
    let content_type = [(header::CONTENT_TYPE, format.content_type())];
    (
        shared,
        content_type,
        Body::from(axum::body::Bytes::from_owner(bytes)),
    )
        .into_response()
}

/// A published file.
async fn file(Path(name): Path<String>, State(app_state): State<AppState>) -> Response {
    app_state.files.respond(&name).await
}

/// A checksum of a file. It may differ between versions of this program, because clients only
/// compare it with an earlier checksum from the same server.
fn etag(bytes: &[u8]) -> String {
    let mut hasher = DefaultHasher::new();
    bytes.hash(&mut hasher);
    format!("\"{:016x}\"", hasher.finish())
}

async fn connect(
    upgrade: WebSocketUpgrade,
    Extension(connection): Extension<Arc<Connection>>,
    Extension(role): Extension<Role>,
    State(app_state): State<AppState>,
) -> Response {
    // The client is admitted before the upgrade, so that a refused client gets an HTTP status with
    // a reason.
    if !app_state
        .admission
        .admit_client(&connection, role == Role::Operator)
    {
        return (
            StatusCode::SERVICE_UNAVAILABLE,
            "too many clients are connected, try again later",
        )
            .into_response();
    }
    upgrade
        .max_message_size(MAX_MESSAGE_BYTES)
        .max_frame_size(MAX_MESSAGE_BYTES)
        .on_upgrade(move |socket| client::serve(socket, connection, role, app_state.server_context))
}

/// A client that steers the arm, or watches how others do.
async fn steer(
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
    Extension(connection): Extension<Arc<Connection>>,
    Extension(role): Extension<Role>,
    State(app_state): State<AppState>,
) -> Response {
    let Some(server) = steered_arm(&app_state.server_context.hub) else {
        return (
            StatusCode::NOT_FOUND,
            "no arm can be steered: this needs [arm.motion] in the rig file and a run that permits motion",
        )
            .into_response();
    };
    let upgrade = match upgrade {
        Ok(upgrade) => upgrade,
        Err(rejection) => return rejection.into_response(),
    };
    if !app_state
        .admission
        .admit_steering_client(&connection, role == Role::Operator)
    {
        return (
            StatusCode::SERVICE_UNAVAILABLE,
            "too many clients are connected to the arm, try again later",
        )
            .into_response();
    }
    upgrade
        .max_message_size(client_message::MAX_MESSAGE_BYTES)
        .max_frame_size(client_message::MAX_MESSAGE_BYTES)
        .on_upgrade(move |socket| async move {
            app_state.steering.serve(SteeringSocket {
                socket,
                connection,
                role,
                server,
                context: app_state.server_context,
            });
        })
}

/// Adds headers that keep other web sites from embedding or reading the responses.
async fn add_security_headers(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    // Reports have a separate policy.
    headers
        .entry(header::CONTENT_SECURITY_POLICY)
        .or_insert(HeaderValue::from_static(CONTENT_SECURITY_POLICY));
    let policies: [(HeaderName, &'static str); 3] = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    headers.extend(policies.map(|(name, value)| (name, HeaderValue::from_static(value))));
    response
}

async fn reject_foreign_origins(
    State(app_state): State<AppState>,
    request: Request,
    next: Next,
) -> Response {
    match app_state.access.check_origin(request.headers()) {
        Ok(()) => next.run(request).await,
        Err(refusal) => (refusal.status(), refusal.to_string()).into_response(),
    }
}

/// Refuses requests without a token, and stores the role of the others.
async fn require_token(
    State(app_state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    match app_state.access.role_of(request.headers()) {
        Ok(role) => {
            request.extensions_mut().insert(role);
            next.run(request).await
        }
        Err(refusal) => (refusal.status(), refusal.to_string()).into_response(),
    }
}
