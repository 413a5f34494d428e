//! A TCP proxy that imitates a wireless link: limited rate, delay, and delayed segments. The link
//! can be cut: connections stay open, but nothing passes until it is restored.

use crate::slow::connect_with_buffer;
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Segments that the link buffers in each direction.
const MAX_SEGMENTS: usize = 256;
const SEGMENT_BYTES: usize = 1460;
/// Receive buffer of the link towards the server.
const RECEIVE_BUFFER_BYTES: usize = 65_536;

/// Properties of a link, the same in both directions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Link {
    /// Data rate.
    pub(crate) bytes_per_sec: f64,
    /// Time from one end to the other.
    pub(crate) delay: Duration,
    /// Every segment with this number is delayed, and so are the segments behind it.
    pub(crate) slow_period: usize,
    /// Additional delay of slow segments.
    pub(crate) slow_delay: Duration,
}

/// Its threads end with the process or their connections.
pub(crate) struct Proxy {
    address: SocketAddr,
    is_cut: Arc<AtomicBool>,
}

impl Proxy {
    /// Forwards connections to `server`.
    pub(crate) fn start(server: SocketAddr, link: Link) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
        let address = listener.local_addr().expect("bound");
        let is_cut: Arc<AtomicBool> = Arc::default();
        let is_cut_here = Arc::clone(&is_cut);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = connect_with_buffer(server, RECEIVE_BUFFER_BYTES) else {
                    continue;
                };
                let ends =
                    [&client, &server].map(|stream| stream.try_clone().expect("a descriptor"));
                let [client_too, server_too] = ends;
                for (from, to) in [(client, server_too), (server, client_too)] {
                    let (send, receive) = sync_channel(MAX_SEGMENTS);
                    std::thread::spawn(move || receive_segments(from, link, &send));
                    let is_cut = Arc::clone(&is_cut_here);
                    std::thread::spawn(move || deliver_segments(to, &receive, &is_cut));
                }
            }
        });
        Self { address, is_cut }
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    pub(crate) fn cut(&self) {
        self.is_cut.store(true, Ordering::Relaxed);
    }

    pub(crate) fn restore(&self) {
        self.is_cut.store(false, Ordering::Relaxed);
    }
}

/// Bytes, and when they arrive at the other end.
type Segment = (Instant, Vec<u8>);

fn receive_segments(mut from: TcpStream, link: Link, to: &SyncSender<Segment>) {
    let mut bytes = [0; SEGMENT_BYTES];
    let (mut sent, mut arrives) = (Instant::now(), Instant::now());
    for number in 1_usize.. {
        let n = from.read(&mut bytes).unwrap_or(0);
        if n == 0 {
            return;
        }
        sent = sent.max(Instant::now()) + Duration::from_secs_f64(n as f64 / link.bytes_per_sec);
        let slow = if number % link.slow_period == 0 {
            link.slow_delay
        } else {
            Duration::ZERO
        };
        arrives = arrives.max(sent + link.delay + slow);
        if to.send((arrives, bytes[..n].to_vec())).is_err() {
            return;
        }
    }
}

fn deliver_segments(mut to: TcpStream, segments: &Receiver<Segment>, is_cut: &AtomicBool) {
    for (arrives, bytes) in segments {
        std::thread::sleep(arrives.saturating_duration_since(Instant::now()));
        while is_cut.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(5));
        }
        if to.write_all(&bytes).is_err() {
            break;
        }
    }
    // Fails if the other side has already closed this end, which is harmless.
    let _ = to.shutdown(Shutdown::Both);
}
