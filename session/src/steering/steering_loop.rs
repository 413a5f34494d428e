//! One cycle of the steering loop: takes the requests of clients, decides what the arm does, and
//! says what clients should know. It has no thread and no clock, so that tests can set the time.

use super::followed_command::{FollowedCommand, stop_text};
use super::joint_map::JointMap;
use super::previews::{Now, Previews};
use super::recovery::{Permission, Recovery};
use super::requests;
use super::steering_log::{About, LoopLog};
use super::time_base::TimeBase;
use drivers::motion::{ArmState, Output, SteeringPort};
use kinematics::inverse::InverseSolver;
use kinematics::{Chain, Stamp, transform};
use std::collections::VecDeque;
use std::path::Path;
use steering::{
    Body, Clearance, NearestPosture, Operator, Reason, Request, Robot, Steering, SteeringConfig,
    Verdict,
};
use viz::{
    Preview, PreviewRequest, ReceivedRequest, RefusedRequest, SteeringCommand, SteeringRequest,
    SteeringState,
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
    chain: Chain,
    joints: JointMap,
    port: SteeringPort,
    previews: Previews,
    waiting_previews: VecDeque<(u64, PreviewRequest)>,
    recovery: Recovery,
    times: TimeBase,
    /// Whether an operator has had the lease. Nothing is sent to the arm before.
    has_begun: bool,
    followed: FollowedCommand,
    log: Option<LoopLog>,
}

/// Results of a cycle.
#[derive(Debug, Default)]
pub(super) struct Outcome {
    /// Replies to clients.
    pub(super) replies: Vec<(u64, Reply)>,
    /// Whether an operator has the lease for the first time, and thus the arm.
    pub(super) begins: bool,
    /// Whether somebody has stopped the arm, also if nobody has had the lease yet: the tour of a
    /// simulated arm must end.
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
        for note in steering.self_collision().notes() {
            log::warn!("steering: {note}");
        }
        Ok(Self {
            steering,
            previews: Previews::new(solver),
            waiting_previews: VecDeque::new(),
            recovery: Recovery::new(port.clone()),
            chain,
            joints,
            port,
            times,
            has_begun: false,
            followed: FollowedCommand::default(),
            log: None,
        })
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

    /// The newest state of the arm, in the order of the chain; `None` before the arm has reported one.
    pub(super) fn arm(&self) -> Option<ArmState> {
        Some(self.joints.state_in_chain(self.port.state()?))
    }

    /// Takes the requests, and decides what the arm does.
    ///
    /// * `arm`: the newest state of the arm, in the order of the chain.
    /// * `scene`: what is known about the scene.
    pub(super) fn cycle(
        &mut self,
        now: Stamp,
        received: &[ReceivedRequest],
        arm: &ArmState,
        scene: &dyn Clearance,
    ) -> Outcome {
        let mut outcome = Outcome::default();
        for request in received {
            self.take(now, request, arm, &mut outcome);
        }
        self.finish_recovery(now, arm, &mut outcome);
        let verdict = self.steering.cycle(now, arm, scene);
        // Without a map of the scene, a simulated arm must not continue its tour.
        let is_scene_lost = matches!(self.steering.stop(), Some(Reason::SceneLost { .. }));
        outcome.ends_tour |= is_scene_lost;
        if self.has_begun {
            let output = verdict.output.clone();
            self.port.send(&self.joints.output_for_driver(output));
        }
        if let Some(log) = &mut self.log {
            log.take(now, &mut self.steering);
        }
        self.followed
            .note_cycle(verdict.target().is_some(), self.times.instant(now));
        // A goal out of reach takes longer than a cycle. While the arm follows an operator, the next
        // decision must not wait for it.
        if verdict.target().is_none() {
            self.answer_preview(now, arm, scene, &mut outcome);
        }
        outcome.state = self.state(now, arm, &verdict);
        outcome
    }

    /// Brakes, because the loop ends.
    pub(super) fn finish(&self) {
        if self.has_begun {
            self.port.send(&Output::Brake);
        }
    }

    fn take(
        &mut self,
        now: Stamp,
        received: &ReceivedRequest,
        arm: &ArmState,
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
        arm: &ArmState,
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
        let n_joints = self.chain.n_joints();
        let converted = requests::command(received, command, self.times, n_joints);
        self.handle(now, &Request::Command(converted))?;
        self.followed.receive(command);
        Ok(())
    }

    /// Permits motion after a stop. An arm that a fault has stopped is enabled first, which takes
    /// a while.
    fn rearm(&mut self, now: Stamp, permission: Permission, arm: &ArmState) -> Result<(), String> {
        if arm.stopped.is_some() && self.holds_lease(permission.operator) {
            let named = self.steering.check_stop(permission.stop);
            named.map_err(|reason| reason.to_string())?;
            return self.recovery.start(permission);
        }
        self.permit(now, permission)
    }

    fn permit(&mut self, now: Stamp, permission: Permission) -> Result<(), String> {
        let Permission { operator, stop } = permission;
        self.handle(now, &Request::Rearm { operator, stop })
    }

    fn finish_recovery(&mut self, now: Stamp, arm: &ArmState, outcome: &mut Outcome) {
        let Some((permission, recovered)) = self.recovery.take_result(now, arm) else {
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
        let Some((client, request)) = self.waiting_previews.pop_front() else {
            return;
        };
        let compared = Now {
            steering: &self.steering,
            scene,
            at: now,
            position: &arm.position,
        };
        let preview = self.previews.answer(&request.goal, &compared);
        outcome
            .replies
            .push((client, Reply::Preview(request.id, preview)));
    }

    /// The state for clients; `None` if the arm's report has no pose.
    fn state(&self, now: Stamp, arm: &ArmState, verdict: &Verdict) -> Option<SteeringState> {
        let pose_at = |q: &[f64]| Some(transform::to_xyz_xyzw(&self.chain.forward(q).ok()?));
        let target = verdict.target().map(|target| target.position.clone());
        Some(SteeringState {
            at: self.times.instant(arm.reported_at),
            holder: self.steering.holder().map(|(holder, _)| holder.0),
            lease_left_secs: self.steering.lease_left_secs(now),
            offered_to: self.steering.offered_to(now).map(|operator| operator.0),
            stop: stop_text(self.steering.stop(), self.steering.newest_stop()),
            stop_number: self.steering.stop().map(|_| self.steering.stop_number()),
            is_recovering: self.recovery.is_running(),
            is_moving: !arm.is_at_rest,
            base_from_tip: pose_at(&arm.position)?,
            base_from_target: target.as_deref().and_then(pose_at),
            position: arm.position.clone(),
            target,
            limits: verdict.limits.iter().map(requests::applied_limit).collect(),
            applied: self.followed.applied(),
            contacts: None,
            base: None,
        })
    }
}
