//! Velocities of a base with a simulated clock.

use super::drive::DriveCycle;
use super::{
    BaseFollower, BaseLimits, BaseOutput, BaseReport, BaseTarget, BaseVelocity, MovableBase,
};
use crate::Error;
use crate::motion::NotFollowed;
use kinematics::Stamp;
use numbers::random::Random;
use parking_lot::Mutex;
use std::sync::Arc;

const LIMITS: BaseLimits = BaseLimits {
    max_forward_m_s: 0.5,
    max_left_m_s: 0.2,
    max_yaw_rad_s: 1.0,
    acceleration_m_s2: 0.5,
    yaw_acceleration_rad_s2: 1.0,
    brake_m_s2: 1.0,
    brake_yaw_rad_s2: 2.0,
};
const CYCLE_SECS: f64 = 0.02;
/// Rounding of sums of velocities.
const ROUNDING: f64 = 1e-9;

fn at(cycle: u32) -> Stamp {
    Stamp(1).plus_secs(CYCLE_SECS * f64::from(cycle))
}

fn target(motion: u64, serial: u64, velocity: [f64; 3], expires_at: Stamp) -> BaseTarget {
    BaseTarget {
        motion,
        serial,
        velocity: BaseVelocity::from_array(velocity),
        expires_at,
    }
}

fn follower() -> BaseFollower {
    let mut follower = BaseFollower::new(LIMITS).expect("valid limits");
    follower.step(at(0));
    follower
}

#[test]
fn a_base_accelerates_and_brakes_within_its_limits_and_brakes_when_a_target_expires() {
    let mut follower = follower();
    let until = at(60);
    follower
        .follow(at(0), &target(1, 1, [0.5, 0.0, 0.0], until))
        .expect("a new target");
    for cycle in 1..=50 {
        let speed_m_s = follower.step(at(cycle)).forward_m_s;
        let expected = (LIMITS.acceleration_m_s2 * CYCLE_SECS * f64::from(cycle)).min(0.5);
        assert!((speed_m_s - expected).abs() < ROUNDING, "{speed_m_s}");
    }
    for cycle in 51..=60 {
        assert_eq!(follower.step(at(cycle)).forward_m_s, 0.5);
    }
    assert_eq!(follower.braked_motion(), 0);
    // 0.5 m/s at 1 m/s² take half a second: 25 cycles.
    for cycle in 61..=84 {
        let speed_m_s = follower.step(at(cycle)).forward_m_s;
        let expected = 0.5 - LIMITS.brake_m_s2 * CYCLE_SECS * f64::from(cycle - 60);
        assert!((speed_m_s - expected).abs() < ROUNDING, "{speed_m_s}");
    }
    for cycle in 85..=86 {
        follower.step(at(cycle));
    }
    assert!(follower.is_at_rest());
    assert_eq!(follower.braked_motion(), 1);
    // The same grip does not move the base again.
    let again = follower.follow(at(87), &target(1, 2, [0.5, 0.0, 0.0], at(100)));
    assert_eq!(again, Err(NotFollowed::MotionEnded { motion: 1 }));
    assert_eq!(
        follower.follow(at(87), &target(2, 1, [0.5, 0.0, 0.0], at(100))),
        Ok(())
    );
}

#[test]
fn invalid_repeated_and_expired_targets_change_nothing() {
    let mut follower = follower();
    follower
        .follow(at(0), &target(2, 5, [0.3, 0.0, 0.0], at(1000)))
        .expect("a new target");
    for refused in [
        target(2, 6, [f64::NAN, 0.0, 0.0], at(1000)),
        target(2, 6, [0.0, f64::INFINITY, 0.0], at(1000)),
        target(2, 5, [-0.3, 0.0, 0.0], at(1000)),
        target(2, 4, [-0.3, 0.0, 0.0], at(1000)),
        target(1, 9, [-0.3, 0.0, 0.0], at(1000)),
        target(2, 6, [-0.3, 0.0, 0.0], at(9)),
    ] {
        assert!(follower.follow(at(10), &refused).is_err(), "{refused:?}");
    }
    for cycle in 10..100 {
        follower.step(at(cycle));
    }
    assert_eq!(follower.velocity().forward_m_s, 0.3);
}

#[test]
fn a_clock_that_goes_back_ends_the_motion() {
    let mut follower = follower();
    follower
        .follow(at(50), &target(1, 1, [0.3, 0.0, 0.0], at(60)))
        .expect("a new target");
    follower.step(at(50));
    follower.step(at(20));
    assert_eq!(follower.braked_motion(), 1);
}

#[test]
fn no_sequence_of_targets_breaks_a_limit() {
    let mut random = Random::new(11);
    let mut follower = follower();
    let mut serial = 0;
    let mut motion = 1;
    for cycle in 1..20_000_u32 {
        serial += 1;
        let number = |random: &mut Random| match random.below(12) {
            0 => f64::NAN,
            1 => 1e300,
            _ => 4.0 * random.unit() - 2.0,
        };
        let velocity = std::array::from_fn(|_| number(&mut random));
        let expires_at = at(cycle + 5).plus_secs(-0.2 * random.unit());
        let _ = follower.follow(at(cycle), &target(motion, serial, velocity, expires_at));
        if follower.braked_motion() >= motion {
            motion += 1;
        }
        let before = follower.velocity();
        let after = follower.step(at(cycle));
        let linear_m_s =
            (after.forward_m_s - before.forward_m_s).hypot(after.left_m_s - before.left_m_s);
        assert!(linear_m_s <= LIMITS.brake_m_s2 * CYCLE_SECS + ROUNDING);
        let yaw_rad_s = (after.yaw_rad_s - before.yaw_rad_s).abs();
        assert!(yaw_rad_s <= LIMITS.brake_yaw_rad_s2 * CYCLE_SECS + ROUNDING);
        let excess = (after.forward_m_s / LIMITS.max_forward_m_s)
            .hypot(after.left_m_s / LIMITS.max_left_m_s);
        assert!(excess <= 1.0 + ROUNDING, "{after:?}");
        assert!(after.yaw_rad_s.abs() <= LIMITS.max_yaw_rad_s + ROUNDING);
    }
    assert!(motion > 100, "motions end and begin: {motion}");
}

#[test]
fn a_base_that_cannot_move_sideways_keeps_the_forward_part() {
    let limits = BaseLimits {
        max_left_m_s: 0.0,
        ..LIMITS
    };
    let (clamped, scale) = limits.clamped(BaseVelocity::from_array([1.0, 3.0, -2.0]));
    assert_eq!(clamped.to_array(), [0.5, 0.0, -1.0]);
    assert_eq!(scale, 0.5);
}

#[test]
fn limits_that_are_not_positive_or_brake_too_little_are_refused() {
    for (limits, expected) in [
        (
            BaseLimits {
                max_forward_m_s: f64::NAN,
                ..LIMITS
            },
            "max_forward_m_s",
        ),
        (
            BaseLimits {
                max_left_m_s: -0.1,
                ..LIMITS
            },
            "max_left_m_s",
        ),
        (
            BaseLimits {
                brake_m_s2: 0.4,
                ..LIMITS
            },
            "brake_m_s2",
        ),
    ] {
        let error = BaseFollower::new(limits).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    }
}

/// A base that reaches every velocity immediately, and its commands.
#[derive(Clone, Default)]
struct IdealBase(Arc<Mutex<BaseReport>>);

impl MovableBase for IdealBase {
    fn drive(&mut self, now: Stamp, velocity: &BaseVelocity) -> Result<(), Error> {
        let mut report = self.0.lock();
        report.reported_at = Some(now);
        if !report.is_on_tour {
            report.velocity = *velocity;
            report.is_stop_confirmed = *velocity == BaseVelocity::ZERO;
        }
        Ok(())
    }

    fn report(&mut self, _now: Stamp) -> BaseReport {
        self.0.lock().clone()
    }
}

#[test]
fn a_base_on_its_tour_does_not_obey_and_then_brakes_from_its_own_velocity() {
    let base = IdealBase::default();
    *base.0.lock() = BaseReport {
        velocity: BaseVelocity::from_array([0.8, 0.0, 0.0]),
        is_on_tour: true,
        ..BaseReport::default()
    };
    let mut cycle = DriveCycle::new(Box::new(base.clone()), LIMITS).expect("valid limits");
    let port = cycle.port.clone();
    port.send(&BaseOutput::Drive(target(1, 1, [-0.5, 0.0, 0.0], at(1000))));
    for step in 0..10 {
        cycle.step(at(step));
    }
    assert_eq!(base.0.lock().velocity.forward_m_s, 0.8);
    assert!(!port.state().expect("a report").is_at_rest);

    base.0.lock().is_on_tour = false;
    let mut last_m_s = 0.8;
    for step in 10..60 {
        cycle.step(at(step));
        let speed_m_s = base.0.lock().velocity.forward_m_s;
        assert!(last_m_s - speed_m_s <= LIMITS.brake_m_s2 * CYCLE_SECS + ROUNDING);
        last_m_s = speed_m_s;
    }
    cycle.step(at(60));
    assert!(port.state().expect("a report").is_at_rest);
    port.send(&BaseOutput::Drive(target(2, 2, [0.1, 0.0, 0.0], at(1000))));
    port.send(&BaseOutput::Brake);
    for step in 61..70 {
        cycle.step(at(step));
    }
    assert_eq!(last_m_s, 0.0);
    let state = port.state().expect("a report");
    assert!(state.is_at_rest && state.braked_motion == 2, "{state:?}");
}
