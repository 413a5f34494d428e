//! A range scanner whose turns come over UDP, each in one datagram or cut into parts.

use super::counts::{CLOCK_RESTARTED, DatagramCounts, Senders, count_and_warn};
use super::receiver::{ReceivedDatagram, Receiver};
use super::sequence::{self, SequencePosition, SequenceTracker};
use crate::wire::datagram::{DatagramHeader, ScanPart, decode_scan};
use crate::{Error, RangePoint, RangeScan, RangeScanner};
use kinematics::Stamp;
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A scanner that sends JSON.
///
/// A turn is told once all its parts are there, or without those that are not once a later turn begins.
#[derive(Debug)]
pub struct UdpScanner {
    name: Arc<str>,
    receiver: Receiver,
    sequence: SequenceTracker,
    counts: DatagramCounts,
    senders: Senders,
    /// The turn whose parts are coming.
    partial_scan: Option<PartialScan>,
    pub(super) completed: VecDeque<RangeScan>,
}

#[derive(Debug)]
struct PartialScan {
    header: DatagramHeader,
    stamp: Stamp,
    parts: Vec<Option<Vec<RangePoint>>>,
}

impl UdpScanner {
    /// Listens for the scanner of this name; port 0 takes a free one.
    pub fn open(name: &str, address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open(format!("range scanner {name:?}"), address)?;
        Ok(Self {
            name: name.into(),
            receiver,
            sequence: SequenceTracker::default(),
            counts: DatagramCounts::default(),
            senders: Senders::default(),
            partial_scan: None,
            completed: VecDeque::new(),
        })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// What became of the datagrams so far.
    pub fn counts(&self) -> DatagramCounts {
        self.counts
    }

    /// As if nothing had come yet.
    #[cfg(any(test, fuzzing))]
    pub(super) fn reset(&mut self) {
        (self.sequence, self.partial_scan) = (SequenceTracker::default(), None);
        self.completed.clear();
    }

    pub(super) fn take(&mut self, datagram: &ReceivedDatagram) {
        self.counts.n_received += 1;
        let device = self.receiver.device();
        count_and_warn(device, &mut self.counts.n_dropped, datagram.n_dropped, "datagrams gave way to newer ones");
        let part = match decode_scan(&datagram.bytes) {
            Ok(part) => part,
            Err(error) => return self.reject(format_args!("{error}")),
        };
        if *part.frame != *self.name {
            return self.reject(format_args!("it is of another frame"));
        }
        self.senders.note(device, datagram.from);
        match self.sequence.position(part.header.seq, datagram.at) {
            SequencePosition::New { n_lost } => {
                count_and_warn(self.receiver.device(), &mut self.counts.n_lost, n_lost, "scans did not come");
                self.begin(part, datagram.at);
            }
            SequencePosition::Restart => {
                count_and_warn(self.receiver.device(), &mut self.counts.n_restarts, 1, "the sender counts anew");
                self.begin(part, datagram.at);
            }
            SequencePosition::Current => self.add(part),
            SequencePosition::Late => {
                count_and_warn(self.receiver.device(), &mut self.counts.n_late, 1, "a part came late")
            }
        }
    }

    /// A new turn; what has come of the one before is all there will be.
    fn begin(&mut self, part: ScanPart, arrival: Stamp) {
        self.finish_scan();
        let n_before = self.sequence.n_clock_restarts();
        let stamp = self.sequence.stamp(&part.header, arrival);
        let n_new_restarts = self.sequence.n_clock_restarts() - n_before;
        count_and_warn(self.receiver.device(), &mut self.counts.n_clock_restarts, n_new_restarts, CLOCK_RESTARTED);
        let Some(stamp) = stamp else {
            let (stamp_nanos, hint) = (part.header.stamp_nanos, sequence::hint(&part.header, arrival));
            return self.reject(format_args!("the stamp {stamp_nanos} is not after the last, or not of now{hint}"));
        };
        let parts = vec![None; part.n_parts as usize];
        self.partial_scan = Some(PartialScan { header: part.header, stamp, parts });
        self.add(part);
    }

    fn add(&mut self, part: ScanPart) {
        let Some(partial_scan) = &mut self.partial_scan else {
            // Of a turn that is complete, or was refused.
            return count_and_warn(self.receiver.device(), &mut self.counts.n_late, 1, "a part came twice or late");
        };
        if partial_scan.header != part.header || partial_scan.parts.len() != part.n_parts as usize {
            return self.reject(format_args!("it contradicts another part of the same scan"));
        }
        let position = &mut partial_scan.parts[part.part as usize];
        if position.is_some() {
            return count_and_warn(self.receiver.device(), &mut self.counts.n_late, 1, "a part came twice");
        }
        *position = Some(part.points);
        if partial_scan.parts.iter().all(Option::is_some) {
            self.finish_scan();
        }
    }

    fn finish_scan(&mut self) {
        let Some(PartialScan { stamp, parts, .. }) = self.partial_scan.take() else { return };
        let n_missing = parts.iter().filter(|part| part.is_none()).count() as u64;
        count_and_warn(self.receiver.device(), &mut self.counts.n_lost, n_missing, "parts of a scan did not come");
        let points: Arc<[RangePoint]> = parts.into_iter().flatten().flatten().collect();
        self.completed.push_back(RangeScan { scanner: Arc::clone(&self.name), stamp, points });
    }

    fn reject(&mut self, reason: std::fmt::Arguments<'_>) {
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_rejected,
            1,
            format_args!("a datagram is refused: {reason}"),
        );
    }
}

impl RangeScanner for UdpScanner {
    fn name(&self) -> &str {
        &self.name
    }

    fn next_scan(&mut self, timeout: Duration) -> Result<RangeScan, Error> {
        let until = Instant::now() + timeout;
        loop {
            if let Some(scan) = self.completed.pop_front() {
                return Ok(scan);
            }
            let Some(datagram) = self.receiver.next(until)? else { break };
            self.take(&datagram);
            if self.completed.is_empty() && Instant::now() >= until {
                break; // However many useless ones there are.
            }
        }
        Err(Error::NoScan { scanner: self.name.to_string(), waited: timeout })
    }
}

impl Drop for UdpScanner {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
