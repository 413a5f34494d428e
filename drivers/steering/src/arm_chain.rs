//! The links of an arm after lease and clutch: limits, self-collision and clearance.

use crate::authority::Authority;
use crate::body::Body;
use crate::capsule::Capsule;
use crate::check::{check, positive};
use crate::clearance::{ClearanceConfig, ClearancePoints, Restriction};
use crate::clutch::ClutchConfig;
use crate::error::Error;
use crate::inverse::InverseKinematics;
use crate::lease::LeaseConfig;
use crate::limits::{Goal, LimitConfig, Limits, Model, Pace, moved_tip};
use crate::reason::{Effect, Limit, Link, Reason, braked, refused};
use crate::request::Intent;
use crate::self_collision::{ClosePair, SelfCollision, SelfCollisionConfig};
use crate::verdict::Verdict;
use drivers::motion::{ArmState, MotionLimits, Output, Target, exact};
use kinematics::{Chain, Stamp, Transform};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

mod posture_check;

/// Configuration of all links.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SteeringConfig {
    /// Who may move the arm.
    pub lease: LeaseConfig,
    /// Devices and their dead-man switches.
    pub clutch: ClutchConfig,
    /// How fast and how far the arm may move.
    pub limits: LimitConfig,
    /// Distance between parts of the robot.
    pub self_collision: SelfCollisionConfig,
    /// Distance from the scene.
    pub clearance: ClearanceConfig,
    /// How long an arm follows a target without a newer one.
    pub target_expiry_secs: f64,
    /// Age of the arm's state from which the arm must brake.
    pub max_arm_silence_secs: f64,
    /// Fraction of full speed while the base under the arm moves.
    pub moving_base_frac: f64,
}

impl Default for SteeringConfig {
    fn default() -> Self {
        Self {
            lease: LeaseConfig::default(),
            clutch: ClutchConfig::default(),
            limits: LimitConfig::default(),
            self_collision: SelfCollisionConfig::default(),
            clearance: ClearanceConfig::default(),
            target_expiry_secs: 0.1,
            max_arm_silence_secs: 0.1,
            moving_base_frac: 0.25,
        }
    }
}

/// The robot of a chain of decisions.
pub struct Robot<'a> {
    /// Joints that move.
    pub chain: Chain,
    /// Inverse kinematics of the same joints.
    pub inverse: Box<dyn InverseKinematics + Send>,
    /// Shape of the robot.
    pub body: Body,
    /// Limits of the joints, as the generator of the setpoints has them.
    pub joints: &'a [MotionLimits],
    /// A posture in which no parts of the robot touch, if one is known, such as that at the start;
    /// see [`SelfCollision::new`].
    pub free_posture: Option<&'a [f64]>,
}

/// Longest time between two cycles for which the target moves on. After a longer pause, the target
/// continues as if the pause had been this long.
const MAX_CYCLE_SECS: f64 = 0.05;
/// How much closer a surface may appear at the target before the arm brakes, meters. It is larger
/// than the noise of a distance field, and smaller than the stop distance.
const MAX_APPROACH_M: f64 = 0.005;

/// Decides how an arm moves while an operator may move it.
pub(crate) struct ArmChain {
    pub(crate) config: SteeringConfig,
    pub(crate) chain: Chain,
    inverse: Box<dyn InverseKinematics + Send>,
    pub(crate) body: Body,
    pub(crate) limits: Limits,
    pub(crate) self_collision: SelfCollision,
    pub(crate) clearance: Arc<ClearancePoints>,
    /// Posture for which the pairs of parts were selected.
    pub(crate) free_posture: Option<Vec<f64>>,
    state: ArmChainState,
}

/// All that the chain of an arm remembers between two calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ArmChainState {
    /// Whether the newest report of the arm says that it is stopped.
    is_stopped: bool,
    /// The motion of the grip that is held; `None` while the arm must be at rest.
    motion: Option<Motion>,
    n_motions: u64,
    n_targets: u64,
    /// Time of the last cycle.
    pub(crate) last_cycle_nanos: Option<i64>,
}

impl ArmChainState {
    /// Number of joints of the target.
    pub(crate) fn n_joints(&self) -> Option<usize> {
        self.motion.as_ref().map(|motion| motion.target.len())
    }
}

/// A motion from a grip until the arm brakes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Motion {
    /// Number of the grip.
    grip: u64,
    /// The last target.
    #[serde(with = "exact::list")]
    target: Vec<f64>,
    /// Distance from the scene at which this target was accepted; infinite without a surface.
    #[serde(with = "exact::number")]
    accepted_m: f64,
}

/// Robot and scene in one posture.
struct Surroundings {
    close_pairs: Vec<ClosePair>,
    points_in_base: Vec<[f64; 3]>,
    restrictions: Vec<Restriction>,
}

/// Inputs of one step of a target.
struct Way<'a> {
    motion: &'a Motion,
    arm: &'a ArmState,
    pace: Pace,
    here: &'a Surroundings,
}

/// Returns what is known about points of the robot.
pub(crate) type Look<'a> = dyn FnMut(&[[f64; 3]]) -> Vec<Restriction> + 'a;

/// Inputs of one cycle of an arm.
pub(crate) struct ArmInput<'a> {
    pub(crate) now: Stamp,
    pub(crate) arm: &'a ArmState,
    /// Factor on the speed because the base under the arm moves.
    pub(crate) base_scale: f64,
}

impl std::fmt::Debug for ArmChain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ArmChain")
            .field("config", &self.config)
            .field("state", &self.state)
            .finish_non_exhaustive()
    }
}

impl ArmChain {
    /// * `config`: its lease and clutch are not used here.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range, or numbers of joints differ.
    pub(crate) fn new(config: SteeringConfig, robot: Robot<'_>) -> Result<Self, Error> {
        check_times(&config)?;
        let n_joints = robot.chain.n_joints();
        let limits = Limits::new(config.limits, robot.joints, n_joints)?;
        let self_collision = SelfCollision::new(
            config.self_collision,
            &robot.body,
            &limits.ranges(),
            robot.free_posture,
        )?;
        let zero = vec![0.0; n_joints];
        let clearance = ClearancePoints::new(config.clearance.clone(), &robot.body, &zero)?;
        Ok(Self {
            config,
            chain: robot.chain,
            inverse: robot.inverse,
            body: robot.body,
            limits,
            self_collision,
            clearance: Arc::new(clearance),
            free_posture: robot.free_posture.map(<[f64]>::to_vec),
            state: ArmChainState::default(),
        })
    }

    pub(crate) fn state(&self) -> ArmChainState {
        self.state.clone()
    }

    pub(crate) fn set_state(&mut self, state: ArmChainState) {
        self.state = state;
    }

    /// Notes a stop of the arm: once if it lasts, and again if motion was permitted meanwhile.
    pub(crate) fn note_stopped(&mut self, authority: &mut Authority, arm: &ArmState) {
        let was_stopped = std::mem::replace(&mut self.state.is_stopped, arm.stopped.is_some());
        let Some(report) = &arm.stopped else {
            return;
        };
        if authority.stop().is_none() || !was_stopped {
            let report = report.clone();
            authority.latch_stop(Link::Arm, Reason::ArmStopped { report });
        }
    }

    /// What is wrong with the state of the arm.
    pub(crate) fn problem(&self, now: Stamp, arm: &ArmState) -> Option<Reason> {
        let silent_secs = now.secs_since(arm.reported_at);
        if silent_secs > self.config.max_arm_silence_secs {
            return Some(Reason::ArmSilent { silent_secs });
        }
        let expected = self.chain.n_joints();
        let got = arm.position.len();
        if got != expected {
            let report = format!("{got} joints instead of {expected}");
            return Some(Reason::ArmReport { report });
        }
        let not_finite = arm.position.iter().position(|q| !q.is_finite())?;
        let joint = &self.chain.joint_names()[not_finite];
        let report = format!("no finite position of joint {joint}");
        Some(Reason::ArmReport { report })
    }

    /// Moves the target, if the arm may begin or continue its motion.
    pub(crate) fn decide(
        &mut self,
        authority: &mut Authority,
        input: &ArmInput<'_>,
        look: &mut Look<'_>,
    ) -> Verdict {
        let secs = self.note_cycle(input.now);
        match self.permitted_motion(authority, input.arm) {
            Ok(motion) => self.move_target(authority, motion, input, secs, look),
            Err((link, reason)) => {
                self.state.motion = None;
                braking(link, reason)
            }
        }
    }

    /// Keeps the arm at rest.
    pub(crate) fn rest(&mut self, now: Stamp, (link, reason): (Link, Reason)) -> Verdict {
        self.note_cycle(now);
        self.state.motion = None;
        braking(link, reason)
    }

    /// Time since the last cycle for which the target moves on.
    fn note_cycle(&mut self, now: Stamp) -> f64 {
        let last = self.state.last_cycle_nanos.replace(now.0).map(Stamp);
        let since_last = last.map_or(0.0, |last| now.secs_since(last));
        since_last.clamp(0.0, MAX_CYCLE_SECS)
    }

    /// The motion of the grip, which the arm itself may end.
    fn permitted_motion(
        &mut self,
        authority: &mut Authority,
        arm: &ArmState,
    ) -> Result<Motion, (Link, Reason)> {
        let grip = authority.grip_number();
        // A grip may follow another one whose release was lost.
        let motion = self.state.motion.take();
        match motion.filter(|motion| motion.grip == grip) {
            Some(_) if arm.braked_motion >= self.state.n_motions => {
                Err(authority.brake(Link::Arm, Reason::ArmBraked))
            }
            Some(motion) if arm.is_at_rest => {
                // The target of an arm at rest is at most one step away. If the arm is elsewhere, a
                // person has moved it by hand, and it must not move back without a new grip.
                match self.limits.lag(&self.chain, &motion.target, &arm.position) {
                    Some(reason) => Err(authority.brake(Link::Arm, reason)),
                    None => Ok(motion),
                }
            }
            Some(motion) => Ok(motion),
            // The grip starts where the arm comes to rest, so it waits until then.
            None if !arm.is_at_rest => Err((Link::Arm, Reason::StillBraking)),
            None => {
                // An arm that lived longer than this chain has braked after higher numbers.
                self.state.n_motions = self.state.n_motions.max(arm.braked_motion) + 1;
                Ok(Motion {
                    grip,
                    target: arm.position.clone(),
                    accepted_m: f64::NEG_INFINITY,
                })
            }
        }
    }

    /// Moves the target one step toward the goal, as far as limits and distances permit.
    fn move_target(
        &mut self,
        authority: &mut Authority,
        motion: Motion,
        input: &ArmInput<'_>,
        secs: f64,
        look: &mut Look<'_>,
    ) -> Verdict {
        let is_new = motion.accepted_m == f64::NEG_INFINITY;
        let here = self.surroundings(&motion.target, look);
        // A surface may have appeared at a target that was free when it was accepted.
        let (nearest_m, nearest) = self.clearance.nearest(&here.restrictions);
        let has_approached =
            nearest_m < self.clearance.stop_m() && nearest_m < motion.accepted_m - MAX_APPROACH_M;
        if let (true, false, Some(nearest)) = (has_approached, is_new, nearest) {
            let reason = self
                .clearance
                .reason(&nearest, &here.points_in_base, &self.body);
            let (link, reason) = authority.brake(Link::Clearance, reason);
            return braking(link, reason);
        }
        let mut limits = Vec::new();
        if input.base_scale < 1.0 {
            limits.push(Limit {
                link: Link::Base,
                effect: Effect::Slowed(input.base_scale),
                reason: Reason::BaseMoves,
            });
        }
        let pace = Pace {
            secs,
            scale: input.base_scale * self.speed_scale(&here, &mut limits),
        };
        let way = Way {
            motion: &motion,
            arm: input.arm,
            pace,
            here: &here,
        };
        let accepted = self.accepted_step(authority, &way, look, &mut limits);
        let (target, accepted_m) =
            accepted.unwrap_or((motion.target, nearest_m.max(motion.accepted_m)));
        limits.sort_by_key(|limit| limit.link);
        self.state.motion = Some(Motion {
            grip: motion.grip,
            target: target.clone(),
            accepted_m,
        });
        self.state.n_targets += 1;
        Verdict {
            output: Output::Follow(Target {
                motion: self.state.n_motions,
                serial: self.state.n_targets,
                position: target,
                expires_at: authority.expiry(input.now, self.config.target_expiry_secs),
            }),
            limits,
        }
    }

    /// Fraction of full speed because of what is near.
    fn speed_scale(&self, here: &Surroundings, limits: &mut Vec<Limit>) -> f64 {
        let own = self.self_collision.speed(&here.close_pairs, &self.body);
        let scene = self
            .clearance
            .speed(&here.restrictions, &here.points_in_base, &self.body);
        let mut slowest = 1.0;
        for (link, (scale, reason)) in [(Link::SelfCollision, own), (Link::Clearance, scene)] {
            if let (true, Some(reason)) = (scale < 1.0, reason) {
                limits.push(Limit {
                    link,
                    effect: Effect::Slowed(scale),
                    reason,
                });
            }
            slowest = f64::min(slowest, scale);
        }
        slowest
    }

    /// The next target, and its distance from the scene. `None` if the target stays.
    fn accepted_step(
        &self,
        authority: &mut Authority,
        way: &Way<'_>,
        look: &mut Look<'_>,
        limits: &mut Vec<Limit>,
    ) -> Option<(Vec<f64>, f64)> {
        let Way {
            motion,
            arm,
            pace,
            here,
        } = *way;
        let q = &motion.target;
        // The grip starts at the tip's pose at rest, also if the target cannot move yet.
        let tip = self.chain.forward(q).ok()?;
        let goal = goal(authority, &tip, q, pace)?;
        if Limits::has_not_begun(q, arm) {
            return None;
        }
        if let Some(reason) = self.limits.lag(&self.chain, q, &arm.position) {
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Slowed(0.0),
                reason,
            });
            return None;
        }
        let model = Model {
            chain: &self.chain,
            inverse: self.inverse.as_ref(),
            body: &self.body,
        };
        let step = match self.limits.step(&model, q, &goal, pace) {
            Ok(step) => step,
            Err(reason) => {
                limits.push(refused(Link::Limits, reason));
                return None;
            }
        };
        limits.extend(step.limits);
        if step.q == *q {
            return None;
        }
        let there = self.surroundings(&step.q, look);
        let own = self
            .self_collision
            .refusal(&here.close_pairs, &there.close_pairs, &self.body);
        let scene = self.clearance.refusal(
            &here.restrictions,
            &there.restrictions,
            &there.points_in_base,
            &self.body,
        );
        limits.extend(own.map(|reason| refused(Link::SelfCollision, reason)));
        limits.extend(scene.map(|reason| refused(Link::Clearance, reason)));
        let is_refused = limits.iter().any(|limit| {
            limit.effect == Effect::Refused
                && matches!(limit.link, Link::SelfCollision | Link::Clearance)
        });
        let (nearest_m, _) = self.clearance.nearest(&there.restrictions);
        (!is_refused).then_some((step.q, nearest_m))
    }

    fn surroundings(&self, q: &[f64], look: &mut Look<'_>) -> Surroundings {
        let capsules: Vec<Capsule> = self.body.capsules(q);
        let points_in_base = self.clearance.in_base(&capsules);
        Surroundings {
            close_pairs: self.self_collision.close_pairs(&capsules),
            restrictions: look(&points_in_base),
            points_in_base,
        }
    }
}

/// Where the operator wants the arm; `None` if the clutch is open.
fn goal(
    authority: &mut Authority,
    base_from_tip: &Transform,
    q: &[f64],
    pace: Pace,
) -> Option<Goal> {
    if let Some(pose) = authority.goal(base_from_tip) {
        return Some(Goal::Pose(pose));
    }
    match &authority.held()?.intent {
        Intent::Joints { position } => Some(Goal::Joints(position.clone())),
        Intent::JointVelocity { velocity } => {
            let moved = q.iter().zip(velocity).map(|(q, v)| q + v * pace.secs);
            Some(Goal::Joints(moved.collect()))
        }
        Intent::TipVelocity {
            linear_m_s,
            angular_rad_s,
        } => {
            let pose = moved_tip(base_from_tip, *linear_m_s, *angular_rad_s, pace.secs);
            Some(Goal::Pose(pose))
        }
        Intent::Hand { .. }
        | Intent::Pose { .. }
        | Intent::BaseVelocity { .. }
        | Intent::BaseGoal { .. } => None,
    }
}

fn braking(link: Link, reason: Reason) -> Verdict {
    Verdict {
        output: Output::Brake,
        limits: vec![braked(link, reason)],
    }
}

fn check_times(config: &SteeringConfig) -> Result<(), Error> {
    positive("target_expiry_secs", config.target_expiry_secs)?;
    positive("max_arm_silence_secs", config.max_arm_silence_secs)?;
    let frac = config.moving_base_frac;
    let is_valid = frac > 0.0 && frac <= 1.0;
    check(
        "moving_base_frac",
        frac,
        is_valid,
        "more than 0 and at most 1",
    )
}
