//! One port for the page, the status and the WebSocket, on its own thread.

use crate::page::{FILES, PageFile};
use crate::protocol::MAX_MESSAGE_BYTES;
use crate::{Error, Hub, Status, session};
use axum::Router;
use axum::extract::{Request, State, WebSocketUpgrade};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::serve::ListenerExt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::sync::watch;

/// How long a stopping server waits for its clients to be told.
const GOODBYE_TIMEOUT: Duration = Duration::from_millis(500);
/// More clients than this are refused.
const MAX_CLIENTS: usize = 32;

/// Where to listen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServerConfig {
    /// A loopback address; port 0 takes any free one.
    pub listen: SocketAddr,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self { listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7007) }
    }
}

/// A running server; dropped, it says goodbye to its clients and frees the port.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Listens, and serves what lies in the hub until dropped.
    pub fn start(config: ServerConfig, hub: Hub) -> Result<Self, Error> {
        let asked = config.listen;
        if !asked.ip().is_loopback() {
            return Err(Error::NotLoopback { address: asked });
        }
        let (listener, address) = listen(asked)?;
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
                // A picture that is still being encoded is not waited for.
                runtime.shutdown_background();
            })
            .map_err(|source| Error::Thread { source })?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// Where the server really listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What to open in a browser.
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
    let refused = |source: std::io::Error| match source.kind() {
        std::io::ErrorKind::AddrInUse => Error::AddressInUse { address },
        _ => Error::Listen { address, source },
    };
    let listener = TcpListener::bind(address).map_err(refused)?;
    listener.set_nonblocking(true).map_err(refused)?;
    let bound = listener.local_addr().map_err(refused)?;
    Ok((listener, bound))
}

async fn serve(listener: TcpListener, hub: Hub, mut stopped: watch::Receiver<bool>) -> std::io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?.tap_io(|stream| {
        // Small messages must not wait for large ones to be acknowledged; without it, only the delay grows.
        if let Err(error) = stream.set_nodelay(true) {
            log::debug!("cannot switch off Nagle's algorithm: {error}");
        }
    });
    let app = router(hub.clone(), stopped.clone());
    tokio::select! {
        ended = axum::serve(listener, app).into_future() => return ended,
        _ = stopped.changed() => {}
    }
    let all_left = async {
        while hub.n_clients() > 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    if tokio::time::timeout(GOODBYE_TIMEOUT, all_left).await.is_err() {
        log::debug!("{} clients did not take leave in time", hub.n_clients());
    }
    Ok(())
}

/// What the handlers share.
#[derive(Clone)]
struct Site {
    hub: Hub,
    stopped: watch::Receiver<bool>,
}

fn router(hub: Hub, stopped: watch::Receiver<bool>) -> Router {
    let mut router = Router::new().route("/status", get(status)).route("/ws", get(connect));
    for file in FILES {
        router = router.route(file.path, get(|| async { page_file(file) }));
    }
    router.layer(from_fn(refuse_strangers)).with_state(Site { hub, stopped })
}

fn page_file(file: &'static PageFile) -> Response {
    let headers: [(HeaderName, &str); 2] =
        [(header::CONTENT_TYPE, file.content_type), (header::CACHE_CONTROL, "no-cache")];
    (headers, file.bytes).into_response()
}

async fn status(State(site): State<Site>) -> Response {
    let latest = site.hub.status().borrow().clone();
    let json = match latest {
        Some(status) => serde_json::to_string(&*status),
        None => serde_json::to_string(&Status::default()),
    };
    match json {
        Ok(json) => ([(header::CONTENT_TYPE, "application/json")], json).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn connect(upgrade: WebSocketUpgrade, State(site): State<Site>) -> Response {
    if site.hub.n_clients() >= MAX_CLIENTS {
        return (StatusCode::SERVICE_UNAVAILABLE, "all places for clients are taken").into_response();
    }
    upgrade.max_message_size(MAX_MESSAGE_BYTES).on_upgrade(move |socket| session::serve(socket, site.hub, site.stopped))
}

/// Only pages of this server may use it: other web sites open in the same browser reach loopback too.
async fn refuse_strangers(request: Request, next: Next) -> Response {
    if is_ours(request.headers()) {
        next.run(request).await
    } else {
        (StatusCode::FORBIDDEN, "only pages of this server, opened under localhost, may use it").into_response()
    }
}

fn is_ours(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let Some(host) = text(header::HOST) else { return false };
    let name = host.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok()).map_or(host, |(name, _)| name);
    let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    let is_local = name.eq_ignore_ascii_case("localhost") || address.is_ok_and(|address| address.is_loopback());
    let has_our_origin = match headers.get(header::ORIGIN) {
        None => true, // Not a browser.
        Some(_) => text(header::ORIGIN).and_then(|origin| origin.strip_prefix("http://")) == Some(host),
    };
    is_local && has_our_origin
}

#[cfg(test)]
mod tests {
    use super::is_ours;
    use axum::http::{HeaderMap, HeaderValue, header};

    #[test]
    fn other_sites_and_renamed_hosts_are_strangers() {
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
            assert_eq!(is_ours(&headers), expected, "{host} {origin:?}");
        }
        assert!(!is_ours(&HeaderMap::new()));
    }
}
