//! Servo steps follow moving targets, pass singularities and never exceed a limit.

use super::robots_for_tests::{
    PANDA_READY, UR_READY, is_within, panda, random_joints, so101, ur3e, ur5e, ur10e,
};
use super::{InverseSolver, Orientation, ServoLimits, ServoStep, Target};
use crate::{Chain, Transform};
use nalgebra::{UnitQuaternion, Vector3};
use numbers::random::Random;
use std::f64::consts::{PI, TAU};

const STEP_SECS: f64 = 0.002;
/// Rounding of a difference of joint values divided by the time of a step.
const SPEED_ROUNDING: f64 = 1e-9;

/// An arm that follows targets perfectly.
struct Follower {
    chain: Chain,
    solver: InverseSolver,
    limits: ServoLimits,
    joints: Vec<f64>,
}

impl Follower {
    fn new(chain: Chain, joints: &[f64]) -> Self {
        let speeds = chain.limits().iter();
        Self {
            limits: ServoLimits {
                joint_speeds: speeds.map(|limit| limit.velocity.min(2.0)).collect(),
                linear_m_s: 0.5,
                angular_rad_s: 1.5,
                comfort_hz: 0.5,
            },
            solver: InverseSolver::new(chain.clone()).unwrap(),
            chain,
            joints: joints.to_vec(),
        }
    }

    /// Takes a step and checks that no joint is too fast or leaves its range.
    fn step(&mut self, target: &Target) -> ServoStep {
        let mut next = vec![0.0; self.joints.len()];
        let step = self
            .solver
            .servo(target, &self.joints, &self.limits, STEP_SECS, &mut next)
            .unwrap();
        let moves = next.iter().zip(&self.joints).zip(&self.limits.joint_speeds);
        for ((next, present), speed) in moves {
            let rate = (next - present).abs() / STEP_SECS;
            assert!(rate <= speed + SPEED_ROUNDING, "{rate} > {speed}: {step:?}");
        }
        assert!(is_within(&self.chain, &next), "{next:?}");
        self.joints = next;
        step
    }

    fn pose(&self) -> Transform {
        self.chain.forward(&self.joints).unwrap()
    }

    /// Largest joint speed over a number of steps.
    fn largest_speed(&mut self, target: &Target, n_steps: u32) -> f64 {
        let mut largest = 0.0_f64;
        for _ in 0..n_steps {
            let before = self.joints.clone();
            self.step(target);
            let moves = self.joints.iter().zip(&before);
            largest = moves.fold(largest, |largest, (a, b)| {
                largest.max((a - b).abs() / STEP_SECS)
            });
        }
        largest
    }
}

#[test]
fn a_moving_target_is_followed_one_step_behind() {
    for (chain, ready) in [(panda(), &PANDA_READY[..]), (ur5e(), &UR_READY[..])] {
        let mut follower = Follower::new(chain, ready);
        let start = follower.pose();
        for step in 0..2000 {
            // The target moves along a circle of 10 cm at 0.16 m/s, with a rotation of 0.2 rad.
            let angle = TAU * f64::from(step) * STEP_SECS / 4.0;
            let offset = Vector3::new(angle.sin(), 1.0 - angle.cos(), 0.0) * 0.1;
            let target = Target::pose(
                Transform::translation(offset.x, offset.y, offset.z)
                    * start
                    * Transform::rotation(Vector3::x() * 0.2 * angle.sin()),
            );
            let done = follower.step(&target);
            assert!(
                done.gap.distance_m < 5e-4 && done.gap.angle_rad < 2e-3,
                "{step}: {done:?}"
            );
            assert_eq!(done.fastest_joint_ix, None);
        }
    }
}

#[test]
fn distant_targets_are_approached_straight_and_at_the_speeds_of_the_tip() {
    let mut follower = Follower::new(panda(), &PANDA_READY);
    let start = follower.pose().translation.vector;
    let offset = Vector3::new(0.05, 0.15, -0.1);
    let target =
        Target::pose(Transform::translation(offset.x, offset.y, offset.z) * follower.pose());
    let mut last = start;
    for _ in 0..1000 {
        follower.step(&target);
        let now = follower.pose().translation.vector;
        assert!((now - last).norm() <= 0.5 * STEP_SECS * 1.01);
        let off_line = (now - start).cross(&offset.normalize()).norm();
        assert!(off_line < 1e-4, "{off_line}");
        last = now;
    }
    assert!((last - start - offset).norm() < 1e-6);
}

/// Moves the tip to the mirrored angle of the wrist, through the angle at which two axes are in
/// line.
#[test]
fn singularities_are_passed_at_bounded_speeds() {
    for chain in [ur3e(), ur5e(), ur10e()] {
        let mut joints = UR_READY;
        joints[4] = -0.4;
        let mut follower = Follower::new(chain, &joints);
        let start = follower.pose();
        joints[4] = 0.4;
        let end = follower.chain.forward(&joints).unwrap();
        let mut was_singular = false;
        for step in 0..3000 {
            let frac = (f64::from(step) / 2000.0).min(1.0);
            let target = Target::pose(crate::transform::interpolate(&start, &end, frac));
            was_singular |= follower.step(&target).is_singular;
        }
        let gap = Target::pose(end).gap(&follower.pose());
        assert!(was_singular, "the path leads through a singularity");
        assert!(gap.distance_m < 1e-3 && gap.angle_rad < 1e-3, "{gap:?}");
    }
}

#[test]
fn an_arm_that_is_stretched_out_comes_to_rest_and_returns() {
    for (chain, ready) in [(panda(), &PANDA_READY[..]), (ur5e(), &UR_READY[..])] {
        let mut follower = Follower::new(chain, ready);
        let start = follower.pose();
        let mut target = Target {
            base_from_tip: Transform::translation(2.0, 0.3, 0.5),
            orientation: Orientation::Free,
        };
        follower.largest_speed(&target, 6000);
        let speed = follower.largest_speed(&target, 500);
        assert!(speed < 0.02, "at rest, not {speed} rad/s");
        let nearest = follower
            .solver
            .clone()
            .solve(&target, &follower.joints)
            .unwrap_err();
        let least = nearest.nearest().unwrap().gap.distance_m;
        let gap = target.gap(&follower.pose());
        assert!(
            gap.distance_m < least + 0.02,
            "{gap:?}, but {least} is possible"
        );

        target.base_from_tip = start;
        follower.largest_speed(&target, 4000);
        assert!(target.gap(&follower.pose()).distance_m < 1e-6);
    }
}

#[test]
fn no_limit_is_exceeded_whatever_the_targets_are() {
    let mut random = Random::new(8);
    for chain in [panda(), ur5e(), so101()] {
        let start = random_joints(&chain, &mut random);
        let mut follower = Follower::new(chain, &start);
        let mut target = Target::pose(follower.pose());
        for step in 0..10_000 {
            if step % 25 == 0 {
                let at = |random: &mut Random| random.uniform(-1.5, 1.5);
                let rotation = Vector3::new(at(&mut random), at(&mut random), at(&mut random));
                let translation = Vector3::new(at(&mut random), at(&mut random), at(&mut random));
                target.base_from_tip = Transform::new(translation, rotation * 2.0);
                target.orientation = match random.below(3) {
                    0 => Orientation::Full,
                    1 => Orientation::Axis(Vector3::z_axis()),
                    _ => Orientation::Free,
                };
            }
            follower.step(&target);
        }
    }
}

#[test]
fn a_joint_near_its_end_is_held_and_the_others_take_over() {
    let mut joints = PANDA_READY;
    joints[6] = 2.85;
    let mut follower = Follower::new(panda(), &joints);
    follower.limits.comfort_hz = 0.0;
    let start = follower.pose();
    let mut was_held = false;
    let target = Target::pose(start * Transform::rotation(Vector3::z() * 0.3));
    for _ in 0..4000 {
        was_held |= follower.step(&target).joint_at_limit_ix == Some(6);
    }
    let gap = target.gap(&follower.pose());
    assert!(
        was_held && gap.distance_m < 1e-3 && gap.angle_rad < 1e-3,
        "{gap:?}"
    );
}

#[test]
fn joints_beyond_their_ranges_move_inward() {
    let chain = panda();
    let mut follower = Follower::new(chain.clone(), &PANDA_READY);
    let mut joints = PANDA_READY;
    joints[3] = 0.2;
    let target = Target::pose(chain.forward(&joints).unwrap());
    let mut next = [0.0; 7];
    let mut last = joints[3];
    for _ in 0..2000 {
        let limits = &follower.limits;
        follower
            .solver
            .servo(&target, &joints, limits, STEP_SECS, &mut next)
            .unwrap();
        assert!(next[3] < last && last - next[3] <= limits.joint_speeds[3] * STEP_SECS + 1e-12);
        (joints, last) = (next, next[3]);
        if is_within(&chain, &joints) {
            return;
        }
    }
    // The approach is exponential, so the end of the range is only almost reached.
    assert!(last < chain.limits()[3].upper + 1e-6, "{last}");
}

#[test]
fn free_joints_move_to_the_posture_while_the_tip_stays() {
    let mut follower = Follower::new(panda(), &PANDA_READY);
    let mut posture = PANDA_READY;
    posture[0] += 0.5;
    follower.solver = follower.solver.with_posture(&posture).unwrap();
    let target = Target::pose(follower.pose());
    for _ in 0..4000 {
        let gap = follower.step(&target).gap;
        assert!(gap.distance_m < 1e-4 && gap.angle_rad < 1e-4, "{gap:?}");
    }
    assert!(
        follower.joints[0] > PANDA_READY[0] + 0.05,
        "{:?}",
        follower.joints
    );
}

#[test]
fn half_a_turn_is_made_at_bounded_speed() {
    let mut follower = Follower::new(ur5e(), &UR_READY);
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI);
    let target = Target::pose(follower.pose() * half_turn);
    follower.largest_speed(&target, 3000);
    assert!(target.gap(&follower.pose()).angle_rad < 1e-6);
}

#[test]
fn invalid_steps_are_rejected_and_leave_the_output() {
    let mut follower = Follower::new(panda(), &PANDA_READY);
    let target = Target::pose(follower.pose());
    let nowhere = Target::pose(Transform::translation(f64::NAN, 0.0, 0.0));
    let good = follower.limits.clone();
    let slow = ServoLimits {
        linear_m_s: 0.0,
        ..good.clone()
    };
    let endless = ServoLimits {
        comfort_hz: f64::INFINITY,
        ..good.clone()
    };
    let short = ServoLimits {
        joint_speeds: vec![1.0; 6],
        ..good.clone()
    };
    let still = ServoLimits {
        joint_speeds: vec![0.0; 7],
        ..good.clone()
    };
    let mut next = [9.0; 7];
    let mut message = |target: &Target, joints: &[f64], limits: &ServoLimits, step_secs: f64| {
        let result = follower
            .solver
            .servo(target, joints, limits, step_secs, &mut next);
        assert_eq!(next, [9.0; 7]);
        result.unwrap_err().to_string()
    };
    assert!(message(&nowhere, &PANDA_READY, &good, 0.01).contains("not a finite number"));
    assert!(message(&target, &PANDA_READY[..2], &good, 0.01).starts_with("2 joint values"));
    assert!(message(&target, &[f64::NAN; 7], &good, 0.01).contains("NaN"));
    assert!(message(&target, &PANDA_READY, &short, 0.01).starts_with("6 joint values"));
    for (limits, step_secs, text) in [
        (
            &slow,
            0.01,
            "inverse kinematics: linear_m_s is 0, must be above 0",
        ),
        (
            &still,
            0.01,
            "inverse kinematics: slowest joint speed is 0, must be above 0",
        ),
        (
            &good,
            0.0,
            "inverse kinematics: step_secs is 0, must be above 0",
        ),
        (
            &good,
            f64::NAN,
            "inverse kinematics: step_secs is NaN, must be above 0",
        ),
        (
            &endless,
            0.01,
            "inverse kinematics: comfort_hz is inf, must be finite and not negative",
        ),
    ] {
        assert_eq!(message(&target, &PANDA_READY, limits, step_secs), text);
    }
}
