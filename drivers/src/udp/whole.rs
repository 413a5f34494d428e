//! Readings of which each comes whole in one datagram.

use super::counts::{Counts, tell};
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
    /// Who sent the newest.
    from: Option<SocketAddr>,
    /// How often that was another one than before.
    n_senders: u64,
    n_clock_restarts: u64,
}

impl WholeReadings {
    /// Listens; port 0 takes a free one.
    pub(super) fn open(device: &str, plural: &'static str, address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open(device.to_owned(), address)?;
        Ok(Self {
            plural,
            receiver,
            order: Order::default(),
            counts: Counts::default(),
            from: None,
            n_senders: 0,
            n_clock_restarts: 0,
        })
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
        let Self { plural, receiver, order, counts, from, n_senders, n_clock_restarts } = self;
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
        let what = "the sender's clock began again or jumped, or it does not count nanoseconds";
        tell(device, n_clock_restarts, order.n_clock_restarts() - n_before, what);
        if from.replace(arrived.from).is_some_and(|before| before != arrived.from) {
            tell(device, n_senders, 1, format_args!("{} sends, another one did before", arrived.from));
        }
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
