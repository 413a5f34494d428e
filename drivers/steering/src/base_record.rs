//! A record of all inputs and decisions of a base, for recordings and replays.

use crate::base_verdict::{BaseSituation, BaseVerdict};
use crate::reason::Reason;
use crate::request::Request;
use drivers::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Number of entries that are kept if nobody takes them: a minute at 100 Hz.
const MAX_ENTRIES: usize = 6000;

/// One input of the chain, and its decision.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum BaseEntry {
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
        /// What was known.
        situation: BaseSituation,
        /// The decision.
        verdict: BaseVerdict,
    },
}

/// The newest entries. If nobody takes them, the oldest are dropped.
#[derive(Clone, Debug, Default)]
pub(crate) struct BaseRecord {
    entries: VecDeque<BaseEntry>,
    n_dropped: u64,
}

impl BaseRecord {
    pub(crate) fn push(&mut self, entry: BaseEntry) {
        self.entries.push_back(entry);
        while self.entries.len() > MAX_ENTRIES {
            self.entries.pop_front();
            self.n_dropped += 1;
        }
    }

    /// Takes all entries, and the number of entries that were dropped since the last call.
    pub(crate) fn take(&mut self) -> (Vec<BaseEntry>, u64) {
        let n_dropped = std::mem::take(&mut self.n_dropped);
        (self.entries.drain(..).collect(), n_dropped)
    }
}

/// Whether two decisions are equal in every bit of their velocities.
pub(crate) fn are_identical(a: &BaseVerdict, b: &BaseVerdict) -> bool {
    let bits = |verdict: &BaseVerdict| {
        let velocity = verdict.target().map(|target| target.velocity.to_array());
        velocity.map(|numbers| numbers.map(f64::to_bits))
    };
    a == b && bits(a) == bits(b)
}
