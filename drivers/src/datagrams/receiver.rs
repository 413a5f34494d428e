//! A UDP socket read by a separate thread that stamps datagrams on arrival.

use super::silence::{self, Silence};
use crate::{Error, clock};
use kinematics::Stamp;
use parking_lot::{Condvar, Mutex};
use std::collections::VecDeque;
use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Capacity of the queue in bytes. If the queue would exceed this capacity, the oldest datagram is
/// dropped. The limit counts bytes instead of datagrams, because a part of a scan is a hundred
/// times as long as a joint state.
const MAX_WAITING_BYTES: usize = 16 << 20;
/// Approximate memory use of a datagram in addition to its bytes. Because of it, empty datagrams
/// count, too.
const OVERHEAD_BYTES: usize = 128;
/// Maximum length of a datagram.
const MAX_DATAGRAM_BYTES: usize = 65_536;
/// Maximum age of a datagram at the first read. Older datagrams are discarded, because they arrived
/// while other devices were still being opened.
const MAX_BUFFERED_AGE: Duration = Duration::from_millis(200);
/// Interval at which the thread checks whether it has to stop.
const POLL: Duration = Duration::from_millis(100);

/// A datagram with its arrival time and sender.
pub(crate) struct ReceivedDatagram {
    pub(crate) at: Stamp,
    pub(crate) from: SocketAddr,
    pub(crate) bytes: Vec<u8>,
    /// Number of datagrams dropped before this one.
    pub(crate) n_dropped: u64,
}

/// A bound socket and its thread; dropping it frees the port.
#[derive(Debug)]
pub(crate) struct Receiver {
    device: String,
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    arrived: Condvar,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<(Stamp, SocketAddr, Vec<u8>)>,
    n_bytes: usize,
    n_dropped: u64,
    error: Option<std::io::Error>,
    /// Whether a datagram was requested yet.
    has_reader: bool,
    silence: Silence,
    stop: bool,
}

impl Receiver {
    /// Listens. With port 0, a free port is used. `device` is the name of the device in messages.
    pub(crate) fn open(device: String, address: SocketAddr) -> Result<Self, Error> {
        let bound = UdpSocket::bind(address).and_then(|socket| {
            socket.set_read_timeout(Some(POLL))?;
            Ok((socket.local_addr()?, socket))
        });
        let (address, socket) = match bound {
            Ok(bound) => bound,
            Err(source) => {
                return Err(Error::Listen {
                    device,
                    address,
                    source,
                });
            }
        };
        if !address.ip().is_loopback() {
            log::warn!(
                "{device}: any program that can reach {address} can send data to it, because datagrams are not authenticated"
            );
        }
        let shared = Arc::new(Shared::default());
        let reading = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name(device.clone())
            .spawn(move || reading.read(&socket));
        match thread {
            Ok(thread) => Ok(Self {
                device,
                address,
                shared,
                thread: Some(thread),
            }),
            Err(source) => Err(Error::Thread { device, source }),
        }
    }

    /// Address it listens on.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Name of the device in messages.
    pub(crate) fn device(&self) -> &str {
        &self.device
    }

    /// Returns the oldest queued datagram. Returns `None` if no datagram arrives before the time
    /// `until`.
    pub(crate) fn next(&self, until: Instant) -> Result<Option<ReceivedDatagram>, Error> {
        let mut state = self.shared.state.lock();
        // Old datagrams are discarded. Otherwise, the first read would return a burst of old
        // values, and the clock map would start with their delays.
        if !std::mem::replace(&mut state.has_reader, true) {
            state.discard_before(clock::now() - MAX_BUFFERED_AGE);
        }
        loop {
            if let Some((at, from, bytes)) = state.queue.pop_front() {
                state.silence.end();
                state.n_bytes -= bytes.len() + OVERHEAD_BYTES;
                return Ok(Some(ReceivedDatagram {
                    at,
                    from,
                    bytes,
                    n_dropped: std::mem::take(&mut state.n_dropped),
                }));
            }
            // Datagrams that arrived before the error are returned first.
            if let Some(source) = state.error.take() {
                return Err(Error::Network {
                    device: self.device.clone(),
                    source,
                });
            }
            let remaining = until.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                if state.silence.is_news(Instant::now()) {
                    log::warn!("{}", silence::advice(&self.device, self.address));
                }
                return Ok(None);
            }
            self.shared.arrived.wait_for(&mut state, remaining);
        }
    }
}

impl Shared {
    fn read(&self, socket: &UdpSocket) {
        let mut buffer = vec![0; MAX_DATAGRAM_BYTES];
        loop {
            let received = socket.recv_from(&mut buffer);
            // The time is taken before the lock, so that a reader that holds the lock does not
            // delay the stamp.
            let at = clock::now();
            let mut state = self.state.lock();
            if state.stop {
                return;
            }
            match received {
                Ok((n, from)) => state.put(at, from, buffer[..n].to_vec()),
                Err(error)
                    if matches!(
                        error.kind(),
                        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                    ) =>
                {
                    continue;
                }
                Err(error) => {
                    state.error = Some(error);
                    self.arrived.notify_all();
                    return;
                }
            }
            self.arrived.notify_all();
        }
    }
}

impl State {
    fn discard_before(&mut self, begin: Stamp) {
        while self.queue.front().is_some_and(|(at, ..)| *at < begin)
            && let Some((.., discarded)) = self.queue.pop_front()
        {
            self.n_bytes -= discarded.len() + OVERHEAD_BYTES;
        }
        // Datagrams that were dropped before the first read do not count, because the caller was
        // not slow.
        self.n_dropped = 0;
    }

    fn put(&mut self, at: Stamp, from: SocketAddr, bytes: Vec<u8>) {
        self.n_bytes += bytes.len() + OVERHEAD_BYTES;
        self.queue.push_back((at, from, bytes));
        while self.n_bytes > MAX_WAITING_BYTES
            && let Some((.., oldest)) = self.queue.pop_front()
        {
            self.n_bytes -= oldest.len() + OVERHEAD_BYTES;
            self.n_dropped += 1;
        }
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.shared.state.lock().stop = true;
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    const SENDER: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 7);

    #[test]
    fn datagrams_before_first_read_are_discarded_by_age() {
        let mut state = State {
            n_dropped: 3,
            ..State::default()
        };
        (0..10).for_each(|ix| state.put(Stamp(ix), SENDER, vec![0; 5]));
        state.discard_before(Stamp(7));
        assert_eq!(
            (state.queue.len(), state.n_bytes, state.n_dropped),
            (3, 3 * (5 + OVERHEAD_BYTES), 0)
        );
        state.discard_before(Stamp(100));
        assert_eq!((state.queue.len(), state.n_bytes), (0, 0));
    }

    #[test]
    fn slow_caller_drops_oldest_and_memory_is_bounded() {
        let mut state = State::default();
        for ix in 0..1000 {
            state.put(Stamp(ix), SENDER, vec![0; 60_000]);
            assert!(state.n_bytes <= MAX_WAITING_BYTES);
        }
        let n_left = state.queue.len();
        assert_eq!(n_left as u64 + state.n_dropped, 1000);
        assert_eq!(state.queue.back().expect("the newest").0, Stamp(999));
        for ix in 0..1_000_000 {
            state.put(Stamp(ix), SENDER, Vec::new());
        }
        assert!(
            state.queue.len() <= MAX_WAITING_BYTES / OVERHEAD_BYTES,
            "the number of empty datagrams is limited, too"
        );
    }
}
