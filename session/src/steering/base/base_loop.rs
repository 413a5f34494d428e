//! One cycle of the loop that steers a base: takes the requests of clients, decides about the
//! motion of the base, and returns the state for clients. It has no thread and no clock, so that
//! tests can set the time.

use super::robot_watch::SeenRobot;
use crate::steering::followed_command::{FollowedCommand, stop_text};
use crate::steering::requests;
use crate::steering::steering_log::LoopLog;
use crate::steering::time_base::TimeBase;
use drivers::base_motion::{BaseOutput, BasePort, BaseState, BaseVelocity};
use kinematics::{Stamp, Transform, transform};
use steering::{
    BaseSituation, BaseSteering, BaseSteeringConfig, BaseVerdict, Error, Operator, Request,
};
use viz::{
    ReceivedRequest, RefusedRequest, SteeredBaseState, SteeringCommand, SteeringRequest,
    SteeringState,
};

/// The state of the loop between two cycles.
pub(super) struct BaseLoop {
    steering: BaseSteering,
    port: BasePort,
    times: TimeBase,
    /// Time of the first cycle.
    began_at: Option<Stamp>,
    /// Whether an operator has had the lease. Nothing is sent to the base before.
    has_begun: bool,
    followed: FollowedCommand,
    log: Option<LoopLog<BaseSteering>>,
}

/// Results of a cycle.
#[derive(Debug)]
pub(super) struct BaseOutcome {
    /// Requests that were refused: the client, the kind of the request, and why.
    pub(super) refusals: Vec<(u64, RefusedRequest, String)>,
    /// Whether the tour of a simulated base must end: an operator has the lease for the first time,
    /// or somebody has stopped the base.
    pub(super) ends_tour: bool,
    /// The state for clients.
    pub(super) state: SteeringState,
}

impl BaseLoop {
    /// # Errors
    ///
    /// If the configuration is not valid.
    pub(super) fn new(
        config: BaseSteeringConfig,
        port: BasePort,
        times: TimeBase,
    ) -> Result<Self, Error> {
        Ok(Self {
            steering: BaseSteering::new(config)?,
            port,
            times,
            began_at: None,
            has_begun: false,
            followed: FollowedCommand::default(),
            log: None,
        })
    }

    /// The chain of decisions.
    pub(super) fn steering(&self) -> &BaseSteering {
        &self.steering
    }

    /// Logs all decisions from now on.
    pub(super) fn log_into(&mut self, log: LoopLog<BaseSteering>) {
        self.log = Some(log);
    }

    /// Takes the requests, and decides about the motion of the base.
    pub(super) fn cycle(
        &mut self,
        now: Stamp,
        received: &[ReceivedRequest],
        seen: &SeenRobot,
    ) -> BaseOutcome {
        let mut refusals = Vec::new();
        let mut ends_tour = false;
        for request in received {
            let had_begun = self.has_begun;
            if let Err(reason) = self.take(now, request)
                && let Some(kind) = requests::kind(&request.request)
            {
                refusals.push((request.client, kind, reason));
            }
            ends_tour |= self.has_begun != had_begun || request.request == SteeringRequest::Stop;
        }
        let situation = self.situation(now, seen);
        let verdict = self.steering.cycle(now, &situation);
        if self.has_begun {
            self.port.send(&verdict.output);
        }
        if let Some(log) = &mut self.log {
            log.take(now, &mut self.steering);
        }
        self.followed
            .note_cycle(verdict.target().is_some(), self.times.instant(now));
        BaseOutcome {
            refusals,
            ends_tour,
            state: self.state(now, &situation, &verdict),
        }
    }

    /// Brakes, because the loop ends.
    pub(super) fn finish(&self) {
        if self.has_begun {
            self.port.send(&BaseOutput::Brake);
        }
    }

    /// The state of the robot. A base that has never reported counts as silent since the first
    /// cycle.
    fn situation(&mut self, now: Stamp, seen: &SeenRobot) -> BaseSituation {
        let began_at = *self.began_at.get_or_insert(now);
        let base = self.port.state().unwrap_or(BaseState {
            reported_at: began_at,
            velocity: BaseVelocity::ZERO,
            is_at_rest: false,
            braked_motion: 0,
            fault: None,
            refusal: None,
        });
        BaseSituation {
            base,
            pose: seen.pose,
            arm: seen.posture.clone(),
        }
    }

    fn take(&mut self, now: Stamp, received: &ReceivedRequest) -> Result<(), String> {
        let operator = Operator(received.client);
        let request = match &received.request {
            SteeringRequest::TakeLease => {
                self.handle(now, &Request::TakeLease(operator))?;
                self.has_begun = true;
                return Ok(());
            }
            SteeringRequest::RenewLease => Request::RenewLease(operator),
            SteeringRequest::ReleaseLease => Request::ReleaseLease(operator),
            SteeringRequest::OfferLease { to } => Request::OfferLease {
                from: operator,
                to: Operator(*to),
            },
            SteeringRequest::Stop => Request::Stop { by: Some(operator) },
            SteeringRequest::Rearm { stop } => Request::Rearm {
                operator,
                stop: *stop,
            },
            SteeringRequest::Command(command) => return self.command(now, received, command),
            SteeringRequest::Preview(_) => {
                return Err("a base has no previews: send the goal as a command".to_owned());
            }
            SteeringRequest::View { world_from_camera } => {
                self.see(now, operator, *world_from_camera);
                return Ok(());
            }
            // A client that has disconnected cannot open a dead-man switch any more.
            SteeringRequest::Disconnected if self.holds_lease(operator) => {
                Request::ReleaseLease(operator)
            }
            SteeringRequest::Disconnected => return Ok(()),
        };
        self.handle(now, &request)
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

    /// Logs the view of the holder of the lease.
    fn see(&mut self, now: Stamp, operator: Operator, world_from_camera: [f64; 7]) {
        let is_holder = self.holds_lease(operator);
        if let Some(log) = self.log.as_mut().filter(|_| is_holder) {
            log.see(now, operator.0, world_from_camera);
        }
    }

    fn command(
        &mut self,
        now: Stamp,
        received: &ReceivedRequest,
        command: &SteeringCommand,
    ) -> Result<(), String> {
        let converted = requests::command(received, command, self.times, 0);
        self.handle(now, &Request::Command(converted))?;
        self.followed.receive(command);
        Ok(())
    }

    fn state(&self, now: Stamp, situation: &BaseSituation, verdict: &BaseVerdict) -> SteeringState {
        let base = &situation.base;
        let pose = situation.pose.map(|seen| seen.pose);
        let goal = verdict.target().and_then(|_| self.steering.goal());
        SteeringState {
            at: self.times.instant(base.reported_at.min(now)),
            holder: self.steering.holder().map(|(holder, _)| holder.0),
            lease_left_secs: self.steering.lease_left_secs(now),
            offered_to: self.steering.offered_to(now).map(|operator| operator.0),
            stop: stop_text(self.steering.stop(), self.steering.newest_stop()),
            stop_number: self.steering.stop().map(|_| self.steering.stop_number()),
            is_recovering: false,
            is_moving: !base.is_at_rest,
            // There is no arm that clients could move.
            position: Vec::new(),
            target: None,
            base_from_tip: transform::to_xyz_xyzw(&Transform::identity()),
            base_from_target: None,
            limits: verdict.limits.iter().map(requests::applied_limit).collect(),
            applied: self.followed.applied(),
            contacts: None,
            base: Some(SteeredBaseState {
                world_from_base: pose.map(|pose| [pose.x_m, pose.y_m, pose.yaw_rad]),
                velocity: base.velocity.to_array(),
                target: verdict.target().map(|target| target.velocity.to_array()),
                goal,
                has_arrived: verdict.has_arrived,
            }),
        }
    }
}
