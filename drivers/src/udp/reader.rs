//! Reads values that each fit in one datagram.

use super::sequence::{self, SequencePosition, SequenceTracker};
use crate::Error;
use crate::datagrams::counts::{CLOCK_RESTARTED, DatagramCounts, DatagramMonitor, count_and_warn};
use crate::datagrams::receiver::{ReceivedDatagram, Receiver};
use crate::datagrams::senders::Senders;
use crate::wire::Malformed;
use crate::wire::datagram::{DatagramHeader, unmatched_names};
use kinematics::Stamp;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Receives values from one sender. Dropping it frees the port.
#[derive(Debug)]
pub(super) struct DatagramReader {
    /// Name of the values in messages, in the plural.
    plural: &'static str,
    /// Joints of the arm; empty for values of other devices.
    pub(super) joint_names: Vec<String>,
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
        Ok(Self {
            plural,
            joint_names: Vec::new(),
            receiver,
            sequence: SequenceTracker::default(),
            counts: DatagramCounts::default(),
            monitor,
            senders: Senders::default(),
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

    /// A handle with which another thread can read these statistics.
    pub(super) fn monitor(&self) -> DatagramMonitor {
        self.monitor.clone()
    }

    /// Updates the statistics that other threads see.
    pub(super) fn publish_counts(&self) {
        self.monitor.set_counts(self.counts);
    }

    /// Returns the next value that `decode` accepts, with its stamp on the clock of this computer.
    /// Returns `None` if no value arrives in time. A datagram without a value, such as the state of
    /// a gripper, only advances the sequence.
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
            // The time limit also applies if invalid datagrams keep arriving.
            if Instant::now() >= until {
                break;
            }
        }
        Ok(None)
    }

    /// Checks one datagram and counts it. Returns its stamp and its value if the value is new.
    pub(super) fn take<T>(
        &mut self,
        datagram: &ReceivedDatagram,
        decode: impl Fn(&[u8]) -> Result<(DatagramHeader, Option<T>), Malformed>,
    ) -> Option<(Stamp, T)> {
        self.counts.n_received += 1;
        let plural = self.plural;
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_dropped,
            datagram.n_dropped,
            format_args!("{plural} were dropped because the program was too slow"),
        );
        let (header, reading) = match decode(&datagram.bytes) {
            Ok(decoded) => decoded,
            Err(error) => {
                self.reject(error.to_string());
                return None;
            }
        };
        // Only valid datagrams identify the sender. Other traffic on the port, such as a port scan,
        // must not replace the current sender.
        let device = self.receiver.device();
        let n_foreign = &mut self.counts.n_foreign;
        if !self
            .senders
            .accepts(device, datagram.from, datagram.at, n_foreign)
        {
            return None;
        }
        if !self.is_new(&header, datagram.at) {
            return None;
        }
        // The value is checked after the sequence number, so that states of other joints do not
        // count as lost.
        let Some(reading) = reading else {
            self.count_other(&datagram.bytes);
            return None;
        };
        let stamp = self.stamp(&header, datagram.at)?;
        Some((stamp, reading))
    }

    /// Whether a datagram is newer than all before it. Counts lost and late ones, and restarts.
    fn is_new(&mut self, header: &DatagramHeader, arrival: Stamp) -> bool {
        let plural = self.plural;
        let device = self.receiver.device();
        match self.sequence.position(header.seq, arrival) {
            SequencePosition::New { n_lost } => count_and_warn(
                device,
                &mut self.counts.n_lost,
                n_lost,
                format_args!("{plural} did not arrive"),
            ),
            SequencePosition::Restart => count_and_warn(
                device,
                &mut self.counts.n_restarts,
                1,
                "the sender's sequence numbers restarted",
            ),
            SequencePosition::Current | SequencePosition::Late => {
                count_and_warn(
                    device,
                    &mut self.counts.n_late,
                    1,
                    format_args!("{plural} were late or duplicate"),
                );
                return false;
            }
        }
        true
    }

    /// Counts a state that names none of the joints, and explains the first one in the log. Such
    /// states come from a gripper on the same port, or from an arm whose joints are named wrongly.
    fn count_other(&mut self, bytes: &[u8]) {
        if self.counts.n_other == 0
            && let Ok(names) = unmatched_names(bytes, &self.joint_names)
        {
            let device = self.receiver.device();
            log::info!(
                "{device}: ignoring states that name none of the arm's joints: {names}; if these are its joints, correct arm.joints"
            );
            self.monitor.set_unmatched_names(names);
        }
        self.counts.n_other += 1;
    }

    /// The stamp of a datagram on our clock. Rejects the datagram if its stamp is impossible.
    fn stamp(&mut self, header: &DatagramHeader, arrival: Stamp) -> Option<Stamp> {
        let n_before = self.sequence.n_clock_restarts();
        let stamp = self.sequence.stamp(header, arrival);
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_clock_restarts,
            self.sequence.n_clock_restarts() - n_before,
            CLOCK_RESTARTED,
        );
        if stamp.is_none() {
            self.reject(sequence::rejection(header, arrival));
        }
        stamp
    }

    fn reject(&mut self, reason: String) {
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_rejected,
            1,
            format_args!("rejected a datagram: {reason}"),
        );
        self.monitor.set_last_rejection(reason);
    }
}

impl Drop for DatagramReader {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
