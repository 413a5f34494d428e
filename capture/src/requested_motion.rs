//! A motion of an arm to joint positions that a user has requested, and its result.

use crate::config::Rig;
use crate::open;
use crate::supervised_arm::SupervisedArm;
use drivers::clock;
use drivers::motion::JointTarget;
use kinematics::{JointState, Stamp};
use messages::{BadInput, Setting};
use serde::Serialize;

/// A target may exceed the joint range by this much, rad or m.
const TOLERANCE_RAD: f64 = 1e-4;

/// Where an arm moves.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RequestedMotion {
    /// Positions of all joints, rad or m.
    pub to: Option<Vec<f64>>,
    /// Joints, and by how much they move from their current positions, rad or m.
    pub by: Vec<(String, f64)>,
}

impl RequestedMotion {
    /// Whether there is nothing to move.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.to.is_none() && self.by.is_empty()
    }

    /// Rejects joints that the arm does not have, and wrong numbers of positions.
    ///
    /// # Errors
    /// Describes the first mistake.
    pub fn check(&self, rig: &Rig) -> Result<(), BadInput> {
        let joints = &rig.arm.joints;
        if let Some(to) = self.to.as_ref().filter(|to| to.len() != joints.len()) {
            let n = to.len();
            let names = joints.join(", ");
            return Err(BadInput(format!(
                "{} has {n} positions, the arm has {} joints: {names}",
                Setting::Positions,
                joints.len()
            )));
        }
        // Two values for a joint are ambiguous: the user may mean their sum, or the last value.
        if let Some(joint) = joints
            .iter()
            .find(|joint| self.by.iter().filter(|(by, _)| by == *joint).count() > 1)
        {
            return Err(BadInput(format!(
                "{}: joint {joint:?} is given twice",
                Setting::By
            )));
        }
        if let Some((joint, _)) = self.by.iter().find(|(joint, _)| !joints.contains(joint)) {
            let available = if joints.is_empty() {
                "none".to_owned()
            } else {
                joints.join(", ")
            };
            return Err(BadInput(format!(
                "{}: unknown joint {joint:?}; joints of the arm: {available}",
                Setting::By
            )));
        }
        Ok(())
    }

    /// Sends the target to the arm. Returns the target after it was clamped to the limits.
    ///
    /// * `now`: the joints before the motion.
    ///
    /// # Errors
    /// If the target is outside of the range of a joint, or the arm rejects it. Then nothing moves.
    pub fn start(
        &self,
        arm: &mut SupervisedArm,
        rig: &Rig,
        now: &JointState,
    ) -> anyhow::Result<JointTarget> {
        let requested = self.target(&rig.arm.joints, now);
        // The target is checked before it is sent. The driver would clamp it, and the arm would
        // move although the target is a mistake.
        check_range(rig, &requested, now)?;
        let target = arm.command(&requested)?;
        for (joint, (requested, accepted)) in rig
            .arm
            .joints
            .iter()
            .zip(requested.position.iter().zip(&target.position))
        {
            if (requested - accepted).abs() > TOLERANCE_RAD {
                log::warn!(
                    "joint {joint:?} moves to {accepted:.4}, the limit of its range, instead of {requested:.4}"
                );
            }
        }
        Ok(target)
    }

    fn target(&self, joints: &[String], now: &JointState) -> JointTarget {
        // Without target positions, joints that `by` does not name stay where they are.
        let mut position = self.to.clone().unwrap_or_else(|| now.position.clone());
        for (joint, delta) in &self.by {
            let moved = joints
                .iter()
                .zip(&mut position)
                .find(|(name, _)| *name == joint);
            if let Some((_, position)) = moved {
                *position += delta;
            }
        }
        JointTarget { position }
    }
}

/// Rejects a target outside the joint ranges of the URDF, so that a typing error does not move an
/// arm to its limits. A joint that is already outside its range may stay there.
fn check_range(rig: &Rig, requested: &JointTarget, now: &JointState) -> anyhow::Result<()> {
    let chain = open::chain_of(rig)?;
    for (ix, joint) in rig.arm.joints.iter().enumerate() {
        let Some(joint_ix) = chain.joint_names().iter().position(|known| known == joint) else {
            continue;
        };
        let lower = chain.limits()[joint_ix].lower;
        let upper = chain.limits()[joint_ix].upper;
        let requested = requested.position[ix];
        let now = now.position[ix];
        // Rounded positions of a joint at its limit may lie slightly outside.
        if (requested - now).abs() > TOLERANCE_RAD
            && !(lower - TOLERANCE_RAD..=upper + TOLERANCE_RAD).contains(&requested)
        {
            return Err(BadInput(format!(
                "joint {joint:?}: target {requested:.4} is outside its range of {lower:.4} to {upper:.4}; the joint is at {now:.4}, and nothing was moved"
            ))
            .into());
        }
    }
    Ok(())
}

/// Where an arm has arrived. It serializes as JSON.
#[derive(Debug, Serialize)]
pub struct Arrival<'a> {
    event: &'static str,
    joints: &'a [String],
    /// The target, and the position that the joints report, rad or m.
    target: &'a [f64],
    position: &'a [f64],
    /// Largest absolute difference between the two.
    error: f64,
    seconds: f64,
}

impl<'a> Arrival<'a> {
    /// The arrival at a target of a motion that began at `began`.
    ///
    /// * `last`: the joints at the end.
    #[must_use]
    pub fn new(
        joints: &'a [String],
        target: &'a JointTarget,
        last: &'a JointState,
        began: Stamp,
    ) -> Self {
        let errors = target
            .position
            .iter()
            .zip(&last.position)
            .map(|(target, actual)| (target - actual).abs());
        Self {
            event: "done",
            joints,
            target: &target.position,
            position: &last.position,
            error: errors.fold(0.0, f64::max),
            seconds: clock::now().secs_since(began),
        }
    }

    /// The arrival as one line.
    #[must_use]
    pub fn line(&self) -> String {
        format!(
            "arrived after {:.1} s at {}, maximum error {:.5}",
            self.seconds,
            format_positions(self.position),
            self.error
        )
    }
}

/// Positions of joints as text, rad or m.
#[must_use]
pub fn format_positions(position: &[f64]) -> String {
    position
        .iter()
        .map(|position| format!("{position:.4}"))
        .collect::<Vec<_>>()
        .join(", ")
}
