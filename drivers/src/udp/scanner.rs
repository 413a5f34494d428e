//! A range scanner whose turns come over UDP, each in one datagram or cut into parts.

use super::counts::{CLOCK_RESTARTED, Counts, Senders, tell};
use super::order::{self, Order, Place};
use super::receiver::{Arrived, Receiver};
use crate::wire::datagram::{Head, ScanPart, decode_scan};
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
    order: Order,
    counts: Counts,
    senders: Senders,
    /// The turn whose parts are coming.
    turn: Option<Turn>,
    pub(super) done: VecDeque<RangeScan>,
}

#[derive(Debug)]
struct Turn {
    head: Head,
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
            order: Order::default(),
            counts: Counts::default(),
            senders: Senders::default(),
            turn: None,
            done: VecDeque::new(),
        })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.receiver.address()
    }

    /// What became of the datagrams so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// As if nothing had come yet.
    #[cfg(any(test, fuzzing))]
    pub(super) fn forget(&mut self) {
        (self.order, self.turn) = (Order::default(), None);
        self.done.clear();
    }

    pub(super) fn take(&mut self, arrived: &Arrived) {
        self.counts.n_received += 1;
        let device = self.receiver.device();
        tell(device, &mut self.counts.n_dropped, arrived.n_dropped, "datagrams gave way to newer ones");
        let part = match decode_scan(&arrived.bytes) {
            Ok(part) => part,
            Err(error) => return self.refuse(format_args!("{error}")),
        };
        if *part.frame != *self.name {
            return self.refuse(format_args!("it is of another frame"));
        }
        self.senders.note(device, arrived.from);
        match self.order.place(part.head.seq, arrived.at) {
            Place::New { n_lost } => {
                tell(self.receiver.device(), &mut self.counts.n_lost, n_lost, "scans did not come");
                self.begin(part, arrived.at);
            }
            Place::Restart => {
                tell(self.receiver.device(), &mut self.counts.n_restarts, 1, "the sender counts anew");
                self.begin(part, arrived.at);
            }
            Place::Newest => self.add(part),
            Place::Late => tell(self.receiver.device(), &mut self.counts.n_late, 1, "a part came late"),
        }
    }

    /// A new turn; what has come of the one before is all there will be.
    fn begin(&mut self, part: ScanPart, arrival: Stamp) {
        self.end_turn();
        let n_before = self.order.n_clock_restarts();
        let stamp = self.order.stamp(&part.head, arrival);
        let n_more = self.order.n_clock_restarts() - n_before;
        tell(self.receiver.device(), &mut self.counts.n_clock_restarts, n_more, CLOCK_RESTARTED);
        let Some(stamp) = stamp else {
            let (says, hint) = (part.head.stamp_nanos, order::hint(&part.head, arrival));
            return self.refuse(format_args!("the stamp {says} is not after the last, or not of now{hint}"));
        };
        let parts = vec![None; part.n_parts as usize];
        self.turn = Some(Turn { head: part.head, stamp, parts });
        self.add(part);
    }

    fn add(&mut self, part: ScanPart) {
        let Some(turn) = &mut self.turn else {
            // Of a turn that is complete, or was refused.
            return tell(self.receiver.device(), &mut self.counts.n_late, 1, "a part came twice or late");
        };
        if turn.head != part.head || turn.parts.len() != part.n_parts as usize {
            return self.refuse(format_args!("it contradicts another part of the same scan"));
        }
        let place = &mut turn.parts[part.part as usize];
        if place.is_some() {
            return tell(self.receiver.device(), &mut self.counts.n_late, 1, "a part came twice");
        }
        *place = Some(part.points);
        if turn.parts.iter().all(Option::is_some) {
            self.end_turn();
        }
    }

    fn end_turn(&mut self) {
        let Some(Turn { stamp, parts, .. }) = self.turn.take() else { return };
        let n_missing = parts.iter().filter(|part| part.is_none()).count() as u64;
        tell(self.receiver.device(), &mut self.counts.n_lost, n_missing, "parts of a scan did not come");
        let points: Arc<[RangePoint]> = parts.into_iter().flatten().flatten().collect();
        self.done.push_back(RangeScan { scanner: Arc::clone(&self.name), stamp, points });
    }

    fn refuse(&mut self, why: std::fmt::Arguments<'_>) {
        tell(self.receiver.device(), &mut self.counts.n_refused, 1, format_args!("a datagram is refused: {why}"));
    }
}

impl RangeScanner for UdpScanner {
    fn name(&self) -> &str {
        &self.name
    }

    fn next_scan(&mut self, timeout: Duration) -> Result<RangeScan, Error> {
        let until = Instant::now() + timeout;
        loop {
            if let Some(scan) = self.done.pop_front() {
                return Ok(scan);
            }
            let Some(arrived) = self.receiver.next(until)? else { break };
            self.take(&arrived);
            if self.done.is_empty() && Instant::now() >= until {
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
