//! The state of a chain of decisions, so that a record can begin at any time.

use super::Steering;
use crate::arm_chain::ArmChainState;
use crate::authority::AuthorityState;
use crate::base_chain::BaseChainState;
use crate::error::Error;
use serde::{Deserialize, Serialize};

/// All that a chain of decisions remembers between two calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {
    authority: AuthorityState,
    arm: Option<ArmChainState>,
    base: Option<BaseChainState>,
}

impl State {
    /// Whether two states differ at most in the times of the last calls.
    pub fn is_equal_except_times(&self, other: &Self) -> bool {
        let without_times = |state: &Self| {
            let mut state = state.clone();
            state.authority.latest_nanos = None;
            if let Some(arm) = &mut state.arm {
                arm.last_cycle_nanos = None;
            }
            state
        };
        without_times(self) == without_times(other)
    }

    /// Lengths of the lists of joint values.
    fn n_joints(&self) -> impl Iterator<Item = usize> {
        let target = self.arm.as_ref().and_then(ArmChainState::n_joints);
        target.into_iter().chain(self.authority.n_joints())
    }
}

impl Steering {
    /// All that the chain remembers.
    pub fn state(&self) -> State {
        State {
            authority: self.authority.state(),
            arm: self.arm.as_ref().map(|arm| arm.state()),
            base: self.base.as_ref().map(|base| base.state()),
        }
    }

    /// Continues from a state, of which another chain with the same robot and configuration was.
    ///
    /// # Errors
    /// If the state is of a robot with another number of joints, or with other parts. The chain then
    /// does not change.
    pub fn set_state(&mut self, state: State) -> Result<(), Error> {
        let expected = self.arm.as_ref().map_or(0, |arm| arm.chain.n_joints());
        let got = state.n_joints().find(|n_joints| *n_joints != expected);
        if let Some(got) = got {
            return Err(Error::State { got, expected });
        }
        let has_same_parts = state.arm.is_some() == self.arm.is_some()
            && state.base.is_some() == self.base.is_some();
        if !has_same_parts {
            return Err(Error::Parts);
        }
        self.authority.set_state(state.authority);
        if let Some((arm, state)) = self.arm.as_mut().zip(state.arm) {
            arm.set_state(state);
        }
        if let Some((base, state)) = self.base.as_mut().zip(state.base) {
            base.set_state(state);
        }
        Ok(())
    }
}
