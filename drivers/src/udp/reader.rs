//! Readings of which each comes whole in one datagram.

use super::counts::{CLOCK_RESTARTED, DatagramCounts, Senders, count_and_warn};
use super::receiver::{ReceivedDatagram, Receiver};
use super::sequence::{self, SequencePosition, SequenceTracker};
use crate::Error;
use crate::wire::Malformed;
use crate::wire::datagram::DatagramHeader;
use kinematics::Stamp;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// A sender of such readings; dropping it frees the port.
#[derive(Debug)]
pub(super) struct DatagramReader {
    /// What they are called in messages.
    plural: &'static str,
    receiver: Receiver,
    pub(super) sequence: SequenceTracker,
    pub(super) counts: DatagramCounts,
    senders: Senders,
}

impl DatagramReader {
    /// Listens; port 0 takes a free one.
    pub(super) fn open(device: &str, plural: &'static str, address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open(device.to_owned(), address)?;
        let (sequence, counts, senders) = (SequenceTracker::default(), DatagramCounts::default(), Senders::default());
        Ok(Self { plural, receiver, sequence, counts, senders })
    }

    /// Where it listens.
    pub(super) fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// What became of the datagrams so far.
    pub(super) fn counts(&self) -> DatagramCounts {
        self.counts
    }

    /// The next reading that `decode` understands, with our time of it; `None` when none came within a time.
    pub(super) fn next<T>(
        &mut self,
        timeout: Duration,
        decode: impl Fn(&[u8]) -> Result<(DatagramHeader, T), Malformed>,
    ) -> Result<Option<(Stamp, T)>, Error> {
        let until = Instant::now() + timeout;
        while let Some(datagram) = self.receiver.next(until)? {
            if let Some(reading) = self.take(&datagram, &decode) {
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
        datagram: &ReceivedDatagram,
        decode: impl Fn(&[u8]) -> Result<(DatagramHeader, T), Malformed>,
    ) -> Option<(Stamp, T)> {
        let Self { plural, receiver, sequence, counts, senders } = self;
        let device = receiver.device();
        counts.n_received += 1;
        count_and_warn(
            device,
            &mut counts.n_dropped,
            datagram.n_dropped,
            format_args!("{plural} gave way to newer ones"),
        );
        let (header, reading) = match decode(&datagram.bytes) {
            Ok(decoded) => decoded,
            Err(error) => {
                count_and_warn(device, &mut counts.n_rejected, 1, format_args!("a datagram is refused: {error}"));
                return None;
            }
        };
        senders.note(device, datagram.from);
        match sequence.position(header.seq, datagram.at) {
            SequencePosition::New { n_lost } => {
                count_and_warn(device, &mut counts.n_lost, n_lost, format_args!("{plural} did not come"))
            }
            SequencePosition::Restart => count_and_warn(device, &mut counts.n_restarts, 1, "the sender counts anew"),
            SequencePosition::Current | SequencePosition::Late => {
                count_and_warn(device, &mut counts.n_late, 1, format_args!("{plural} came late or twice"));
                return None;
            }
        }
        let n_before = sequence.n_clock_restarts();
        let stamp = sequence.stamp(&header, datagram.at);
        count_and_warn(device, &mut counts.n_clock_restarts, sequence.n_clock_restarts() - n_before, CLOCK_RESTARTED);
        if stamp.is_none() {
            let stamp_nanos = header.stamp_nanos;
            let hint = sequence::hint(&header, datagram.at);
            let what = format_args!("the stamp {stamp_nanos} is not after the last, or not of now{hint}");
            count_and_warn(device, &mut counts.n_rejected, 1, what);
        }
        Some((stamp?, reading))
    }
}

impl Drop for DatagramReader {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
