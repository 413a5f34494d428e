//! The decision of one cycle.

use crate::reason::{Effect, Limit};
use drivers::motion::{Output, Target};
use serde::{Deserialize, Serialize};

/// The decision of one cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// What the arm should do.
    pub output: Output,
    /// The limits that were applied, in the order of the links.
    pub limits: Vec<Limit>,
}

impl Verdict {
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
