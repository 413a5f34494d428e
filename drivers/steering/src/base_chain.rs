//! The links of a base after lease and dead-man switch: posture of the arm, limits, area, goals, and
//! distance from the scene.

use crate::authority::Authority;
use crate::base_area::Area;
use crate::base_clearance::{
    BaseClearance, BaseClearanceConfig, Passage, RESPONSE_SECS, RoomLook, Way,
};
use crate::base_goal::toward;
use crate::base_verdict::{BaseSituation, BaseVerdict, FloorPose, SeenPose};
use crate::check::{check, positive};
use crate::clutch::ClutchConfig;
use crate::error::Error;
use crate::lease::LeaseConfig;
use crate::reason::{Effect, Limit, Link, Reason, braked, refused};
use crate::request::Intent;
use crate::stowed::Stowed;
use drivers::base_motion::{BaseLimits, BaseOutput, BaseState, BaseTarget, BaseVelocity};
use kinematics::Stamp;
use serde::{Deserialize, Serialize};

/// Configuration of the chain of a base.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseSteeringConfig {
    /// Who may move the base.
    pub lease: LeaseConfig,
    /// Devices and their dead-man switches.
    pub clutch: ClutchConfig,
    /// How fast the base may move.
    pub limits: BaseLimits,
    /// The rectangle on the floor in which the base link stays: smallest x and y, then largest x
    /// and y, in the world, meters. `None` for no bound.
    pub area_m: Option<[f64; 4]>,
    /// Where the arm on the base must be while the base moves; `None` without an arm.
    pub stowed: Option<Stowed>,
    /// How the base keeps away from the scene; `None` if nothing is known about the scene.
    pub clearance: Option<BaseClearanceConfig>,
    /// How long a base follows a target without a newer one.
    pub target_expiry_secs: f64,
    /// Age of the newest report of the base above which the base must brake.
    pub max_base_silence_secs: f64,
    /// Greatest age of the pose of the base and of the posture of the arm.
    pub max_pose_age_secs: f64,
}

impl BaseSteeringConfig {
    /// The defaults, with the limits of a base.
    pub fn new(limits: BaseLimits) -> Self {
        Self {
            lease: LeaseConfig::default(),
            clutch: ClutchConfig::default(),
            limits,
            area_m: None,
            stowed: None,
            clearance: None,
            target_expiry_secs: 0.1,
            // A base that is driven over a radio link may lose several replies in a row.
            max_base_silence_secs: 0.3,
            max_pose_age_secs: 0.5,
        }
    }

    fn check(&self) -> Result<(), Error> {
        for (what, value) in [
            ("target_expiry_secs", self.target_expiry_secs),
            ("max_base_silence_secs", self.max_base_silence_secs),
            ("max_pose_age_secs", self.max_pose_age_secs),
        ] {
            positive(what, value)?;
        }
        let limits = self.limits.check();
        limits.map_err(|error| Error::BaseLimits {
            why: error.to_string(),
        })?;
        if let Some([x0, y0, x1, y1]) = self.area_m {
            for (what, from, to) in [("area_m: largest x", x0, x1), ("area_m: largest y", y0, y1)] {
                let is_valid = to > from && to.is_finite() && from.is_finite();
                check(what, to, is_valid, "more than the smallest one")?;
            }
        }
        if let Some(stowed) = &self.stowed {
            let (got, expected) = (stowed.position.len(), stowed.joints.len());
            if got != expected {
                let what = "stowed position";
                return Err(Error::JointCount {
                    what,
                    got,
                    expected,
                });
            }
            positive("stowed.tolerance", stowed.tolerance)?;
        }
        Ok(())
    }
}

/// Decides how a base moves while an operator may move it.
#[derive(Debug)]
pub(crate) struct BaseChain {
    config: BaseSteeringConfig,
    area: Option<Area>,
    clearance: Option<BaseClearance>,
    state: BaseChainState,
}

/// All that the chain of a base remembers between two calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct BaseChainState {
    /// Whether the newest report of the base has a fault.
    has_fault: bool,
    /// The motion of the grip that is held; `None` while the base must be at rest.
    motion: Option<Motion>,
    n_motions: u64,
    n_targets: u64,
}

/// A motion from a grip until the base brakes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Motion {
    /// Number of the grip.
    grip: u64,
    /// The goal whose place was reached, if one was.
    reached: Option<FloorPose>,
}

/// Inputs of one cycle of a base.
pub(crate) struct BaseInput<'a> {
    pub(crate) now: Stamp,
    pub(crate) situation: &'a BaseSituation,
    /// Whether the arm on the base is at rest, if it is steered.
    pub(crate) is_arm_at_rest: bool,
}

/// Where the base is, and how fast.
struct Place<'a> {
    seen: Option<SeenPose>,
    /// Time from the pose until the base follows a decision.
    reaction_secs: f64,
    measured: &'a BaseVelocity,
}

impl BaseChain {
    /// * `config`: its lease and clutch are not used here.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range.
    pub(crate) fn new(config: BaseSteeringConfig) -> Result<Self, Error> {
        config.check()?;
        Ok(Self {
            area: config.area_m.map(Area::of),
            clearance: config
                .clearance
                .clone()
                .map(BaseClearance::new)
                .transpose()?,
            config,
            state: BaseChainState::default(),
        })
    }

    pub(crate) fn config(&self) -> &BaseSteeringConfig {
        &self.config
    }

    pub(crate) fn clearance(&self) -> Option<&BaseClearance> {
        self.clearance.as_ref()
    }

    pub(crate) fn state(&self) -> BaseChainState {
        self.state.clone()
    }

    pub(crate) fn set_state(&mut self, state: BaseChainState) {
        self.state = state;
    }

    /// Notes a fault of the base: once if it lasts, and again if motion was permitted meanwhile.
    pub(crate) fn note_fault(&mut self, authority: &mut Authority, base: &BaseState) {
        let had_fault = std::mem::replace(&mut self.state.has_fault, base.fault.is_some());
        let Some(report) = &base.fault else {
            return;
        };
        if authority.stop().is_none() || !had_fault {
            let report = report.clone();
            authority.latch_stop(Link::Base, Reason::BaseStopped { report });
        }
    }

    /// What is wrong with the report of the base.
    pub(crate) fn problem(&self, now: Stamp, base: &BaseState) -> Option<Reason> {
        let silent_secs = now.secs_since(base.reported_at);
        (silent_secs > self.config.max_base_silence_secs)
            .then_some(Reason::BaseSilent { silent_secs })
    }

    /// Moves the base, if it may begin or continue its motion.
    pub(crate) fn decide(
        &mut self,
        authority: &mut Authority,
        input: &BaseInput<'_>,
        look: &mut RoomLook<'_>,
    ) -> BaseVerdict {
        let pose = self.fresh_pose(input.now, input.situation.pose.as_ref());
        let driven = self
            .permitted_motion(authority, input, pose.is_some())
            .and_then(|motion| self.drive(authority, input, motion, pose, look));
        driven.unwrap_or_else(|limit| self.rest(limit))
    }

    /// Keeps the base at rest.
    pub(crate) fn rest(&mut self, (link, reason): (Link, Reason)) -> BaseVerdict {
        self.state.motion = None;
        BaseVerdict {
            output: BaseOutput::Brake,
            limits: vec![braked(link, reason)],
            has_arrived: false,
        }
    }

    /// The motion of the grip, which the arm, the base and its pose may end.
    fn permitted_motion(
        &mut self,
        authority: &mut Authority,
        input: &BaseInput<'_>,
        has_pose: bool,
    ) -> Result<Motion, (Link, Reason)> {
        let BaseInput { now, situation, .. } = *input;
        let base = &situation.base;
        let max_age_secs = self.config.max_pose_age_secs;
        if let Some(stowed) = &self.config.stowed
            && let Some(reason) = stowed.refusal(now, situation.arm.as_ref(), max_age_secs)
        {
            return Err(authority.brake(Link::Arm, reason));
        }
        let needs_pose =
            self.area.is_some() || self.clearance.is_some() || goal_of(authority).is_some();
        if needs_pose && !has_pose {
            let reason = Reason::BasePoseUnknown { max_age_secs };
            return Err(authority.brake(Link::Limits, reason));
        }
        let grip = authority.grip_number();
        match self.state.motion.filter(|motion| motion.grip == grip) {
            Some(_) if base.braked_motion >= self.state.n_motions => {
                Err(authority.brake(Link::Base, Reason::BaseBraked))
            }
            Some(motion) => Ok(motion),
            None if !input.is_arm_at_rest => Err((Link::Arm, Reason::StillBraking)),
            // A grip that follows another one whose release was lost also waits for rest.
            None if !base.is_at_rest => Err((Link::Base, Reason::BaseStillBraking)),
            None => {
                // A base that was opened before this chain may have ended motions with higher
                // numbers.
                self.state.n_motions = self.state.n_motions.max(base.braked_motion) + 1;
                Ok(Motion {
                    grip,
                    reached: None,
                })
            }
        }
    }

    /// The pose of the base, if it is known now.
    fn fresh_pose(&self, now: Stamp, seen: Option<&SeenPose>) -> Option<SeenPose> {
        let seen = seen.filter(|seen| seen.pose.is_finite())?;
        let is_fresh = now.secs_since(seen.at) <= self.config.max_pose_age_secs;
        is_fresh.then_some(*seen)
    }

    /// The target of this cycle.
    fn drive(
        &mut self,
        authority: &mut Authority,
        input: &BaseInput<'_>,
        mut motion: Motion,
        seen: Option<SeenPose>,
        look: &mut RoomLook<'_>,
    ) -> Result<BaseVerdict, (Link, Reason)> {
        let base = &input.situation.base;
        let pose = seen.map(|seen| seen.pose);
        let age_secs = seen.map_or(0.0, |seen| input.now.secs_since(seen.at).max(0.0));
        let reaction_secs = RESPONSE_SECS + age_secs;
        let mut limits = Vec::new();
        let mut has_arrived = false;
        let wanted = match (authority.held().map(|held| &held.intent), pose) {
            (Some(Intent::BaseVelocity { velocity }), _) => {
                motion.reached = None;
                self.within_limits(BaseVelocity::from_array(*velocity), &mut limits)
            }
            (Some(Intent::BaseGoal { world_from_goal }), Some(pose)) => {
                let [x_m, y_m, yaw_rad] = *world_from_goal;
                let goal = FloorPose { x_m, y_m, yaw_rad };
                if self.area.is_some_and(|area| !area.contains(x_m, y_m)) {
                    let place = [x_m, y_m, 0.0];
                    limits.push(refused(Link::Limits, Reason::GoalOutsideArea { place }));
                    BaseVelocity::ZERO
                } else {
                    let was_at_place = motion.reached == Some(goal);
                    let limits = &self.config.limits;
                    let step = toward(&goal, &pose, limits, was_at_place, reaction_secs);
                    motion.reached = step.is_at_place.then_some(goal);
                    has_arrived = step.has_arrived;
                    step.velocity
                }
            }
            _ => BaseVelocity::ZERO,
        };
        let place = Place {
            seen,
            reaction_secs,
            measured: &base.velocity,
        };
        let wanted = self.within_area(wanted, &place, &mut limits);
        let velocity = self
            .within_room(wanted, &place, look, &mut limits)
            .map_err(|reason| authority.brake(Link::Clearance, reason))?;
        if let Some(report) = &base.refusal {
            let report = report.clone();
            limits.push(refused(Link::Base, Reason::BaseRefused { report }));
        }
        self.state.motion = Some(motion);
        self.state.n_targets += 1;
        Ok(BaseVerdict {
            output: BaseOutput::Drive(BaseTarget {
                motion: self.state.n_motions,
                serial: self.state.n_targets,
                velocity,
                expires_at: authority.expiry(input.now, self.config.target_expiry_secs),
            }),
            limits,
            has_arrived,
        })
    }

    fn within_limits(&self, wanted: BaseVelocity, limits: &mut Vec<Limit>) -> BaseVelocity {
        if !self.config.limits.is_holonomic() && wanted.left_m_s != 0.0 {
            limits.push(refused(Link::Limits, Reason::NoSideways));
        }
        let (velocity, scale) = self.config.limits.clamped(wanted);
        if scale < 1.0 {
            limits.push(Limit {
                link: Link::Limits,
                effect: Effect::Slowed(scale),
                reason: Reason::BaseSpeed,
            });
        }
        velocity
    }

    fn within_area(
        &self,
        wanted: BaseVelocity,
        place: &Place<'_>,
        limits: &mut Vec<Limit>,
    ) -> BaseVelocity {
        let (Some(area), Some(seen)) = (self.area, place.seen) else {
            return wanted;
        };
        let (velocity, slowed) = area.permitted(
            &seen.pose,
            wanted,
            place.measured,
            &self.config.limits,
            place.reaction_secs,
        );
        if let Some((scale, reason)) = slowed {
            let effect = if scale > 0.0 {
                Effect::Slowed(scale)
            } else {
                Effect::Refused
            };
            limits.push(Limit {
                link: Link::Limits,
                effect,
                reason,
            });
        }
        velocity
    }

    /// The part of a velocity with which the base can stop before everything that is not known to
    /// be free.
    ///
    /// # Errors
    /// If the base must brake harder than it usually slows down, because something is too close.
    fn within_room(
        &self,
        wanted: BaseVelocity,
        place: &Place<'_>,
        look: &mut RoomLook<'_>,
        limits: &mut Vec<Limit>,
    ) -> Result<BaseVelocity, Reason> {
        let (Some(clearance), Some(pose)) = (&self.clearance, &place.seen) else {
            return Ok(wanted);
        };
        let way = Way {
            pose,
            velocity: &wanted,
            limits: &self.config.limits,
            reaction_secs: place.reaction_secs,
        };
        let passage = clearance.passage(&way, place.measured, look);
        let (scale, reason) = match passage {
            Passage::Free => return Ok(wanted),
            Passage::TooFast(reason) => return Err(reason),
            Passage::Slowed(scale, reason) => (scale, reason),
        };
        let effect = if scale > 0.0 {
            Effect::Slowed(scale)
        } else {
            Effect::Refused
        };
        limits.push(Limit {
            link: Link::Clearance,
            effect,
            reason,
        });
        Ok(BaseVelocity::from_array(
            wanted.to_array().map(|part| part * scale),
        ))
    }
}

/// The goal to which the operator sends the base now: x, y, heading in the world.
pub(crate) fn goal_of(authority: &Authority) -> Option<[f64; 3]> {
    match authority.held()?.intent {
        Intent::BaseGoal { world_from_goal } => Some(world_from_goal),
        _ => None,
    }
}
