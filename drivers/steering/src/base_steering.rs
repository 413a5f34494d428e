//! The chain of decisions of a base: lease, dead-man switch, posture of the arm, limits and area.

use crate::authority::{Authority, AuthorityState};
use crate::base_area::Area;
use crate::base_goal::toward;
use crate::base_record::{BaseEntry, BaseRecord, are_identical};
use crate::base_verdict::{BaseSituation, BaseVerdict, FloorPose, SeenPose};
use crate::check::{check, positive};
use crate::clutch::ClutchConfig;
use crate::error::Error;
use crate::lease::LeaseConfig;
use crate::reason::{Effect, Limit, Link, Reason};
use crate::record::Difference;
use crate::request::{Intent, Operator, Request};
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

/// Decides about the motion of a base, from the requests of operators and from the state of the
/// base and the arm on it.
///
/// It has no clock and no threads: every function takes the time, on one monotonic clock. The same
/// calls give the same decisions, bit for bit.
#[derive(Debug)]
pub struct BaseSteering {
    config: BaseSteeringConfig,
    area: Option<Area>,
    authority: Authority,
    /// Whether the newest report of the base has a fault.
    has_fault: bool,
    /// The motion of the grip that is held; `None` while the base must be at rest.
    motion: Option<Motion>,
    n_motions: u64,
    n_targets: u64,
    record: BaseRecord,
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

/// All that the chain of a base remembers between two calls.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseSteeringState {
    authority: AuthorityState,
    has_fault: bool,
    motion: Option<Motion>,
    n_motions: u64,
    n_targets: u64,
}

impl BaseSteeringState {
    /// Whether two states differ at most in the time of the last call.
    pub fn is_equal_except_time(&self, other: &Self) -> bool {
        let without_time = |state: &Self| {
            let mut state = state.clone();
            state.authority.latest_nanos = None;
            state
        };
        without_time(self) == without_time(other)
    }
}

/// Configuration and state of the chain of a base, with which a record can be replayed alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaseSetup {
    /// Configuration of all links.
    pub config: BaseSteeringConfig,
    state: BaseSteeringState,
}

impl BaseSetup {
    /// The same chain in another state.
    #[must_use]
    pub fn with_state(self, state: BaseSteeringState) -> Self {
        Self { state, ..self }
    }

    /// The chain of decisions in the recorded state.
    ///
    /// # Errors
    /// If the configuration is invalid, which means that it is damaged.
    pub fn build(&self) -> Result<BaseSteering, Error> {
        let mut steering = BaseSteering::new(self.config.clone())?;
        let state = self.state.clone();
        steering.authority.set_state(state.authority);
        steering.has_fault = state.has_fault;
        steering.motion = state.motion;
        steering.n_motions = state.n_motions;
        steering.n_targets = state.n_targets;
        Ok(steering)
    }
}

impl BaseSteering {
    /// Builds the chain. Nobody has control at first.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range.
    pub fn new(config: BaseSteeringConfig) -> Result<Self, Error> {
        config.check()?;
        Ok(Self {
            area: config.area_m.map(Area::of),
            authority: Authority::new(config.lease, config.clutch)?,
            config,
            has_fault: false,
            motion: None,
            n_motions: 0,
            n_targets: 0,
            record: BaseRecord::default(),
        })
    }

    /// The configuration.
    pub fn config(&self) -> &BaseSteeringConfig {
        &self.config
    }

    /// Who has control, and since when.
    pub fn holder(&self) -> Option<(Operator, Stamp)> {
        self.authority.lease().holder()
    }

    /// Time until the lease expires if its holder is silent; `None` if nobody has control.
    pub fn lease_left_secs(&self, now: Stamp) -> Option<f64> {
        self.authority.lease().left_secs(now)
    }

    /// The operator who may take control from its holder now.
    pub fn offered_to(&self, now: Stamp) -> Option<Operator> {
        self.authority.lease().offered_to(now)
    }

    /// Why the base stays at rest until an operator permits motion, if it does.
    pub fn stop(&self) -> Option<&Reason> {
        self.authority.stop().map(|(_, reason)| reason)
    }

    /// The newest reason, if the base was stopped again for another reason.
    pub fn newest_stop(&self) -> Option<&Reason> {
        self.authority.newest_stop()
    }

    /// Number of the newest stop, which a permission must name; 0 before the first.
    pub fn stop_number(&self) -> u64 {
        self.authority.stop_number()
    }

    /// The goal to which the operator sends the base now: x, y, heading in the world.
    pub fn goal(&self) -> Option<[f64; 3]> {
        match self.authority.held()?.intent {
            Intent::BaseGoal { world_from_goal } => Some(world_from_goal),
            _ => None,
        }
    }

    /// Takes a request. Motion changes with the next [`BaseSteering::cycle`].
    ///
    /// # Errors
    /// Why the request was refused. A refused command may still open the clutch.
    pub fn handle(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        let result = self.decide_request(now, request);
        self.record.push(BaseEntry::Request {
            at: now,
            request: request.clone(),
            refusal: result.clone().err(),
        });
        result
    }

    /// Decides what the base does in this cycle. Call it at the rate of the commands, or faster.
    pub fn cycle(&mut self, now: Stamp, situation: &BaseSituation) -> BaseVerdict {
        let verdict = self.decide_cycle(now, situation);
        self.record.push(BaseEntry::Cycle {
            at: now,
            situation: situation.clone(),
            verdict: verdict.clone(),
        });
        verdict
    }

    /// Takes the entries since the last call, and the number of older ones that were dropped
    /// because this function was called too rarely.
    pub fn take_record(&mut self) -> (Vec<BaseEntry>, u64) {
        self.record.take()
    }

    /// All that the chain remembers.
    pub fn state(&self) -> BaseSteeringState {
        BaseSteeringState {
            authority: self.authority.state(),
            has_fault: self.has_fault,
            motion: self.motion,
            n_motions: self.n_motions,
            n_targets: self.n_targets,
        }
    }

    /// Configuration and state, from which a replay can begin.
    pub fn setup(&self) -> BaseSetup {
        BaseSetup {
            config: self.config.clone(),
            state: self.state(),
        }
    }

    /// Repeats an entry of a record. The chain must be in the state in which the entry was made.
    ///
    /// # Errors
    /// If the decision differs from the recorded one.
    pub fn replay(&mut self, entry: &BaseEntry) -> Result<(), Difference> {
        match entry {
            BaseEntry::Request {
                at,
                request,
                refusal,
            } => {
                let replayed = self.decide_request(*at, request).err();
                if replayed == *refusal {
                    return Ok(());
                }
                Err(Difference {
                    at: *at,
                    replayed: format!("{replayed:?}"),
                    recorded: format!("{refusal:?}"),
                })
            }
            BaseEntry::Cycle {
                at,
                situation,
                verdict,
            } => {
                let replayed = self.decide_cycle(*at, situation);
                if are_identical(&replayed, verdict) {
                    return Ok(());
                }
                Err(Difference {
                    at: *at,
                    replayed: format!("{replayed:?}"),
                    recorded: format!("{verdict:?}"),
                })
            }
        }
    }

    fn decide_request(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        self.authority.advance(now);
        if let Request::Command(command) = request
            && command.grip.is_some()
            && !command.moves_base()
        {
            return Err(Reason::OnlyBase);
        }
        self.authority.handle(now, request)
    }

    fn decide_cycle(&mut self, now: Stamp, situation: &BaseSituation) -> BaseVerdict {
        self.authority.advance(now);
        let pose = self.fresh_pose(now, situation.pose.as_ref());
        match self.permitted_motion(now, situation, pose) {
            Ok(motion) => self.drive(now, situation, motion, pose),
            Err((link, reason)) => {
                if self.authority.held().is_none() {
                    self.motion = None;
                }
                braking(link, reason)
            }
        }
    }

    /// The motion that all of lease, clutch, base and arm permit. If one of them does not, the
    /// motion has ended.
    fn permitted_motion(
        &mut self,
        now: Stamp,
        situation: &BaseSituation,
        pose: Option<FloorPose>,
    ) -> Result<Motion, (Link, Reason)> {
        let base = &situation.base;
        // A base that stops may report nothing after its fault, so the fault comes first.
        self.note_fault(base);
        if let Some(stop) = self.authority.stop() {
            return Err(stop.clone());
        }
        if let Some(reason) = self.base_problem(now, base) {
            return Err(self.authority.brake(Link::Base, reason));
        }
        self.authority.permitted(now)?;
        if let Some(stowed) = &self.config.stowed
            && let Some(reason) =
                stowed.refusal(now, situation.arm.as_ref(), self.config.max_pose_age_secs)
        {
            return Err(self.authority.brake(Link::Arm, reason));
        }
        if pose.is_none() && (self.area.is_some() || self.goal().is_some()) {
            let max_age_secs = self.config.max_pose_age_secs;
            let reason = Reason::BasePoseUnknown { max_age_secs };
            return Err(self.authority.brake(Link::Limits, reason));
        }
        let grip = self.authority.grip_number();
        match self.motion.filter(|motion| motion.grip == grip) {
            Some(_) if base.braked_motion >= self.n_motions => {
                Err(self.authority.brake(Link::Base, Reason::BaseBraked))
            }
            Some(motion) => Ok(motion),
            // A grip that follows another one whose release was lost also waits for rest.
            None if !base.is_at_rest => Err((Link::Base, Reason::BaseStillBraking)),
            None => {
                // A base that was opened before this chain may have ended motions with higher
                // numbers.
                self.n_motions = self.n_motions.max(base.braked_motion) + 1;
                Ok(Motion {
                    grip,
                    reached: None,
                })
            }
        }
    }

    /// Notes a fault of the base: once if it lasts, and again if motion was permitted meanwhile.
    fn note_fault(&mut self, base: &BaseState) {
        let had_fault = std::mem::replace(&mut self.has_fault, base.fault.is_some());
        let Some(report) = &base.fault else {
            return;
        };
        if self.authority.stop().is_none() || !had_fault {
            let report = report.clone();
            let reason = Reason::BaseStopped { report };
            self.authority.latch_stop(Link::Base, reason);
        }
    }

    /// What is wrong with the report of the base.
    fn base_problem(&self, now: Stamp, base: &BaseState) -> Option<Reason> {
        let silent_secs = now.secs_since(base.reported_at);
        (silent_secs > self.config.max_base_silence_secs)
            .then_some(Reason::BaseSilent { silent_secs })
    }

    /// The pose of the base, if it is known now.
    fn fresh_pose(&self, now: Stamp, seen: Option<&SeenPose>) -> Option<FloorPose> {
        let seen = seen.filter(|seen| seen.pose.is_finite())?;
        let is_fresh = now.secs_since(seen.at) <= self.config.max_pose_age_secs;
        is_fresh.then_some(seen.pose)
    }

    /// The target of this cycle.
    fn drive(
        &mut self,
        now: Stamp,
        situation: &BaseSituation,
        mut motion: Motion,
        pose: Option<FloorPose>,
    ) -> BaseVerdict {
        let mut limits = Vec::new();
        let mut has_arrived = false;
        let wanted = match (self.authority.held().map(|held| &held.intent), pose) {
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
                    let step = toward(&goal, &pose, &self.config.limits, was_at_place);
                    motion.reached = step.is_at_place.then_some(goal);
                    has_arrived = step.has_arrived;
                    step.velocity
                }
            }
            _ => BaseVelocity::ZERO,
        };
        let velocity = self.within_area(wanted, &situation.base.velocity, pose, &mut limits);
        if let Some(report) = &situation.base.refusal {
            let report = report.clone();
            limits.push(refused(Link::Base, Reason::BaseRefused { report }));
        }
        self.motion = Some(motion);
        self.n_targets += 1;
        let expiry = now.plus_secs(self.config.target_expiry_secs);
        BaseVerdict {
            output: BaseOutput::Drive(BaseTarget {
                motion: self.n_motions,
                serial: self.n_targets,
                velocity,
                // If this chain does not run, the base's thread also brakes when the device is
                // silent.
                expires_at: self
                    .authority
                    .deadline()
                    .map_or(expiry, |end| end.min(expiry)),
            }),
            limits,
            has_arrived,
        }
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
        measured: &BaseVelocity,
        pose: Option<FloorPose>,
        limits: &mut Vec<Limit>,
    ) -> BaseVelocity {
        let (Some(area), Some(pose)) = (self.area, pose) else {
            return wanted;
        };
        let (velocity, slowed) = area.permitted(&pose, wanted, measured, &self.config.limits);
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
}

fn braking(link: Link, reason: Reason) -> BaseVerdict {
    BaseVerdict {
        output: BaseOutput::Brake,
        limits: vec![Limit {
            link,
            effect: Effect::Braked,
            reason,
        }],
        has_arrived: false,
    }
}

fn refused(link: Link, reason: Reason) -> Limit {
    Limit {
        link,
        effect: Effect::Refused,
        reason,
    }
}
