//! Reads values that each fit in one datagram.

use super::counts::{CLOCK_RESTARTED, DatagramCounts, DatagramMonitor, Senders, count_and_warn};
use super::receiver::{ReceivedDatagram, Receiver};
use super::sequence::{self, SequencePosition, SequenceTracker};
use crate::Error;
use crate::wire::Malformed;
use crate::wire::datagram::DatagramHeader;
use kinematics::Stamp;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Receives values from one sender. Dropping it frees the port.
#[derive(Debug)]
pub(super) struct DatagramReader {
    /// Name of the values in messages, in the plural.
    plural: &'static str,
    receiver: Receiver,
    pub(super) sequence: SequenceTracker,
    pub(super) counts: DatagramCounts,
    monitor: DatagramMonitor,
    senders: Senders,
}

impl DatagramReader {
    /// Listens. With port 0, a free port is used.
    pub(super) fn open(
        device: &str,
        plural: &'static str,
        address: SocketAddr,
    ) -> Result<Self, Error> {
        let receiver = Receiver::open(device.to_owned(), address)?;
        let monitor = DatagramMonitor::new(device, receiver.address());
        let (sequence, counts, senders) = (
            SequenceTracker::default(),
            DatagramCounts::default(),
            Senders::default(),
        );
        Ok(Self {
            plural,
            receiver,
            sequence,
            counts,
            monitor,
            senders,
        })
    }

    /// Address it listens on.
    pub(super) fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// Statistics of the datagrams so far.
    pub(super) fn counts(&self) -> DatagramCounts {
        self.counts
    }

    /// The same statistics for another thread.
    pub(super) fn monitor(&self) -> DatagramMonitor {
        self.monitor.clone()
    }

    /// Updates the statistics that other threads see.
    pub(super) fn publish_counts(&self) {
        self.monitor.set_counts(self.counts);
    }

    /// Returns the next value that `decode` accepts with its stamp on our clock, or `None` if none
    /// came in time. A datagram without a value, such as the state of a gripper, only counts in the
    /// sequence.
    pub(super) fn next<T>(
        &mut self,
        timeout: Duration,
        decode: impl Fn(&[u8]) -> Result<(DatagramHeader, Option<T>), Malformed>,
    ) -> Result<Option<(Stamp, T)>, Error> {
        let until = Instant::now() + timeout;
        while let Some(datagram) = self.receiver.next(until)? {
            let reading = self.take(&datagram, &decode);
            self.publish_counts();
            if reading.is_some() {
                return Ok(reading);
            }
            if Instant::now() >= until {
                break; // Even if invalid datagrams keep arriving.
            }
        }
        Ok(None)
    }

    pub(super) fn take<T>(
        &mut self,
        datagram: &ReceivedDatagram,
        decode: impl Fn(&[u8]) -> Result<(DatagramHeader, Option<T>), Malformed>,
    ) -> Option<(Stamp, T)> {
        let Self {
            plural,
            receiver,
            sequence,
            counts,
            monitor,
            senders,
        } = self;
        let device = receiver.device();
        counts.n_received += 1;
        count_and_warn(
            device,
            &mut counts.n_dropped,
            datagram.n_dropped,
            format_args!("{plural} were dropped because the program was too slow"),
        );
        let (header, reading) = match decode(&datagram.bytes) {
            Ok(decoded) => decoded,
            Err(error) => {
                count_and_warn(
                    device,
                    &mut counts.n_rejected,
                    1,
                    format_args!("rejected a datagram: {error}"),
                );
                monitor.set_last_rejection(error.to_string());
                return None;
            }
        };
        if !senders.accepts(device, datagram.from, datagram.at, &mut counts.n_foreign) {
            return None;
        }
        match sequence.position(header.seq, datagram.at) {
            SequencePosition::New { n_lost } => count_and_warn(
                device,
                &mut counts.n_lost,
                n_lost,
                format_args!("{plural} did not arrive"),
            ),
            SequencePosition::Restart => count_and_warn(
                device,
                &mut counts.n_restarts,
                1,
                "the sender's sequence numbers restarted",
            ),
            SequencePosition::Current | SequencePosition::Late => {
                count_and_warn(
                    device,
                    &mut counts.n_late,
                    1,
                    format_args!("{plural} were late or duplicate"),
                );
                return None;
            }
        }
        let Some(reading) = reading else {
            if counts.n_other == 0 {
                log::info!(
                    "{device}: ignoring states that name none of the arm's joints; if these are its joints, correct arm.joints"
                );
            }
            counts.n_other += 1;
            return None;
        };
        let n_before = sequence.n_clock_restarts();
        let stamp = sequence.stamp(&header, datagram.at);
        count_and_warn(
            device,
            &mut counts.n_clock_restarts,
            sequence.n_clock_restarts() - n_before,
            CLOCK_RESTARTED,
        );
        if stamp.is_none() {
            let reason = sequence::rejection(&header, datagram.at);
            count_and_warn(
                device,
                &mut counts.n_rejected,
                1,
                format_args!("rejected a datagram: {reason}"),
            );
            monitor.set_last_rejection(reason);
        }
        Some((stamp?, reading))
    }
}

impl Drop for DatagramReader {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
