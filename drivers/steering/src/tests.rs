//! Tests of the whole chain with a simulated clock.

mod base_clearance_tests;
mod base_tests;
mod clearance_tests;
mod clutch_tests;
mod late_start_tests;
mod lease_tests;
mod mobile_tests;
mod random_tests;
mod replay_tests;
mod self_collision_tests;

use crate::{
    AnalyticScene, ArmState, Body, Clearance, Command, Device, Follower, Intent, Operator, Output,
    Reason, Request, Robot, Steering, SteeringConfig, Verdict, brake_limits,
};
use drivers::motion::{MotionLimits, Setpoint};
use kinematics::urdf::Robot as Urdf;
use kinematics::{Chain, Stamp, Transform, transform};
use std::time::Duration;

const PANDA: &str = include_str!("../../../rigs/robots/panda.urdf");
/// A posture with the tip in front of the arm.
const START: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
const CYCLE: Duration = Duration::from_millis(10);
const ANA: Operator = Operator(1);
const BEN: Operator = Operator(2);
const PAD: Device = Device(10);
const BRAKE_FACTOR: f64 = 2.0;
/// Rounding of differences of setpoints, relative to a limit.
const ROUNDING: f64 = 1e-4;

fn panda() -> (Urdf, Chain) {
    let urdf = Urdf::parse(PANDA).unwrap();
    let chain = Chain::new(&urdf, "panda_link0", "panda_link8").unwrap();
    (urdf, chain)
}

fn joint_limits(chain: &Chain) -> Vec<MotionLimits> {
    let limits = chain.limits().iter();
    limits
        .map(|joint| MotionLimits::new(joint, 1.0, 0.5, 0.1))
        .collect()
}

fn new_steering(config: SteeringConfig) -> Steering {
    let (urdf, chain) = panda();
    let body = Body::new(&urdf, &chain, &|_| None).unwrap();
    let robot = Robot {
        inverse: Box::new(crate::NearestPosture::new(chain.clone())),
        joints: &joint_limits(&chain),
        chain,
        body,
        free_posture: Some(&START),
    };
    Steering::new(config, robot).unwrap()
}

fn free_scene() -> AnalyticScene {
    AnalyticScene {
        solids: Vec::new(),
        seen_at: Stamp(0),
        seen_radius_m: 10.0,
    }
}

/// A configuration in which the scene stays fresh, for tests of other links.
fn ageless() -> SteeringConfig {
    let mut config = SteeringConfig::default();
    config.clearance.fresh_secs = 1e6;
    config.clearance.stale_secs = 2e6;
    config
}

fn hand(x: f64, y: f64, z: f64) -> Intent {
    Intent::Hand {
        base_from_hand: [x, y, z, 0.0, 0.0, 0.0, 1.0],
    }
}

fn pose_intent(pose: &Transform) -> Intent {
    Intent::Pose {
        base_from_tip: transform::to_xyz_xyzw(pose),
    }
}

/// An arm, its chain of decisions, and a scene. Every step checks the limits of the setpoints.
struct Sim {
    chain: Chain,
    steering: Steering,
    follower: Follower,
    scene: Box<dyn Clearance>,
    now: Stamp,
    sequence: u64,
    limits: Vec<MotionLimits>,
    stopped: Option<String>,
}

impl Sim {
    fn new(config: SteeringConfig) -> Self {
        Self::at(config, &START)
    }

    fn at(config: SteeringConfig, start: &[f64]) -> Self {
        let (_, chain) = panda();
        let limits = joint_limits(&chain);
        let brake = brake_limits(&limits, BRAKE_FACTOR);
        Self {
            follower: Follower::new(&limits, &brake, start, CYCLE).unwrap(),
            steering: new_steering(config),
            scene: Box::new(free_scene()),
            now: Stamp(1_000_000_000),
            sequence: 0,
            chain,
            limits,
            stopped: None,
        }
    }

    /// Ana has control, and her pad was seen with an open switch.
    fn ready(config: SteeringConfig) -> Self {
        let mut sim = Self::new(config);
        sim.request(Request::TakeLease(ANA)).unwrap();
        sim.send(None, hand(0.0, 0.0, 0.0)).unwrap();
        sim
    }

    fn request(&mut self, request: Request) -> Result<(), Reason> {
        self.steering.handle(self.now, &request)
    }

    /// An operator permits motion after the newest stop.
    fn rearm(&mut self, operator: Operator) -> Result<(), Reason> {
        let stop = self.steering.stop_number();
        self.request(Request::Rearm { operator, stop })
    }

    fn command(&mut self, grip: Option<u64>, intent: Intent) -> Command {
        self.sequence += 1;
        Command {
            operator: ANA,
            device: PAD,
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip,
            intent,
        }
    }

    /// Sends a sample of Ana's pad.
    fn send(&mut self, grip: Option<u64>, intent: Intent) -> Result<(), Reason> {
        let command = self.command(grip, intent);
        self.request(Request::Command(command))
    }

    fn arm(&self) -> ArmState {
        ArmState {
            reported_at: self.now,
            position: self.follower.setpoint().position.clone(),
            is_at_rest: self.follower.is_at_rest(),
            braked_motion: self.follower.braked_motion(),
            stopped: self.stopped.clone(),
        }
    }

    /// One cycle of the chain and of the arm.
    fn cycle(&mut self) -> Verdict {
        self.now += CYCLE;
        let arm = self.arm();
        let verdict = self.steering.cycle(self.now, &arm, self.scene.as_ref());
        self.follower.obey(self.now, &verdict.output).unwrap();
        self.step_arm();
        verdict
    }

    /// One cycle of the arm alone, as if the chain was stuck.
    fn step_arm(&mut self) {
        let before = self.follower.setpoint().clone();
        let after = self.follower.step(self.now).unwrap();
        check_setpoints(&before, &after, &self.limits);
    }

    /// A sample and a cycle.
    fn drive(&mut self, grip: Option<u64>, intent: Intent) -> Verdict {
        self.send(grip, intent).unwrap();
        self.cycle()
    }

    fn tip(&self) -> Transform {
        let position = &self.follower.setpoint().position;
        self.chain.forward(position).unwrap()
    }

    fn rest(&mut self) {
        for _ in 0..1000 {
            if self.follower.is_at_rest() {
                return;
            }
            self.cycle();
        }
        panic!("the arm does not come to rest");
    }
}

/// Invariant: setpoints continue within velocity, and within acceleration and jerk of braking, and
/// within the ranges.
fn check_setpoints(before: &Setpoint, after: &Setpoint, limits: &[MotionLimits]) {
    let secs = CYCLE.as_secs_f64();
    for (ix, joint) in limits.iter().enumerate() {
        let moved = (after.position[ix] - before.position[ix]).abs();
        let accelerated = (after.velocity[ix] - before.velocity[ix]).abs();
        let jerked = (after.acceleration[ix] - before.acceleration[ix]).abs();
        let acceleration = BRAKE_FACTOR * joint.acceleration;
        let jerk = BRAKE_FACTOR * joint.jerk;
        let tolerance = 1.0 + ROUNDING;
        assert!(
            moved <= joint.velocity * secs * tolerance,
            "velocity of joint {ix}: {moved}"
        );
        assert!(
            accelerated <= acceleration * secs * tolerance,
            "acceleration of joint {ix}: {accelerated}"
        );
        assert!(
            jerked <= jerk * secs * tolerance,
            "jerk of joint {ix}: {jerked} from {before:?} to {after:?}"
        );
        let [lower, upper] = joint.position;
        let q = after.position[ix];
        assert!(
            q >= lower - 1e-9 && q <= upper + 1e-9,
            "range of joint {ix}: {q}"
        );
    }
}

fn is_braking(verdict: &Verdict) -> bool {
    verdict.output == Output::Brake
}

/// The reasons of a verdict, as an operator reads them.
fn words(verdict: &Verdict) -> String {
    let limits: Vec<String> = verdict.limits.iter().map(ToString::to_string).collect();
    limits.join("; ")
}
