//! A WebSocket of a client on this computer (RFC 6455).
//!
//! It runs in the measured process, so it does only what the benches need: each message of the
//! server is one frame, and the mask of the client is zero.

use anyhow::{Context, Result, anyhow, ensure};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};

pub(crate) const TEXT: u8 = 1;
pub(crate) const BINARY: u8 = 2;
pub(crate) const CLOSE: u8 = 8;
pub(crate) const PING: u8 = 9;
pub(crate) const PONG: u8 = 10;

/// Receives the frames of the server.
pub(crate) struct Receiver(BufReader<TcpStream>);

/// Sends frames to the server.
pub(crate) struct Sender(TcpStream);

/// Opens a WebSocket on a connection, such as `/ws` of a server.
pub(crate) fn open(stream: &TcpStream, host: SocketAddr, path: &str) -> Result<(Receiver, Sender)> {
    // Browsers also disable the delay of small packets. With the delay, a request after a report
    // would wait up to 40 ms for an acknowledgment.
    stream
        .set_nodelay(true)
        .context("cannot set an option of a connection")?;
    let clone = || stream.try_clone().context("cannot share a connection");
    let mut receiver = Receiver(BufReader::new(clone()?));
    let mut sender = Sender(clone()?);
    write!(
        sender.0,
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )?;
    receiver.read_response()?;
    Ok((receiver, sender))
}

impl Receiver {
    fn read_response(&mut self) -> Result<()> {
        let mut line = String::new();
        self.0.read_line(&mut line)?;
        ensure!(
            line.starts_with("HTTP/1.1 101"),
            "the server responded {:?}, expected a WebSocket",
            line.trim_end()
        );
        // The headers end with an empty line.
        while line.trim_end() != "" {
            line.clear();
            ensure!(
                self.0.read_line(&mut line)? > 0,
                "the server closed the connection"
            );
        }
        Ok(())
    }

    /// Opcode and length of the next frame. The server sends each message as one frame.
    pub(crate) fn next_frame(&mut self) -> Result<(u8, u64)> {
        let mut head = [0; 2];
        self.0.read_exact(&mut head)?;
        let is_final = head[0] & 0x80 != 0;
        ensure!(
            is_final,
            "the server sent a fragmented message, expected one frame per message"
        );
        // According to RFC 6455, section 5.2, lengths from 126 on are in the next 2 or 8 bytes. The
        // highest bit of this byte marks a mask, which only clients use.
        let n_bytes = match head[1] {
            126 => {
                let mut bytes = [0; 2];
                self.0.read_exact(&mut bytes)?;
                u64::from(u16::from_be_bytes(bytes))
            }
            127 => {
                let mut bytes = [0; 8];
                self.0.read_exact(&mut bytes)?;
                u64::from_be_bytes(bytes)
            }
            short @ 0..126 => u64::from(short),
            masked => {
                return Err(anyhow!(
                    "the server sent a masked frame (length byte {masked})"
                ));
            }
        };
        Ok((head[0] & 0x0f, n_bytes))
    }

    /// The contents of a frame of this length.
    pub(crate) fn contents(&mut self, n_bytes: u64) -> Result<Vec<u8>> {
        let mut contents = Vec::new();
        let n_read = (&mut self.0).take(n_bytes).read_to_end(&mut contents)?;
        ensure!(
            n_read as u64 == n_bytes,
            "the server closed the connection within a message"
        );
        Ok(contents)
    }

    /// Discards the contents of a frame of this length.
    pub(crate) fn skip(&mut self, n_bytes: u64) -> Result<()> {
        let n_skipped = std::io::copy(&mut (&mut self.0).take(n_bytes), &mut std::io::sink())?;
        ensure!(
            n_skipped == n_bytes,
            "the server closed the connection within a message"
        );
        Ok(())
    }
}

impl Sender {
    /// Sends a frame. The protocol requires a mask to protect proxies. The mask is zero, because
    /// there is no proxy on loopback.
    pub(crate) fn send(&mut self, opcode: u8, contents: &[u8]) -> Result<()> {
        let mut frame = vec![0x80 | opcode];
        match u8::try_from(contents.len()) {
            Ok(n @ 0..126) => frame.push(0x80 | n),
            _ => {
                frame.push(0x80 | 126);
                let too_long = |_| {
                    anyhow!(
                        "a message of {} bytes, expected at most 65535",
                        contents.len()
                    )
                };
                frame.extend(
                    u16::try_from(contents.len())
                        .map_err(too_long)?
                        .to_be_bytes(),
                );
            }
        }
        frame.extend([0; 4]);
        frame.extend(contents);
        Ok(self.0.write_all(&frame)?)
    }
}
