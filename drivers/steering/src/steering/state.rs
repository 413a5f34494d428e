//! The state of a chain of decisions, so that a record can begin at any time.

use super::{Motion, Steering};
use crate::clutch::ClutchState;
use crate::error::Error;
use crate::lease::Holder;
use crate::reason::{Link, Reason};
use drivers::motion::exact;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// All that a chain of decisions remembers between two calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct State {
    lease: Option<Holder>,
    clutch: ClutchState,
    stop: Option<Reason>,
    motion: Option<Motion>,
    last_brake: Option<(Link, Reason)>,
    n_motions: u64,
    n_targets: u64,
    times: Times,
}

/// Times of the last calls.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Times {
    latest: Option<Nanos>,
    last_cycle: Option<Nanos>,
}

/// A stamp.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Nanos(#[serde(with = "exact::stamp")] Stamp);

impl State {
    /// Whether two states differ at most in the times of the last calls.
    pub fn is_equal_except_times(&self, other: &Self) -> bool {
        let without_times = |state: &Self| Self {
            times: Times::default(),
            ..state.clone()
        };
        without_times(self) == without_times(other)
    }
}

impl Steering {
    /// All that the chain remembers.
    pub fn state(&self) -> State {
        State {
            lease: self.lease.holder,
            clutch: self.clutch.state(),
            stop: self.stop.clone(),
            motion: self.motion.clone(),
            last_brake: self.last_brake.clone(),
            n_motions: self.n_motions,
            n_targets: self.n_targets,
            times: Times {
                latest: self.latest.map(Nanos),
                last_cycle: self.last_cycle.map(Nanos),
            },
        }
    }

    /// Continues from a state, of which another chain with the same robot and configuration was.
    ///
    /// # Errors
    /// If the state is of a robot with another number of joints. The chain then does not change.
    pub fn set_state(&mut self, state: State) -> Result<(), Error> {
        let expected = self.chain.n_joints();
        let got = state.n_joints().find(|n_joints| *n_joints != expected);
        if let Some(got) = got {
            return Err(Error::State { got, expected });
        }
        self.lease.holder = state.lease;
        self.clutch.set_state(state.clutch);
        self.stop = state.stop;
        self.motion = state.motion;
        self.last_brake = state.last_brake;
        self.n_motions = state.n_motions;
        self.n_targets = state.n_targets;
        self.latest = state.times.latest.map(|Nanos(at)| at);
        self.last_cycle = state.times.last_cycle.map(|Nanos(at)| at);
        Ok(())
    }
}

impl State {
    /// Lengths of the lists of joint values.
    fn n_joints(&self) -> impl Iterator<Item = usize> {
        let target = self.motion.as_ref().map(|motion| motion.target.len());
        target.into_iter().chain(self.clutch.n_joints())
    }
}
