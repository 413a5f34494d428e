//! Third link: how far the target moves in one cycle.
//!
//! The target moves in small steps from the last one toward the goal. Each step is limited in the
//! speed of the tip, of every joint and of every part of the robot, so an elbow cannot swing fast
//! while the tip moves slowly. Acceleration and jerk are limits of the generator of the setpoints.
//! Near a singular posture, joints move far for small motions of the tip. Their limit then slows
//! the tip down.

use crate::body::Body;
use crate::check::{check, positive};
use crate::error::Error;
use crate::inverse::InverseKinematics;
use crate::reason::{Effect, Limit, Link, Reason};
use drivers::motion::{ArmState, MotionLimits};
use kinematics::{Chain, Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Limits of the target.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LimitConfig {
    /// Maximum speed of the tip and of every other part of the robot.
    pub max_speed_m_s: f64,
    /// Maximum angular speed of the tip.
    pub max_angular_rad_s: f64,
    /// Lower and upper corner of the box in the frame of the base that the tip stays in, meters.
    pub workspace_m: Option<[[f64; 3]; 2]>,
    /// Distance of targets from the ends of the ranges of the joints, radians or meters.
    pub joint_margin: f64,
    /// How far the target may be ahead of the arm: the distance that a joint moves in this time at
    /// its maximum velocity. The generator moves all joints in a straight line to the target. With
    /// a larger lead, this line could leave the path that was checked.
    pub max_lead_secs: f64,
}

impl Default for LimitConfig {
    fn default() -> Self {
        Self {
            // The speed up to which ISO 10218-1 permits a person near a robot in manual operation.
            max_speed_m_s: 0.25,
            max_angular_rad_s: 1.0,
            workspace_m: None,
            joint_margin: 0.02,
            max_lead_secs: 0.3,
        }
    }
}

/// Rounding of the position in which an arm comes to rest at its target, radians or meters.
const ARRIVAL: f64 = 1e-4;
/// Maximum distance of a joint between two targets, before the step is shortened. A longer one
/// means that the posture found is another branch of solutions. The way to it would not follow the
/// pose.
const MAX_POSTURE_STEP: f64 = 0.3;
/// Rounding of postures at the end of a range, radians or meters.
const ROUNDING: f64 = 1e-9;
/// Step lengths that are tried if no posture is found for the whole step.
const STEP_FRACS: [f64; 3] = [1.0, 0.5, 0.25];
/// Rounds in which a step is shortened. Parts move on arcs, so shortening by a ratio may leave them
/// slightly too fast.
const MAX_ROUNDS: usize = 3;

/// Where the operator wants the arm.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Goal {
    /// Pose of the tip, `base_from_tip`.
    Pose(Transform),
    /// Joint positions.
    Joints(Vec<f64>),
}

/// The limits, checked.
#[derive(Clone, Debug)]
pub(crate) struct Limits {
    pub(crate) config: LimitConfig,
    joints: Vec<MotionLimits>,
}

/// A step that respects the limits.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Step {
    pub(crate) q: Vec<f64>,
    pub(crate) limits: Vec<Limit>,
}

/// What a step needs to know about the robot.
pub(crate) struct Model<'a> {
    pub(crate) chain: &'a Chain,
    pub(crate) inverse: &'a dyn InverseKinematics,
    pub(crate) body: &'a Body,
}

/// Duration of a cycle, and the fraction of full speed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pace {
    pub(crate) secs: f64,
    pub(crate) scale: f64,
}

impl Limits {
    /// Checks the limits. `joints` has one entry per joint of the chain.
    pub(crate) fn new(
        config: LimitConfig,
        joints: &[MotionLimits],
        n_joints: usize,
    ) -> Result<Self, Error> {
        if joints.len() != n_joints {
            return Err(Error::JointCount {
                what: "the list of motion limits",
                got: joints.len(),
                expected: n_joints,
            });
        }
        positive("limits.max_speed_m_s", config.max_speed_m_s)?;
        positive("limits.max_angular_rad_s", config.max_angular_rad_s)?;
        positive("limits.max_lead_secs", config.max_lead_secs)?;
        let margin = config.joint_margin;
        let is_valid = margin >= 0.0 && margin.is_finite();
        check(
            "limits.joint_margin",
            margin,
            is_valid,
            "0 or a positive number",
        )?;
        for (ix, joint) in joints.iter().enumerate() {
            positive(format!("the velocity of joint {}", ix + 1), joint.velocity)?;
            let [lower, upper] = joint.position;
            check(
                format!("the range of joint {} without margins", ix + 1),
                upper - lower,
                upper - lower > 2.0 * margin,
                "more than twice limits.joint_margin",
            )?;
        }
        if let Some([low, high]) = config.workspace_m {
            for (low, high) in low.iter().zip(&high) {
                let side_m = high - low;
                let what = "a side of limits.workspace_m";
                check(what, side_m, side_m > 0.0, "a positive number")?;
            }
        }
        Ok(Self {
            config,
            joints: joints.to_vec(),
        })
    }

    /// Limits of the joints.
    pub(crate) fn joints(&self) -> &[MotionLimits] {
        &self.joints
    }

    /// Ranges of the joints, without margins.
    pub(crate) fn ranges(&self) -> Vec<[f64; 2]> {
        self.joints.iter().map(|joint| joint.position).collect()
    }

    /// Why the arm may not rest at a posture, if it may not: a joint is outside its range, or the tip
    /// is outside the workspace.
    pub(crate) fn outside(&self, chain: &Chain, q: &[f64]) -> Option<Reason> {
        let margin = self.config.joint_margin;
        let outside = q.iter().zip(&self.joints).position(|(q, joint)| {
            let [lower, upper] = joint.position;
            // Written so that NaN is outside.
            let is_inside = *q >= lower + margin - ROUNDING && *q <= upper - margin + ROUNDING;
            !is_inside
        });
        if let Some(ix) = outside {
            let joint = chain.joint_names()[ix].clone();
            return Some(Reason::JointRange { joint });
        }
        let [low, high] = self.config.workspace_m?;
        let tip = chain.forward(q).ok()?.translation.vector;
        let is_inside = (0..3).all(|axis| (low[axis]..=high[axis]).contains(&tip[axis]));
        (!is_inside).then(|| Reason::Workspace { place: tip.into() })
    }

    /// The joint that is too far behind its target, and by how much.
    pub(crate) fn lag(&self, chain: &Chain, target: &[f64], arm: &[f64]) -> Option<Reason> {
        let joints = target.iter().zip(arm).zip(&self.joints).enumerate();
        joints
            .map(|(ix, ((target, arm), joint))| (ix, (target - arm).abs(), joint.velocity))
            .find(|(_, lag, velocity)| *lag > velocity * self.config.max_lead_secs)
            .map(|(ix, lag, _)| Reason::Lag {
                joint: chain.joint_names()[ix].clone(),
                lag,
            })
    }

    /// Whether an arm at rest has not begun to move to its target, for example because its
    /// controller takes a while to start a motion. A target that moved on would make the arm catch
    /// up with the speed of its joints, faster than its parts may be and beside the checked path.
    pub(crate) fn has_not_begun(target: &[f64], arm: &ArmState) -> bool {
        let pairs = target.iter().zip(&arm.position);
        arm.is_at_rest && pairs.map(|(a, b)| (a - b).abs()).any(|gap| gap > ARRIVAL)
    }

    /// A step from `q` toward a goal.
    pub(crate) fn step(
        &self,
        model: &Model<'_>,
        q: &[f64],
        goal: &Goal,
        pace: Pace,
    ) -> Result<Step, Reason> {
        let mut limits = Vec::new();
        let bounds = self.bounds(q);
        let toward = match goal {
            Goal::Joints(goal) => clamp_joints(model.chain, goal, &bounds, &mut limits),
            Goal::Pose(goal) => self.toward_pose(model, q, goal, pace, &bounds, &mut limits)?,
        };
        let shortened = self.shorten(model, q, toward, pace, &mut limits);
        Ok(Step {
            q: shortened,
            limits,
        })
    }

    /// The ranges with margins. A joint that is already beyond a margin may stay and come back.
    fn bounds(&self, q: &[f64]) -> Vec<[f64; 2]> {
        let margin = self.config.joint_margin;
        q.iter()
            .zip(&self.joints)
            .map(|(q, joint)| {
                let [lower, upper] = joint.position;
                [q.min(lower + margin), q.max(upper - margin)]
            })
            .collect()
    }

    /// Joint values after a step of the tip toward a pose.
    fn toward_pose(
        &self,
        model: &Model<'_>,
        q: &[f64],
        goal: &Transform,
        pace: Pace,
        bounds: &[[f64; 2]],
        limits: &mut Vec<Limit>,
    ) -> Result<Vec<f64>, Reason> {
        let unreachable = |pose: &Transform| Reason::Unreachable {
            place: pose.translation.vector.into(),
        };
        let tip = model.chain.forward(q).map_err(|_| unreachable(goal))?;
        let goal = self.clamp_to_workspace(&tip, goal, limits);
        let frac = self.tip_frac(&tip, &goal, pace);
        if frac < 1.0 {
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Slowed(frac),
                reason: Reason::TipSpeed,
            });
        }
        for step_frac in STEP_FRACS {
            let next = transform::interpolate(&tip, &goal, frac * step_frac);
            let Some(found) = model.inverse.solve(&next, q, bounds) else {
                continue;
            };
            return same_branch(model.chain, q, found);
        }
        Err(unreachable(&goal))
    }

    /// Moves a goal into the workspace box. A tip outside the box may stay there and come back.
    fn clamp_to_workspace(
        &self,
        tip: &Transform,
        goal: &Transform,
        limits: &mut Vec<Limit>,
    ) -> Transform {
        let Some([low, high]) = self.config.workspace_m else {
            return *goal;
        };
        let tip = tip.translation.vector;
        let low = Vector3::from(low).inf(&tip);
        let high = Vector3::from(high).sup(&tip);
        let wanted = goal.translation.vector;
        let inside = wanted.sup(&low).inf(&high);
        if inside != wanted {
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Refused,
                reason: Reason::Workspace {
                    place: wanted.into(),
                },
            });
        }
        Transform::from_parts(inside.into(), goal.rotation)
    }

    /// The part of the way to a goal that the tip moves in one cycle. Translation and rotation are
    /// shortened by the same factor, so that the path is straight.
    fn tip_frac(&self, tip: &Transform, goal: &Transform, pace: Pace) -> f64 {
        let distance_m = (goal.translation.vector - tip.translation.vector).norm();
        let angle_rad = tip.rotation.angle_to(&goal.rotation);
        let cycle = pace.secs * pace.scale;
        let frac = |max: f64, way: f64| if way > max { max / way } else { 1.0 };
        frac(self.config.max_speed_m_s * cycle, distance_m)
            .min(frac(self.config.max_angular_rad_s * cycle, angle_rad))
    }

    /// Shortens a step until no joint and no part of the robot is too fast.
    fn shorten(
        &self,
        model: &Model<'_>,
        q: &[f64],
        toward: Vec<f64>,
        pace: Pace,
        limits: &mut Vec<Limit>,
    ) -> Vec<f64> {
        let cycle = pace.secs * pace.scale;
        // Written so that NaN stays.
        let is_moving = cycle > 0.0;
        if !is_moving {
            return q.to_vec();
        }
        let mut next = toward;
        for _ in 0..MAX_ROUNDS {
            let Some((ratio, reason)) = self.excess(model, q, &next, cycle) else {
                return next;
            };
            let scale = 1.0 / ratio;
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Slowed(scale),
                reason,
            });
            for (next, q) in next.iter_mut().zip(q) {
                *next = q + (*next - q) * scale;
            }
        }
        next
    }

    /// By what factor a step is too long, and why.
    fn excess(
        &self,
        model: &Model<'_>,
        q: &[f64],
        next: &[f64],
        cycle: f64,
    ) -> Option<(f64, Reason)> {
        /// Rounding of a step that was shortened to its limit.
        const ROUNDING: f64 = 1e-9;
        let mut worst = (1.0 + ROUNDING, None);
        for (ix, joint) in self.joints.iter().enumerate() {
            let ratio = (next[ix] - q[ix]).abs() / (joint.velocity * cycle);
            if ratio > worst.0 {
                let joint = model.chain.joint_names()[ix].clone();
                worst = (ratio, Some(Reason::JointSpeed { joint }));
            }
        }
        let before = model.body.capsules(q);
        let after = model.body.capsules(next);
        for (part_ix, (before, after)) in before.iter().zip(&after).enumerate() {
            for end in 0..2 {
                let moved_m = (after.ends[end] - before.ends[end]).norm();
                let ratio = moved_m / (self.config.max_speed_m_s * cycle);
                if ratio > worst.0 {
                    let part = model.body.part(part_ix).link.clone();
                    let place = before.ends[end].into();
                    worst = (ratio, Some(Reason::PartSpeed { part, place }));
                }
            }
        }
        worst.1.map(|reason| (worst.0, reason))
    }
}

/// Clamps joint positions to bounds.
fn clamp_joints(
    chain: &Chain,
    goal: &[f64],
    bounds: &[[f64; 2]],
    limits: &mut Vec<Limit>,
) -> Vec<f64> {
    let mut clamped = Vec::with_capacity(goal.len());
    for (ix, (goal, [lower, upper])) in goal.iter().zip(bounds).enumerate() {
        let inside = goal.max(*lower).min(*upper);
        if inside != *goal {
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Refused,
                reason: Reason::JointRange {
                    joint: chain.joint_names()[ix].clone(),
                },
            });
        }
        clamped.push(inside);
    }
    clamped
}

/// Checks that a posture is close to the present one.
fn same_branch(chain: &Chain, q: &[f64], found: Vec<f64>) -> Result<Vec<f64>, Reason> {
    let steps = q.iter().zip(&found).map(|(q, found)| (found - q).abs());
    let longest = steps.enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b));
    match longest {
        Some((ix, step)) if step > MAX_POSTURE_STEP => Err(Reason::OtherPosture {
            joint: chain.joint_names()[ix].clone(),
            step,
        }),
        _ => Ok(found),
    }
}

/// The pose that a tip has after moving for `secs`, with velocities in axes of the base.
pub(crate) fn moved_tip(
    base_from_tip: &Transform,
    linear_m_s: [f64; 3],
    angular_rad_s: [f64; 3],
    secs: f64,
) -> Transform {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(angular_rad_s) * secs);
    Transform::from_parts(
        (base_from_tip.translation.vector + Vector3::from(linear_m_s) * secs).into(),
        rotation * base_from_tip.rotation,
    )
}
