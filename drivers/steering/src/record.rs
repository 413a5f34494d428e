//! A record of all inputs and decisions, for recordings and replays.

use crate::base_clearance::Room;
use crate::base_verdict::{BaseSituation, BaseVerdict};
use crate::clearance::Restriction;
use crate::reason::Reason;
use crate::request::Request;
use crate::verdict::{Decision, Verdict};
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
        /// The arm; `None` if the robot has none that is steered.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        arm: Option<Box<ArmCycle>>,
        /// The base; `None` if the robot has none that is steered.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        base: Option<Box<BaseCycle>>,
    },
}

/// The arm in one cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmCycle {
    /// State of the arm.
    pub state: ArmState,
    /// What was known about the scene, for each posture that was checked.
    pub seen: Vec<Vec<Restriction>>,
    /// The decision.
    pub verdict: Verdict,
}

/// The base in one cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BaseCycle {
    /// State of the base and of the arm on it.
    pub situation: BaseSituation,
    /// What was known about the scene, for each way that was checked.
    pub rooms: Vec<Room>,
    /// The decision.
    pub verdict: BaseVerdict,
}

impl Entry {
    /// When the request arrived, or the time of the cycle.
    pub fn at(&self) -> Stamp {
        let (Self::Request { at, .. } | Self::Cycle { at, .. }) = self;
        *at
    }

    /// Whether a part of the robot should follow a target.
    pub fn has_target(&self) -> bool {
        match self {
            Self::Request { .. } => false,
            Self::Cycle { arm, base, .. } => {
                let arm = arm.as_ref().and_then(|arm| arm.verdict.target());
                let base = base.as_ref().and_then(|base| base.verdict.target());
                arm.is_some() || base.is_some()
            }
        }
    }
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
pub(crate) fn are_identical(a: &Decision, b: &Decision) -> bool {
    a == b && bits(a) == bits(b)
}

fn bits(decision: &Decision) -> Vec<u64> {
    let arm = decision.arm.as_ref().and_then(Verdict::target);
    let position = arm.map_or(&[][..], |target| &target.position);
    let base = decision.base.as_ref().and_then(BaseVerdict::target);
    let velocity = base.map(|target| target.velocity.to_array());
    let numbers = position.iter().chain(velocity.iter().flatten());
    numbers.map(|number| number.to_bits()).collect()
}
