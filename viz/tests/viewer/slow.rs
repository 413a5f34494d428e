//! A connection whose client reads at a limited rate.

use crate::client::{TIMEOUT, n_unread};
use rustix::net::sockopt::set_socket_recv_buffer_size;
use rustix::net::{AddressFamily, SocketType, socket};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Receive buffer of a slow client.
const RECEIVE_BUFFER_BYTES: usize = 8192;
const MAX_READ_BYTES: usize = 4096;

/// Connects with a receive buffer of this size. It is set before the connection is opened.
/// Otherwise, the kernel sends segments of 64 kB over loopback, in bursts that no other link has,
/// and enlarges the buffer to megabytes.
pub(crate) fn connect_with_buffer(
    address: SocketAddr,
    n_bytes: usize,
) -> std::io::Result<TcpStream> {
    let socket = socket(AddressFamily::INET, SocketType::STREAM, None)?;
    set_socket_recv_buffer_size(&socket, n_bytes)?;
    rustix::net::connect(&socket, &address)?;
    Ok(TcpStream::from(socket))
}

/// Reads at a limited rate, and counts what it reads.
pub(crate) struct Slow {
    stream: TcpStream,
    bytes_per_sec: f64,
    n_read: Arc<AtomicUsize>,
}

/// Counts the bytes of a slow connection. Tests count bytes before a reply instead of time, because
/// the computer may be busy.
pub(crate) struct Counter {
    stream: TcpStream,
    n_read: Arc<AtomicUsize>,
}

impl Slow {
    pub(crate) fn connect(address: SocketAddr, bytes_per_sec: f64) -> Self {
        let stream =
            connect_with_buffer(address, RECEIVE_BUFFER_BYTES).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        Self {
            stream,
            bytes_per_sec,
            n_read: Arc::default(),
        }
    }

    pub(crate) fn counter(&self) -> Counter {
        Counter {
            stream: self.descriptor(),
            n_read: Arc::clone(&self.n_read),
        }
    }

    /// Another descriptor of the same connection.
    pub(crate) fn descriptor(&self) -> TcpStream {
        self.stream.try_clone().expect("a descriptor")
    }
}

impl Counter {
    /// Bytes that the client has read.
    pub(crate) fn n_read(&self) -> usize {
        self.n_read.load(Ordering::Relaxed)
    }

    /// Bytes that have arrived: those that the client has read, and those that the kernel holds for
    /// it.
    pub(crate) fn n_arrived(&self) -> usize {
        self.n_read() + n_unread(&self.stream)
    }
}

impl Read for Slow {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        let n_max = bytes.len().min(MAX_READ_BYTES);
        let n = self.stream.read(&mut bytes[..n_max])?;
        std::thread::sleep(Duration::from_secs_f64(n as f64 / self.bytes_per_sec));
        self.n_read.fetch_add(n, Ordering::Relaxed);
        Ok(n)
    }
}

impl Write for Slow {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.stream.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.stream.flush()
    }
}
