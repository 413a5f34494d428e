//! A range scanner whose scans are received over UDP, each in one or more datagrams.

use super::sequence::{self, SequencePosition, SequenceTracker};
use crate::datagrams::counts::{CLOCK_RESTARTED, DatagramCounts, DatagramMonitor, count_and_warn};
use crate::datagrams::receiver::{ReceivedDatagram, Receiver};
use crate::datagrams::senders::Senders;
use crate::wire::datagram::{DatagramHeader, ScanPart, decode_scan};
use crate::{Error, RangePoint, RangeScan, RangeScanner, device_names};
use kinematics::Stamp;
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A range scanner whose scans are received over UDP.
///
/// A scan is returned when all its parts have arrived. If parts are missing when the next scan
/// begins, it is returned without them.
#[derive(Debug)]
pub struct UdpScanner {
    name: Arc<str>,
    receiver: Receiver,
    sequence: SequenceTracker,
    counts: DatagramCounts,
    monitor: DatagramMonitor,
    senders: Senders,
    /// The scan whose parts are arriving.
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
    /// Listens for the scanner of this name. With port 0, a free port is used.
    pub fn open(name: &str, address: SocketAddr) -> Result<Self, Error> {
        let receiver = Receiver::open(device_names::range_scanner(name), address)?;
        let monitor = DatagramMonitor::new(receiver.device(), receiver.address());
        Ok(Self {
            name: name.into(),
            receiver,
            sequence: SequenceTracker::default(),
            counts: DatagramCounts::default(),
            monitor,
            senders: Senders::default(),
            partial_scan: None,
            completed: VecDeque::new(),
        })
    }

    /// Address it listens on.
    pub fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// Statistics of the datagrams so far.
    pub fn counts(&self) -> DatagramCounts {
        self.counts
    }

    /// A handle with which another thread can read these statistics.
    pub fn monitor(&self) -> DatagramMonitor {
        self.monitor.clone()
    }

    /// Resets the state to before the first datagram.
    #[cfg(any(test, fuzzing))]
    pub(super) fn reset(&mut self) {
        self.sequence = SequenceTracker::default();
        self.partial_scan = None;
        self.completed.clear();
    }

    pub(super) fn take(&mut self, datagram: &ReceivedDatagram) {
        self.counts.n_received += 1;
        let device = self.receiver.device();
        count_and_warn(
            device,
            &mut self.counts.n_dropped,
            datagram.n_dropped,
            "datagrams were dropped because the program was too slow",
        );
        let part = match decode_scan(&datagram.bytes) {
            Ok(part) => part,
            Err(error) => return self.reject(format_args!("{error}")),
        };
        // Two scanners may send to one port by mistake, and their points would be placed with the
        // wrong pose.
        if *part.frame != *self.name {
            return self.reject(format_args!("it belongs to another frame"));
        }
        if !self.senders.accepts(
            device,
            datagram.from,
            datagram.at,
            &mut self.counts.n_foreign,
        ) {
            return;
        }
        match self.sequence.position(part.header.seq, datagram.at) {
            SequencePosition::New { n_lost } => {
                count_and_warn(
                    self.receiver.device(),
                    &mut self.counts.n_lost,
                    n_lost,
                    "scans did not arrive",
                );
                self.begin(part, datagram.at);
            }
            SequencePosition::Restart => {
                count_and_warn(
                    self.receiver.device(),
                    &mut self.counts.n_restarts,
                    1,
                    "the sender's sequence numbers restarted",
                );
                self.begin(part, datagram.at);
            }
            SequencePosition::Current => self.add(part),
            SequencePosition::Late => count_and_warn(
                self.receiver.device(),
                &mut self.counts.n_late,
                1,
                "a part of a scan was late",
            ),
        }
    }

    /// Starts a new scan. The previous one is returned without its missing parts.
    fn begin(&mut self, part: ScanPart, arrival: Stamp) {
        self.finish_scan();
        let n_before = self.sequence.n_clock_restarts();
        // All parts contain the same stamp. The first part that arrives has the smallest delay, so
        // it is used to map the stamp.
        let stamp = self.sequence.stamp(&part.header, arrival);
        let n_new_restarts = self.sequence.n_clock_restarts() - n_before;
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_clock_restarts,
            n_new_restarts,
            CLOCK_RESTARTED,
        );
        let Some(stamp) = stamp else {
            return self.reject(format_args!(
                "{}",
                sequence::rejection(&part.header, arrival)
            ));
        };
        let parts = vec![None; part.n_parts as usize];
        self.partial_scan = Some(PartialScan {
            header: part.header,
            stamp,
            parts,
        });
        self.add(part);
    }

    fn add(&mut self, part: ScanPart) {
        let Some(partial_scan) = &mut self.partial_scan else {
            // The scan is already complete, or was rejected.
            return count_and_warn(
                self.receiver.device(),
                &mut self.counts.n_late,
                1,
                "a part of a scan was late or duplicate",
            );
        };
        // Parts of two scans with one sequence number, such as after a restart of the sender, must
        // not be mixed.
        if partial_scan.header != part.header || partial_scan.parts.len() != part.n_parts as usize {
            return self.reject(format_args!("it contradicts another part of the same scan"));
        }
        let position = &mut partial_scan.parts[part.part as usize];
        if position.is_some() {
            return count_and_warn(
                self.receiver.device(),
                &mut self.counts.n_late,
                1,
                "a part of a scan was duplicate",
            );
        }
        *position = Some(part.points);
        if partial_scan.parts.iter().all(Option::is_some) {
            self.finish_scan();
        }
    }

    fn finish_scan(&mut self) {
        let Some(PartialScan { stamp, parts, .. }) = self.partial_scan.take() else {
            return;
        };
        let n_missing = parts.iter().filter(|part| part.is_none()).count() as u64;
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_lost,
            n_missing,
            "parts of a scan did not arrive",
        );
        // Parts are stored by their number, so points are in order even if parts were reordered on
        // the way.
        let points: Arc<[RangePoint]> = parts.into_iter().flatten().flatten().collect();
        self.completed.push_back(RangeScan {
            scanner: Arc::clone(&self.name),
            stamp,
            points,
        });
    }

    fn reject(&mut self, reason: std::fmt::Arguments<'_>) {
        count_and_warn(
            self.receiver.device(),
            &mut self.counts.n_rejected,
            1,
            format_args!("rejected a datagram: {reason}"),
        );
        self.monitor.set_last_rejection(reason.to_string());
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
            let Some(datagram) = self.receiver.next(until)? else {
                break;
            };
            self.take(&datagram);
            self.monitor.set_counts(self.counts);
            // The time limit also applies if invalid datagrams keep arriving.
            if self.completed.is_empty() && Instant::now() >= until {
                break;
            }
        }
        Err(Error::NoScan {
            scanner: self.name.to_string(),
            waited: timeout,
        })
    }
}

impl Drop for UdpScanner {
    fn drop(&mut self) {
        self.counts.summarize(self.receiver.device());
    }
}
