//! Readings of which each comes whole in one datagram.

use super::counts::{CLOCK_RESTARTED, Counts, Senders, tell};
use super::order::{self, Order, Place};
use super::receiver::{Arrived, Receiver};
use crate::Error;
use crate::wire::Malformed;
use crate::wire::datagram::Head;
use kinematics::Stamp;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A sender of such readings; dropping it frees the port.
#[derive(Debug)]
pub(super) struct WholeReadings {
    /// What they are called in messages.
    plural: &'static str,
    receiver: Receiver,
    pub(super) order: Order,
    pub(super) counts: Counts,
    senders: Senders,
}

impl WholeReadings {
    /// Listens; port 0 takes a free one.
    pub(super) fn open(device: &str, plural: &'static str, address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open(device.to_owned(), address)?;
        let (order, counts, senders) = (Order::default(), Counts::default(), Senders::default());
        Ok(Self { plural, receiver, order, counts, senders })
    }

    /// Where it listens.
    pub(super) fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// What became of the datagrams so far.
    pub(super) fn counts(&self) -> Counts {
        self.counts
    }

    /// The next reading that `decode` understands, with our time of it; `None` when none came within a time.
    pub(super) fn next<T>(
        &mut self,
        timeout: Duration,
        decode: impl Fn(&[u8]) -> Result<(Head, T), Malformed>,
    ) -> Result<Option<(Stamp, T)>, Error> {
        let until = Instant::now() + timeout;
        while let Some(arrived) = self.receiver.next(until)? {
            if let Some(reading) = self.take(&arrived, &decode) {
                return Ok(Some(reading));
            }
            if Instant::now() >= until {
                break; // However many useless ones there are.
            }
        }
        Ok(None)
    }

    pub(super) fn take<T>(
        &mut self,
        arrived: &Arrived,
        decode: impl Fn(&[u8]) -> Result<(Head, T), Malformed>,
    ) -> Option<(Stamp, T)> {
        let Self { plural, receiver, order, counts, senders } = self;
        let device = receiver.device();
        counts.n_received += 1;
        tell(device, &mut counts.n_dropped, arrived.n_dropped, format_args!("{plural} gave way to newer ones"));
        let (head, reading) = match decode(&arrived.bytes) {
            Ok(decoded) => decoded,
            Err(error) => {
                tell(device, &mut counts.n_refused, 1, format_args!("a datagram is refused: {error}"));
                return None;
            }
        };
        senders.note(device, arrived.from);
        match order.place(head.seq, arrived.at) {
            Place::New { n_lost } => tell(device, &mut counts.n_lost, n_lost, format_args!("{plural} did not come")),
            Place::Restart => tell(device, &mut counts.n_restarts, 1, "the sender counts anew"),
            Place::Newest | Place::Late => {
                tell(device, &mut counts.n_late, 1, format_args!("{plural} came late or twice"));
                return None;
            }
        }
        let n_before = order.n_clock_restarts();
        let stamp = order.stamp(&head, arrived.at);
        tell(device, &mut counts.n_clock_restarts, order.n_clock_restarts() - n_before, CLOCK_RESTARTED);
        if stamp.is_none() {
            let says = head.stamp_nanos;
            let hint = order::hint(&head, arrived.at);
            let what = format_args!("the stamp {says} is not after the last, or not of now{hint}");
            tell(device, &mut counts.n_refused, 1, what);
        }
        Some((stamp?, reading))
    }
}

impl Drop for WholeReadings {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
