//! Checks an arm that is steered against what [`MovableArm::steering_port`] promises. The arm may be
//! emulated or real.

use super::{ArmState, JointTarget, MovableArm, Output, SteeringPort, Target};
use crate::clock;
use kinematics::Stamp;
use std::time::Duration;

/// Acceleration and jerk of braking, as a factor of the limits of motions.
const BRAKE_FACTOR: f64 = 2.0;
/// How long the arm follows a target. It is long, so that a busy computer does not end a motion.
const VALIDITY: Duration = Duration::from_millis(300);
/// Time between two targets.
const PERIOD: Duration = Duration::from_millis(5);
/// Time after which a condition counts as never met.
const LIMIT: Duration = Duration::from_secs(60);
/// Distance by which the reported position of an arm at rest may change: a controller may round it.
const STILL: f64 = 1e-4;
/// Number of reports in which an arm that rests must not move.
const N_STILL_REPORTS: usize = 20;

/// Which motion is tried.
#[derive(Clone, Copy, Debug)]
pub struct TriedMotion {
    /// Index of the joint that moves, in the order of the joint names.
    pub joint_ix: usize,
    /// Distance of the target, radians or meters. The arm must need more than a second for it.
    pub distance: f64,
    /// Distance after which the stream of targets ends.
    pub until: f64,
    /// Part of a reason for which the arm may stop on a busy computer. It is then recovered.
    pub busy: Option<&'static str>,
}

/// Steers an arm: it follows a stream of targets, brakes when the stream ends, and then moves only
/// with a new motion. While the arm is steered, its owner does not use it, as a program that is
/// blocked.
///
/// # Panics
/// If the arm does something else.
pub fn check_steering(arm: &mut dyn MovableArm, tried: TriedMotion) {
    let port = arm.steering_port(BRAKE_FACTOR).expect("the arm is enabled");
    let mut operator = ScriptedOperator::new(port, tried);
    let start = operator.wait("a report of rest", |state| state.is_at_rest);
    let refusal = arm
        .command(&JointTarget {
            position: start.position.clone(),
        })
        .expect_err("the arm is steered");
    assert!(refusal.to_string().contains("steered"), "{refusal}");

    // The stream ends: the last target expires.
    let braked = operator.move_then(&start, |_| {});
    let distance = braked.position[tried.joint_ix] - start.position[tried.joint_ix];
    assert!(
        distance.abs() < tried.distance.abs(),
        "it braked before its target: {braked:?}"
    );
    operator.check_that_nothing_moves(&braked);

    // The operator lets go. The position is the new start, so the arm moves back.
    operator.tried.distance = -tried.distance;
    let released = operator.move_then(&braked, |port| port.send(&Output::Brake));
    operator.check_that_nothing_moves(&released);

    // The owner stops the arm.
    operator.tried.distance = tried.distance;
    let stopped = operator.move_then(&released, |_| arm.stop().expect("a steered arm stops"));
    operator.check_that_nothing_moves(&stopped);
}

/// Sends targets as a chain of decisions does.
struct ScriptedOperator {
    port: SteeringPort,
    tried: TriedMotion,
    motion: u64,
    serial: u64,
}

impl ScriptedOperator {
    fn new(port: SteeringPort, tried: TriedMotion) -> Self {
        Self {
            port,
            tried,
            motion: 0,
            serial: 0,
        }
    }

    /// The next target of the present motion.
    fn target(&mut self, position: Vec<f64>) -> Target {
        self.serial += 1;
        Target {
            motion: self.motion,
            serial: self.serial,
            position,
            expires_at: clock::now() + VALIDITY,
        }
    }

    /// Moves the joint from `start` with a new motion, then ends the motion in some way, and waits
    /// for rest.
    fn move_then(&mut self, start: &ArmState, mut end: impl FnMut(&SteeringPort)) -> ArmState {
        let ix = self.tried.joint_ix;
        let mut goal = start.position.clone();
        goal[ix] += self.tried.distance;
        let began = clock::now();
        let mut from = start.position[ix];
        self.motion += 1;
        loop {
            assert_in_time(began, "the arm moves");
            let target = self.target(goal.clone());
            self.port.send(&Output::Follow(target));
            std::thread::sleep(PERIOD);
            let state = self.state();
            if (state.position[ix] - from).abs() > self.tried.until {
                end(&self.port);
                break;
            }
            // A busy computer may have delayed the targets for too long.
            if state.braked_motion >= self.motion && state.is_at_rest {
                from = state.position[ix];
                self.motion = state.braked_motion + 1;
            }
        }
        let motion = self.motion;
        let rest = self.wait("a brake", |state| {
            state.is_at_rest && state.braked_motion >= motion
        });
        let moved = rest.position[ix] - start.position[ix];
        assert!(
            moved.abs() > self.tried.until && moved * self.tried.distance > 0.0,
            "{start:?} {rest:?}"
        );
        rest
    }

    /// Sends targets that must not be followed.
    fn check_that_nothing_moves(&mut self, rest: &ArmState) {
        let mut goal = rest.position.clone();
        goal[self.tried.joint_ix] -= self.tried.distance;
        let mut not_finite = goal.clone();
        not_finite[self.tried.joint_ix] = f64::NAN;
        let mut seen_at = rest.reported_at;
        for _ in 0..N_STILL_REPORTS {
            // Targets of the motion that has ended.
            let same_motion = self.target(goal.clone());
            // Targets of a new motion that are not valid, or too late.
            let new_motion = |target: Target| Target {
                motion: self.motion + 1,
                ..target
            };
            let expired = Target {
                expires_at: Stamp(clock::now().0 - 1),
                ..same_motion.clone()
            };
            let without_joints = Target {
                position: Vec::new(),
                ..same_motion.clone()
            };
            let without_position = Target {
                position: not_finite.clone(),
                ..same_motion.clone()
            };
            for target in [
                same_motion,
                new_motion(expired),
                new_motion(without_joints),
                new_motion(without_position),
            ] {
                self.port.send(&Output::Follow(target));
            }
            let state = self.wait("a report", |state| state.reported_at > seen_at);
            seen_at = state.reported_at;
            let is_still = std::iter::zip(&state.position, &rest.position)
                .all(|(is, was)| (is - was).abs() < STILL);
            assert!(state.is_at_rest && is_still, "{rest:?} {state:?}");
        }
        // The next motion is later than the number that was used here.
        self.motion += 1;
    }

    /// The newest state. Recovers an arm that stopped because the computer is busy.
    fn state(&self) -> ArmState {
        let began = clock::now();
        loop {
            assert_in_time(began, "the arm reports its state");
            let state = self.port.state();
            match state.as_ref().map(|state| &state.stopped) {
                Some(None) => return state.expect("it was just found"),
                Some(Some(reason)) => {
                    let is_busy = self.tried.busy.is_some_and(|busy| reason.contains(busy));
                    assert!(is_busy, "{reason}");
                    self.port.recover().expect("the computer was only busy");
                }
                None => {}
            }
            std::thread::sleep(PERIOD);
        }
    }

    fn wait(&self, what: &str, condition: impl Fn(&ArmState) -> bool) -> ArmState {
        let began = clock::now();
        loop {
            let state = self.state();
            if condition(&state) {
                return state;
            }
            assert!(
                clock::now().duration_since(began) < LIMIT,
                "no {what}: {state:?}"
            );
            std::thread::sleep(PERIOD);
        }
    }
}

fn assert_in_time(began: Stamp, what: &str) {
    assert!(clock::now().duration_since(began) < LIMIT, "never: {what}");
}
