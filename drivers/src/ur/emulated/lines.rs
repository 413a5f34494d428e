//! Clients that send lines of text: of the dashboard server and of the script interface.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

/// Maximum size of a text that is not complete. Programs have some kilobytes.
const MAX_BYTES: usize = 1 << 16;
/// Bytes to receive at once.
const RECEIVE_BYTES: usize = 4096;

/// A listener with its clients. All sockets are in non-blocking mode.
#[derive(Debug)]
pub(super) struct LineServer {
    listener: TcpListener,
    /// Text that each client receives first.
    greeting: &'static str,
    clients: Vec<LineClient>,
}

#[derive(Debug)]
struct LineClient {
    stream: TcpStream,
    received: Vec<u8>,
    is_closed: bool,
}

impl LineServer {
    pub(super) fn new(listener: TcpListener, greeting: &'static str) -> Self {
        Self {
            listener,
            greeting,
            clients: Vec::new(),
        }
    }

    /// Serves all clients. `take` removes complete texts from the received text of a client, and
    /// returns the answers.
    pub(super) fn serve(&mut self, mut take: impl FnMut(&mut Vec<u8>) -> String) {
        while let Ok((stream, _)) = self.listener.accept() {
            let mut client = LineClient {
                stream,
                received: Vec::new(),
                is_closed: false,
            };
            client.is_closed = client.stream.set_nonblocking(true).is_err();
            client.send(self.greeting);
            self.clients.push(client);
        }
        for client in &mut self.clients {
            client.receive();
            // A client may send its text and close the connection at once.
            let answers = take(&mut client.received);
            client.send(&answers);
        }
        self.clients.retain(|client| !client.is_closed);
    }
}

impl LineClient {
    fn receive(&mut self) {
        let mut bytes = [0; RECEIVE_BYTES];
        while !self.is_closed {
            match self.stream.read(&mut bytes) {
                Ok(0) => self.is_closed = true,
                Ok(n) => self.received.extend_from_slice(&bytes[..n]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => self.is_closed = true,
            }
            self.is_closed |= self.received.len() > MAX_BYTES;
        }
    }

    fn send(&mut self, text: &str) {
        self.is_closed |= !text.is_empty() && self.stream.write_all(text.as_bytes()).is_err();
    }
}

/// Removes the first line, with its end.
pub(super) fn take_line(received: &mut Vec<u8>) -> Option<String> {
    let n = received.iter().position(|byte| *byte == b'\n')? + 1;
    let line: Vec<u8> = received.drain(..n).collect();
    Some(String::from_utf8_lossy(&line).into_owned())
}

/// Removes the first program, which ends with an `end` that is not indented.
pub(super) fn take_program(received: &mut Vec<u8>) -> Option<String> {
    const END: &[u8] = b"\nend\n";
    let start = received.windows(END.len()).position(|part| part == END)?;
    let program: Vec<u8> = received.drain(..start + END.len()).collect();
    Some(String::from_utf8_lossy(&program).into_owned())
}
