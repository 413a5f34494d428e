//! A base whose poses come over UDP, for instance from a localiser of its own.

use super::counts::{Counts, tell};
use super::order::{Order, Place};
use super::receiver::{Arrived, Receiver};
use crate::wire::datagram::decode_pose;
use crate::{Base, BasePose, Error};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A base that is told where it is.
#[derive(Debug)]
pub struct UdpBase {
    receiver: Receiver,
    order: Order,
    counts: Counts,
}

impl UdpBase {
    /// Listens; port 0 takes a free one.
    pub fn open(address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open("base".to_owned(), address)?;
        Ok(Self { receiver, order: Order::default(), counts: Counts::default() })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// What became of the datagrams so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    fn take(&mut self, arrived: &Arrived) -> Option<BasePose> {
        let Self { receiver, order, counts } = self;
        let device = receiver.device();
        counts.n_received += 1;
        tell(device, &mut counts.n_dropped, arrived.n_dropped, "poses gave way to newer ones");
        let datagram = match decode_pose(&arrived.bytes) {
            Ok(datagram) => datagram,
            Err(error) => {
                tell(device, &mut counts.n_refused, 1, format_args!("a datagram is refused: {error}"));
                return None;
            }
        };
        match order.place(datagram.head.seq, arrived.at) {
            Place::New { n_lost } => tell(device, &mut counts.n_lost, n_lost, "poses did not come"),
            Place::Restart => tell(device, &mut counts.n_restarts, 1, "the sender counts anew"),
            Place::Newest | Place::Late => {
                tell(device, &mut counts.n_late, 1, "a pose came late or twice");
                return None;
            }
        }
        let stamp = order.stamp(&datagram.head, arrived.at);
        if stamp.is_none() {
            let says = datagram.head.stamp_nanos;
            tell(
                device,
                &mut counts.n_refused,
                1,
                format_args!("the stamp {says} is not after the last, or not of now"),
            );
        }
        Some(BasePose { stamp: stamp?, world_from_base: datagram.world_from_base })
    }
}

impl Base for UdpBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error> {
        let until = Instant::now() + timeout;
        while let Some(arrived) = self.receiver.next(until)? {
            if let Some(pose) = self.take(&arrived) {
                return Ok(pose);
            }
            if Instant::now() >= until {
                break; // However many useless ones there are.
            }
        }
        Err(Error::NoBasePose { waited: timeout })
    }
}

impl Drop for UdpBase {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
