//! One cycle of the steering loop: takes the requests of clients, decides about the arm and the base
//! of the robot, and returns the state for clients. It has no thread and no clock, so that tests can
//! set the time.

use super::base::SeenRobot;
use super::followed_command::{FollowedCommand, stop_text};
use super::joint_map::JointMap;
use super::previews::{Now, Previews};
use super::recovery::{Permission, Recovery};
use super::requests;
use super::steering_log::{About, LoopLog};
use super::time_base::TimeBase;
use drivers::base_motion::{BaseOutput, BasePort, BaseState, BaseVelocity};
use drivers::motion::{ArmState, Output, SteeringPort};
use kinematics::inverse::InverseSolver;
use kinematics::{Chain, Stamp, Transform, transform};
use std::collections::VecDeque;
use std::path::Path;
use steering::{
    BaseSituation, BaseSteeringConfig, Body, Clearance, Decision, NearestPosture, Operator, Reason,
    Request, Robot, SeenPosture, Situation, Steering, SteeringConfig,
};
use viz::{
    AppliedLimit, Preview, PreviewRequest, ReceivedRequest, RefusedRequest, SteeredBaseState,
    SteeredPart, SteeringCommand, SteeringRequest, SteeringState,
};

/// Maximum number of goals that wait to be checked. The server keeps one per client.
const MAX_PREVIEWS: usize = 32;

/// What the loop needs to know about the arm.
pub(super) struct SteeredRobot {
    /// The chain from the base to the tip that operators move.
    pub(super) chain: Chain,
    /// The shape of the robot.
    pub(super) body: Body,
    /// Between the driver and the chain.
    pub(super) joints: JointMap,
    /// The arm.
    pub(super) port: SteeringPort,
}

/// The state of the loop between two cycles.
pub(super) struct SteeringLoop {
    steering: Steering,
    arm: Option<ArmSide>,
    base: Option<BaseSide>,
    waiting_previews: VecDeque<(u64, PreviewRequest)>,
    times: TimeBase,
    /// Whether an operator has had the lease. Nothing is sent to the robot before.
    has_begun: bool,
    followed: FollowedCommand,
    /// Whether the newest grip has moved the base. Its reasons are shown until the next grip.
    has_moved_base: bool,
    log: Option<LoopLog>,
}

/// The arm of the loop.
struct ArmSide {
    chain: Chain,
    joints: JointMap,
    port: SteeringPort,
    previews: Previews,
    recovery: Recovery,
}

/// The base of the loop.
struct BaseSide {
    port: BasePort,
    /// Time of the first cycle.
    began_at: Option<Stamp>,
}

/// The newest reports of a robot.
#[derive(Clone, Debug, Default)]
pub(super) struct Reports {
    /// State of the arm in the order of the chain; `None` if it is not steered.
    pub(super) arm: Option<ArmState>,
    /// The robot besides the reports of its steered parts.
    pub(super) robot: SeenRobot,
}

/// Results of a cycle.
#[derive(Debug, Default)]
pub(super) struct Outcome {
    /// Replies to clients.
    pub(super) replies: Vec<(u64, Reply)>,
    /// Whether an operator has the lease for the first time, and thus the robot.
    pub(super) begins: bool,
    /// Whether somebody has stopped the robot, also if nobody has had the lease yet: the tour of a
    /// simulated robot must end.
    pub(super) ends_tour: bool,
    /// The state for clients; `None` if the arm's report has no pose.
    pub(super) state: Option<SteeringState>,
}

/// A reply to a client.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Reply {
    /// Why a request was refused.
    Refused(RefusedRequest, String),
    /// Whether the goal of this number can be reached.
    Preview(u64, Preview),
}

impl SteeringLoop {
    /// The loop of an arm.
    ///
    /// * `first`: the first state that the arm reported, in the order of the driver.
    ///
    /// # Errors
    ///
    /// If the limits of the arm and the configuration do not match the robot.
    pub(super) fn new(
        config: SteeringConfig,
        robot: SteeredRobot,
        times: TimeBase,
        first: &ArmState,
    ) -> anyhow::Result<Self> {
        let SteeredRobot {
            chain,
            body,
            joints,
            port,
        } = robot;
        let limits = joints.limits_in_chain(port.limits());
        let margin = config.limits.joint_margin;
        let ranges = limits
            .iter()
            .map(|joint| [joint.position[0] + margin, joint.position[1] - margin]);
        let solver = InverseSolver::within(chain.clone(), ranges.collect())?;
        // Nothing touches where the arm is now.
        let free_posture = joints.in_chain(&first.position);
        let steering = Steering::new(
            config,
            Robot {
                inverse: Box::new(NearestPosture::new(chain.clone())),
                chain: chain.clone(),
                body,
                joints: &limits,
                free_posture: Some(&free_posture),
            },
        )?;
        let notes = steering.self_collision().map(|it| it.notes());
        for note in notes.into_iter().flatten() {
            log::warn!("steering: {note}");
        }
        let arm = ArmSide {
            previews: Previews::new(solver),
            recovery: Recovery::new(port.clone()),
            chain,
            joints,
            port,
        };
        Ok(Self {
            arm: Some(arm),
            ..Self::of(steering, times)
        })
    }

    /// The loop of a base.
    ///
    /// # Errors
    ///
    /// If the configuration is not valid.
    pub(super) fn of_base(
        config: BaseSteeringConfig,
        port: BasePort,
        times: TimeBase,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            base: Some(BaseSide::new(port)),
            ..Self::of(Steering::of_base(config)?, times)
        })
    }

    /// Adds the base of the arm.
    ///
    /// # Errors
    ///
    /// If the configuration is not valid.
    pub(super) fn with_base(
        self,
        config: BaseSteeringConfig,
        port: BasePort,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            steering: self.steering.with_base(config)?,
            base: Some(BaseSide::new(port)),
            ..self
        })
    }

    fn of(steering: Steering, times: TimeBase) -> Self {
        Self {
            steering,
            arm: None,
            base: None,
            waiting_previews: VecDeque::new(),
            times,
            has_begun: false,
            followed: FollowedCommand::default(),
            has_moved_base: false,
            log: None,
        }
    }

    /// Logs all decisions from now on.
    ///
    /// # Errors
    ///
    /// If no thread can be started.
    pub(super) fn log_into(&mut self, folder: &Path, about: About) -> std::io::Result<()> {
        self.log = Some(LoopLog::new(folder, about, &self.steering)?);
        Ok(())
    }

    /// The newest state of the arm, in the order of the chain; `None` without an arm, or before it
    /// has reported a state.
    pub(super) fn arm(&self) -> Option<ArmState> {
        let arm = self.arm.as_ref()?;
        Some(arm.joints.state_in_chain(arm.port.state()?))
    }

    /// Takes the requests, and decides about the motion of the robot.
    ///
    /// * `scene`: what is known about the scene.
    pub(super) fn cycle(
        &mut self,
        now: Stamp,
        received: &[ReceivedRequest],
        reports: &Reports,
        scene: &dyn Clearance,
    ) -> Outcome {
        let mut outcome = Outcome::default();
        let arm = reports.arm.as_ref();
        for request in received {
            self.take(now, request, arm, &mut outcome);
        }
        if let Some(arm) = arm {
            self.finish_recovery(now, arm, &mut outcome);
        }
        let situation = Situation {
            arm: reports.arm.clone(),
            base: self.base_situation(now, reports),
        };
        // The decision may end the grip.
        if let Some(moves_base) = self.steering.authority().moves_base() {
            self.has_moved_base = moves_base;
        }
        let decision = self.steering.decide(now, &situation, scene);
        // Without a map of the scene, a simulated robot must not continue its tour.
        let is_scene_lost = matches!(self.steering.stop(), Some(Reason::SceneLost { .. }));
        outcome.ends_tour |= is_scene_lost;
        if self.has_begun {
            self.send(&decision);
        }
        if let Some(log) = &mut self.log {
            log.take(now, &mut self.steering);
        }
        let is_following = is_following(&decision);
        self.followed
            .note_cycle(is_following, self.times.instant(now));
        // A goal out of reach takes longer than a cycle. While the robot follows an operator, the
        // next decision must not wait for it.
        if let Some(arm) = arm.filter(|_| !is_following) {
            self.answer_preview(now, arm, scene, &mut outcome);
        }
        outcome.state = self.state(now, &situation, &decision);
        outcome
    }

    /// Brakes, because the loop ends.
    pub(super) fn finish(&self) {
        if !self.has_begun {
            return;
        }
        if let Some(arm) = &self.arm {
            arm.port.send(&Output::Brake);
        }
        if let Some(base) = &self.base {
            base.port.send(&BaseOutput::Brake);
        }
    }

    fn send(&self, decision: &Decision) {
        if let Some((arm, verdict)) = self.arm.as_ref().zip(decision.arm.as_ref()) {
            let output = verdict.output.clone();
            arm.port.send(&arm.joints.output_for_driver(output));
        }
        if let Some((base, verdict)) = self.base.as_ref().zip(decision.base.as_ref()) {
            base.port.send(&verdict.output);
        }
    }

    /// The state of the base and of the arm on it. A base that has never reported counts as silent
    /// since the first cycle.
    fn base_situation(&mut self, now: Stamp, reports: &Reports) -> Option<BaseSituation> {
        let side = self.base.as_mut()?;
        let began_at = *side.began_at.get_or_insert(now);
        let base = side.port.state().unwrap_or(BaseState {
            reported_at: began_at,
            velocity: BaseVelocity::ZERO,
            is_at_rest: false,
            braked_motion: 0,
            fault: None,
            refusal: None,
        });
        let steered_arm = reports.arm.as_ref().map(|arm| SeenPosture {
            at: arm.reported_at,
            position: arm.position.clone(),
        });
        Some(BaseSituation {
            base,
            pose: reports.robot.pose,
            arm: steered_arm.or_else(|| reports.robot.posture.clone()),
        })
    }

    fn take(
        &mut self,
        now: Stamp,
        received: &ReceivedRequest,
        arm: Option<&ArmState>,
        outcome: &mut Outcome,
    ) {
        let client = received.client;
        if let Err(reason) = self.decide(now, received, arm, outcome)
            && let Some(kind) = requests::kind(&received.request)
        {
            let refused = Reply::Refused(kind, reason);
            outcome.replies.push((client, refused));
        }
    }

    fn decide(
        &mut self,
        now: Stamp,
        received: &ReceivedRequest,
        arm: Option<&ArmState>,
        outcome: &mut Outcome,
    ) -> Result<(), String> {
        let operator = Operator(received.client);
        let request = match &received.request {
            SteeringRequest::TakeLease => return self.take_lease(now, operator, outcome),
            SteeringRequest::RenewLease => Request::RenewLease(operator),
            SteeringRequest::ReleaseLease => Request::ReleaseLease(operator),
            SteeringRequest::OfferLease { to } => Request::OfferLease {
                from: operator,
                to: Operator(*to),
            },
            SteeringRequest::Stop => {
                outcome.ends_tour = true;
                Request::Stop { by: Some(operator) }
            }
            SteeringRequest::Rearm { stop } => {
                let permission = Permission {
                    operator,
                    stop: *stop,
                };
                return self.rearm(now, permission, arm);
            }
            SteeringRequest::Command(command) => return self.command(now, received, command),
            SteeringRequest::Preview(request) => {
                return self.queue_preview(received.client, request);
            }
            SteeringRequest::View { world_from_camera } => {
                self.see(now, operator, *world_from_camera);
                return Ok(());
            }
            // Whoever has gone cannot open a dead-man switch any more.
            SteeringRequest::Disconnected if self.holds_lease(operator) => {
                Request::ReleaseLease(operator)
            }
            SteeringRequest::Disconnected => return Ok(()),
        };
        self.handle(now, &request)
    }

    /// Logs the view of the holder of the lease.
    fn see(&mut self, now: Stamp, operator: Operator, world_from_camera: [f64; 7]) {
        let is_holder = self.holds_lease(operator);
        if let Some(log) = self.log.as_mut().filter(|_| is_holder) {
            log.see(now, operator.0, world_from_camera);
        }
    }

    fn handle(&mut self, now: Stamp, request: &Request) -> Result<(), String> {
        let handled = self.steering.handle(now, request);
        handled.map_err(|reason| reason.to_string())
    }

    fn holds_lease(&self, operator: Operator) -> bool {
        self.steering
            .holder()
            .is_some_and(|(holder, _)| holder == operator)
    }

    fn take_lease(
        &mut self,
        now: Stamp,
        operator: Operator,
        outcome: &mut Outcome,
    ) -> Result<(), String> {
        self.handle(now, &Request::TakeLease(operator))?;
        outcome.begins |= !self.has_begun;
        self.has_begun = true;
        Ok(())
    }

    fn command(
        &mut self,
        now: Stamp,
        received: &ReceivedRequest,
        command: &SteeringCommand,
    ) -> Result<(), String> {
        let n_joints = self.arm.as_ref().map_or(0, |arm| arm.chain.n_joints());
        let converted = requests::command(received, command, self.times, n_joints);
        self.handle(now, &Request::Command(converted))?;
        self.followed.receive(command);
        Ok(())
    }

    /// Permits motion after a stop. An arm that a fault has stopped is enabled first, which takes
    /// a while.
    fn rearm(
        &mut self,
        now: Stamp,
        permission: Permission,
        arm: Option<&ArmState>,
    ) -> Result<(), String> {
        let is_stopped = arm.is_some_and(|arm| arm.stopped.is_some());
        let is_holder = self.holds_lease(permission.operator);
        if let Some(side) = self.arm.as_mut().filter(|_| is_stopped && is_holder) {
            let named = self.steering.authority().check_stop(permission.stop);
            named.map_err(|reason| reason.to_string())?;
            return side.recovery.start(permission);
        }
        self.permit(now, permission)
    }

    fn permit(&mut self, now: Stamp, permission: Permission) -> Result<(), String> {
        let Permission { operator, stop } = permission;
        self.handle(now, &Request::Rearm { operator, stop })
    }

    fn finish_recovery(&mut self, now: Stamp, arm: &ArmState, outcome: &mut Outcome) {
        let result = self
            .arm
            .as_mut()
            .and_then(|side| side.recovery.take_result(now, arm));
        let Some((permission, recovered)) = result else {
            return;
        };
        // The operator could not know of stops during the recovery. After such a stop, the arm is
        // enabled, but motion must be permitted again.
        let permitted = recovered.and_then(|()| self.permit(now, permission));
        if let Err(reason) = permitted {
            let refused = Reply::Refused(RefusedRequest::Rearm, reason);
            outcome.replies.push((permission.operator.0, refused));
        }
    }

    fn queue_preview(&mut self, client: u64, request: &PreviewRequest) -> Result<(), String> {
        if self.arm.is_none() {
            return Err("a base has no previews: send the goal as a command".to_owned());
        }
        if self.waiting_previews.len() >= MAX_PREVIEWS {
            return Err("too many goals wait to be checked: ask again".to_owned());
        }
        self.waiting_previews.push_back((client, request.clone()));
        Ok(())
    }

    /// Answers at most one preview, so that requests are still taken between several.
    fn answer_preview(
        &mut self,
        now: Stamp,
        arm: &ArmState,
        scene: &dyn Clearance,
        outcome: &mut Outcome,
    ) {
        let Some(side) = &mut self.arm else {
            return;
        };
        let Some((client, request)) = self.waiting_previews.pop_front() else {
            return;
        };
        let compared = Now {
            steering: &self.steering,
            scene,
            at: now,
            position: &arm.position,
        };
        let preview = side.previews.answer(&request.goal, &compared);
        outcome
            .replies
            .push((client, Reply::Preview(request.id, preview)));
    }

    /// The state for clients; `None` if the arm's report has no pose.
    fn state(
        &self,
        now: Stamp,
        situation: &Situation,
        decision: &Decision,
    ) -> Option<SteeringState> {
        let authority = self.steering.authority();
        let stop = authority.stop().map(|(_, reason)| reason);
        let base = situation.base.as_ref();
        let reported_at = match (&situation.arm, base) {
            (Some(arm), _) => arm.reported_at,
            (None, Some(it)) => it.base.reported_at.min(now),
            (None, None) => now,
        };
        let arm = situation.arm.as_ref();
        let is_arm_moving = arm.is_some_and(|arm| !arm.is_at_rest);
        let is_base_moving = base.is_some_and(|it| !it.base.is_at_rest);
        let state = SteeringState {
            at: self.times.instant(reported_at),
            holder: authority.holder().map(|(holder, _)| holder.0),
            lease_left_secs: authority.lease_left_secs(now),
            offered_to: authority.offered_to(now).map(|operator| operator.0),
            stop: stop_text(stop, authority.newest_stop()),
            stop_number: stop.map(|_| authority.stop_number()),
            is_recovering: self.arm.as_ref().is_some_and(|it| it.recovery.is_running()),
            is_moving: is_arm_moving || is_base_moving,
            moved_part: authority.moves_base().map(part),
            // Without an arm, there is nothing that clients could move with joints.
            position: Vec::new(),
            target: None,
            base_from_tip: transform::to_xyz_xyzw(&Transform::identity()),
            base_from_target: None,
            limits: self.limits(decision),
            applied: self.followed.applied(),
            contacts: None,
            base: base.map(|it| self.base_state(it, decision)),
        };
        match (&self.arm, arm) {
            (Some(side), Some(arm)) => side.add_to(state, arm, decision),
            _ => Some(state),
        }
    }

    /// The limits that act on the part that the operator moves or has moved last.
    fn limits(&self, decision: &Decision) -> Vec<AppliedLimit> {
        let moves_base = self.has_moved_base;
        let base = decision.base.as_ref().map(|it| (&it.limits, part(true)));
        let arm = decision.arm.as_ref().map(|it| (&it.limits, part(false)));
        let shown = if moves_base {
            base.or(arm)
        } else {
            arm.or(base)
        };
        let Some((limits, part)) = shown else {
            return Vec::new();
        };
        let applied = limits.iter();
        applied
            .map(|limit| requests::applied_limit(limit, part))
            .collect()
    }

    fn base_state(&self, situation: &BaseSituation, decision: &Decision) -> SteeredBaseState {
        let pose = situation.pose.map(|seen| seen.pose);
        let target = decision.base.as_ref().and_then(|it| it.target());
        SteeredBaseState {
            world_from_base: pose.map(|pose| [pose.x_m, pose.y_m, pose.yaw_rad]),
            velocity: situation.base.velocity.to_array(),
            is_moving: !situation.base.is_at_rest,
            target: target.map(|target| target.velocity.to_array()),
            goal: target.and_then(|_| self.steering.base_goal()),
            has_arrived: decision.base.as_ref().is_some_and(|it| it.has_arrived),
        }
    }
}

impl ArmSide {
    /// The state for clients with the posture of the arm; `None` if its report has no pose.
    fn add_to(
        &self,
        state: SteeringState,
        arm: &ArmState,
        decision: &Decision,
    ) -> Option<SteeringState> {
        let pose_at = |q: &[f64]| Some(transform::to_xyz_xyzw(&self.chain.forward(q).ok()?));
        let target = decision.arm.as_ref().and_then(|verdict| verdict.target());
        let target = target.map(|target| target.position.clone());
        Some(SteeringState {
            base_from_tip: pose_at(&arm.position)?,
            base_from_target: target.as_deref().and_then(pose_at),
            position: arm.position.clone(),
            target,
            ..state
        })
    }
}

impl BaseSide {
    fn new(port: BasePort) -> Self {
        Self {
            port,
            began_at: None,
        }
    }
}

/// Whether a part of the robot follows its operator.
fn is_following(decision: &Decision) -> bool {
    let arm = decision.arm.as_ref().and_then(|it| it.target());
    let base = decision.base.as_ref().and_then(|it| it.target());
    arm.is_some() || base.is_some()
}

fn part(is_base: bool) -> SteeredPart {
    if is_base {
        SteeredPart::Base
    } else {
        SteeredPart::Arm
    }
}
