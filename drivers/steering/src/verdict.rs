//! Inputs of one cycle, and the decision.

use crate::base_verdict::{BaseSituation, BaseVerdict};
use crate::reason::{Effect, Limit, Link, Reason, braked};
use drivers::motion::{ArmState, Output, Target};
use serde::{Deserialize, Serialize};

/// State of the steered parts of a robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Situation {
    /// The newest state of the arm, if it is steered.
    pub arm: Option<ArmState>,
    /// The newest state of the base, if it is steered.
    pub base: Option<BaseSituation>,
}

/// The decision of one cycle about all steered parts of a robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decision {
    /// The arm, if it is steered.
    pub arm: Option<Verdict>,
    /// The base, if it is steered.
    pub base: Option<BaseVerdict>,
}

/// The decision of one cycle about an arm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// What the arm should do.
    pub output: Output,
    /// The limits that were applied, in the order of the links.
    pub limits: Vec<Limit>,
}

impl Verdict {
    /// The decision about an arm that the chain does not have.
    pub(crate) fn braking_without_arm() -> Self {
        Self {
            output: Output::Brake,
            limits: vec![braked(Link::Clutch, Reason::OnlyBase)],
        }
    }

    /// Smallest fraction of the requested speed that a link left, 0 to 1: 0 if a link refused the
    /// motion or a part of it.
    pub fn speed_scale(&self) -> f64 {
        let scale = |limit: &Limit| match limit.effect {
            Effect::Slowed(scale) => scale,
            Effect::Refused | Effect::Braked => 0.0,
        };
        self.limits.iter().map(scale).fold(1.0, f64::min)
    }

    /// The target, if the arm should follow one.
    pub fn target(&self) -> Option<&Target> {
        match &self.output {
            Output::Follow(target) => Some(target),
            Output::Brake => None,
        }
    }
}
