//! Tests of the drivers against emulated servos on a pseudo terminal. They wait for conditions,
//! with a time limit that only a failure reaches.

use super::emulated::{Disturbance, EmulatedServo, EmulatedServoBus, ServoKind};
use super::{
    DynamixelProtocol, FeetechProtocol, MovableServoArm, MovableServoArmConfig, PortConfig, Scan,
    ServoArm, ServoArmConfig, ServoConfig, ServoProtocol, servos_on,
};
use crate::can::FollowingLimits;
use crate::motion::steering_check::{TriedMotion, check_steering};
use crate::motion::{
    JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss, Output, Target,
};
use crate::{Arm, Error, clock};
use kinematics::JointState;
use std::f64::consts::TAU;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Time after which a condition counts as never met.
const LIMIT: Duration = Duration::from_secs(60);
const WAIT: Duration = Duration::from_millis(100);
/// Longer than usual, so that a busy computer does not count as a missing servo.
const ANSWER_DELAY: Duration = Duration::from_millis(500);
const RAD_PER_COUNT: f64 = TAU / 4096.0;
/// Servos of the tests: ID, start position, zero, and whether it is reversed.
const SERVOS: [(u8, i32, i32, bool); 3] = [
    (1, 2148, 2048, false),
    (2, 1948, 2048, true),
    (7, 2548, 2500, false),
];
/// Both protocols.
const KINDS: [ServoKind; 2] = [ServoKind::Feetech, ServoKind::Dynamixel];

/// An emulated arm.
struct Bench {
    kind: ServoKind,
    folder: TempDir,
    bus: Option<EmulatedServoBus>,
}

impl Bench {
    fn new(kind: ServoKind) -> Self {
        let mut bench = Self {
            kind,
            folder: tempfile::tempdir().expect("a folder"),
            bus: None,
        };
        let servo =
            |(id, position, ..): (u8, i32, i32, bool)| EmulatedServo::new(kind, id, position);
        bench.plug_in(SERVOS.map(servo).to_vec());
        bench
    }

    fn device(&self) -> PathBuf {
        self.folder.path().join("arm")
    }

    fn plug_in(&mut self, servos: Vec<EmulatedServo>) {
        let bus = EmulatedServoBus::start(self.kind, servos, &self.device(), |_, _| {});
        self.bus = Some(bus.expect("a pseudo terminal"));
    }

    fn unplug(&mut self) -> Vec<EmulatedServo> {
        self.bus.take().expect("it is plugged in").unplug()
    }

    fn bus(&self) -> &EmulatedServoBus {
        self.bus.as_ref().expect("it is plugged in")
    }

    fn config(&self) -> ServoArmConfig {
        let servo = |(id, _, zero_counts, is_reversed): (u8, i32, i32, bool)| ServoConfig {
            joint: format!("joint{id}"),
            id,
            zero_counts,
            is_reversed,
            gear_ratio: 1.0,
            following: FollowingLimits::default(),
        };
        let protocol: &'static dyn ServoProtocol = match self.kind {
            ServoKind::Feetech => &FeetechProtocol,
            ServoKind::Dynamixel => &DynamixelProtocol,
        };
        ServoArmConfig {
            protocol,
            port: PortConfig {
                device: self.device(),
                baud_hz: 1_000_000,
                reconnect_for: LIMIT,
                max_answer_delay: ANSWER_DELAY,
            },
            servos: SERVOS.map(servo).to_vec(),
            rate_hz: 200.0,
        }
    }

    /// Moves without haste, so that a busy computer does not count as stalled.
    fn movable(&self, on_loss: OnLoss) -> MovableServoArmConfig {
        let limits = MotionLimits {
            position: [-1.0, 1.0],
            velocity: 0.5,
            acceleration: 2.0,
            jerk: 20.0,
        };
        MovableServoArmConfig {
            arm: self.config(),
            motion: MotionConfig {
                limits: vec![limits; SERVOS.len()],
                on_loss,
                timeout: Duration::from_secs(2),
                accept_no_watchdog: true,
            },
        }
    }
}

/// The next state of an arm. Waits while the arm is silent or reconnecting.
fn next_state(arm: &mut dyn Arm) -> JointState {
    let began = Instant::now();
    loop {
        match arm.read(WAIT) {
            Ok(state) => return state,
            Err(Error::NoJoints { .. } | Error::ArmReconnecting { .. }) => {
                assert!(began.elapsed() < LIMIT, "no state");
            }
            Err(error) => panic!("{error}"),
        }
    }
}

fn wait_until(what: &str, mut is_met: impl FnMut() -> bool) {
    let began = Instant::now();
    while !is_met() {
        assert!(began.elapsed() < LIMIT, "never happened: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Joint positions of the test servos at their start.
fn start_rad() -> Vec<f64> {
    SERVOS
        .iter()
        .map(|(_, position, zero, is_reversed)| {
            let direction = if *is_reversed { -1.0 } else { 1.0 };
            direction * f64::from(position - zero) * RAD_PER_COUNT
        })
        .collect()
}

fn assert_near(got: &[f64], expected: &[f64], tolerance_rad: f64) {
    assert_eq!(got.len(), expected.len());
    for (got_rad, expected_rad) in got.iter().zip(expected) {
        let error = (got_rad - expected_rad).abs();
        assert!(error <= tolerance_rad, "{got:?} instead of {expected:?}");
    }
}

#[test]
fn joints_are_read_in_order_with_direction_and_zero() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let mut arm = ServoArm::open(&bench.config()).expect("three servos");
        assert_eq!(arm.joint_names(), ["joint1", "joint2", "joint7"]);
        let before = clock::now();
        // The first states may have been read before this time.
        let state = loop {
            let state = next_state(&mut arm);
            if state.stamp > before {
                break state;
            }
        };
        assert!(state.stamp < clock::now());
        assert_near(&state.position, &start_rad(), 1e-9);
        assert_eq!(state.velocity, [0.0; 3]);
        // A hand moves the arm: the reversed joint has the opposite velocity.
        for servo in &mut bench.bus().line().servos {
            servo.set_motion(2048.0, 1000.0);
        }
        let moved = loop {
            let state = next_state(&mut arm);
            if state.position[0] == 0.0 {
                break state;
            }
        };
        let speed = 1000.0 * RAD_PER_COUNT;
        // One unit of velocity of a Dynamixel servo is 0.024 rad/s.
        assert_near(&moved.velocity, &[speed, -speed, speed], 0.025);
        let n_goals: u64 = bench
            .bus()
            .line()
            .servos
            .iter()
            .map(EmulatedServo::n_goals)
            .sum();
        assert_eq!(n_goals, 0, "reading commands nothing");
    }
}

#[test]
fn fast_sync_reads_are_used_if_all_servos_support_them() {
    for is_supported in [true, false] {
        let bench = Bench::new(ServoKind::Dynamixel);
        bench.bus().line().has_fast_reads = is_supported;
        let mut arm = ServoArm::open(&bench.config()).expect("three servos");
        for _ in 0..20 {
            assert_near(&next_state(&mut arm).position, &start_rad(), 1e-9);
        }
        assert_eq!(bench.bus().line().n_fast_reads() > 10, is_supported);
    }
}

#[test]
fn disturbed_answers_never_become_wrong_positions() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let mut config = bench.config();
        // Many answers are missing here.
        config.port.max_answer_delay = PortConfig::MAX_ANSWER_DELAY;
        let began = Instant::now();
        let mut arm = loop {
            // On a busy computer, a servo may miss this short delay.
            match ServoArm::open(&config) {
                Ok(arm) => break arm,
                Err(error) => assert!(began.elapsed() < LIMIT, "{error}"),
            }
        };
        bench.bus().line().disturbance = Disturbance {
            noise_every: 3,
            damaged_every: 7,
            missing_every: 11,
        };
        let mut stamps = Vec::new();
        for _ in 0..100 {
            let state = next_state(&mut arm);
            assert_near(&state.position, &start_rad(), 1e-9);
            stamps.push(state.stamp);
        }
        assert!(stamps.is_sorted());
    }
}

#[test]
fn unplugged_arm_is_read_again_after_it_is_plugged_in() {
    for kind in KINDS {
        let mut bench = Bench::new(kind);
        let mut arm = ServoArm::open(&bench.config()).expect("three servos");
        let before = next_state(&mut arm);
        let servos = bench.unplug();
        wait_until("reconnecting", || {
            matches!(arm.read(WAIT), Err(Error::ArmReconnecting { .. }))
        });
        bench.plug_in(servos);
        // States from before the outage may still be queued, but none follows the first error.
        let after = next_state(&mut arm);
        assert!(after.stamp > before.stamp);
        assert_near(&after.position, &before.position, 1e-9);
    }
}

#[test]
fn arm_that_stays_away_is_an_error_that_names_the_remedy() {
    let mut bench = Bench::new(ServoKind::Feetech);
    let mut config = bench.config();
    config.port.reconnect_for = Duration::from_millis(100);
    let mut arm = ServoArm::open(&config).expect("three servos");
    bench.unplug();
    let mut last = String::new();
    wait_until("the driver gives up", || match arm.read(WAIT) {
        Err(Error::ArmReconnecting { .. } | Error::NoJoints { .. }) | Ok(_) => false,
        Err(error) => {
            last = error.to_string();
            true
        }
    });
    assert!(last.contains("serial port"), "{last}");
}

#[test]
fn silent_servo_is_named_and_read_again_when_it_has_power() {
    let bench = Bench::new(ServoKind::Feetech);
    let mut arm = ServoArm::open(&bench.config()).expect("three servos");
    next_state(&mut arm);
    bench.bus().line().servos[1].set_powered(false);
    wait_until("reconnecting", || {
        matches!(arm.read(WAIT), Err(Error::ArmReconnecting { .. }))
    });
    bench.bus().line().servos[1].set_powered(true);
    assert_near(&next_state(&mut arm).position, &start_rad(), 1e-9);
    drop(arm);
    bench.bus().line().servos[1].set_powered(false);
    let error = ServoArm::open(&bench.config()).expect_err("one is missing");
    let message = error.to_string();
    assert!(
        message.contains("\"joint2\"") && message.contains("no servo with ID 2 answers"),
        "{message}"
    );
}

#[test]
fn port_is_used_by_one_program_at_a_time() {
    let bench = Bench::new(ServoKind::Feetech);
    let _arm = ServoArm::open(&bench.config()).expect("three servos");
    let message = ServoArm::open(&bench.config())
        .expect_err("the port is in use")
        .to_string();
    assert!(message.contains("another program uses it"), "{message}");
    let mut config = bench.config();
    config.port.device = bench.folder.path().join("absent");
    let message = ServoArm::open(&config).expect_err("no port").to_string();
    assert!(message.contains("fieldrig devices"), "{message}");
    config.port.device = PathBuf::from("/dev/null");
    let message = ServoArm::open(&config).expect_err("no port").to_string();
    assert!(message.contains("not a serial port"), "{message}");
}

#[test]
fn other_servos_are_refused() {
    let bench = Bench::new(ServoKind::Feetech);
    // An SCS servo stores the high byte first.
    bench.bus().line().servos[0].set(2, &[1]);
    let message = ServoArm::open(&bench.config())
        .expect_err("SCS")
        .to_string();
    assert!(message.contains("only STS and SMS"), "{message}");
    let bench = Bench::new(ServoKind::Dynamixel);
    // An XL-320 has another control table.
    bench.bus().line().servos[0].set(0, &350_u16.to_le_bytes());
    let message = ServoArm::open(&bench.config())
        .expect_err("XL-320")
        .to_string();
    assert!(message.contains("model number 350"), "{message}");
}

#[test]
fn servos_are_found_by_ping() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let found = servos_on(&bench.device(), ANSWER_DELAY)
            .expect("a port")
            .expect("servos");
        let (driver, model) = match kind {
            ServoKind::Feetech => ("feetech", "STS3215, firmware 3.10"),
            ServoKind::Dynamixel => ("dynamixel", "XL430-W250, firmware 46"),
        };
        assert_eq!((found.driver, found.baud_hz), (driver, 1_000_000));
        let servos: Vec<_> = found
            .servos
            .iter()
            .map(|servo| (servo.id, servo.model.as_str()))
            .collect();
        assert_eq!(servos, [(1, model), (2, model), (7, model)]);
    }
}

#[test]
fn arbitrary_bytes_are_consumed_without_a_panic() {
    // A linear congruential generator, so that the bytes are always the same. Half of the bytes are
    // those of headers, which makes packets likely.
    let mut state = 1_u32;
    let mut next_byte = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let [_, _, choice, byte] = state.to_le_bytes();
        match choice % 8 {
            0..=2 => 0xFF,
            3 => 0xFD,
            4 => byte % 12,
            _ => byte,
        }
    };
    let bytes: Vec<u8> = (0..20_000).map(|_| next_byte()).collect();
    for protocol in [&FeetechProtocol as &dyn ServoProtocol, &DynamixelProtocol] {
        for len in [0, 4] {
            let mut rest = &bytes[..];
            loop {
                let n_bytes = match protocol.format().decode(rest, len) {
                    Scan::Packet { n_bytes, .. }
                    | Scan::Corrupt { n_bytes }
                    | Scan::Garbage { n_bytes } => n_bytes,
                    Scan::Incomplete if rest.is_empty() => break,
                    Scan::Incomplete => 1,
                };
                assert!((1..=rest.len()).contains(&n_bytes));
                rest = &rest[n_bytes..];
            }
        }
    }
}

#[test]
fn arm_moves_to_its_target_and_is_released_at_the_end() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Release)).expect("enabled");
        assert!(
            bench
                .bus()
                .line()
                .servos
                .iter()
                .all(EmulatedServo::is_enabled)
        );
        assert_eq!(arm.motion(), Motion::Holding);
        assert_near(&next_state(&mut arm).position, &start_rad(), 1e-9);
        let position = vec![0.3, -0.2, 0.1];
        let target = JointTarget {
            position: position.clone(),
        };
        assert_eq!(arm.command(&target).expect("in range"), target);
        wait_until("arrival", || {
            assert!(
                !matches!(arm.motion(), Motion::Stopped { .. }),
                "{:?}",
                arm.motion()
            );
            let state = next_state(&mut arm);
            let is_near = |(got, goal): (&f64, &f64)| (got - goal).abs() <= RAD_PER_COUNT;
            state.position.iter().zip(&position).all(is_near)
        });
        let beyond = JointTarget {
            position: vec![9.0, 0.0, 0.0],
        };
        assert_eq!(arm.command(&beyond).expect("clamped").position[0], 1.0);
        drop(arm);
        let line = bench.bus().line();
        assert!(
            !line.servos.iter().any(EmulatedServo::is_enabled),
            "{kind:?}"
        );
    }
}

#[test]
fn held_arm_stays_enabled_and_usable_by_others() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let arm = MovableServoArm::open(&bench.movable(OnLoss::Hold)).expect("enabled");
        drop(arm);
        let servos = &bench.bus().line().servos;
        assert!(servos.iter().all(EmulatedServo::is_enabled), "{kind:?}");
        assert!(!servos.iter().any(EmulatedServo::has_watchdog_expired));
    }
}

#[test]
fn blocked_joint_stops_the_arm_and_is_not_pushed() {
    let bench = Bench::new(ServoKind::Feetech);
    let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Hold)).expect("enabled");
    bench.bus().line().servos[0].set_stops([0.0, 2200.0]);
    let target = JointTarget {
        position: vec![1.0, 0.0, 0.0],
    };
    arm.command(&target).expect("in range");
    wait_until("a stop", || matches!(arm.motion(), Motion::Stopped { .. }));
    let Motion::Stopped { reason } = arm.motion() else {
        unreachable!("it stopped");
    };
    assert!(
        reason.contains("\"joint1\"") && reason.contains("max_following_error_rad"),
        "{reason}"
    );
    let message = arm.command(&target).expect_err("it stopped").to_string();
    assert!(message.contains("has not been recovered"), "{message}");
    // Its goal is where it is, so the obstacle can be removed without a jump.
    bench.bus().line().servos[0].set_stops([0.0, 4095.0]);
    next_state(&mut arm);
    std::thread::sleep(Duration::from_millis(50));
    let position = bench.bus().line().servos[0].position_counts();
    assert!((position - 2200.0).abs() <= 1.0, "{position}");
    arm.recover().expect("the obstacle is gone");
    assert_eq!(arm.motion(), Motion::Holding);
}

#[test]
fn overload_and_loss_of_torque_stop_the_arm() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Release)).expect("enabled");
        bench.bus().line().servos[2].set_faults(1 << 5);
        wait_until("a stop", || matches!(arm.motion(), Motion::Stopped { .. }));
        let stopped = format!("{:?}", arm.motion());
        assert!(
            stopped.contains("joint7") && stopped.contains("overload"),
            "{stopped}"
        );
        wait_until("release", || {
            !bench
                .bus()
                .line()
                .servos
                .iter()
                .any(EmulatedServo::is_enabled)
        });
        let message = arm.recover().expect_err("still overloaded").to_string();
        assert!(message.contains("overload"), "{message}");
        bench.bus().line().servos[2].set_faults(0);
        arm.recover().expect("the fault is gone");
        // The power fails for a moment.
        bench.bus().line().servos[1].set_powered(false);
        bench.bus().line().servos[1].set_powered(true);
        wait_until("a stop", || matches!(arm.motion(), Motion::Stopped { .. }));
        let stopped = format!("{:?}", arm.motion());
        assert!(
            stopped.contains("joint2") && stopped.contains("disabled"),
            "{stopped}"
        );
    }
}

#[test]
fn unplugged_arm_stops_and_is_recovered_only_on_request() {
    for kind in KINDS {
        let mut bench = Bench::new(kind);
        let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Hold)).expect("enabled");
        let servos = bench.unplug();
        wait_until("a stop", || matches!(arm.motion(), Motion::Stopped { .. }));
        bench.plug_in(servos);
        let target = JointTarget {
            position: vec![0.0; 3],
        };
        arm.command(&target).expect_err("it is not recovered");
        arm.recover().expect("it is plugged in again");
        arm.command(&target).expect("it was recovered");
    }
}

#[test]
fn watchdog_holds_the_arm_when_commands_end() {
    let mut bench = Bench::new(ServoKind::Dynamixel);
    let mut config = bench.movable(OnLoss::Hold);
    config.motion.accept_no_watchdog = false;
    let mut arm = MovableServoArm::open(&config).expect("enabled");
    let target = JointTarget {
        position: vec![1.0, -1.0, 1.0],
    };
    arm.command(&target).expect("in range");
    let began = next_state(&mut arm).position[0];
    wait_until("motion", || next_state(&mut arm).position[0] > began + 0.02);
    // The cable is cut: the servos get no more instructions.
    let mut servos = bench.unplug();
    let cut = clock::now();
    let expired_at = cut.plus_secs(2.1);
    servos
        .iter_mut()
        .for_each(|servo| servo.advance(expired_at));
    assert!(servos.iter().all(EmulatedServo::has_watchdog_expired));
    let held: Vec<_> = servos.iter().map(EmulatedServo::position_counts).collect();
    servos
        .iter_mut()
        .for_each(|servo| servo.advance(expired_at.plus_secs(1.0)));
    for (servo, held) in servos.iter().zip(held) {
        assert!(servo.is_enabled());
        assert!((servo.position_counts() - held).abs() <= 1.0);
    }
    // Expired watchdogs are cleared by a recovery.
    bench.plug_in(servos);
    wait_until("a stop", || matches!(arm.motion(), Motion::Stopped { .. }));
    arm.recover().expect("it is plugged in again");
    assert!(
        !bench
            .bus()
            .line()
            .servos
            .iter()
            .any(EmulatedServo::has_watchdog_expired)
    );
}

#[test]
fn unsuitable_configurations_are_refused_before_anything_is_sent() {
    let bench = Bench::new(ServoKind::Feetech);
    let check = |config: &MovableServoArmConfig| {
        MovableServoArm::check(config).map_err(|error| error.to_string())
    };
    let mut config = bench.movable(OnLoss::Hold);
    assert_eq!(check(&config), Ok(()));
    config.motion.accept_no_watchdog = false;
    let message = check(&config).expect_err("no watchdog");
    assert!(message.contains("accept_no_watchdog = true"), "{message}");
    config.motion.on_loss = OnLoss::Damp;
    let message = check(&config).expect_err("it cannot damp");
    assert!(message.contains("\"hold\" or \"release\""), "{message}");
    config.motion.limits.pop();
    let message = check(&config).expect_err("a limit is missing");
    assert!(message.contains("2 joints"), "{message}");
    let dynamixel = Bench::new(ServoKind::Dynamixel);
    let mut config = dynamixel.movable(OnLoss::Hold);
    config.motion.accept_no_watchdog = false;
    assert_eq!(check(&config), Ok(()), "its watchdog holds");
    config.motion.on_loss = OnLoss::Release;
    let message = check(&config).expect_err("its watchdog cannot release");
    assert!(message.contains("can only hold"), "{message}");
    config.motion.on_loss = OnLoss::Hold;
    config.motion.timeout = Duration::from_millis(5);
    let message = MovableServoArm::open(&config)
        .expect_err("four cycles take 20 ms")
        .to_string();
    assert!(message.contains("timeout_millis"), "{message}");
    // Operating mode 1 is velocity.
    dynamixel.bus().line().servos[1].set(11, &[1]);
    let message = MovableServoArm::open(&dynamixel.movable(OnLoss::Hold))
        .expect_err("it would spin")
        .to_string();
    assert!(message.contains("operating mode is 1"), "{message}");
    let line = dynamixel.bus().line();
    assert!(!line.servos.iter().any(EmulatedServo::is_enabled));
}

#[test]
fn steered_arm_brakes_when_its_targets_expire() {
    for kind in KINDS {
        let bench = Bench::new(kind);
        let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Release)).expect("enabled");
        let tried = TriedMotion {
            joint_ix: 0,
            distance: 0.8,
            until: 0.05,
            busy: None,
        };
        check_steering(&mut arm, tried);
        let port = arm.steering_port(1.0).expect("the same port");
        let commanded = port.state().expect("a report").position;
        wait_until("arrival of the servos", || {
            let state = next_state(&mut arm);
            let is_near = |(got, goal): (&f64, &f64)| (got - goal).abs() <= RAD_PER_COUNT;
            state.position.iter().zip(&commanded).all(is_near)
        });
        drop(arm);
        let state = port.state().expect("a report");
        assert!(state.stopped.is_some(), "the port outlives the arm");
        port.recover().expect_err("there is no arm");
        assert!(
            !bench
                .bus()
                .line()
                .servos
                .iter()
                .any(EmulatedServo::is_enabled)
        );
    }
}

#[test]
fn steered_arm_that_stopped_moves_only_after_a_recovery_with_a_new_motion() {
    let bench = Bench::new(ServoKind::Dynamixel);
    let mut arm = MovableServoArm::open(&bench.movable(OnLoss::Hold)).expect("enabled");
    let port = arm.steering_port(2.0).expect("enabled");
    let send = |motion, serial| {
        port.send(&Output::Follow(Target {
            motion,
            serial,
            position: vec![0.9, 0.0, 0.0],
            expires_at: clock::now() + LIMIT,
        }));
    };
    let state = || port.state().expect("a report");
    let position = || state().position[0];
    let stopped = || state().stopped;
    wait_until("a report", || port.state().is_some());
    let start = position();
    let mut serial = 0;
    let mut motion = 0;
    // On a busy computer, the arm may brake before the next target.
    wait_until("motion", || {
        serial += 1;
        motion = state().braked_motion + 1;
        send(motion, serial);
        position() > start + 0.05
    });
    bench.bus().line().servos[2].set_faults(1 << 5);
    wait_until("a stop", || stopped().is_some());
    let reason = stopped().expect("it stopped");
    assert!(reason.contains("overload"), "{reason}");
    port.recover().expect_err("still overloaded");
    bench.bus().line().servos[2].set_faults(0);
    send(motion, serial + 1);
    port.recover().expect("the fault is gone");
    wait_until("a report", || stopped().is_none());
    // Neither the old target nor a new one of the same motion is followed.
    let rest = position();
    for n in 2..20 {
        send(motion, serial + n);
        next_state(&mut arm);
        assert!((position() - rest).abs() < 1e-9 && stopped().is_none());
    }
    wait_until("motion", || {
        serial += 1;
        send(state().braked_motion + 1, serial);
        position() > rest + 0.05
    });
}
