//! Records what a server sends to a page, and plays it to another page.

use serde_json::{Value, json};
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Opcodes of WebSocket frames.
const TEXT: u8 = 1;
const BINARY: u8 = 2;

/// Bytes, and when they were received.
type Chunk = (Instant, Vec<u8>);

/// A proxy that records the bytes of each connection from the server.
pub(crate) struct RecordingProxy {
    address: SocketAddr,
    connections: Arc<Mutex<Vec<Vec<Chunk>>>>,
}

impl RecordingProxy {
    /// Forwards connections to `server`. Its threads end with the process or their connections.
    pub(crate) fn start(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
        let address = listener.local_addr().expect("bound");
        let connections: Arc<Mutex<Vec<Vec<Chunk>>>> = Arc::default();
        let recorded = Arc::clone(&connections);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = TcpStream::connect(server) else {
                    continue;
                };
                let [client_too, server_too] =
                    [&client, &server].map(|stream| stream.try_clone().expect("a descriptor"));
                std::thread::spawn(move || forward(client, server_too, |_| ()));
                let ix = {
                    let mut connections = recorded.lock().expect("no panic");
                    connections.push(Vec::new());
                    connections.len() - 1
                };
                let recorded = Arc::clone(&recorded);
                std::thread::spawn(move || {
                    forward(server, client_too, |bytes| {
                        recorded.lock().expect("no panic")[ix]
                            .push((Instant::now(), bytes.to_vec()));
                    });
                });
            }
        });
        Self {
            address,
            connections,
        }
    }

    /// URL of the page through the proxy.
    pub(crate) fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// The messages of the only WebSocket.
    pub(crate) fn session(&self) -> Session {
        let connections = self.connections.lock().expect("no panic");
        let is_websocket = |chunks: &&Vec<Chunk>| {
            chunks
                .first()
                .is_some_and(|(_, bytes)| bytes.starts_with(b"HTTP/1.1 101"))
        };
        let mut sockets = connections.iter().filter(is_websocket);
        let session = Session::parse(sockets.next().expect("a WebSocket"));
        assert!(sockets.next().is_none(), "the page connected again");
        session
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, mut record: impl FnMut(&[u8])) {
    let mut bytes = vec![0; 1 << 16];
    while let Some(n) = from.read(&mut bytes).ok().filter(|n| *n > 0) {
        record(&bytes[..n]);
        if to.write_all(&bytes[..n]).is_err() {
            break;
        }
    }
    // Fails if the other side has already closed this end, which is harmless.
    let _ = to.shutdown(Shutdown::Both);
}

/// The messages from a server to a page.
#[derive(Clone)]
pub(crate) struct Session {
    /// Each message and when it was complete, since the first one.
    messages: Arc<[(Duration, Message)]>,
    /// The server's clock at the first message, milliseconds.
    clock_millis: f64,
}

impl Session {
    /// The server sends each message as one frame, without mask.
    fn parse(chunks: &[Chunk]) -> Self {
        let bytes: Vec<u8> = chunks
            .iter()
            .flat_map(|(_, bytes)| bytes)
            .copied()
            .collect();
        // The time at which the byte with this index was received.
        let time_of = |ix: usize| {
            let mut end = 0;
            let is_inside = |(_, bytes): &&Chunk| {
                end += bytes.len();
                ix < end
            };
            chunks.iter().find(is_inside).expect("a received byte").0
        };
        let head = bytes
            .windows(4)
            .position(|window| window == b"\r\n\r\n")
            .expect("the end of the handshake");
        let (mut at, mut timed) = (head + 4, Vec::new());
        while let Some((opcode, payload)) = frame(&bytes[at..]) {
            let end = payload.as_ptr_range().end as usize - bytes.as_ptr() as usize;
            match opcode {
                TEXT => timed.push((
                    time_of(end - 1),
                    Message::text(String::from_utf8(payload.to_vec()).expect("UTF-8")),
                )),
                BINARY => timed.push((time_of(end - 1), Message::binary(payload.to_vec()))),
                _ => {}
            }
            at = end;
        }
        let began = timed.first().expect("a hello").0;
        let messages: Arc<[_]> = timed
            .into_iter()
            .map(|(time, message)| (time - began, message))
            .collect();
        let hello = texts(&messages).next().expect("a hello");
        assert_eq!(hello["type"], "hello");
        let clock_millis = hello["clock_millis"].as_f64().expect("a time");
        Self {
            messages,
            clock_millis,
        }
    }

    pub(crate) fn duration(&self) -> Duration {
        self.messages.last().expect("messages").0
    }

    /// The text messages.
    pub(crate) fn texts(&self) -> impl Iterator<Item = Value> {
        texts(&self.messages)
    }

    /// Headers and payloads of the binary messages of a type, joined if they were sent in parts.
    pub(crate) fn binaries(&self, kind: &str) -> Vec<(Value, Vec<u8>)> {
        let (mut joined, mut found) = (Vec::new(), Vec::new());
        for (_, message) in self.messages.iter() {
            let Message::Binary(bytes) = message else {
                continue;
            };
            let (mut header, mut payload) = unframed(bytes);
            if header["type"] == "part" {
                joined.extend(payload);
                if header["bytes"] != joined.len() {
                    continue;
                }
                (header, payload) = unframed(&std::mem::take(&mut joined));
            }
            if header["type"] == kind {
                found.push((header, payload));
            }
        }
        found
    }

    /// Plays the session to a page at a multiple of its speed, then keeps the connection open until
    /// `is_over`. Answers pings on the clock of the session.
    pub(crate) fn play(&self, mut socket: WebSocket<TcpStream>, speed: f64, is_over: &AtomicBool) {
        socket
            .get_ref()
            .set_read_timeout(Some(Duration::from_millis(1)))
            .expect("a timeout");
        let began = Instant::now();
        let elapsed = || began.elapsed().mul_f64(speed);
        let is_played =
            |message: &Message| !matches!(message, Message::Text(text) if is_own_answer(text));
        let mut rest = self
            .messages
            .iter()
            .filter(|(_, message)| is_played(message))
            .peekable();
        while !is_over.load(Ordering::Relaxed) {
            while let Some((_, message)) = rest.next_if(|(at, _)| *at <= elapsed()) {
                if socket.send(message.clone()).is_err() {
                    return; // The page was closed.
                }
            }
            let clock_millis = self.clock_millis + elapsed().as_secs_f64() * 1e3;
            let answer = match socket.read() {
                Ok(Message::Text(text)) => answer_to(&text, clock_millis),
                Ok(_) => None,
                Err(tungstenite::Error::Io(error))
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) =>
                {
                    None
                }
                Err(_) => return,
            };
            if answer.is_some_and(|answer| socket.send(answer).is_err()) {
                return;
            }
        }
    }
}

/// Whether a recorded message must not be played, because it is replaced or would end the
/// connection.
fn is_own_answer(text: &str) -> bool {
    let message: Value = serde_json::from_str(text).expect("JSON");
    ["pong", "goodbye"]
        .iter()
        .any(|kind| message["type"] == *kind)
}

fn answer_to(text: &str, clock_millis: f64) -> Option<Message> {
    let message: Value = serde_json::from_str(text).expect("JSON");
    let pong = json!({"type": "pong", "t": message["t"], "clock_millis": clock_millis});
    (message["type"] == "ping").then(|| Message::text(pong.to_string()))
}

fn texts(messages: &[(Duration, Message)]) -> impl Iterator<Item = Value> {
    messages.iter().filter_map(|(_, message)| match message {
        Message::Text(text) => Some(serde_json::from_str(text).expect("JSON")),
        _ => None,
    })
}

/// Opcode and payload of the frame at the beginning; `None` if it is not complete.
fn frame(bytes: &[u8]) -> Option<(u8, &[u8])> {
    let opcode = bytes.first()? & 0x0f;
    let (begin, n) = match bytes.get(1)? {
        126 => (
            4,
            usize::from(u16::from_be_bytes(bytes.get(2..4)?.try_into().ok()?)),
        ),
        127 => (
            10,
            usize::try_from(u64::from_be_bytes(bytes.get(2..10)?.try_into().ok()?)).ok()?,
        ),
        n => (2, usize::from(*n)),
    };
    Some((opcode, bytes.get(begin..begin + n)?))
}

/// Header and payload of a binary message.
fn unframed(bytes: &[u8]) -> (Value, Vec<u8>) {
    let (length, rest) = bytes.split_first_chunk().expect("a length");
    let (header, payload) = rest.split_at(u32::from_le_bytes(*length) as usize);
    (
        serde_json::from_slice(header).expect("a JSON header"),
        payload.to_vec(),
    )
}
