//! Tests of arms that are steered, with a simulated clock.

use super::{
    ArmState, JointTarget, Motion, MotionLimits, Mover, Output, Setpoint, Steered, SteeringPort,
    Target,
};
use kinematics::Stamp;
use std::time::Duration;

const PERIOD: Duration = Duration::from_millis(1);
const VALIDITY: Duration = Duration::from_millis(100);
const BRAKE_FACTOR: f64 = 2.0;
/// Rounding of differences of setpoints, relative to a limit.
const ROUNDING: f64 = 1e-4;
const START: [f64; 2] = [0.0, -2.0];

fn limits() -> Vec<MotionLimits> {
    let joint = |position| MotionLimits {
        position,
        velocity: 0.5,
        acceleration: 2.0,
        jerk: 20.0,
    };
    // The range of the second joint does not contain 0.
    vec![joint([-1.0, 1.0]), joint([-3.0, -0.1])]
}

fn port() -> SteeringPort {
    SteeringPort::new(&limits(), BRAKE_FACTOR, || Ok(())).unwrap()
}

/// An arm and the program that steers it.
struct Sim {
    port: SteeringPort,
    steered: Steered,
    now: Stamp,
    serial: u64,
    last: Setpoint,
}

impl Sim {
    fn new() -> Self {
        let port = port();
        Self {
            steered: Steered::new(port.clone(), &START, PERIOD).unwrap(),
            port,
            now: Stamp(1_000_000_000),
            serial: 0,
            last: Setpoint::at_rest(START.to_vec()),
        }
    }

    fn target(&mut self, motion: u64, position: [f64; 2]) -> Target {
        self.serial += 1;
        Target {
            motion,
            serial: self.serial,
            position: position.to_vec(),
            expires_at: self.now + VALIDITY,
        }
    }

    fn send(&mut self, motion: u64, position: [f64; 2]) {
        let target = self.target(motion, position);
        self.port.send(&Output::Follow(target));
    }

    /// One cycle of the arm. Checks the limits.
    fn step(&mut self) {
        self.now += PERIOD;
        let next = self.steered.step(self.now).unwrap();
        check_cycle(&self.last, &next, BRAKE_FACTOR);
        self.last = next;
    }

    /// Sends a target in each cycle.
    fn drive(&mut self, motion: u64, position: [f64; 2], n_cycles: usize) {
        for _ in 0..n_cycles {
            self.send(motion, position);
            self.step();
        }
    }

    /// Cycles without targets, until the arm rests.
    fn rest(&mut self) {
        for _ in 0..5000 {
            self.step();
            if self.steered.is_at_rest() {
                return;
            }
        }
        panic!("the arm does not come to rest: {:?}", self.last);
    }

    fn state(&self) -> ArmState {
        self.port.state().expect("a report")
    }
}

/// Invariant: a cycle respects the limits, and those of braking for acceleration and jerk.
fn check_cycle(before: &Setpoint, after: &Setpoint, factor: f64) {
    let secs = PERIOD.as_secs_f64() * (1.0 + ROUNDING);
    for (ix, joint) in limits().iter().enumerate() {
        let moved = (after.position[ix] - before.position[ix]).abs();
        let accelerated = (after.velocity[ix] - before.velocity[ix]).abs();
        let jerked = (after.acceleration[ix] - before.acceleration[ix]).abs();
        assert!(
            moved <= joint.velocity * secs
                && accelerated <= factor * joint.acceleration * secs
                && jerked <= factor * joint.jerk * secs,
            "joint {ix}: {before:?} {after:?}"
        );
    }
}

#[test]
fn arm_follows_a_stream_and_brakes_when_it_ends() {
    let mut sim = Sim::new();
    assert_eq!(sim.port.state(), None);
    sim.step();
    assert!(sim.state().is_at_rest);
    sim.drive(1, [0.8, -1.0], 500);
    let state = sim.state();
    assert!(!state.is_at_rest && state.position[0] > 0.05, "{state:?}");
    assert_eq!(state.position, sim.last.position);
    assert_eq!(state.reported_at, sim.now);
    // The program that steers is blocked. The arm follows its last target until it expires.
    let mut n_cycles = 0;
    while sim.state().braked_motion < 1 {
        sim.step();
        n_cycles += 1;
        assert!(n_cycles <= 101, "braking begins at the expiry");
    }
    assert!(n_cycles >= 99, "{n_cycles}");
    sim.rest();
    assert!(sim.last.position[0] < 0.7, "{:?}", sim.last);
}

#[test]
fn target_with_a_distant_expiry_is_followed_for_a_second() {
    let mut sim = Sim::new();
    let target = Target {
        expires_at: Stamp(i64::MAX),
        ..sim.target(1, [0.9, -1.0])
    };
    sim.port.send(&Output::Follow(target));
    for _ in 0..1000 {
        sim.step();
    }
    assert!(sim.steered.is_following());
    for _ in 0..2 {
        sim.step();
    }
    assert_eq!(sim.state().braked_motion, 1);
}

#[test]
fn arm_arrives_at_a_target_that_is_repeated() {
    let mut sim = Sim::new();
    sim.drive(1, [0.1, -1.9], 2000);
    assert!((sim.last.position[0] - 0.1).abs() < 1e-9, "{:?}", sim.last);
    assert!(sim.steered.is_at_rest() && sim.steered.is_following());
    for _ in 0..200 {
        sim.step();
    }
    assert!(!sim.steered.is_following(), "the last target has expired");
}

#[test]
fn motion_that_braked_is_continued_only_with_a_new_number() {
    let mut sim = Sim::new();
    sim.drive(1, [0.8, -1.0], 300);
    sim.port.send(&Output::Brake);
    sim.rest();
    let rest = sim.last.clone();
    sim.drive(1, [0.8, -1.0], 300);
    assert_eq!(sim.last, rest);
    assert_eq!(sim.state().braked_motion, 1);
    sim.drive(2, [0.8, -1.0], 300);
    assert!(sim.last.position[0] > rest.position[0] + 0.01);
}

#[test]
fn target_after_a_brake_in_the_same_cycle_does_not_undo_the_brake() {
    let mut sim = Sim::new();
    sim.drive(1, [0.8, -1.0], 300);
    sim.port.send(&Output::Brake);
    sim.send(1, [0.8, -1.0]);
    sim.step();
    assert_eq!(sim.state().braked_motion, 1);
    sim.rest();
    // The arm has not seen a target of the motion that ends here.
    sim.send(2, [0.8, -1.0]);
    sim.port.send(&Output::Brake);
    sim.drive(2, [0.8, -1.0], 50);
    assert!(sim.steered.is_at_rest());
    assert_eq!(sim.state().braked_motion, 2);
    sim.port.send(&Output::Brake);
    sim.send(3, [0.8, -1.0]);
    sim.step();
    assert!(sim.steered.is_following(), "a new grip after a brake");
}

#[test]
fn invalid_late_repeated_and_overtaken_targets_change_nothing() {
    let mut sim = Sim::new();
    let mut undisturbed = Sim::new();
    for cycle in 0..600 {
        let goal = [0.002 * f64::from(cycle), -2.0 + 0.001 * f64::from(cycle)];
        let goal = [goal[0].min(0.8), goal[1].min(-1.5)];
        let target = sim.target(2, goal);
        undisturbed.send(2, goal);
        let with = |change: &dyn Fn(&mut Target)| {
            let mut changed = target.clone();
            changed.position = vec![-0.9, -2.9];
            change(&mut changed);
            Output::Follow(changed)
        };
        let mut disturbances = vec![
            with(&|target| target.position[0] = f64::NAN),
            with(&|target| target.position[1] = f64::INFINITY),
            with(&|target| target.position.truncate(1)),
        ];
        if cycle > 0 {
            disturbances.push(with(&|target| target.serial -= 1));
            disturbances.push(with(&|target| target.motion = 1));
        }
        for disturbance in &disturbances {
            sim.port.send(disturbance);
        }
        sim.port.send(&Output::Follow(target.clone()));
        for disturbance in &disturbances {
            sim.port.send(disturbance);
        }
        // A repetition with other contents.
        sim.port.send(&with(&|_| {}));
        sim.step();
        undisturbed.step();
        assert_eq!(sim.last, undisturbed.last, "cycle {cycle}");
    }
    // Targets that are too late.
    for _ in 0..200 {
        let late = Target {
            expires_at: Stamp(sim.now.0 - 1),
            ..sim.target(2, [-0.9, -2.9])
        };
        sim.port.send(&Output::Follow(late));
        sim.step();
        undisturbed.step();
        assert_eq!(sim.last, undisturbed.last);
    }
}

#[test]
fn new_motion_may_count_its_targets_from_the_start() {
    let mut sim = Sim::new();
    sim.drive(1, [0.3, -1.8], 300);
    sim.port.send(&Output::Brake);
    sim.rest();
    let rest = sim.last.position[0];
    // The program that steers was restarted.
    sim.serial = 0;
    sim.drive(2, [0.8, -1.8], 300);
    assert!(sim.last.position[0] > rest + 0.01);
}

#[test]
fn nothing_from_before_a_stop_is_followed_after_the_recovery() {
    let mut sim = Sim::new();
    sim.drive(1, [0.8, -1.0], 300);
    let waiting = sim.target(2, [0.8, -1.0]);
    sim.port.send(&Output::Follow(waiting.clone()));
    sim.steered.report_stopped(sim.now, "a motor is silent");
    let state = sim.state();
    assert_eq!(state.stopped.as_deref(), Some("a motor is silent"));
    assert_eq!(state.position, sim.last.position);
    // The joints have sagged.
    let sagged = [sim.last.position[0], -2.5];
    sim.steered.rest_at(&limits(), &sagged).unwrap();
    sim.last = Setpoint::at_rest(sagged.to_vec());
    sim.port.send(&Output::Follow(waiting));
    for _ in 0..50 {
        sim.step();
    }
    assert_eq!(sim.last.position, sagged);
    let state = sim.state();
    assert!(state.is_at_rest && state.stopped.is_none() && state.braked_motion == 2);
    sim.drive(3, [0.8, -1.0], 300);
    assert!(sim.last.position[1] > -2.49);
}

#[test]
fn weak_or_undefined_brakes_and_invalid_limits_are_refused() {
    for factor in [0.99, -1.0, f64::NAN, f64::INFINITY] {
        let error = SteeringPort::new(&limits(), factor, || Ok(())).unwrap_err();
        assert!(error.to_string().contains("at least 1"), "{error}");
    }
    let mut invalid = limits();
    invalid[1].jerk = 0.0;
    let error = SteeringPort::new(&invalid, BRAKE_FACTOR, || Ok(())).unwrap_err();
    assert!(error.to_string().contains("joint 2"), "{error}");
}

#[test]
fn port_recovers_the_arm_and_reports_why_not() {
    let recovered = port().recover();
    assert!(recovered.is_ok());
    let refused = SteeringPort::new(&limits(), BRAKE_FACTOR, || {
        Err(crate::Error::Motion {
            reason: "the user stop is pressed".to_owned(),
        })
    });
    let error = refused.unwrap().recover().unwrap_err().to_string();
    assert!(error.contains("user stop"), "{error}");
}

#[test]
fn arm_that_is_too_fast_returns_to_its_limits() {
    // A robot extrapolates over missed commands, and may become faster than its limits.
    for (velocity, acceleration) in [(0.55, 1.5), (0.52, -1.0), (0.5, 2.3)] {
        let mut sim = Sim::new();
        sim.drive(1, [0.9, -1.0], 400);
        let displaced = Setpoint {
            position: vec![0.1, -1.9],
            velocity: vec![velocity, 0.1],
            acceleration: vec![acceleration, 0.0],
        };
        sim.steered.resume(&displaced).unwrap();
        let secs = PERIOD.as_secs_f64() * (1.0 + ROUNDING);
        let mut last = displaced;
        for cycle in 0..3000 {
            // The stream ends while the joint may still be too fast.
            if cycle < 5 {
                sim.send(1, [0.9, -1.0]);
            }
            sim.now += PERIOD;
            let next = sim.steered.step(sim.now).unwrap();
            for (ix, joint) in limits().iter().enumerate() {
                let jerked = (next.acceleration[ix] - last.acceleration[ix]).abs();
                assert!(
                    jerked <= BRAKE_FACTOR * joint.jerk * secs,
                    "{last:?} {next:?}"
                );
            }
            last = next;
        }
        assert!(sim.steered.is_at_rest());
    }
}

fn mover_at_rest() -> Mover {
    let mut mover = Mover::default();
    mover.hold_at(limits(), START.to_vec(), PERIOD).unwrap();
    mover
}

#[test]
fn commanded_motion_is_braked_when_steering_begins() {
    let mut mover = mover_at_rest();
    let goal = JointTarget {
        position: vec![0.9, -1.0],
    };
    mover.set_target(&goal).unwrap();
    let mut now = Stamp(0);
    let mut last = mover.held();
    let mut step = |mover: &mut Mover, factor| {
        now += PERIOD;
        let next = mover.step(now).unwrap();
        check_cycle(&last, &next, factor);
        last = next.clone();
        next
    };
    for _ in 0..500 {
        step(&mut mover, 1.0);
    }
    assert_eq!(mover.motion(), Motion::Moving);
    mover.steer(port()).unwrap();
    let refusal = mover.set_target(&goal).unwrap_err().to_string();
    assert!(refusal.contains("steered"), "{refusal}");
    let mut n_cycles = 0;
    while mover.motion() == Motion::Moving {
        step(&mut mover, BRAKE_FACTOR);
        n_cycles += 1;
        assert!(n_cycles < 1000, "it brakes");
    }
    assert!(mover.held().position[0] < 0.8);
}

#[test]
fn arm_that_shuts_down_follows_no_further_targets() {
    let mut mover = mover_at_rest();
    let port = port();
    mover.steer(port.clone()).unwrap();
    let mut now = Stamp(0);
    let mut cycle = |mover: &mut Mover, motion| {
        port.send(&Output::Follow(Target {
            motion,
            serial: now.0.unsigned_abs(),
            position: vec![0.9, -1.0],
            expires_at: now + VALIDITY,
        }));
        mover.step(now).unwrap();
        now += PERIOD;
    };
    for _ in 0..300 {
        cycle(&mut mover, 1);
    }
    assert_eq!(mover.motion(), Motion::Moving);
    // The operator grips again and again.
    let mut motion = 2;
    while !mover.come_to_rest() {
        cycle(&mut mover, motion);
        motion += 1;
        assert!(motion < 1000, "it comes to rest");
    }
    cycle(&mut mover, motion);
    assert!(mover.is_at_rest());
}

#[test]
fn arm_that_was_not_enabled_has_no_setpoints() {
    let mut mover = Mover::default();
    mover.step(Stamp(0)).unwrap_err();
    let target = JointTarget {
        position: START.to_vec(),
    };
    mover.set_target(&target).unwrap_err();
    assert!(mover.is_at_rest());
}

#[test]
fn panic_of_the_thread_is_reported_and_nothing_is_followed_any_more() {
    let mut sim = Sim::new();
    sim.drive(1, [0.8, -1.0], 300);
    let Sim {
        port,
        steered,
        last,
        now,
        ..
    } = sim;
    let waiting = Target {
        motion: 1,
        serial: 1_000_000,
        position: vec![0.8, -1.0],
        expires_at: now + VALIDITY,
    };
    port.send(&Output::Follow(waiting));
    let thread = std::thread::spawn(move || {
        let _moved_here = steered;
        panic!("as a bug in the thread of an arm would do");
    });
    thread.join().unwrap_err();
    let state = port.state().unwrap();
    let reason = state.stopped.unwrap();
    assert!(reason.contains("panicked"), "{reason}");
    assert_eq!(state.position, last.position);
    assert_eq!(state.braked_motion, 1);
    assert!(!port.has_target());
}
