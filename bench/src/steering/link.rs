//! A connection on this computer that can be cut, and that can lose packets.
//!
//! It forwards what a client and a server send. A socket on this computer loses nothing, and only
//! an administrator could make it do so. The link therefore delays what TCP would deliver late: a
//! lost packet is sent again after the packets behind it have shown the loss (RFC 5681, section
//! 3.2), and everything behind it waits. If it is lost again, the sender waits for its timeout.

use anyhow::{Context, Result};
use numbers::random::{Random, nth_bits};
use parking_lot::Mutex;
use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Delay of a packet that was lost once: three more packets at 90 Hz.
const FAST_RETRANSMIT: Duration = Duration::from_millis(33);
/// Further delay of a packet that was lost again: the minimum timeout of Linux.
const TIMEOUT: Duration = Duration::from_millis(200);
/// Time between two looks at whether the link is connected again.
const POLL: Duration = Duration::from_millis(1);
/// Size of a buffer. Messages of clients have at most 4096 bytes.
const BUFFER_BYTES: usize = 16 << 10;

/// Faults of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct LinkFault {
    /// Whether messages are lost in both directions without notice, as with an unplugged cable.
    pub(super) is_cut: bool,
    /// Fraction of the packets that are lost, 0 to 1.
    pub(super) loss_frac: f64,
    /// Time that every packet takes, in both directions.
    pub(super) delay: Duration,
}

/// A link to a server. Dropping it ends the connection.
pub(super) struct Link {
    /// The client's end.
    stream: TcpStream,
    fault: Arc<Mutex<LinkFault>>,
}

impl Link {
    /// Connects to a server.
    ///
    /// # Errors
    ///
    /// If the server does not accept the connection, or a thread cannot be started.
    pub(super) fn open(server: SocketAddr, seed: u64) -> Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))
            .context("cannot listen on this computer")?;
        let address = listener.local_addr().context("a socket has no address")?;
        let stream = connect(address)?;
        let (client_end, _) = listener.accept().context("cannot accept a connection")?;
        client_end
            .set_nodelay(true)
            .context("cannot set an option of a connection")?;
        let server_end = connect(server)?;
        let fault = Arc::<Mutex<LinkFault>>::default();
        let directions = [(0, &client_end, &server_end), (1, &server_end, &client_end)];
        for (ix, from, to) in directions {
            let clone =
                |stream: &TcpStream| stream.try_clone().context("cannot share a connection");
            let (packets, waiting) = sync_channel(MAX_PACKETS);
            let direction = Direction {
                from: clone(from)?,
                packets,
                fault: Arc::clone(&fault),
                random: Random::new(nth_bits(seed, ix)),
                delivered_by: Instant::now(),
            };
            spawn("link", move || direction.receive())?;
            let (to, fault) = (clone(to)?, Arc::clone(&fault));
            spawn("link", move || deliver(to, &waiting, &fault))?;
        }
        Ok(Self { stream, fault })
    }

    /// The client's end.
    pub(super) fn stream(&self) -> &TcpStream {
        &self.stream
    }

    /// Sets the fault of the link.
    pub(super) fn set(&self, fault: LinkFault) {
        *self.fault.lock() = fault;
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        // Waiting packets are dropped. Errors mean that a side has ended.
        self.set(LinkFault::default());
        let _ = self.stream.shutdown(Shutdown::Both);
    }
}

fn connect(address: SocketAddr) -> Result<TcpStream> {
    let stream =
        TcpStream::connect(address).with_context(|| format!("cannot connect to {address}"))?;
    stream
        .set_nodelay(true)
        .context("cannot set an option of a connection")?;
    Ok(stream)
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Result<()> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(run)
        .context("cannot start a thread")?;
    Ok(())
}

/// Number of packets on the way in one direction. Above it, the sender waits, as it does when the
/// buffers of a real connection are full.
const MAX_PACKETS: usize = 256;

/// A packet, and when it arrives.
type Packet = (Instant, Vec<u8>);

/// One direction of a link.
struct Direction {
    from: TcpStream,
    packets: SyncSender<Packet>,
    fault: Arc<Mutex<LinkFault>>,
    random: Random,
    /// When the newest packet arrives. No packet overtakes another.
    delivered_by: Instant,
}

impl Direction {
    /// Takes packets until the sender ends.
    fn receive(mut self) {
        let mut buffer = vec![0; BUFFER_BYTES];
        while let Ok(n_bytes @ 1..) = self.from.read(&mut buffer) {
            let at = self.arrival();
            if self.packets.send((at, buffer[..n_bytes].to_vec())).is_err() {
                return;
            }
        }
    }

    fn arrival(&mut self) -> Instant {
        let LinkFault {
            loss_frac, delay, ..
        } = *self.fault.lock();
        let mut at = Instant::now() + delay;
        if self.random.unit() < loss_frac {
            at += FAST_RETRANSMIT;
            if self.random.unit() < loss_frac {
                at += TIMEOUT;
            }
        }
        self.delivered_by = self.delivered_by.max(at);
        self.delivered_by
    }
}

/// Delivers packets until either side ends. The end is delivered, too.
fn deliver(mut to: TcpStream, packets: &Receiver<Packet>, fault: &Mutex<LinkFault>) {
    for (at, bytes) in packets {
        std::thread::sleep(at.saturating_duration_since(Instant::now()));
        wait_while_cut(fault);
        if to.write_all(&bytes).is_err() {
            return;
        }
    }
    wait_while_cut(fault);
    // Fails if the other side has ended already.
    let _ = to.shutdown(Shutdown::Both);
}

fn wait_while_cut(fault: &Mutex<LinkFault>) {
    while fault.lock().is_cut {
        std::thread::sleep(POLL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A link to a server that returns what it gets.
    fn to_echo() -> Link {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
        let address = listener.local_addr().expect("an address");
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().expect("a client");
            let mut buffer = [0; 64];
            while let Ok(n_bytes @ 1..) = stream.read(&mut buffer) {
                stream.write_all(&buffer[..n_bytes]).expect("it is open");
            }
        });
        Link::open(address, 1).expect("it listens")
    }

    #[test]
    fn a_link_that_is_cut_delivers_nothing_until_it_is_connected_again() {
        let link = to_echo();
        let mut stream = link.stream().try_clone().expect("a connection");
        let mut reply = [0; 2];
        stream.write_all(b"ab").expect("sent");
        stream.read_exact(&mut reply).expect("a reply");
        assert_eq!(&reply, b"ab");

        link.set(LinkFault {
            is_cut: true,
            ..LinkFault::default()
        });
        stream.write_all(b"cd").expect("sent");
        let patience = Some(Duration::from_millis(50));
        stream.set_read_timeout(patience).expect("a timeout");
        assert!(stream.read_exact(&mut reply).is_err(), "nothing arrives");
        link.set(LinkFault::default());
        stream.set_read_timeout(None).expect("no timeout");
        stream.read_exact(&mut reply).expect("a reply");
        assert_eq!(&reply, b"cd");
    }

    #[test]
    fn a_slow_link_delivers_after_its_delay_in_each_direction() {
        const DELAY: Duration = Duration::from_millis(20);
        let link = to_echo();
        link.set(LinkFault {
            delay: DELAY,
            ..LinkFault::default()
        });
        let mut stream = link.stream().try_clone().expect("a connection");
        let began = Instant::now();
        stream.write_all(b"ab").expect("sent");
        let mut reply = [0; 2];
        stream.read_exact(&mut reply).expect("a reply");
        assert!(began.elapsed() >= 2 * DELAY && &reply == b"ab");
    }

    #[test]
    fn lost_packets_arrive_late_and_in_order() {
        let link = to_echo();
        link.set(LinkFault {
            loss_frac: 0.5,
            ..LinkFault::default()
        });
        let mut stream = link.stream().try_clone().expect("a connection");
        let sent: Vec<u8> = (0..20).collect();
        for byte in &sent {
            stream.write_all(&[*byte]).expect("sent");
        }
        let mut got = vec![0; sent.len()];
        stream.read_exact(&mut got).expect("all of them");
        assert_eq!(got, sent);
    }
}
