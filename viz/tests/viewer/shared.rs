//! A shared server: TLS, tokens, roles, and hostile clients.

use crate::slow::{Counter, Slow};
use crate::tls;
use crate::tls::TIMEOUT;
use numbers::random::Random;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use trainer::Picture;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};
use viz::{Certificate, Control, Hub, Server, ServerConfig, Sharing, Tokens};

/// A handshake may take 3 s; on two busy cores it takes longer.
const HANDSHAKE_SECS: std::ops::Range<f64> = 2.0..8.0;
/// A new viewer connects within this time, regardless of other connections.
const VIEWER_TIMEOUT: Duration = Duration::from_secs(1);

/// A shared server and what its users know.
pub(crate) struct Shared {
    pub(crate) hub: Hub,
    server: Server,
    pub(crate) operator: String,
    pub(crate) viewer: String,
    fingerprint: String,
}

impl Shared {
    pub(crate) fn start() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let certificate = Certificate::kept_in(folder.path()).expect("a certificate");
        let (fingerprint, tokens) = (
            certificate.fingerprint(),
            Tokens::random().expect("random numbers"),
        );
        let (operator, viewer) = (
            tokens.operator.text().to_owned(),
            tokens.viewer.text().to_owned(),
        );
        let config = ServerConfig {
            listen: SocketAddr::from(([0, 0, 0, 0], 0)),
        };
        let hub = Hub::new();
        let server = Server::start_shared(
            config,
            Sharing {
                certificate,
                tokens,
            },
            hub.clone(),
        );
        Self {
            hub,
            server: server.expect("a free port exists"),
            operator,
            viewer,
            fingerprint,
        }
    }

    pub(crate) fn address(&self) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], self.server.address().port()))
    }

    pub(crate) fn tls(&self) -> tls::TlsStream {
        tls::connect(self.address(), &self.fingerprint)
    }

    /// Status line and headers, and the body, of a GET request with additional headers.
    pub(crate) fn get(&self, path: &str, headers: &str) -> (String, String) {
        let mut stream = self.tls();
        let address = self.address();
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{headers}\r\n"
        )
        .expect("sent");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer); // The end may come without a TLS close.
        let answer = String::from_utf8_lossy(&answer);
        let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
        (head.to_lowercase(), body.to_owned())
    }

    fn client(&self, token: &str) -> Client {
        Client(self.websocket(self.tls(), token))
    }

    /// Opens a WebSocket over a TLS connection.
    fn websocket<S: Read + Write>(&self, stream: S, token: &str) -> WebSocket<S> {
        let mut request = format!("wss://{}/ws", self.address())
            .into_client_request()
            .expect("a request");
        let headers = request.headers_mut();
        headers.insert(
            "authorization",
            format!("Bearer {token}").parse().expect("text"),
        );
        headers.insert(
            "origin",
            format!("https://{}", self.address()).parse().expect("text"),
        );
        let Ok((socket, _)) = tungstenite::client(request, stream) else {
            panic!("no WebSocket")
        };
        socket
    }

    /// A connection on which a WebSocket is open, for invalid frames.
    fn raw_client(&self) -> tls::TlsStream {
        let mut stream = self.tls();
        let request = upgrade_request(
            self.address(),
            &format!("Authorization: Bearer {}\r\n", self.viewer),
        );
        stream.write_all(request.as_bytes()).expect("sent");
        let mut head = [0; 12];
        stream.read_exact(&mut head).expect("an answer");
        assert_eq!(&head, b"HTTP/1.1 101");
        stream
    }
}

fn upgrade_request(address: SocketAddr, headers: &str) -> String {
    format!(
        "GET /ws HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{headers}\r\n"
    )
}

struct Client(WebSocket<tls::TlsStream>);

impl Client {
    fn send(&mut self, message: &Value) {
        self.0
            .send(Message::text(message.to_string()))
            .expect("sent");
    }

    fn text_of(&mut self, kind: &str) -> Value {
        loop {
            let Message::Text(text) = self.0.read().expect("a message") else {
                continue;
            };
            let value: Value = serde_json::from_str(&text).expect("JSON");
            if value["type"] == kind {
                return value;
            }
        }
    }

    fn is_answered(&mut self) -> bool {
        self.send(&json!({"type": "ping", "t": 2.5}));
        self.text_of("pong")["t"] == json!(2.5)
    }
}

/// Seconds until the other side closes the connection.
fn secs_until_closed(mut stream: impl Read) -> f64 {
    let started = Instant::now();
    // A reset also ends the connection; a read that times out does not.
    let ended = std::io::copy(&mut stream, &mut std::io::sink());
    let is_timeout = ended.is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock);
    assert!(!is_timeout, "the connection stays open");
    started.elapsed().as_secs_f64()
}

#[test]
fn data_requires_a_token_and_the_page_does_not() {
    let shared = Shared::start();
    let bearer = |token: &str| format!("Authorization: Bearer {token}\r\n");
    let cookie = format!("Cookie: __Host-fieldrig-7007={}\r\n", shared.viewer);
    for path in [
        "/status",
        "/robot/0.stl",
        "/files/splat.ply",
        "/ws",
        "/steer",
    ] {
        for (headers, named) in [
            (String::new(), "requires a token"),
            (bearer("0123"), "invalid token"),
        ] {
            let (head, body) = shared.get(path, &headers);
            assert!(head.starts_with("http/1.1 401"), "{path}: {head}");
            assert!(
                body.contains(named) && body.lines().count() == 1,
                "{path}: {body}"
            );
        }
    }
    for headers in [bearer(&shared.operator), bearer(&shared.viewer), cookie] {
        assert!(
            shared
                .get("/status", &headers)
                .0
                .starts_with("http/1.1 200"),
            "{headers}"
        );
    }
    let (head, _) = shared.get("/", "");
    assert!(head.starts_with("http/1.1 200"), "{head}");
    // Foreign pages can neither embed the page nor learn its address, and a self-signed certificate
    // stays acceptable.
    assert!(
        head.contains("frame-ancestors 'none'") && head.contains("referrer-policy: no-referrer"),
        "{head}"
    );
    assert!(!head.contains("strict-transport-security"), "{head}");
}

#[test]
fn foreign_origins_are_refused_despite_a_token() {
    let shared = Shared::start();
    for origin in [
        "https://example.com",
        "http://127.0.0.1",
        "null",
        "https://127.0.0.1:1",
    ] {
        let headers = format!(
            "Authorization: Bearer {}\r\nOrigin: {origin}\r\n",
            shared.operator
        );
        for path in ["/status", "/ws", "/steer", "/"] {
            let (head, body) = shared.get(path, &headers);
            assert!(
                head.starts_with("http/1.1 403") && body.lines().count() == 1,
                "{origin}: {head}: {body}"
            );
        }
    }
}

#[test]
fn clients_without_tls_learn_to_use_it() {
    let shared = Shared::start();
    let mut stream = TcpStream::connect(shared.address()).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    stream
        .write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        .expect("sent");
    let mut answer = String::new();
    let _ = stream.read_to_string(&mut answer); // The request is not read, so a reset may follow the answer.
    assert!(
        answer.starts_with("HTTP/1.1 400") && answer.contains("https://"),
        "{answer:?}"
    );
}

#[test]
fn only_operators_change_the_run() {
    let shared = Shared::start();
    let mut viewer = shared.client(&shared.viewer);
    assert_eq!(viewer.text_of("hello")["role"], json!("viewer"));
    viewer.send(&json!({"type": "control", "action": "pause"}));
    let refusal = viewer.text_of("error")["message"].clone();
    assert!(
        refusal
            .as_str()
            .is_some_and(|text| text.contains("requires the role operator")),
        "{refusal}"
    );
    assert_eq!(shared.hub.operator_requests().take_controls(), []);
    viewer.send(&json!({"type": "edit", "action": "undo", "id": 4}));
    let refusal = viewer.text_of("error");
    assert!(
        refusal["id"] == 4
            && refusal["message"]
                .as_str()
                .is_some_and(|text| text.contains("role operator"))
    );
    assert_eq!(shared.hub.operator_requests().take_edits(), []);

    let mut operator = shared.client(&shared.operator);
    assert_eq!(operator.text_of("hello")["role"], json!("operator"));
    operator.send(&json!({"type": "control", "action": "pause"}));
    operator.send(&json!({"type": "edit", "action": "undo"}));
    assert!(operator.is_answered(), "the messages before were read");
    assert_eq!(shared.hub.operator_requests().take_edits().len(), 1);
    assert_eq!(
        shared.hub.operator_requests().take_controls(),
        [Control::Pause]
    );
    assert!(
        viewer.is_answered(),
        "a refused message does not end the connection"
    );
}

#[test]
fn slow_handshakes_are_closed_and_do_not_block_others() {
    /// Descriptors of both ends are in this process, whose limit may be 1024.
    const N_SLOW: usize = 300;
    let shared = Shared::start();
    let mut operator = shared.client(&shared.operator);
    let started = Instant::now();
    // The beginning of a ClientHello, and nothing.
    let slow: Vec<_> = (0..N_SLOW)
        .map(|ix| {
            let mut stream = TcpStream::connect(shared.address()).expect("the server listens");
            stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
            if ix % 2 == 0 {
                let _ = stream.write_all(&[0x16, 3, 1, 2, 0, 1]);
            }
            stream
        })
        .collect();
    assert!(operator.is_answered());
    // Other tests keep the cores busy, so only the fastest of a few viewers counts.
    let took = (0..4).map(|_| {
        let began = Instant::now();
        shared.client(&shared.viewer).text_of("hello");
        began.elapsed()
    });
    let took = took.min().expect("viewers");
    assert!(
        took < VIEWER_TIMEOUT,
        "new viewers waited {took:?} or longer"
    );
    for stream in slow.into_iter().rev().take(8) {
        secs_until_closed(stream);
        let secs = started.elapsed().as_secs_f64();
        assert!(
            HANDSHAKE_SECS.contains(&secs),
            "a slow handshake was closed after {secs} s"
        );
    }
    assert!(operator.is_answered());
}

#[test]
fn hostile_clients_are_closed_and_others_unharmed() {
    /// A text frame with the mask 0 that does not end the message.
    const FRAGMENT: u8 = 0x01;
    const CONTINUATION: u8 = 0x00;
    const TEXT: u8 = 0x81;
    let frame = |kind: u8, n_bytes: u64, payload: &[u8]| {
        let mut bytes = vec![kind, 0x80 | 127];
        bytes.extend(n_bytes.to_be_bytes());
        bytes.extend([0; 4]);
        bytes.extend(payload);
        bytes
    };
    let shared = Shared::start();
    let mut operator = shared.client(&shared.operator);

    let mut endless = shared.raw_client();
    let started = Instant::now();
    let mut n_sent = 0;
    endless
        .write_all(&frame(FRAGMENT, 1024, &[b' '; 1024]))
        .expect("sent");
    while endless
        .write_all(&frame(CONTINUATION, 1024, &[b' '; 1024]))
        .is_ok()
    {
        n_sent += 1024;
        assert!(
            started.elapsed() < TIMEOUT,
            "{n_sent} bytes of fragments were accepted"
        );
    }

    let garbage: Vec<u8> = (0..4000_u32)
        .map(|ix| (ix.wrapping_mul(2_654_435_761) >> 13).to_le_bytes()[0])
        .collect();
    let unmasked = [TEXT, 2, b'{', b'}'].to_vec();
    for (what, bytes) in [
        (
            "an oversize message",
            frame(TEXT, 70_000, &vec![b' '; 70_000]),
        ),
        // Refused before it is received, so that it uses no memory.
        ("an announced frame of 10 MB", frame(TEXT, 10_000_000, &[])),
        ("an announced frame of 1 TiB", frame(TEXT, 1 << 40, &[])),
        ("garbage", garbage),
        ("an unmasked frame", unmasked),
    ] {
        let mut stream = shared.raw_client();
        let _ = stream.write_all(&bytes);
        let secs = secs_until_closed(stream);
        assert!(secs < 5.0, "{what} was refused only after {secs} s");
        assert!(operator.is_answered(), "after {what}");
    }

    // Garbage instead of a handshake, and after one instead of a request.
    let mut stream = TcpStream::connect(shared.address()).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let _ = stream.write_all(&[0x16, 3, 1, 0, 4, 9, 9, 9, 9]);
    assert!(secs_until_closed(stream) < 5.0);
    let mut stream = shared.tls();
    stream.write_all(&[7; 40_000]).expect("sent");
    assert!(secs_until_closed(stream) < 5.0);
    assert!(operator.is_answered());
}

/// A picture that cannot be compressed, so that it takes long to send.
fn noise() -> Picture {
    let size_px = [1280, 720];
    let mut random = Random::new(5);
    let n = (size_px[0] * size_px[1]) as usize;
    let rgba_srgb = (0..4 * n)
        .map(|_| u8::try_from(random.below(256)).expect("a byte"))
        .collect();
    Picture {
        size_px,
        rgba_srgb,
        depth_m: vec![1.0; n],
    }
}

/// Numbers of bytes that leave the server before the replies to pings while it sends pictures.
fn bytes_before_replies<S: Read + Write>(
    mut socket: WebSocket<S>,
    counter: &Counter,
) -> Vec<usize> {
    /// Pings, and how many of them are sent while the server still measures the connection.
    const N_PINGS: usize = 25;
    const N_FIRST: usize = 10;
    let send = |socket: &mut WebSocket<_>, message: Value| {
        socket
            .send(Message::text(message.to_string()))
            .expect("sent");
    };
    send(
        &mut socket,
        json!({"type": "hello", "protocols": [3, 4], "capabilities": ["parts"]}),
    );
    let mut n_bytes = Vec::new();
    let mut is_sending_pictures = false;
    while n_bytes.len() < N_PINGS {
        let (asked, n_arrived) = (Instant::now(), counter.n_arrived());
        send(&mut socket, json!({"type": "ping", "t": 7}));
        send(
            &mut socket,
            json!({
                "type": "render", "id": n_bytes.len(), "size_px": [1280, 720], "stages": [1.0],
                "world_from_camera": [1, 0, 0, 0.0, 0, 0, 1, -2.0, 0, -1, 0, 0.5, 0, 0, 0, 1],
                "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9}, "outputs": ["color", "depth"],
                "depth_format": "f32",
            }),
        );
        // Continues to read, so that pictures are sent all the time.
        let mut answered = None;
        while answered.is_none() || asked.elapsed() < Duration::from_millis(150) {
            match socket.read().expect("a message") {
                Message::Text(text) if text.contains("\"pong\"") => {
                    answered = Some(counter.n_read())
                }
                Message::Binary(_) => is_sending_pictures = true,
                _ => {}
            }
        }
        n_bytes.extend(
            answered
                .filter(|_| is_sending_pictures)
                .map(|n_read| n_read.saturating_sub(n_arrived)),
        );
    }
    n_bytes.split_off(N_FIRST)
}

/// With TLS as without, little data waits on the server.
#[test]
fn replies_do_not_wait_for_pictures_with_tls() {
    /// 100 ms of data that the kernel has not sent yet, and a part of the next message. The median:
    /// the server may estimate the rate of a connection too high for a while.
    const MAX_MEDIAN_SECS: f64 = 0.15;
    let shared = Shared::start();
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let local = Server::start(config, shared.hub.clone()).expect("a free port exists");
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let picture = noise();
            while !is_over.load(Ordering::Relaxed) {
                shared
                    .hub
                    .pictures()
                    .wait_for_request(Duration::from_millis(50));
                if let Some(pending) = shared.hub.pictures().next_request() {
                    pending.deliver(picture.clone());
                }
            }
        });
        let measured = [2.5e5, 6.25e5, 2.5e6].map(|bytes_per_sec| {
            let stream = Slow::connect(shared.address(), bytes_per_sec);
            let counter = stream.counter();
            let socket = shared.websocket(tls::over(stream, &shared.fingerprint), &shared.viewer);
            let with_tls = bytes_before_replies(socket, &counter);
            let stream = Slow::connect(local.address(), bytes_per_sec);
            let counter = stream.counter();
            let Ok((socket, _)) =
                tungstenite::client(format!("ws://{}/ws", local.address()), stream)
            else {
                panic!("no WebSocket")
            };
            (
                bytes_per_sec,
                with_tls,
                bytes_before_replies(socket, &counter),
            )
        });
        is_over.store(true, Ordering::Relaxed);
        for (bytes_per_sec, with_tls, without_tls) in measured {
            for (name, mut n_bytes) in [("with TLS", with_tls), ("without TLS", without_tls)] {
                n_bytes.sort();
                let secs = |n_bytes: usize| n_bytes as f64 / bytes_per_sec;
                let (median, most) = (
                    secs(n_bytes[n_bytes.len() / 2]),
                    secs(n_bytes[n_bytes.len() - 1]),
                );
                eprintln!(
                    "{} Mbit/s {name}: median {median:.3} s, most {most:.3} s",
                    bytes_per_sec * 8e-6
                );
                assert!(
                    median < MAX_MEDIAN_SECS,
                    "at {bytes_per_sec} bytes/s {name}: {n_bytes:?} bytes before replies"
                );
            }
        }
    });
}
