//! The region of postures in which an arm must be while its base moves.

use crate::base_verdict::SeenPosture;
use crate::reason::Reason;
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// A posture, and how far each joint may be away from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stowed {
    /// Names of the joints.
    pub joints: Vec<String>,
    /// Position of each joint, radians or meters.
    pub position: Vec<f64>,
    /// Largest distance of each joint, radians or meters.
    pub tolerance: f64,
}

impl Stowed {
    /// Why the base may not move, if it may not.
    pub(crate) fn refusal(
        &self,
        now: Stamp,
        arm: Option<&SeenPosture>,
        max_age_secs: f64,
    ) -> Option<Reason> {
        let known = arm.filter(|arm| {
            // Written so that nothing but an age within the limit counts.
            let is_fresh = now.secs_since(arm.at) <= max_age_secs;
            is_fresh && arm.position.len() == self.position.len()
        });
        let Some(arm) = known else {
            return Some(Reason::ArmUnknown);
        };
        let offsets = arm.position.iter().zip(&self.position);
        let offsets = offsets.map(|(position, stowed)| (position - stowed).abs());
        let is_off = |offset: f64| {
            let is_near = offset <= self.tolerance;
            !is_near
        };
        let (joint_ix, offset) = offsets.enumerate().find(|(_, offset)| is_off(*offset))?;
        Some(Reason::ArmNotStowed {
            joint: self.joints[joint_ix].clone(),
            offset,
        })
    }
}
