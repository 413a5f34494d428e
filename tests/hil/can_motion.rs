//! Tests inside the virtual kernel that move arms on CAN buses, interrupt the connection, and
//! recover. The motors are emulated, including their shafts and watchdogs. The tests kill or
//! suspend a process, take a link down, or disconnect the emulated cable.

use crate::can::{DAMIAO_LIMITS, Wire, all_families, damiao, ip, motor};
use drivers::can::cia402::{Cia402, Units};
use drivers::can::emulated::{EmulatedMotor, State};
use drivers::can::odrive::{self, Odrive};
use drivers::can::robstride::{self, Robstride};
use drivers::can::{Bus, BusConfig, BusEvent, Gains, MotorConfig, MovableArmConfig, MovableCanArm};
use drivers::motion::steering_check::{TriedMotion, check_steering};
use drivers::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use drivers::wire::can::{Frame, Id, canopen};
use drivers::{Arm, clock};
use kinematics::Stamp;
use numbers::random::Random;
use parking_lot::{Mutex, MutexGuard};
use socketcan::{CanErrorFrame, CanSocket, Socket};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Environment variable with a bus name. If it is set, this program moves the arm on that bus until
/// the process is killed.
const CHILD: &str = "FIELDRIG_HIL_CHILD";
const RATE_HZ: f64 = 200.0;
const TIMEOUT: Duration = Duration::from_millis(250);
/// Period of the emulated motors, which is also the delay of their answers.
const MOTOR_PERIOD: Duration = Duration::from_millis(1);
/// Motors that report automatically do so every 10 ms.
const REPORT_PERIOD: Duration = Duration::from_millis(10);
const LIMITS: MotionLimits = MotionLimits {
    position: [-2.0, 2.0],
    velocity: 1.0,
    acceleration: 2.0,
    jerk: 20.0,
};
const GAINS: Gains = Gains {
    stiffness_nm_rad: 30.0,
    damping_nm_s_rad: 1.5,
};
const UNITS: Units = Units {
    counts_per_turn: 65_536.0,
    rated_torque_nm: 10.0,
};

/// Observed state of a motor, in joint angles.
#[derive(Clone, Debug)]
pub(crate) struct MotorObservation {
    pub(crate) state: State,
    pub(crate) position_rad: f64,
    pub(crate) velocity_rad_s: f64,
    timed_out_at: Option<Stamp>,
    /// Commanded positions, in order.
    commanded_rad: Vec<f64>,
    /// Stiffness and damping of the last command in MIT mode, at the motor.
    pub(crate) gains: [f64; 2],
}

/// Motors on a separate thread, on a cable that can be disconnected.
pub(crate) struct Motors {
    observed: Arc<Mutex<Vec<MotorObservation>>>,
    is_disconnected: Arc<AtomicBool>,
    fails_next: Arc<AtomicBool>,
    /// Whether an obstacle holds all shafts where they are.
    pub(crate) is_blocked: Arc<AtomicBool>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Motors {
    pub(crate) fn new(bus: BusConfig, configs: Vec<MotorConfig>, ignore_timeout: bool) -> Self {
        let flag = || Arc::new(AtomicBool::new(false));
        let (is_disconnected, fails_next, is_blocked, stop) = (flag(), flag(), flag(), flag());
        let observed = Arc::<Mutex<Vec<MotorObservation>>>::default();
        let (disconnected, fail_flag, stop_flag, observed_by_thread) = (
            Arc::clone(&is_disconnected),
            Arc::clone(&fails_next),
            Arc::clone(&stop),
            Arc::clone(&observed),
        );
        let blocked_flag = Arc::clone(&is_blocked);
        let bus = Bus::open(&bus).expect("the bus is up");
        let thread = std::thread::spawn(move || {
            let mut emulated: Vec<_> = configs
                .iter()
                .map(|config| EmulatedMotor::new(&*config.protocol, DAMIAO_LIMITS))
                .collect();
            let mut commanded_rad = vec![Vec::new(); emulated.len()];
            if ignore_timeout {
                emulated.iter_mut().for_each(EmulatedMotor::ignore_timeout);
            }
            let mut was_blocked = false;
            while !stop_flag.load(Ordering::Relaxed) {
                // Errors are ignored: a link that goes down reports one.
                let arrived = bus.receive(MOTOR_PERIOD).unwrap_or(None);
                let now = clock::now();
                let mut sent = Vec::new();
                let is_blocked = blocked_flag.load(Ordering::Relaxed);
                if is_blocked != was_blocked {
                    for motor in &mut emulated {
                        let stops = [f64::NEG_INFINITY, f64::INFINITY];
                        motor.set_stops(if is_blocked {
                            [motor.motion().position_rad; 2]
                        } else {
                            stops
                        });
                    }
                    was_blocked = is_blocked;
                }
                if fail_flag.swap(false, Ordering::Relaxed) {
                    emulated[0].fail();
                }
                for ((motor, config), commanded_rad) in
                    emulated.iter_mut().zip(&configs).zip(&mut commanded_rad)
                {
                    sent.extend(motor.report(now).expect("the motion is within range"));
                    if let Some((_, BusEvent::Frame(frame))) = &arrived
                        && !disconnected.load(Ordering::Relaxed)
                    {
                        let before = motor.target();
                        sent.extend(motor.take(frame).expect("the motion is within range"));
                        // Motors with their own control loop also reset the watchdog on frames that
                        // are not commands.
                        let has_own_loop = !config.protocol.family().has_gains();
                        let is_watchdog_reset =
                            motor.watchdog_reset_at() == Some(now) && !has_own_loop;
                        let is_new = motor.target() != before || is_watchdog_reset;
                        if let (Some(target), true) = (motor.target(), is_new) {
                            commanded_rad.push(joint_rad(config, target.position_rad));
                        }
                    }
                }
                for frame in sent
                    .iter()
                    .filter(|_| !disconnected.load(Ordering::Relaxed))
                {
                    let _ = bus.send(frame); // Errors are ignored, as above.
                }
                let state = emulated.iter().zip(&configs).zip(&commanded_rad);
                *observed_by_thread.lock() = state
                    .map(|((motor, config), commanded_rad)| MotorObservation {
                        state: motor.state(),
                        position_rad: joint_rad(config, motor.motion().position_rad),
                        velocity_rad_s: motor.motion().velocity_rad_s,
                        timed_out_at: motor.timed_out_at(),
                        commanded_rad: commanded_rad.clone(),
                        gains: motor
                            .target()
                            .map_or([0.0; 2], |target| [target.kp_nm_rad, target.kd_nm_s_rad]),
                    })
                    .collect();
            }
        });
        let motors = Self {
            observed,
            is_disconnected,
            fails_next,
            is_blocked,
            stop,
            thread: Some(thread),
        };
        motors.wait_until("the motors run", |observed| !observed.is_empty());
        motors
    }

    pub(crate) fn observed(&self) -> MutexGuard<'_, Vec<MotorObservation>> {
        self.observed.lock()
    }

    pub(crate) fn wait_until(&self, what: &str, condition: impl Fn(&[MotorObservation]) -> bool) {
        let start_time = clock::now();
        while !condition(&self.observed()) {
            let waited = clock::now().duration_since(start_time);
            assert!(
                waited < Duration::from_secs(10),
                "timed out after 10 s: {what}; {:?}",
                self.states()
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    pub(crate) fn states(&self) -> Vec<State> {
        self.observed()
            .iter()
            .map(|observed| observed.state)
            .collect()
    }

    pub(crate) fn positions(&self) -> Vec<f64> {
        self.observed()
            .iter()
            .map(|observed| observed.position_rad)
            .collect()
    }

    /// Waits until the watchdogs have stopped all motors, checks that each did so within its
    /// timeout, and returns the times in milliseconds.
    fn wait_until_timed_out(&self, since: Stamp, state: State) -> Vec<f64> {
        self.wait_until("the watchdogs have stopped all motors", |observed| {
            observed.iter().all(|observed| {
                observed.state == state && observed.timed_out_at.is_some_and(|lost| lost >= since)
            })
        });
        let after = |observed: &MotorObservation| {
            observed
                .timed_out_at
                .expect("the wait has succeeded")
                .duration_since(since)
        };
        let after: Vec<Duration> = self.observed().iter().map(after).collect();
        assert!(
            after
                .iter()
                .all(|after| *after <= TIMEOUT + 2 * MOTOR_PERIOD),
            "{after:?}"
        );
        after
            .iter()
            .map(|after| 1e3 * after.as_secs_f64())
            .collect()
    }
}

impl Drop for Motors {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let has_panicked = thread.join().is_err();
            assert!(
                !has_panicked || std::thread::panicking(),
                "motors do not panic"
            );
        }
    }
}

fn joint_rad(config: &MotorConfig, motor_rad: f64) -> f64 {
    let per_turn = if config.is_reversed { -1.0 } else { 1.0 } / config.gear_ratio;
    motor_rad * per_turn + config.offset_rad
}

pub(crate) fn movable(bus: BusConfig, motors: &[MotorConfig], on_loss: OnLoss) -> MovableArmConfig {
    let with_gains = |motor: &MotorConfig| {
        let has_gains = motor.protocol.family().has_gains();
        MotorConfig {
            gains: has_gains.then_some(GAINS),
            ..motor.clone()
        }
    };
    MovableArmConfig {
        arm: drivers::can::ArmConfig {
            buses: vec![bus],
            motors: motors.iter().map(with_gains).collect(),
            rate_hz: RATE_HZ,
        },
        motion: MotionConfig {
            limits: vec![LIMITS; motors.len()],
            on_loss,
            timeout: TIMEOUT,
            accept_no_watchdog: motors.iter().any(is_ak),
        },
    }
}

/// Whether this is an AK motor, which has no watchdog.
pub(crate) fn is_ak(motor: &MotorConfig) -> bool {
    motor.protocol.family().name() == "tmotor"
}

fn drive(number: u8) -> MotorConfig {
    let node = canopen::Node::new(number).expect("a node");
    motor(&format!("drive{number}"), Cia402 { node, units: UNITS })
}

/// One motor of each family that has a watchdog.
pub(crate) fn motors_with_watchdog() -> Vec<MotorConfig> {
    vec![
        damiao(1),
        motor(
            "robstride",
            Robstride {
                motor: 3,
                model: robstride::Model::Rs02,
            },
        ),
        motor(
            "odrive",
            Odrive {
                node: odrive::Node::new(4).expect("a node"),
                endpoints: Some(odrive::emulated::endpoints()),
            },
        ),
        drive(5),
    ]
}

/// Waits until the arm holds, and then until its shafts are at rest.
fn wait_until_holding(arm: &mut MovableCanArm) {
    let start_time = clock::now();
    while arm.motion() != Motion::Holding {
        assert!(
            !matches!(arm.motion(), Motion::Stopped { .. }),
            "{:?}",
            arm.motion()
        );
        assert!(
            clock::now().duration_since(start_time) < Duration::from_secs(20),
            "the arm does not arrive"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(1500));
    while arm.read(Duration::ZERO).is_ok() {}
}

/// Waits until the arm has stopped and returns the reason.
pub(crate) fn wait_until_stopped(arm: &MovableCanArm) -> String {
    let start_time = clock::now();
    loop {
        if let Motion::Stopped { reason } = arm.motion() {
            return reason;
        }
        assert!(
            clock::now().duration_since(start_time) < Duration::from_secs(5),
            "the arm does not stop"
        );
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn motors_of_all_families_reach_targets() {
    let wire = Wire::new("vcan6", false);
    let configs = all_families();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let config = movable(wire.config(false), &configs, OnLoss::Release);
    let mut arm = MovableCanArm::open(&config).expect("all motors are enabled");
    assert_eq!(motors.states(), [State::Enabled; 6]);
    assert_eq!(arm.motion(), Motion::Holding);
    // All motors start at 0. Because of offsets, this is a joint position other than 0 for some of
    // them. Enabling the motors must not cause motion.
    let initial: Vec<f64> = configs.iter().map(|config| config.offset_rad).collect();
    // The resolution causes an error of half a count in the command and half a count in the
    // feedback. Drives and ODrives are more precise. In MIT mode, no count represents zero
    // velocity. The resulting velocity of half a count displaces the motor by this velocity times
    // damping over stiffness.
    let push_offset = |limit_rad_s: f64, counts: f64| {
        limit_rad_s / counts * GAINS.damping_nm_s_rad / GAINS.stiffness_nm_rad
    };
    let counts = [
        25.0 / 65_535.0 + push_offset(30.0, 4095.0),
        25.0 / 65_535.0 + push_offset(30.0, 4095.0),
        25.2 / 65_535.0 + push_offset(44.0, 65_535.0),
        1e-5,
        1e-4,
        25.0 / 65_535.0 + push_offset(50.0, 4095.0),
    ];
    let errors = |got: &[f64], expected: &[f64]| -> Vec<f64> {
        got.iter()
            .zip(expected)
            .map(|(got, expected)| (got - expected).abs())
            .collect()
    };
    let is_within_resolution = |errors: &[f64]| {
        errors
            .iter()
            .zip(counts)
            .all(|(errors, count)| *errors <= count)
    };
    let still = errors(&motors.positions(), &initial);
    assert!(is_within_resolution(&still), "{still:?}");
    for target in [vec![0.7, -0.5, 0.3, 1.1, -0.9, 0.4], initial.clone()] {
        let target = JointTarget { position: target };
        assert_eq!(arm.command(&target).expect("within the limits"), target);
        wait_until_holding(&mut arm);
        // The tolerance is half a count of velocity, extrapolated until the other motors have
        // reported.
        const EXTRAPOLATED_RAD: f64 = 1e-4;
        let mut reported = [f64::INFINITY; 6];
        for _ in 0..50 {
            let state = arm
                .read(Duration::from_secs(1))
                .unwrap_or_else(|e| panic!("{e}; {:?}", arm.motion()));
            for (min, errors) in reported
                .iter_mut()
                .zip(errors(&state.position, &target.position))
            {
                *min = min.min(errors - EXTRAPOLATED_RAD);
            }
        }
        let true_errors = errors(&motors.positions(), &target.position);
        println!(
            "can: moved to {:?}, errors {true_errors:.6?} rad",
            target.position
        );
        assert!(
            is_within_resolution(&reported) && is_within_resolution(&true_errors),
            "{reported:?} {true_errors:?}"
        );
    }
    // Targets outside the range are clamped. Targets with a wrong length are rejected.
    let clamped = arm
        .command(&JointTarget {
            position: vec![9.0; 6],
        })
        .expect("six numbers");
    assert!(
        clamped.position.iter().all(|position| *position <= 2.0),
        "{clamped:?}"
    );
    assert!(
        arm.command(&JointTarget {
            position: vec![0.0; 5]
        })
        .is_err()
    );
    arm.stop().expect("the arm is moving");
    wait_until_holding(&mut arm);
    let rest = motors.positions();
    assert!(
        rest.iter().all(|position| position.abs() < 1.0),
        "expected a stop before the target: {rest:?}"
    );
    drop(arm);
    motors.wait_until("the motors are released", |observed| {
        observed
            .iter()
            .all(|observed| observed.state == State::Free)
    });
}

#[test]
#[ignore = "needs the virtual kernel"]
fn fail_safe_command_is_resent_to_motors_without_watchdog() {
    let wire = Wire::new("vcan13", false);
    let configs: Vec<_> = all_families().into_iter().filter(is_ak).collect();
    // The cable is disconnected while the program shuts down, or while the arm is open. No frames
    // arrive until it is reconnected.
    for is_dropped in [true, false] {
        let motors = Motors::new(wire.config(false), configs.clone(), false);
        let arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release))
            .expect("the motor answers");
        assert_eq!(motors.states(), [State::Enabled]);
        motors.is_disconnected.store(true, Ordering::Relaxed);
        std::thread::scope(|threads| {
            let held_arm = if is_dropped {
                threads.spawn(|| drop(arm));
                None
            } else {
                wait_until_stopped(&arm);
                Some(arm)
            };
            std::thread::sleep(TIMEOUT / 2);
            assert_eq!(
                motors.states(),
                [State::Enabled],
                "the motor executes its last command until it receives another"
            );
            motors.is_disconnected.store(false, Ordering::Relaxed);
            motors.wait_until("the motors are released", |observed| {
                observed
                    .iter()
                    .all(|observed| observed.state == State::Free)
            });
            drop(held_arm);
        });
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn commands_respect_limits_and_joints_arrive_together() {
    let wire = Wire::new("vcan7", false);
    let second = Wire::new("vcan8", false);
    let on_second = MotorConfig {
        bus_ix: 1,
        ..damiao(2)
    };
    let one = Motors::new(wire.config(false), vec![damiao(1)], false);
    let two = Motors::new(second.config(false), vec![on_second.clone()], false);
    let mut config = movable(wire.config(false), &[damiao(1), on_second], OnLoss::Release);
    config.arm.buses.push(second.config(false));
    let mut arm = MovableCanArm::open(&config).expect("both motors are enabled");
    arm.command(&JointTarget {
        position: vec![1.5, 0.2],
    })
    .expect("within the limits");
    std::thread::sleep(Duration::from_millis(700));
    arm.command(&JointTarget {
        position: vec![-0.5, 0.4],
    })
    .expect("another target during the motion");
    wait_until_holding(&mut arm);
    let commanded = [&one, &two].map(|motors| motors.observed()[0].commanded_rad.clone());
    let last_change = commanded.each_ref().map(|path| {
        let last = *path.last().expect("the joint moved");
        path.iter()
            .rposition(|rad| (rad - last).abs() > 2e-3)
            .expect("the joint moved")
    });
    // The second joint alone would arrive hundreds of cycles earlier. The tolerance is needed
    // because the last counts of a short path take many cycles.
    assert!(
        last_change[0].abs_diff(last_change[1]) < 40,
        "{last_change:?}"
    );
    const WINDOW: usize = 40;
    const COUNT_RAD: f64 = 25.0 / 65_535.0;
    let secs = WINDOW as f64 / RATE_HZ;
    let mut max = [0.0_f64; 2];
    for path in &commanded {
        let speeds: Vec<f64> = path
            .windows(WINDOW + 1)
            .map(|path| (path[WINDOW] - path[0]) / secs)
            .collect();
        for (ix, speed) in speeds.iter().enumerate() {
            max[0] = max[0].max(speed.abs());
            if let Some(later) = speeds.get(ix + WINDOW) {
                max[1] = max[1].max((later - speed).abs() / secs);
            }
        }
    }
    println!(
        "can: commands on two buses: maximum {:.3} rad/s (limit 1) and {:.3} rad/s2 (limit 2)",
        max[0], max[1]
    );
    assert!(max[0] <= LIMITS.velocity + COUNT_RAD / secs, "{max:?}");
    assert!(
        max[1] <= LIMITS.acceleration + 2.0 * COUNT_RAD / secs.powi(2),
        "{max:?}"
    );
    assert!(max[0] > 0.9, "expected a fast motion: {max:?}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn steered_arm_brakes_when_its_targets_expire() {
    let wire = Wire::new("vcan15", false);
    let configs = motors_with_watchdog();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let config = movable(wire.config(false), &configs, OnLoss::Release);
    let mut arm = MovableCanArm::open(&config).expect("all motors are enabled");
    let tried = TriedMotion {
        joint_ix: 0,
        distance: 1.5,
        until: 0.1,
        busy: Some("stalled"),
    };
    check_steering(&mut arm, tried);
    wait_until_holding(&mut arm);
    let port = arm.steering_port(1.0).expect("the same port");
    let commanded = port.state().expect("a report").position[0];
    let position = motors.positions()[0];
    assert!(
        (position - commanded).abs() < 0.01,
        "{position} {commanded}"
    );
    drop(arm);
    assert!(motors.states().iter().all(|state| *state != State::Enabled));
    port.recover().expect_err("there is no arm");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn unsafe_configurations_are_not_enabled() {
    let wire = Wire::new("vcan9", false);
    let configs = all_families();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let assert_rejected = |config: &MovableArmConfig, expected: &str| {
        let reported = MovableCanArm::open(config)
            .map(drop)
            .expect_err("the configuration is unsafe")
            .to_string();
        println!("can: rejected: {reported}");
        assert!(reported.contains(expected), "{reported}");
    };
    let good = movable(wire.config(false), &configs, OnLoss::Release);
    let with = |change: &dyn Fn(&mut MovableArmConfig)| {
        let mut config = good.clone();
        change(&mut config);
        config
    };
    assert_rejected(
        &with(&|config| config.motion.on_loss = OnLoss::Hold),
        "can only \"release\"",
    );
    assert_rejected(
        &with(&|config| config.motion.on_loss = OnLoss::Damp),
        "can only \"release\"",
    );
    assert_rejected(
        &with(&|config| config.motion.accept_no_watchdog = false),
        "accept_no_watchdog = true",
    );
    assert_rejected(
        &with(&|config| config.arm.motors[0].gains = None),
        "set its stiffness_nm_rad",
    );
    assert_rejected(
        &with(&|config| config.motion.timeout = Duration::from_millis(10)),
        "at least 4 cycles",
    );
    let too_stiff = Gains {
        stiffness_nm_rad: 900.0,
        ..GAINS
    };
    assert_rejected(
        &with(&|config| config.arm.motors[0].gains = Some(too_stiff)),
        "supports at most 500",
    );
    let older_endpoints = odrive::Endpoints {
        firmware: "0.6.8".to_owned(),
        ..odrive::emulated::endpoints()
    };
    let set_older_endpoints = |config: &mut MovableArmConfig| {
        for motor in &mut config.arm.motors {
            odrive::set_endpoints(&mut motor.protocol, Some(&older_endpoints));
        }
    };
    assert_rejected(&with(&set_older_endpoints), "for firmware 0.6.8");
    let narrow = MotionLimits {
        position: [1.0, 2.0],
        ..LIMITS
    };
    assert_rejected(
        &with(&|config| config.motion.limits[0] = narrow),
        "outside its range",
    );
    assert_rejected(
        &movable(wire.config(false), &[damiao(7)], OnLoss::Release),
        "no answer",
    );
    assert!(
        motors
            .observed()
            .iter()
            .all(|observed| observed.state == State::Free && observed.commanded_rad.is_empty())
    );
    drop(motors);

    for config in motors_with_watchdog() {
        let without_timeout = Motors::new(wire.config(false), vec![config.clone()], true);
        assert_rejected(
            &movable(wire.config(false), &[config], OnLoss::Release),
            "reads back as",
        );
        assert!(
            without_timeout
                .observed()
                .iter()
                .all(|observed| observed.state == State::Free && observed.commanded_rad.is_empty())
        );
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn faults_stop_the_arm_until_recovery() {
    let wire = Wire::new("vcan10", false);
    for (configs, on_loss, state) in [
        (motors_with_watchdog(), OnLoss::Release, State::Free),
        (vec![drive(5), drive(6)], OnLoss::Hold, State::Holding),
    ] {
        let n = configs.len();
        let motors = Motors::new(wire.config(false), configs.clone(), false);
        let mut arm = MovableCanArm::open(&movable(wire.config(false), &configs, on_loss))
            .expect("the motors are enabled");
        for fault in [
            "the cable is disconnected",
            "the link is down",
            "the bus is off",
            "a motor fails",
        ] {
            let direction = if motors.positions()[0] > 0.0 {
                -1.0
            } else {
                1.0
            };
            arm.command(&JointTarget {
                position: vec![direction; n],
            })
            .expect("the arm is enabled");
            std::thread::sleep(Duration::from_millis(600));
            let start_time = clock::now();
            match fault {
                "the cable is disconnected" => {
                    motors.is_disconnected.store(true, Ordering::Relaxed)
                }
                "the link is down" => ip("link set vcan10 down"),
                "the bus is off" => inject_bus_off("vcan10"),
                _ => motors.fails_next.store(true, Ordering::Relaxed),
            }
            // The time is measured from here, because taking the link down takes some time.
            let faulted_at = clock::now();
            let reason = wait_until_stopped(&arm);
            let reported_after = clock::now().duration_since(start_time);
            assert!(
                reported_after < TIMEOUT + REPORT_PERIOD,
                "{fault}: {reported_after:?}"
            );
            // Without a connection, the watchdogs stop the motors. With a connection, the motors
            // received a command to stop.
            let is_isolated = ["the cable is disconnected", "the link is down"].contains(&fault);
            let after_millis = if is_isolated {
                motors.wait_until_timed_out(faulted_at, state)
            } else {
                Vec::new()
            };
            motors.wait_until("no motor is enabled", |observed| {
                observed
                    .iter()
                    .all(|observed| observed.state != State::Enabled)
            });
            println!(
                "can: {fault}, on_loss = {:?}: reported after {:.0} ms ({reason}); watchdogs stopped the motors after {after_millis:.0?} ms",
                on_loss.name(),
                1e3 * reported_after.as_secs_f64()
            );
            motors.is_disconnected.store(false, Ordering::Relaxed);
            ip("link set vcan10 up");
            // After reconnection, no motor is enabled, and a held motor does not move.
            std::thread::sleep(Duration::from_millis(600));
            let before = motors.observed().clone();
            assert!(
                before
                    .iter()
                    .all(|observed| observed.state != State::Enabled),
                "{fault}: {:?}",
                motors.states()
            );
            if on_loss == OnLoss::Hold && fault != "a motor fails" {
                assert!(
                    before.iter().all(|observed| observed.velocity_rad_s == 0.0
                        && observed.state == State::Holding),
                    "{fault}"
                );
            }
            let rejection = arm
                .command(&JointTarget {
                    position: vec![0.0; n],
                })
                .expect_err("the arm is not recovered");
            assert!(
                rejection.to_string().contains("not been recovered"),
                "{rejection}"
            );
            let n_commands: usize = before
                .iter()
                .map(|observed| observed.commanded_rad.len())
                .sum();
            assert_eq!(
                motors
                    .observed()
                    .iter()
                    .map(|observed| observed.commanded_rad.len())
                    .sum::<usize>(),
                n_commands
            );
            // Released motors coast. If they leave the range of the joints, recovery reports an
            // error.
            let coasted: Vec<f64> = motors.positions();
            match arm.recover() {
                Ok(()) => {
                    assert!(
                        motors.states().iter().all(|state| *state == State::Enabled),
                        "{fault}"
                    );
                    let moved: Vec<f64> = motors
                        .positions()
                        .iter()
                        .zip(&coasted)
                        .map(|(now, coasted)| (now - coasted).abs())
                        .collect();
                    assert!(
                        moved.iter().all(|moved| *moved < 0.1),
                        "{fault}: enabling moved the motors: {moved:?}"
                    );
                }
                Err(error) => panic!("{fault}: {error}; the motors are at {coasted:?}"),
            }
        }
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn malformed_frames_at_worst_stop_the_arm() {
    let wire = Wire::new("vcan12", false);
    let configs = motors_with_watchdog();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let mut arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release))
        .expect("the motors are enabled");
    arm.command(&JointTarget {
        position: vec![1.0; configs.len()],
    })
    .expect("within the limits");
    let noise = Bus::open(&wire.config(false)).expect("the bus is up");
    // Ids of all frames that the motors send: replies, feedback, PDOs, SDO replies, heartbeats.
    let ids = [
        Id::standard(0x11),
        Id::extended(0x0280_03FD),
        Id::extended(0x1100_03FD),
        Id::standard(0x081),
    ]
    .into_iter()
    .chain([0x089, 0x085, 0x185, 0x285, 0x585, 0x705].map(Id::standard))
    .map(|id| id.expect("in range"));
    let ids: Vec<Id> = ids.collect();
    let mut random = Random::new(7);
    for _ in 0..3000 {
        let n_bytes = random.below(9);
        let bytes = random.bytes(n_bytes);
        let frame =
            Frame::classic(ids[random.below(ids.len())], &bytes).expect("at most eight bytes");
        noise.send(&frame).expect("the bus is up");
        std::thread::sleep(Duration::from_micros(300));
    }
    let reason = wait_until_stopped(&arm);
    println!("can: 3000 random frames: {reason}");
    motors.wait_until("no motor is enabled", |observed| {
        observed
            .iter()
            .all(|observed| observed.state != State::Enabled)
    });
    for observed in motors.observed().iter() {
        let steps = observed
            .commanded_rad
            .windows(2)
            .map(|path| (path[1] - path[0]).abs());
        let max = steps.fold(0.0, f64::max);
        assert!(
            max <= LIMITS.velocity / RATE_HZ + 25.2 / 65_535.0,
            "a step of {max} rad"
        );
    }
    std::thread::sleep(Duration::from_millis(500));
    arm.recover().expect("the motors answer as before");
    assert!(motors.states().iter().all(|state| *state == State::Enabled));
}

/// Sends the error frame of a controller that goes bus-off.
fn inject_bus_off(interface: &str) {
    const CAN_ERR_BUSOFF: u32 = 0x40;
    let socket = CanSocket::open(interface).expect("the bus is up");
    socket
        .write_frame(&CanErrorFrame::new_error(CAN_ERR_BUSOFF, &[0; 8]).expect("eight bytes"))
        .expect("the bus is up");
}

/// Moves an arm until the process is killed. Another test starts this program with the bus in an
/// environment variable. After a stop, it recovers when it reads a line from stdin.
#[test]
#[ignore = "started by another test"]
fn child_program_moves_arm() {
    let Ok(arguments) = std::env::var(CHILD) else {
        return;
    };
    let is_hold = arguments.ends_with("hold");
    let (configs, on_loss) = if is_hold {
        (vec![drive(5), drive(6)], OnLoss::Hold)
    } else {
        (motors_with_watchdog(), OnLoss::Release)
    };
    let bus = arguments.split(' ').next().expect("a name").to_owned();
    let wire = BusConfig {
        interface: bus,
        bitrate_hz: 1_000_000,
        data_bitrate_hz: None,
        accept_no_restart: false,
    };
    let mut arm =
        MovableCanArm::open(&movable(wire, &configs, on_loss)).expect("the motors are enabled");
    let mut lines = std::io::stdin().lines();
    let mut direction = 1.0;
    loop {
        match arm.motion() {
            Motion::Holding => {
                let target = JointTarget {
                    position: vec![direction; configs.len()],
                };
                // The arm may have stopped in the meantime.
                if arm.command(&target).is_ok() {
                    direction = -direction;
                }
            }
            Motion::Moving => {}
            Motion::Stopped { reason } => {
                println!("child: stopped: {reason}");
                assert!(
                    arm.command(&JointTarget {
                        position: vec![0.0; configs.len()]
                    })
                    .is_err()
                );
                let _ = lines.next();
                arm.recover().expect("the motors answer again");
                println!("child: recovered");
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn start_child(arguments: &str) -> Child {
    Command::new("/bin/hil")
        .args([
            "--ignored",
            "--exact",
            "can_motion::child_program_moves_arm",
            "--nocapture",
        ])
        .env(CHILD, arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("the test program is installed")
}

pub(crate) fn signal(child: &Child, signal: &str) {
    let status = Command::new("/bin/busybox")
        .args(["kill", signal, &child.id().to_string()])
        .status();
    assert!(status.expect("busybox has kill").success());
}

#[test]
#[ignore = "needs the virtual kernel"]
fn killed_or_suspended_program_triggers_watchdogs() {
    let wire = Wire::new("vcan11", false);
    for (configs, name, state) in [
        (motors_with_watchdog(), "release", State::Free),
        (vec![drive(5), drive(6)], "hold", State::Holding),
    ] {
        let motors = Motors::new(wire.config(false), configs, false);
        let mut child = start_child(&format!("vcan11 {name}"));
        let is_moving = |observed: &[MotorObservation]| {
            observed.iter().all(|observed| {
                observed.state == State::Enabled && observed.velocity_rad_s.abs() > 0.3
            })
        };
        motors.wait_until("the child moves the arm", is_moving);

        signal(&child, "-STOP");
        let start_time = clock::now();
        let after = motors.wait_until_timed_out(start_time, state);
        println!(
            "can: SIGSTOP, on_loss = {name:?}: watchdogs stopped the motors after {after:.0?} ms"
        );
        std::thread::sleep(Duration::from_millis(500));
        let before = motors.observed().clone();
        signal(&child, "-CONT");
        let mut reported = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut next = |expected: &str| loop {
            let line = reported.next().expect("the child runs").expect("text");
            if line.contains(expected) {
                return line;
            }
        };
        let line = next("child: stopped");
        println!("can: SIGCONT: {line}");
        assert!(line.contains("stalled for"), "{line}");
        std::thread::sleep(Duration::from_millis(500));
        for (before, after) in before.iter().zip(motors.observed().iter()) {
            assert_eq!(
                after.state,
                if name == "hold" {
                    State::Holding
                } else {
                    State::Free
                },
                "{after:?}"
            );
            assert_eq!(
                after.commanded_rad.len(),
                before.commanded_rad.len(),
                "an old setpoint was executed"
            );
            assert!(
                name == "release" || after.position_rad == before.position_rad,
                "the held motor moved"
            );
        }
        // The arm recovers only on request, and starts from the current positions.
        child
            .stdin
            .as_mut()
            .expect("piped")
            .write_all(b"recover\n")
            .expect("the child reads its stdin");
        next("child: recovered");
        motors.wait_until("the child moves the arm again", is_moving);

        signal(&child, "-KILL");
        let start_time = clock::now();
        let after = motors.wait_until_timed_out(start_time, state);
        println!(
            "can: kill -9, on_loss = {name:?}: watchdogs stopped the motors after {after:.0?} ms"
        );
        child.wait().expect("our own child");
    }
}
