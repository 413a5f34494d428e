//! A blocking WebSocket client.

use serde_json::Value;
use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Far more than the server needs on two busy cores.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(60);

/// A connection to the server under test.
pub(crate) struct Client {
    socket: WebSocket<TcpStream>,
    /// The parts of a binary message received so far.
    joined: Vec<u8>,
    /// Bytes of all messages received so far.
    n_received: usize,
    /// The server has said that it closes the connection.
    is_closing: bool,
}

/// One message from the server.
#[derive(Debug, PartialEq)]
pub(crate) enum Received {
    /// JSON text.
    Text(Value),
    /// JSON header and payload.
    Binary(Value, Vec<u8>),
    /// The connection is closed.
    End,
}

impl Client {
    pub(crate) fn connect(address: SocketAddr) -> Self {
        Self::over(
            TcpStream::connect(address).expect("the server listens"),
            address,
        )
    }

    /// A client that uses this connection.
    pub(crate) fn over(stream: TcpStream, address: SocketAddr) -> Self {
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let (socket, _) =
            tungstenite::client(format!("ws://{address}/ws"), stream).expect("a WebSocket");
        Self {
            socket,
            joined: Vec::new(),
            n_received: 0,
            is_closing: false,
        }
    }

    /// Bytes of all messages received so far, without WebSocket headers.
    pub(crate) fn n_received(&self) -> usize {
        self.n_received
    }

    /// Bytes that have arrived so far. They include those that the kernel holds for this client.
    pub(crate) fn n_arrived(&self) -> usize {
        self.n_received + n_unread(self.socket.get_ref())
    }

    pub(crate) fn send_json(&mut self, message: &Value) {
        self.send_raw(Message::text(message.to_string()));
    }

    pub(crate) fn send_raw(&mut self, message: Message) {
        self.socket.send(message).expect("sent");
    }

    /// Waits until the server has read all messages sent so far.
    pub(crate) fn settle(&mut self) {
        self.send_raw(Message::text("settle?"));
        self.text_of("error");
    }

    pub(crate) fn receive(&mut self) -> Received {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => {
                    self.n_received += text.len();
                    return Received::Text(serde_json::from_str(&text).expect("JSON"));
                }
                Ok(Message::Binary(bytes)) => {
                    self.n_received += bytes.len();
                    match unframe(&bytes) {
                        Received::Binary(header, part) if header["type"] == "part" => {
                            assert_eq!(
                                header["offset"].as_u64(),
                                u64::try_from(self.joined.len()).ok(),
                                "in order"
                            );
                            self.joined.extend(part);
                            if header["bytes"].as_u64() == u64::try_from(self.joined.len()).ok() {
                                return unframe(&std::mem::take(&mut self.joined));
                            }
                        }
                        whole => return whole,
                    }
                }
                Ok(Message::Close(_)) => self.is_closing = true,
                Ok(_) => {}
                Err(tungstenite::Error::ConnectionClosed | tungstenite::Error::Protocol(_)) => {
                    return Received::End;
                }
                // The server has closed the connection before the reply to its close frame.
                Err(tungstenite::Error::Io(error))
                    if error.kind() == ErrorKind::BrokenPipe
                        || self.is_closing && error.kind() == ErrorKind::ConnectionReset =>
                {
                    return Received::End;
                }
                Err(error) => panic!("the connection broke: {error}"),
            }
        }
    }

    /// The next message if it is text.
    pub(crate) fn text(&mut self) -> Value {
        match self.receive() {
            Received::Text(value) => value,
            other => panic!("expected text, got {other:?}"),
        }
    }

    /// The next text message of a type.
    pub(crate) fn text_of(&mut self, kind: &str) -> Value {
        self.receive_until(|received| match received {
            Received::Text(value) if value["type"] == kind => Some(value),
            Received::End => panic!("the connection ended before a {kind:?} message arrived"),
            _ => None,
        })
    }

    /// The next binary message of a type.
    pub(crate) fn binary_of(&mut self, kind: &str) -> (Value, Vec<u8>) {
        self.receive_until(|received| match received {
            Received::Binary(header, payload) if header["type"] == kind => Some((header, payload)),
            Received::Text(value) if value["type"] == "error" => panic!("{value}"),
            Received::End => panic!("the connection ended before a {kind:?} message arrived"),
            _ => None,
        })
    }

    fn receive_until<T>(&mut self, mut matcher: impl FnMut(Received) -> Option<T>) -> T {
        let deadline = Instant::now() + TIMEOUT + Duration::from_secs(1);
        while Instant::now() < deadline {
            if let Some(found) = matcher(self.receive()) {
                return found;
            }
        }
        panic!("the expected message did not arrive");
    }
}

/// Bytes that have arrived over a connection but were not read yet.
pub(crate) fn n_unread(stream: &TcpStream) -> usize {
    let n_bytes = rustix::io::ioctl_fionread(stream).expect("a number of bytes");
    n_bytes.try_into().expect("fits in memory")
}

fn unframe(bytes: &[u8]) -> Received {
    let (length, rest) = bytes.split_at(4);
    let n_header = u32::from_le_bytes(length.try_into().expect("4 bytes")) as usize;
    let (header, payload) = rest.split_at(n_header);
    Received::Binary(
        serde_json::from_slice(header).expect("a JSON header"),
        payload.to_vec(),
    )
}

/// The bytes of one output of a picture.
pub(crate) fn part<'a>(header: &Value, output: &str, payload: &'a [u8]) -> &'a [u8] {
    let number = |name: &str| {
        let number = header[output][name]
            .as_u64()
            .and_then(|n| usize::try_from(n).ok());
        number.unwrap_or_else(|| panic!("{output}.{name} in {header}"))
    };
    &payload[number("offset")..number("offset") + number("bytes")]
}
