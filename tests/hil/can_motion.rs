//! Inside the virtual kernel: arms on CAN buses are moved, lost and found again. The motors are played, with shafts and watchdogs of
//! their own; what is lost is real: a process that is killed or stopped, a link that is down, and a cable that carries nothing.

use crate::can::{DAMIAO_LIMITS, Wire, all_families, damiao, ip, motor};
use drivers::can::emulated::{self, EmulatedMotor, State};
use drivers::can::{Bus, BusConfig, BusEvent, Family, Gains, MotorConfig, MovableArmConfig, MovableCanArm};
use drivers::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use drivers::wire::can::cia402::Units;
use drivers::wire::can::{Frame, Id, canopen, odrive, robstride};
use drivers::{Arm, clock};
use kinematics::Stamp;
use socketcan::{CanErrorFrame, CanSocket, Socket};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// Set to the name of a bus, this program is the one that moves the arm there and is killed.
const CHILD: &str = "FIELDRIG_HIL_CHILD";
const RATE_HZ: f64 = 200.0;
/// A kernel without real time on a busy machine stands still for tens of milliseconds at a time.
const TIMEOUT: Duration = Duration::from_millis(250);
/// How much later than its timeout a played motor may be seen to have stopped, besides what its own thread waited for.
const STOP_TOLERANCE: Duration = Duration::from_millis(30);
/// How much later the arm may tell it on a busy machine.
const REPORT_TOLERANCE: Duration = Duration::from_millis(300);
const LIMITS: MotionLimits = MotionLimits { position: [-2.0, 2.0], velocity: 1.0, acceleration: 2.0, jerk: 20.0 };
const GAINS: Gains = Gains { stiffness_nm_rad: 30.0, damping_nm_s_rad: 1.5 };
const UNITS: Units = Units { counts_per_turn: 65_536.0, rated_torque_nm: 10.0 };

/// What was seen of a motor, in angles of its joint.
#[derive(Clone, Debug)]
pub(crate) struct MotorObservation {
    pub(crate) state: State,
    position_rad: f64,
    velocity_rad_s: f64,
    timed_out_at: Option<Stamp>,
    /// Where it was commanded to be, command after command.
    commanded_rad: Vec<f64>,
}

/// Motors on a thread of their own, on a cable that can be cut.
pub(crate) struct Motors {
    observed: Arc<Mutex<Vec<MotorObservation>>>,
    is_disconnected: Arc<AtomicBool>,
    fails_next: Arc<AtomicBool>,
    /// The longest that this thread itself stood still since it was asked for last, nanoseconds.
    max_stall: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Motors {
    pub(crate) fn new(bus: BusConfig, configs: Vec<MotorConfig>, ignore_timeout: bool) -> Self {
        let flag = || Arc::new(AtomicBool::new(false));
        let (is_disconnected, fails_next, stop, max_stall) = (flag(), flag(), flag(), Arc::<AtomicU64>::default());
        let observed = Arc::<Mutex<Vec<MotorObservation>>>::default();
        let (disconnected, fail_flag, stop_flag, observed_by_thread) =
            (Arc::clone(&is_disconnected), Arc::clone(&fails_next), Arc::clone(&stop), Arc::clone(&observed));
        let stall_nanos = Arc::clone(&max_stall);
        let bus = Bus::open(&bus).expect("it is up");
        let thread = std::thread::spawn(move || {
            let mut emulated: Vec<_> =
                configs.iter().map(|config| EmulatedMotor::new(config.family, DAMIAO_LIMITS)).collect();
            let mut commanded_rad = vec![Vec::new(); emulated.len()];
            if ignore_timeout {
                emulated.iter_mut().for_each(EmulatedMotor::ignore_timeout);
            }
            let mut before = clock::now();
            while !stop_flag.load(Ordering::Relaxed) {
                // A link that is down says so once.
                let arrived = bus.receive(Duration::from_millis(1)).unwrap_or(None);
                let now = clock::now();
                let gap = u64::try_from(now.nanos_since(before)).expect("the clock is monotonic");
                stall_nanos.fetch_max(gap, Ordering::Relaxed);
                before = now;
                let mut sent = Vec::new();
                if fail_flag.swap(false, Ordering::Relaxed) {
                    emulated[0].fail();
                }
                for ((motor, config), commanded_rad) in emulated.iter_mut().zip(&configs).zip(&mut commanded_rad) {
                    sent.extend(motor.report(now).expect("it fits"));
                    if let Some((_, BusEvent::Frame(frame))) = &arrived
                        && !disconnected.load(Ordering::Relaxed)
                    {
                        let before = motor.target();
                        sent.extend(motor.take(frame).expect("it fits"));
                        // Other frames quiet the watchdogs of axes and drives, too.
                        let has_own_loop = matches!(config.family, Family::Odrive { .. } | Family::Cia402 { .. });
                        let is_watchdog_reset = motor.watchdog_reset_at() == Some(now) && !has_own_loop;
                        let is_new = motor.target() != before || is_watchdog_reset;
                        if let (Some(target), true) = (motor.target(), is_new) {
                            commanded_rad.push(joint_rad(config, target.position_rad));
                        }
                    }
                }
                for frame in sent.iter().filter(|_| !disconnected.load(Ordering::Relaxed)) {
                    let _ = bus.send(frame); // As above.
                }
                let state = emulated.iter().zip(&configs).zip(&commanded_rad);
                *observed_by_thread.lock().unwrap_or_else(PoisonError::into_inner) = state
                    .map(|((motor, config), commanded_rad)| MotorObservation {
                        state: motor.state(),
                        position_rad: joint_rad(config, motor.motion().position_rad),
                        velocity_rad_s: motor.motion().velocity_rad_s,
                        timed_out_at: motor.timed_out_at(),
                        commanded_rad: commanded_rad.clone(),
                    })
                    .collect();
            }
        });
        let motors = Self { observed, is_disconnected, fails_next, max_stall, stop, thread: Some(thread) };
        motors.wait_until("they are there", |observed| !observed.is_empty());
        motors
    }

    fn observed(&self) -> MutexGuard<'_, Vec<MotorObservation>> {
        self.observed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn wait_until(&self, what: &str, condition: impl Fn(&[MotorObservation]) -> bool) {
        let start_time = clock::now();
        while !condition(&self.observed()) {
            let waited = clock::now().duration_since(start_time);
            assert!(waited < Duration::from_secs(10), "not within 10 s: {what}; {:?}", self.states());
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    pub(crate) fn states(&self) -> Vec<State> {
        self.observed().iter().map(|observed| observed.state).collect()
    }

    fn positions(&self) -> Vec<f64> {
        self.observed().iter().map(|observed| observed.position_rad).collect()
    }

    /// Waits until all have stopped by themselves, each within its timeout, and says after how long.
    fn wait_until_timed_out(&self, since: Stamp, state: State) -> Vec<f64> {
        self.wait_until("all have stopped by themselves", |observed| {
            observed
                .iter()
                .all(|observed| observed.state == state && observed.timed_out_at.is_some_and(|lost| lost >= since))
        });
        let after = |observed: &MotorObservation| observed.timed_out_at.expect("as waited for").duration_since(since);
        let after: Vec<Duration> = self.observed().iter().map(after).collect();
        let max_stall = Duration::from_nanos(self.max_stall.swap(0, Ordering::Relaxed));
        assert!(after.iter().all(|after| *after < TIMEOUT + STOP_TOLERANCE + max_stall), "{after:?} {max_stall:?}");
        after.iter().map(|after| 1e3 * after.as_secs_f64()).collect()
    }
}

impl Drop for Motors {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let has_panicked = thread.join().is_err();
            assert!(!has_panicked || std::thread::panicking(), "motors do not panic");
        }
    }
}

fn joint_rad(config: &MotorConfig, motor_rad: f64) -> f64 {
    let per_turn = if config.is_reversed { -1.0 } else { 1.0 } / config.gear_ratio;
    motor_rad * per_turn + config.offset_rad
}

pub(crate) fn movable(bus: BusConfig, motors: &[MotorConfig], on_loss: OnLoss) -> MovableArmConfig {
    let with_gains = |motor: &MotorConfig| {
        let has_gains = !matches!(motor.family, Family::Odrive { .. } | Family::Cia402 { .. });
        MotorConfig { gains: has_gains.then_some(GAINS), ..motor.clone() }
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
            accept_no_watchdog: motors.iter().any(|motor| matches!(motor.family, Family::TMotor { .. })),
        },
        odrive_endpoints: Some(emulated::endpoints()),
    }
}

fn drive(number: u8) -> MotorConfig {
    let node = canopen::Node::new(number).expect("a node");
    motor(&format!("drive{number}"), Family::Cia402 { node, units: UNITS })
}

/// One motor of each family that has a watchdog.
fn motors_with_watchdog() -> Vec<MotorConfig> {
    vec![
        damiao(1),
        motor("robstride", Family::Robstride { motor: 3, model: robstride::Model::Rs02 }),
        motor("odrive", Family::Odrive { node: odrive::Node::new(4).expect("a node") }),
        drive(5),
    ]
}

/// Waits until the arm is held, and a moment more until its shafts rest.
fn wait_until_holding(arm: &mut MovableCanArm) {
    let start_time = clock::now();
    while arm.motion() != Motion::Holding {
        assert!(!matches!(arm.motion(), Motion::Stopped { .. }), "{:?}", arm.motion());
        assert!(clock::now().duration_since(start_time) < Duration::from_secs(20), "it never arrives");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(1500));
    while arm.read(Duration::ZERO).is_ok() {}
}

/// Why it stopped, once it has.
pub(crate) fn wait_until_stopped(arm: &MovableCanArm) -> String {
    let start_time = clock::now();
    loop {
        if let Motion::Stopped { reason } = arm.motion() {
            return reason;
        }
        assert!(clock::now().duration_since(start_time) < Duration::from_secs(5), "it goes on");
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
    let mut arm = MovableCanArm::open(&config).expect("all are switched on");
    assert_eq!(motors.states(), [State::Enabled; 6]);
    assert_eq!(arm.motion(), Motion::Holding);
    // The motors were found at 0, and those joints are elsewhere: nothing has moved by being switched on.
    let initial: Vec<f64> = configs.iter().map(|config| config.offset_rad).collect();
    // Half a count in the command and half in the answer; drives and ODrives resolve finer. In MIT mode no count of velocity is 0: half
    // a one pushes a motor as far aside as damping is to stiffness.
    let push_offset =
        |limit_rad_s: f64, counts: f64| limit_rad_s / counts * GAINS.damping_nm_s_rad / GAINS.stiffness_nm_rad;
    let counts = [
        25.0 / 65_535.0 + push_offset(30.0, 4095.0),
        25.0 / 65_535.0 + push_offset(30.0, 4095.0),
        25.2 / 65_535.0 + push_offset(44.0, 65_535.0),
        1e-5,
        1e-4,
        25.0 / 65_535.0 + push_offset(50.0, 4095.0),
    ];
    let errors = |got: &[f64], expected: &[f64]| -> Vec<f64> {
        got.iter().zip(expected).map(|(got, expected)| (got - expected).abs()).collect()
    };
    let is_within_resolution = |errors: &[f64]| errors.iter().zip(counts).all(|(errors, count)| *errors <= count);
    let still = errors(&motors.positions(), &initial);
    assert!(is_within_resolution(&still), "{still:?}");
    for target in [vec![0.7, -0.5, 0.3, 1.1, -0.9, 0.4], initial.clone()] {
        let target = JointTarget { position: target };
        assert_eq!(arm.command(&target).expect("within the limits"), target);
        wait_until_holding(&mut arm);
        // Half a count of velocity carries a reading on for as long as the others' take.
        const EXTRAPOLATED_RAD: f64 = 1e-4;
        let mut reported = [f64::INFINITY; 6];
        for _ in 0..50 {
            let state = arm.read(Duration::from_secs(1)).unwrap_or_else(|e| panic!("{e}; {:?}", arm.motion()));
            for (min, errors) in reported.iter_mut().zip(errors(&state.position, &target.position)) {
                *min = min.min(errors - EXTRAPOLATED_RAD);
            }
        }
        let true_errors = errors(&motors.positions(), &target.position);
        println!("can: sent to {:?}, off by {true_errors:.6?} rad", target.position);
        assert!(is_within_resolution(&reported) && is_within_resolution(&true_errors), "{reported:?} {true_errors:?}");
    }
    // Targets outside the range are brought into it; others change nothing.
    let clamped = arm.command(&JointTarget { position: vec![9.0; 6] }).expect("six numbers");
    assert!(clamped.position.iter().all(|position| *position <= 2.0), "{clamped:?}");
    assert!(arm.command(&JointTarget { position: vec![0.0; 5] }).is_err());
    arm.stop().expect("it moves");
    wait_until_holding(&mut arm);
    let rest = motors.positions();
    assert!(rest.iter().all(|position| position.abs() < 1.0), "it stopped on its way: {rest:?}");
    drop(arm);
    motors.wait_until("they are released", |observed| observed.iter().all(|observed| observed.state == State::Free));
}

#[test]
#[ignore = "needs the virtual kernel"]
fn motors_without_watchdog_get_fail_safe_resent() {
    let wire = Wire::new("vcan13", false);
    let configs: Vec<_> =
        all_families().into_iter().filter(|config| matches!(config.family, Family::TMotor { .. })).collect();
    // The program ends in order, and while the arm looks on the cable fails: nothing of what is said then arrives.
    for is_dropped in [true, false] {
        let motors = Motors::new(wire.config(false), configs.clone(), false);
        let arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release)).expect("it is there");
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
            assert_eq!(motors.states(), [State::Enabled], "it obeys its last command as long as it hears nothing else");
            motors.is_disconnected.store(false, Ordering::Relaxed);
            motors.wait_until("they are released", |observed| {
                observed.iter().all(|observed| observed.state == State::Free)
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
    let on_second = MotorConfig { bus_ix: 1, ..damiao(2) };
    let one = Motors::new(wire.config(false), vec![damiao(1)], false);
    let two = Motors::new(second.config(false), vec![on_second.clone()], false);
    let mut config = movable(wire.config(false), &[damiao(1), on_second], OnLoss::Release);
    config.arm.buses.push(second.config(false));
    let mut arm = MovableCanArm::open(&config).expect("both are switched on");
    arm.command(&JointTarget { position: vec![1.5, 0.2] }).expect("within the limits");
    std::thread::sleep(Duration::from_millis(700));
    arm.command(&JointTarget { position: vec![-0.5, 0.4] }).expect("another on the way");
    wait_until_holding(&mut arm);
    let commanded = [&one, &two].map(|motors| motors.observed()[0].commanded_rad.clone());
    let last_change = commanded.each_ref().map(|path| {
        let last = *path.last().expect("it moved");
        path.iter().rposition(|rad| (rad - last).abs() > 2e-3).expect("it moved")
    });
    // Alone the second joint would be there hundreds of cycles earlier; the last counts of a short way are long ones.
    assert!(last_change[0].abs_diff(last_change[1]) < 40, "{last_change:?}");
    const WINDOW: usize = 40;
    const COUNT_RAD: f64 = 25.0 / 65_535.0;
    let secs = WINDOW as f64 / RATE_HZ;
    let mut max = [0.0_f64; 2];
    for path in &commanded {
        let speeds: Vec<f64> = path.windows(WINDOW + 1).map(|path| (path[WINDOW] - path[0]) / secs).collect();
        for (ix, speed) in speeds.iter().enumerate() {
            max[0] = max[0].max(speed.abs());
            if let Some(later) = speeds.get(ix + WINDOW) {
                max[1] = max[1].max((later - speed).abs() / secs);
            }
        }
    }
    println!("can: commands on two buses: at most {:.3} rad/s of 1 and {:.3} rad/s2 of 2", max[0], max[1]);
    assert!(max[0] <= LIMITS.velocity + COUNT_RAD / secs, "{max:?}");
    assert!(max[1] <= LIMITS.acceleration + 2.0 * COUNT_RAD / secs.powi(2), "{max:?}");
    assert!(max[0] > 0.9, "it was fast: {max:?}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn unsafe_configurations_are_not_enabled() {
    let wire = Wire::new("vcan9", false);
    let configs = all_families();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let assert_rejected = |config: &MovableArmConfig, expected: &str| {
        let reported = MovableCanArm::open(config).map(drop).expect_err("it cannot be moved so").to_string();
        println!("can: refused: {reported}");
        assert!(reported.contains(expected), "{reported}");
    };
    let good = movable(wire.config(false), &configs, OnLoss::Release);
    let with = |change: &dyn Fn(&mut MovableArmConfig)| {
        let mut config = good.clone();
        change(&mut config);
        config
    };
    assert_rejected(&with(&|config| config.motion.on_loss = OnLoss::Hold), "can only \"release\"");
    assert_rejected(&with(&|config| config.motion.on_loss = OnLoss::Damp), "can only \"release\"");
    assert_rejected(&with(&|config| config.motion.accept_no_watchdog = false), "accept_no_watchdog = true");
    assert_rejected(&with(&|config| config.arm.motors[0].gains = None), "set its stiffness_nm_rad");
    assert_rejected(&with(&|config| config.motion.timeout = Duration::from_millis(10)), "at least 4 cycles");
    let too_stiff = Gains { stiffness_nm_rad: 900.0, ..GAINS };
    assert_rejected(&with(&|config| config.arm.motors[0].gains = Some(too_stiff)), "supports at most 500");
    let older_endpoints = || Some(odrive::Endpoints { firmware: "0.6.8".to_owned(), ..emulated::endpoints() });
    assert_rejected(&with(&|config| config.odrive_endpoints = older_endpoints()), "for firmware 0.6.8");
    let narrow = MotionLimits { position: [1.0, 2.0], ..LIMITS };
    assert_rejected(&with(&|config| config.motion.limits[0] = narrow), "outside its range");
    assert_rejected(&movable(wire.config(false), &[damiao(7)], OnLoss::Release), "no answer");
    assert!(
        motors.observed().iter().all(|observed| observed.state == State::Free && observed.commanded_rad.is_empty())
    );
    drop(motors);

    for config in motors_with_watchdog() {
        let without_timeout = Motors::new(wire.config(false), vec![config.clone()], true);
        assert_rejected(&movable(wire.config(false), &[config], OnLoss::Release), "reads back as");
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
        let mut arm =
            MovableCanArm::open(&movable(wire.config(false), &configs, on_loss)).expect("they are switched on");
        for fault in ["the cable is cut", "the link is down", "the bus is lost", "a motor fails"] {
            let direction = if motors.positions()[0] > 0.0 { -1.0 } else { 1.0 };
            arm.command(&JointTarget { position: vec![direction; n] }).expect("it is switched on");
            std::thread::sleep(Duration::from_millis(600));
            motors.max_stall.store(0, Ordering::Relaxed);
            let start_time = clock::now();
            match fault {
                "the cable is cut" => motors.is_disconnected.store(true, Ordering::Relaxed),
                "the link is down" => ip("link set vcan10 down"),
                "the bus is lost" => inject_bus_off("vcan10"),
                _ => motors.fails_next.store(true, Ordering::Relaxed),
            }
            // The program that takes a link down takes its time: now it is down.
            let faulted_at = clock::now();
            let reason = wait_until_stopped(&arm);
            let reported_after = clock::now().duration_since(start_time);
            assert!(reported_after < TIMEOUT + REPORT_TOLERANCE, "{fault}: {reported_after:?}");
            // Where nothing of us reaches them they stop by themselves; else they were told to.
            let is_isolated = ["the cable is cut", "the link is down"].contains(&fault);
            let after_millis = if is_isolated { motors.wait_until_timed_out(faulted_at, state) } else { Vec::new() };
            motors
                .wait_until("none obeys", |observed| observed.iter().all(|observed| observed.state != State::Enabled));
            println!(
                "can: {fault}, on_loss = {:?}: told after {:.0} ms ({reason}); motors stopped by themselves after {after_millis:.0?} ms",
                on_loss.name(),
                1e3 * reported_after.as_secs_f64()
            );
            motors.is_disconnected.store(false, Ordering::Relaxed);
            ip("link set vcan10 up");
            // Whatever comes back, nobody is switched on, and what is held does not move.
            std::thread::sleep(Duration::from_millis(600));
            let before = motors.observed().clone();
            assert!(before.iter().all(|observed| observed.state != State::Enabled), "{fault}: {:?}", motors.states());
            if on_loss == OnLoss::Hold && fault != "a motor fails" {
                assert!(
                    before.iter().all(|observed| observed.velocity_rad_s == 0.0 && observed.state == State::Holding),
                    "{fault}"
                );
            }
            let assert_rejected =
                arm.command(&JointTarget { position: vec![0.0; n] }).expect_err("it was not recovered");
            assert!(assert_rejected.to_string().contains("not been recovered"), "{assert_rejected}");
            let n_commands: usize = before.iter().map(|observed| observed.commanded_rad.len()).sum();
            assert_eq!(
                motors.observed().iter().map(|observed| observed.commanded_rad.len()).sum::<usize>(),
                n_commands
            );
            // The free ones have coasted on: within the joints' range, or it says so.
            let coasted: Vec<f64> = motors.positions();
            match arm.recover() {
                Ok(()) => {
                    assert!(motors.states().iter().all(|state| *state == State::Enabled), "{fault}");
                    let moved: Vec<f64> =
                        motors.positions().iter().zip(&coasted).map(|(now, coasted)| (now - coasted).abs()).collect();
                    assert!(moved.iter().all(|moved| *moved < 0.1), "{fault}: switched on where it is: {moved:?}");
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
    let mut arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release)).expect("they are on");
    arm.command(&JointTarget { position: vec![1.0; configs.len()] }).expect("within the limits");
    let noise = Bus::open(&wire.config(false)).expect("it is up");
    // Answers of each of them, and what else comes from motors: feedback, PDOs, SDO answers, heartbeats.
    let ids = [Id::standard(0x11), Id::extended(0x0280_03FD), Id::extended(0x1100_03FD), Id::standard(0x081)]
        .into_iter()
        .chain([0x089, 0x085, 0x185, 0x285, 0x585, 0x705].map(Id::standard))
        .map(|id| id.expect("in range"));
    let ids: Vec<Id> = ids.collect();
    let mut random = 7_u64;
    let mut next = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(random >> 33).expect("31 bits")
    };
    for _ in 0..3000 {
        let bytes: Vec<u8> = (0..next() % 9).map(|_| next().to_le_bytes()[0]).collect();
        let frame = Frame::classic(ids[next() % ids.len()], &bytes).expect("at most eight bytes");
        noise.send(&frame).expect("it is up");
        std::thread::sleep(Duration::from_micros(300));
    }
    let reason = wait_until_stopped(&arm);
    println!("can: 3000 frames of nonsense: {reason}");
    motors.wait_until("none obeys", |observed| observed.iter().all(|observed| observed.state != State::Enabled));
    for observed in motors.observed().iter() {
        let steps = observed.commanded_rad.windows(2).map(|path| (path[1] - path[0]).abs());
        let max = steps.fold(0.0, f64::max);
        assert!(max <= LIMITS.velocity / RATE_HZ + 25.2 / 65_535.0, "a step of {max} rad");
    }
    std::thread::sleep(Duration::from_millis(500));
    arm.recover().expect("the motors answer as before");
    assert!(motors.states().iter().all(|state| *state == State::Enabled));
}

/// What a controller tells that goes off the bus.
fn inject_bus_off(interface: &str) {
    const CAN_ERR_BUSOFF: u32 = 0x40;
    let socket = CanSocket::open(interface).expect("it is up");
    socket.write_frame(&CanErrorFrame::new_error(CAN_ERR_BUSOFF, &[0; 8]).expect("eight bytes")).expect("it is up");
}

/// The program that moves an arm until it is killed: this one, with a bus to do so on. It is told to recover by a line.
#[test]
#[ignore = "started by another test"]
fn child_program_moves_arm() {
    let Ok(arguments) = std::env::var(CHILD) else { return };
    let is_hold = arguments.ends_with("hold");
    let (configs, on_loss) =
        if is_hold { (vec![drive(5), drive(6)], OnLoss::Hold) } else { (motors_with_watchdog(), OnLoss::Release) };
    let bus = arguments.split(' ').next().expect("a name").to_owned();
    let wire = BusConfig { interface: bus, bitrate_hz: 1_000_000, data_bitrate_hz: None, accept_no_restart: false };
    let mut arm = MovableCanArm::open(&movable(wire, &configs, on_loss)).expect("they are switched on");
    let mut lines = std::io::stdin().lines();
    let mut direction = 1.0;
    loop {
        match arm.motion() {
            Motion::Holding => {
                let target = JointTarget { position: vec![direction; configs.len()] };
                // It may have stopped since.
                if arm.command(&target).is_ok() {
                    direction = -direction;
                }
            }
            Motion::Moving => {}
            Motion::Stopped { reason } => {
                println!("child: stopped: {reason}");
                assert!(arm.command(&JointTarget { position: vec![0.0; configs.len()] }).is_err());
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
        .args(["--ignored", "--exact", "can_motion::child_program_moves_arm", "--nocapture"])
        .env(CHILD, arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("it is laid out")
}

fn signal(child: &Child, signal: &str) {
    let status = Command::new("/bin/busybox").args(["kill", signal, &child.id().to_string()]).status();
    assert!(status.expect("busybox has kill").success());
}

#[test]
#[ignore = "needs the virtual kernel"]
fn killed_or_suspended_program_triggers_watchdogs() {
    let wire = Wire::new("vcan11", false);
    for (configs, name, state) in
        [(motors_with_watchdog(), "release", State::Free), (vec![drive(5), drive(6)], "hold", State::Holding)]
    {
        let motors = Motors::new(wire.config(false), configs, false);
        let mut child = start_child(&format!("vcan11 {name}"));
        let is_moving = |observed: &[MotorObservation]| {
            observed.iter().all(|observed| observed.state == State::Enabled && observed.velocity_rad_s.abs() > 0.3)
        };
        motors.wait_until("the child moves the arm", is_moving);

        motors.max_stall.store(0, Ordering::Relaxed);
        signal(&child, "-STOP");
        let start_time = clock::now();
        let after = motors.wait_until_timed_out(start_time, state);
        println!("can: SIGSTOP, on_loss = {name:?}: motors stopped by themselves after {after:.0?} ms");
        std::thread::sleep(Duration::from_millis(500));
        let before = motors.observed().clone();
        signal(&child, "-CONT");
        let mut reported = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut next = |expected: &str| loop {
            let line = reported.next().expect("it lives").expect("text");
            if line.contains(expected) {
                return line;
            }
        };
        let line = next("child: stopped");
        println!("can: SIGCONT: {line}");
        assert!(line.contains("stalled for"), "{line}");
        std::thread::sleep(Duration::from_millis(500));
        for (before, after) in before.iter().zip(motors.observed().iter()) {
            assert_eq!(after.state, if name == "hold" { State::Holding } else { State::Free }, "{after:?}");
            assert_eq!(after.commanded_rad.len(), before.commanded_rad.len(), "an old setpoint was obeyed");
            assert!(name == "release" || after.position_rad == before.position_rad, "it was held and moved");
        }
        // Only on request, and from where they are.
        child.stdin.as_mut().expect("piped").write_all(b"recover\n").expect("it reads");
        next("child: recovered");
        motors.wait_until("the child moves the arm again", is_moving);

        motors.max_stall.store(0, Ordering::Relaxed);
        signal(&child, "-KILL");
        let start_time = clock::now();
        let after = motors.wait_until_timed_out(start_time, state);
        println!("can: kill -9, on_loss = {name:?}: motors stopped by themselves after {after:.0?} ms");
        child.wait().expect("our own child");
    }
}
