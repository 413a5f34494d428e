//! The chain of decisions: lease, clutch, limits, self-collision, clearance.

use crate::authority::check_operator_times;
use crate::body::Body;
use crate::capsule::Capsule;
use crate::check::positive;
use crate::clearance::{Clearance, ClearanceConfig, ClearancePoints, Restriction};
use crate::clutch::{Change, Clutch, ClutchConfig};
use crate::error::Error;
use crate::inverse::InverseKinematics;
use crate::lease::{Lease, LeaseConfig};
use crate::limits::{Goal, LimitConfig, Limits, Model, Pace, moved_tip};
use crate::reason::{Effect, Limit, Link, Reason};
use crate::record::{Difference, Entry, Record, are_identical};
use crate::request::{Command, Intent, Operator, Request};
use crate::self_collision::{ClosePair, SelfCollision, SelfCollisionConfig};
use crate::verdict::Verdict;
use drivers::motion::{ArmState, MotionLimits, Output, Target, exact};
use kinematics::{Chain, Stamp, Transform};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

mod posture_check;
pub(crate) mod setup;
pub(crate) mod state;

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
/// Number of entries of the record that are kept if nobody takes them: a minute at 100 Hz.
const MAX_ENTRIES: usize = 6000;
/// How much closer a surface may appear at the target before the arm brakes, meters. It is larger
/// than the noise of a distance field, and smaller than the stop distance.
const MAX_APPROACH_M: f64 = 0.005;

/// Decides what the arm does, from the requests of operators and from what is known about the robot
/// and the scene.
///
/// It has no clock and no threads: every function takes the time, on one monotonic clock. The same
/// calls give the same decisions, bit for bit.
pub struct Steering {
    config: SteeringConfig,
    chain: Chain,
    inverse: Box<dyn InverseKinematics + Send>,
    body: Body,
    limits: Limits,
    self_collision: SelfCollision,
    clearance: Arc<ClearancePoints>,
    lease: Lease,
    clutch: Clutch,
    /// Why the arm must stay at rest until an operator permits motion.
    stop: Option<Reason>,
    /// The newest reason, if another stop has followed.
    newest_stop: Option<Reason>,
    /// Number of the newest stop; 0 before the first.
    stop_number: u64,
    /// Whether the newest report of the arm says that it is stopped.
    is_arm_stopped: bool,
    /// The motion of the grip that is held; `None` while the arm must be at rest.
    motion: Option<Motion>,
    /// Why the last motion ended.
    last_brake: Option<(Link, Reason)>,
    n_motions: u64,
    n_targets: u64,
    latest: Option<Stamp>,
    last_cycle: Option<Stamp>,
    /// For records: the posture for which the pairs of parts were selected.
    free_posture: Option<Vec<f64>>,
    record: Record,
}

impl std::fmt::Debug for Steering {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Steering")
            .field("config", &self.config)
            .field("stop", &self.stop)
            .field("motion", &self.motion)
            .finish_non_exhaustive()
    }
}

/// A motion from a grip until the arm brakes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Motion {
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

/// Returns what is known about points of the robot.
type Look<'a> = dyn FnMut(&[[f64; 3]]) -> Vec<Restriction> + 'a;

impl Steering {
    /// Builds the chain. Nobody has control at first, and the arm must be at rest.
    ///
    /// # Errors
    /// If a value of the configuration is out of its range, or numbers of joints differ.
    pub fn new(config: SteeringConfig, robot: Robot<'_>) -> Result<Self, Error> {
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
            chain: robot.chain,
            inverse: robot.inverse,
            body: robot.body,
            limits,
            self_collision,
            clearance: Arc::new(clearance),
            lease: Lease::new(config.lease),
            clutch: Clutch::new(config.clutch, n_joints),
            config,
            stop: None,
            newest_stop: None,
            stop_number: 0,
            is_arm_stopped: false,
            motion: None,
            last_brake: None,
            n_motions: 0,
            n_targets: 0,
            latest: None,
            last_cycle: None,
            free_posture: robot.free_posture.map(<[f64]>::to_vec),
            record: Record::new(MAX_ENTRIES),
        })
    }

    /// The configuration.
    pub fn config(&self) -> &SteeringConfig {
        &self.config
    }

    /// Who has control, and since when.
    pub fn holder(&self) -> Option<(Operator, Stamp)> {
        self.lease.holder()
    }

    /// Time until the lease expires if its holder is silent; `None` if nobody has control.
    pub fn lease_left_secs(&self, now: Stamp) -> Option<f64> {
        self.lease.left_secs(now)
    }

    /// The operator who may take control from its holder now.
    pub fn offered_to(&self, now: Stamp) -> Option<Operator> {
        self.lease.offered_to(now)
    }

    /// Why the arm stays at rest until an operator permits motion, if it does.
    pub fn stop(&self) -> Option<&Reason> {
        self.stop.as_ref()
    }

    /// Why the arm was stopped since, if somebody or something has stopped it again for another
    /// reason than [`Steering::stop`].
    pub fn newest_stop(&self) -> Option<&Reason> {
        self.newest_stop.as_ref()
    }

    /// Number of the newest stop, which a permission must name; 0 before the first. Each stop by
    /// anybody, and each fault of the arm, has its own number.
    pub fn stop_number(&self) -> u64 {
        self.stop_number
    }

    /// Checks that a permission names the newest stop.
    ///
    /// # Errors
    /// That it names another one.
    pub fn check_stop(&self, named: u64) -> Result<(), Reason> {
        let newest = self.stop_number;
        if named == newest {
            return Ok(());
        }
        Err(Reason::OtherStop { named, newest })
    }

    /// The pairs of parts that are checked for collisions.
    pub fn self_collision(&self) -> &SelfCollision {
        &self.self_collision
    }

    /// Takes a request. Motion changes with the next [`Steering::cycle`].
    ///
    /// # Errors
    /// Why the request was refused. A refused command may still open the clutch.
    pub fn handle(&mut self, now: Stamp, request: &Request) -> Result<(), Reason> {
        let result = self.decide_request(now, request);
        self.record.push(Entry::Request {
            at: now,
            request: request.clone(),
            refusal: result.clone().err(),
        });
        result
    }

    /// Decides what the arm does in this cycle. Call it at the rate of the commands, or faster.
    ///
    /// * `arm`: the newest state of the arm.
    /// * `scene`: what is known about the scene.
    pub fn cycle(&mut self, now: Stamp, arm: &ArmState, scene: &dyn Clearance) -> Verdict {
        if let Some(report) = scene.failure().filter(|_| self.stop.is_none()) {
            // The failure lasts: if motion is permitted, the next cycle stops the arm again.
            let stopped = self.handle(now, &Request::SceneLost { report });
            debug_assert!(stopped.is_ok(), "everybody may stop the arm");
        }
        // The closure borrows the points while the decision changes the rest.
        let points = Arc::clone(&self.clearance);
        let mut seen = Vec::new();
        let verdict = self.decide_cycle(now, arm, &mut |points_in_base| {
            let restrictions = points.restrictions(&scene.readings(points_in_base, now));
            seen.push(restrictions.clone());
            restrictions
        });
        self.record.push(Entry::Cycle {
            at: now,
            arm: arm.clone(),
            seen,
            verdict: verdict.clone(),
        });
        verdict
    }

    /// Takes the entries since the last call, and the number of older ones that were dropped
    /// because this function was called too rarely. Together with the configuration and the robot,
    /// all entries since the start make a replay.
    pub fn take_record(&mut self) -> (Vec<Entry>, u64) {
        self.record.take()
    }

    /// Repeats an entry of a record. The chain must be in the state in which the entry was made: a
    /// new chain for the first entry.
    ///
    /// # Errors
    /// If the decision differs from the recorded one.
    pub fn replay(&mut self, entry: &Entry) -> Result<(), Difference> {
        match entry {
            Entry::Request {
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
            Entry::Cycle {
                at,
                arm,
                seen,
                verdict,
            } => {
                let n_points = self.clearance.n_points();
                let mut points = seen
                    .iter()
                    .flatten()
                    .map(|restriction| restriction.point_ix);
                if let Some(point_ix) = points.find(|ix| *ix >= n_points) {
                    return Err(Difference {
                        at: *at,
                        replayed: format!("with {n_points} points of the robot"),
                        recorded: format!("a distance of point {point_ix}"),
                    });
                }
                let mut seen = seen.iter();
                let replayed =
                    self.decide_cycle(*at, arm, &mut |_| seen.next().cloned().unwrap_or_default());
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
        self.advance(now);
        match request {
            Request::TakeLease(operator) => {
                let had_control = self.lease.holder().map(|(holder, _)| holder);
                if let Some(lost) = self.lease.take(now, *operator)? {
                    self.end_control(lost);
                } else if had_control.is_none() {
                    self.last_brake = None;
                }
                Ok(())
            }
            Request::RenewLease(operator) => self.lease.renew(now, *operator),
            Request::ReleaseLease(operator) => {
                let lost = self.lease.release(now, *operator)?;
                self.end_control(lost);
                Ok(())
            }
            Request::OfferLease { from, to } => self.lease.offer(now, *from, *to),
            Request::Stop { by } => {
                let reason = by.map_or(Reason::StoppedByProgram, |operator| Reason::StoppedBy {
                    operator,
                });
                self.latch_stop(Link::Clutch, reason);
                Ok(())
            }
            Request::SceneLost { report } => {
                let report = report.clone();
                self.latch_stop(Link::Clearance, Reason::SceneLost { report });
                Ok(())
            }
            Request::Rearm { operator, stop } => {
                self.lease.renew(now, *operator)?;
                self.check_stop(*stop)?;
                // The arm's own fault is reported again in the next cycle, if it is still there.
                self.stop = None;
                self.newest_stop = None;
                self.clutch.open();
                Ok(())
            }
            Request::Command(command) if command.moves_base() => Err(Reason::NoBase),
            Request::Command(command) => self.take_command(now, command),
        }
    }

    fn take_command(&mut self, now: Stamp, command: &Command) -> Result<(), Reason> {
        self.lease.hear(now, command)?;
        let was_held = self.clutch.held().is_some();
        let may_move = self.stop.is_none();
        let change = self.clutch.receive(now, command, may_move);
        match change {
            Err(reason) => {
                if was_held && self.clutch.held().is_none() {
                    self.brake(Link::Clutch, reason.clone());
                }
                // While the arm is stopped, this is what the operator must know first.
                Err(self.stop.clone().unwrap_or(reason))
            }
            Ok(Change::Closed) => {
                // A grip may follow another one whose release was lost.
                self.motion = None;
                self.last_brake = None;
                Ok(())
            }
            Ok(Change::Opened) => {
                self.brake(Link::Clutch, Reason::NotGripped);
                Ok(())
            }
            Ok(Change::Updated | Change::Open) => Ok(()),
        }
    }

    fn decide_cycle(&mut self, now: Stamp, arm: &ArmState, look: &mut Look<'_>) -> Verdict {
        self.advance(now);
        let since_last = self.last_cycle.map_or(0.0, |last| now.secs_since(last));
        let secs = since_last.clamp(0.0, MAX_CYCLE_SECS);
        self.last_cycle = Some(now);
        match self.permitted_motion(now, arm) {
            Ok(motion) => self.move_target(now, motion, arm, secs, look),
            Err((link, reason)) => braking(link, reason),
        }
    }

    /// The motion that all of lease, clutch and arm permit. If one of them does not, the motion has
    /// ended.
    fn permitted_motion(&mut self, now: Stamp, arm: &ArmState) -> Result<Motion, (Link, Reason)> {
        // An arm that stops may report nothing after its reason, so the reason comes first.
        self.note_stopped_arm(arm);
        if let Some(reason) = &self.stop {
            let link = match reason {
                Reason::ArmStopped { .. } => Link::Arm,
                Reason::SceneLost { .. } => Link::Clearance,
                _ => Link::Clutch,
            };
            return Err((link, reason.clone()));
        }
        if let Some(reason) = self.arm_problem(now, arm) {
            return Err(self.brake(Link::Arm, reason));
        }
        if self.lease.holder().is_none() {
            return Err(self
                .last_brake
                .clone()
                .unwrap_or((Link::Lease, Reason::NoLease)));
        }
        if let Some(reason) = self.clutch.expire(now) {
            return Err(self.brake(Link::Clutch, reason));
        }
        if self.clutch.held().is_none() {
            return Err(self
                .last_brake
                .clone()
                .unwrap_or((Link::Clutch, Reason::NotGripped)));
        }
        match self.motion.clone() {
            Some(_) if arm.braked_motion >= self.n_motions => {
                Err(self.brake(Link::Arm, Reason::ArmBraked))
            }
            Some(motion) if arm.is_at_rest => {
                // The target of an arm at rest is at most one step away. If the arm is elsewhere, a
                // person has moved it by hand, and it must not move back without a new grip.
                match self.limits.lag(&self.chain, &motion.target, &arm.position) {
                    Some(reason) => Err(self.brake(Link::Arm, reason)),
                    None => Ok(motion),
                }
            }
            Some(motion) => Ok(motion),
            // The grip starts where the arm comes to rest, so it waits until then.
            None if !arm.is_at_rest => Err((Link::Arm, Reason::StillBraking)),
            None => Ok(self.start_motion(arm)),
        }
    }

    /// Notes a stop of the arm: once if it lasts, and again if motion was permitted meanwhile.
    fn note_stopped_arm(&mut self, arm: &ArmState) {
        let was_stopped = std::mem::replace(&mut self.is_arm_stopped, arm.stopped.is_some());
        let Some(report) = &arm.stopped else {
            return;
        };
        if self.stop.is_none() || !was_stopped {
            let report = report.clone();
            self.latch_stop(Link::Arm, Reason::ArmStopped { report });
        }
    }

    fn start_motion(&mut self, arm: &ArmState) -> Motion {
        // An arm that lived longer than this chain has braked after higher numbers.
        self.n_motions = self.n_motions.max(arm.braked_motion) + 1;
        let motion = Motion {
            target: arm.position.clone(),
            accepted_m: f64::NEG_INFINITY,
        };
        self.motion = Some(motion.clone());
        motion
    }

    /// Moves the target one step toward the goal, as far as limits and distances permit.
    fn move_target(
        &mut self,
        now: Stamp,
        motion: Motion,
        arm: &ArmState,
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
            let (link, reason) = self.brake(Link::Clearance, reason);
            return braking(link, reason);
        }
        let mut limits = Vec::new();
        let pace = Pace {
            secs,
            scale: self.speed_scale(&here, &mut limits),
        };
        let accepted = self.accepted_step(&motion, arm, pace, &here, look, &mut limits);
        let (target, accepted_m) =
            accepted.unwrap_or((motion.target, nearest_m.max(motion.accepted_m)));
        limits.sort_by_key(|limit| limit.link);
        self.motion = Some(Motion {
            target: target.clone(),
            accepted_m,
        });
        self.n_targets += 1;
        let expiry = now.plus_secs(self.config.target_expiry_secs);
        Verdict {
            output: Output::Follow(Target {
                motion: self.n_motions,
                serial: self.n_targets,
                position: target,
                // The arm itself also notices a silent device, if this chain does not run any more.
                expires_at: self.clutch.deadline().map_or(expiry, |end| end.min(expiry)),
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
        &mut self,
        motion: &Motion,
        arm: &ArmState,
        pace: Pace,
        here: &Surroundings,
        look: &mut Look<'_>,
        limits: &mut Vec<Limit>,
    ) -> Option<(Vec<f64>, f64)> {
        let q = &motion.target;
        // The grip starts at the tip's pose at rest, also if the target cannot move yet.
        let tip = self.chain.forward(q).ok()?;
        let goal = self.goal(&tip, q, pace)?;
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

    /// Where the operator wants the arm; `None` if the clutch is open.
    fn goal(&mut self, base_from_tip: &Transform, q: &[f64], pace: Pace) -> Option<Goal> {
        if let Some(pose) = self.clutch.goal(base_from_tip) {
            return Some(Goal::Pose(pose));
        }
        match &self.clutch.held()?.intent {
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

    fn surroundings(&self, q: &[f64], look: &mut Look<'_>) -> Surroundings {
        let capsules: Vec<Capsule> = self.body.capsules(q);
        let points_in_base = self.clearance.in_base(&capsules);
        Surroundings {
            close_pairs: self.self_collision.close_pairs(&capsules),
            restrictions: look(&points_in_base),
            points_in_base,
        }
    }

    /// Notes the time, and ends what has expired.
    fn advance(&mut self, now: Stamp) {
        if let Some(latest) = self.latest.filter(|latest| now < *latest) {
            // After a step back, nothing would expire for as long as the step.
            self.lease.end();
            self.end_control(Reason::ClockWentBack {
                secs: latest.secs_since(now),
            });
            self.last_cycle = None;
        }
        self.latest = Some(now);
        if let Some(reason) = self.lease.expire(now) {
            self.end_control(reason);
        }
    }

    /// What is wrong with the state of the arm.
    fn arm_problem(&self, now: Stamp, arm: &ArmState) -> Option<Reason> {
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

    /// Ends the motion because the operator lost control.
    fn end_control(&mut self, reason: Reason) {
        self.brake(Link::Lease, reason);
        self.clutch.forget_devices();
    }

    /// Ends the motion until an operator permits it again. The first reason stays.
    fn latch_stop(&mut self, link: Link, reason: Reason) {
        self.stop_number += 1;
        self.brake(link, reason.clone());
        let first = self.stop.get_or_insert_with(|| reason.clone());
        self.newest_stop = (*first != reason).then_some(reason);
    }

    /// Ends the motion and uses the grip up. Returns its arguments.
    fn brake(&mut self, link: Link, reason: Reason) -> (Link, Reason) {
        self.clutch.open();
        self.motion = None;
        self.last_brake = Some((link, reason.clone()));
        (link, reason)
    }
}

fn braking(link: Link, reason: Reason) -> Verdict {
    Verdict {
        output: Output::Brake,
        limits: vec![Limit {
            link,
            effect: Effect::Braked,
            reason,
        }],
    }
}

fn refused(link: Link, reason: Reason) -> Limit {
    Limit {
        link,
        effect: Effect::Refused,
        reason,
    }
}

fn check_times(config: &SteeringConfig) -> Result<(), Error> {
    check_operator_times(&config.lease, &config.clutch)?;
    positive("target_expiry_secs", config.target_expiry_secs)?;
    positive("max_arm_silence_secs", config.max_arm_silence_secs)
}
