//! Whether the arm moves without a jump if its operator grips again and again, with the hand
//! anywhere.
//!
//! A grip concerns the decisions and the generator of setpoints alone, so the clock is simulated.

use super::trace::{Excess, Period, Sample, largest_excess};
use anyhow::{Context, Result};
use capture::known_robots::KnownRobot;
use drivers::motion::{ArmState, Follower, MotionLimits, brake_limits};
use kinematics::urdf::Robot as Urdf;
use kinematics::{Chain, Stamp, Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use numbers::random::Random;
use report::Table;
use serde::Serialize;
use std::f64::consts::PI;
use std::time::Duration;
use steering::{
    AnalyticScene, Body, Command, Device, Intent, NearestPosture, Operator, Request, Robot,
    Steering, SteeringConfig,
};

/// Time between two setpoints.
const PERIOD: Duration = Duration::from_millis(1);
/// Cycles between two decisions, and between two samples of the hand.
const CYCLES_PER_DECISION: u64 = 5;
const CYCLES_PER_SAMPLE: u64 = 11;
/// Number of samples with an open switch before a grip.
const N_OPEN_SAMPLES: u64 = 3;
/// Number of samples of a grip.
const N_CLOSED_SAMPLES: usize = 40;
/// Cycles in which an arm must come to rest.
const MAX_REST_CYCLES: u32 = 5000;
/// Range of the hand around the origin, meters.
const HAND_RANGE_M: f64 = 2.0;
/// Speed of the hand, m/s.
const HAND_M_S: f64 = 0.2;
/// Distance from its first position from which the tip is moved back, meters.
const MOVE_BACK_M: f64 = 0.1;
const BRAKE_FACTOR: f64 = 2.0;
const OPERATOR: Operator = Operator(1);
const DEVICE: Device = Device(1);
const START_RAD: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];

/// Results of all grips.
#[derive(Clone, Debug, Serialize)]
pub struct Grips {
    /// Number of grips.
    pub n_grips: u32,
    /// Grips after which the arm moved.
    pub n_moved: u32,
    /// Grips during which a limit was exceeded in any cycle.
    pub n_exceeded: u32,
    /// The first such excess.
    pub excess: Option<Excess>,
}

/// Grips again and again.
///
/// # Errors
///
/// If the arm cannot be steered, or does not come to rest.
pub(super) fn measure(n_grips: u32) -> Result<Grips> {
    let mut arm = SteeredChain::new()?;
    let mut random = Random::new(1);
    let mut grips = Grips {
        n_grips,
        n_moved: 0,
        n_exceeded: 0,
        excess: None,
    };
    for grip in 1..=u64::from(n_grips) {
        let start = arm.follower.setpoint().position.clone();
        let samples = arm.grip(grip, &mut random)?;
        let excess = largest_excess(&samples, &arm.brake_limits, Period::Constant(PERIOD));
        grips.n_exceeded += u32::from(excess.is_some());
        grips.excess = grips.excess.or(excess);
        grips.n_moved += u32::from(arm.follower.setpoint().position != start);
    }
    Ok(grips)
}

/// The decisions and the setpoints of a Panda, on a simulated clock.
struct SteeredChain {
    steering: Steering,
    follower: Follower,
    chain: Chain,
    brake_limits: Vec<MotionLimits>,
    home_m: Vector3<f64>,
    now: Stamp,
    n_cycles: u64,
    sequence: u64,
}

impl SteeredChain {
    fn new() -> Result<Self> {
        let robot = KnownRobot::find("panda").context("a robot of the program is missing")?;
        let urdf = Urdf::parse(robot.urdf)?;
        let chain = Chain::new(&urdf, robot.base_link, robot.flange_link)?;
        let limits = super::arms::motion_limits(&chain);
        let steered = Robot {
            inverse: Box::new(NearestPosture::new(chain.clone())),
            body: Body::new(&urdf, &chain, &|_| None)?,
            chain: chain.clone(),
            joints: &limits,
            free_posture: Some(&START_RAD),
        };
        let mut steering = Steering::new(SteeringConfig::default(), steered)?;
        steering
            .handle(Stamp(0), &Request::TakeLease(OPERATOR))
            .map_err(|reason| anyhow::anyhow!("{reason}"))?;
        let brake_limits = brake_limits(&limits, BRAKE_FACTOR);
        Ok(Self {
            follower: Follower::new(&limits, &brake_limits, &START_RAD, PERIOD)?,
            steering,
            home_m: chain.forward(&START_RAD)?.translation.vector,
            chain,
            brake_limits,
            now: Stamp(0),
            n_cycles: 0,
            sequence: 0,
        })
    }

    /// Grips with the hand anywhere, moves it, and releases the switch. Returns all setpoints until rest.
    fn grip(&mut self, grip: u64, random: &mut Random) -> Result<Vec<Sample>> {
        let mut samples = vec![self.sample()];
        let mut hand = anywhere(random);
        let step_m = self.direction(random)? * HAND_M_S * sample_secs();
        for _ in 0..N_OPEN_SAMPLES {
            self.send(None, &hand);
            self.run(CYCLES_PER_SAMPLE, &mut samples)?;
        }
        for _ in 0..N_CLOSED_SAMPLES {
            self.send(Some(grip), &hand);
            self.run(CYCLES_PER_SAMPLE, &mut samples)?;
            hand.translation.vector += step_m;
        }
        self.send(None, &hand);
        for _ in 0..MAX_REST_CYCLES {
            self.run(1, &mut samples)?;
            if self.follower.is_at_rest() {
                return Ok(samples);
            }
        }
        anyhow::bail!("the arm does not come to rest after grip {grip}")
    }

    /// A random direction, or back to the first position.
    fn direction(&self, random: &mut Random) -> Result<Vector3<f64>> {
        let tip = self.chain.forward(&self.follower.setpoint().position)?;
        let back_m = self.home_m - tip.translation.vector;
        let direction = if back_m.norm() > MOVE_BACK_M {
            back_m
        } else {
            Vector3::from_fn(|_, _| random.normal())
        };
        Ok(direction.normalize())
    }

    fn send(&mut self, grip: Option<u64>, hand: &Transform) {
        self.sequence += 1;
        let command = Command {
            operator: OPERATOR,
            device: DEVICE,
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip,
            intent: Intent::Hand {
                base_from_hand: transform::to_xyz_xyzw(hand),
            },
        };
        // A refusal shows in the motion.
        let _ = self.steering.handle(self.now, &Request::Command(command));
    }

    fn run(&mut self, n_cycles: u64, samples: &mut Vec<Sample>) -> Result<()> {
        for _ in 0..n_cycles {
            self.now += PERIOD;
            self.n_cycles += 1;
            if self.n_cycles.is_multiple_of(CYCLES_PER_DECISION) {
                self.decide();
            }
            self.follower.step(self.now)?;
            samples.push(self.sample());
        }
        Ok(())
    }

    fn decide(&mut self) {
        let arm = ArmState {
            reported_at: self.now,
            position: self.follower.setpoint().position.clone(),
            is_at_rest: self.follower.is_at_rest(),
            braked_motion: self.follower.braked_motion(),
            stopped: None,
        };
        let scene = AnalyticScene {
            solids: Vec::new(),
            seen_at: self.now,
            seen_radius_m: 10.0,
        };
        let verdict = self.steering.cycle(self.now, &arm, &scene);
        // A target that is not followed shows in the motion.
        let _ = self.follower.obey(self.now, &verdict.output);
    }

    fn sample(&self) -> Sample {
        Sample {
            at: self.now,
            setpoint: self.follower.setpoint().clone(),
        }
    }
}

fn sample_secs() -> f64 {
    CYCLES_PER_SAMPLE as f64 * PERIOD.as_secs_f64()
}

/// A random pose of the hand.
fn anywhere(random: &mut Random) -> Transform {
    let mut axis = || random.uniform(-1.0, 1.0);
    let position_m = HAND_RANGE_M * Vector3::new(axis(), axis(), axis());
    let rotation = UnitQuaternion::from_scaled_axis(PI * Vector3::new(axis(), axis(), axis()));
    Transform::from_parts(position_m.into(), rotation)
}

/// The table of all grips.
pub(super) fn table(grips: &Grips) -> Table {
    let head = ["path", "grips", "moved the arm", "limits exceeded"];
    let counts = [grips.n_grips, grips.n_moved, grips.n_exceeded];
    let mut row = vec!["decisions and generator on a simulated clock".to_owned()];
    row.extend(counts.map(|n| n.to_string()));
    Table {
        title: "Grips with the hand anywhere".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: vec![row],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_grip_moves_the_arm_and_none_makes_it_jump() {
        let grips = measure(5).expect("it is steered");
        assert_eq!(
            (grips.n_moved, grips.n_exceeded),
            (5, 0),
            "{:?}",
            grips.excess
        );
    }
}
