//! A record of all inputs and decisions, for recordings and replays.

use crate::clearance::Restriction;
use crate::reason::Reason;
use crate::request::Request;
use crate::verdict::Verdict;
use drivers::motion::{ArmState, exact};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// One input of the chain, and what the chain decided.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Entry {
    /// A request of an operator.
    Request {
        /// When it arrived.
        #[serde(with = "exact::stamp")]
        at: Stamp,
        /// The request.
        request: Request,
        /// Why it was refused, if it was.
        refusal: Option<Reason>,
    },
    /// One cycle.
    Cycle {
        /// Its time.
        #[serde(with = "exact::stamp")]
        at: Stamp,
        /// State of the arm.
        arm: ArmState,
        /// What was known about the scene, for each posture that was checked.
        seen: Vec<Vec<Restriction>>,
        /// The decision.
        verdict: Verdict,
    },
}

/// The newest entries. If nobody takes them, the oldest are dropped.
#[derive(Clone, Debug)]
pub(crate) struct Record {
    entries: VecDeque<Entry>,
    capacity: usize,
    n_dropped: u64,
}

impl Record {
    /// An empty record.
    pub(crate) fn new(capacity: usize) -> Self {
        Self {
            entries: VecDeque::new(),
            capacity,
            n_dropped: 0,
        }
    }

    /// Adds an entry.
    pub(crate) fn push(&mut self, entry: Entry) {
        self.entries.push_back(entry);
        while self.entries.len() > self.capacity {
            self.entries.pop_front();
            self.n_dropped += 1;
        }
    }

    /// Takes all entries, and the number of entries that were dropped since the last call.
    pub(crate) fn take(&mut self) -> (Vec<Entry>, u64) {
        let n_dropped = std::mem::take(&mut self.n_dropped);
        (self.entries.drain(..).collect(), n_dropped)
    }
}

/// A replay decided differently than the record.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "the replay differs at {:.3} s: it decided {replayed}, the record says {recorded}; the rig, the program or the record changed",
    .at.secs()
)]
pub struct Difference {
    /// Time of the entry.
    pub at: Stamp,
    /// Decision of the replay.
    pub replayed: String,
    /// Decision in the record.
    pub recorded: String,
}

/// Whether two decisions are equal in every bit of their targets.
pub(crate) fn are_identical(a: &Verdict, b: &Verdict) -> bool {
    let bits = |verdict: &Verdict| -> Vec<u64> {
        let position = verdict.target().map_or(&[][..], |target| &target.position);
        position.iter().map(|q| q.to_bits()).collect()
    };
    a == b && bits(a) == bits(b)
}
