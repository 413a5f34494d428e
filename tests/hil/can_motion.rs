//! Inside the virtual kernel: arms on CAN buses are moved, lost and found again. The motors are played, with shafts and watchdogs of
//! their own; what is lost is real: a process that is killed or stopped, a link that is down, and a cable that carries nothing.

use crate::can::{DAMIAO_LIMITS, Wire, all_families, damiao, ip, motor};
use drivers::can::played::{self, Played, State};
use drivers::can::{Arrived, Bus, BusConfig, Family, Gains, MotorConfig, MovableArmConfig, MovableCanArm};
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
const SLACK: Duration = Duration::from_millis(30);
/// How much later the arm may tell it on a busy machine.
const TOLD_SLACK: Duration = Duration::from_millis(300);
const LIMITS: MotionLimits = MotionLimits { position: [-2.0, 2.0], velocity: 1.0, acceleration: 2.0, jerk: 20.0 };
const GAINS: Gains = Gains { stiffness_nm_rad: 30.0, damping_nm_s_rad: 1.5 };
const UNITS: Units = Units { counts_per_turn: 65_536.0, rated_torque_nm: 10.0 };

/// What was seen of a motor, in angles of its joint.
#[derive(Clone, Debug)]
pub(crate) struct Seen {
    pub(crate) state: State,
    position_rad: f64,
    velocity_rad_s: f64,
    lost_at: Option<Stamp>,
    /// Where it was commanded to be, command after command.
    commanded_rad: Vec<f64>,
}

/// Motors on a thread of their own, on a cable that can be cut.
pub(crate) struct Motors {
    seen: Arc<Mutex<Vec<Seen>>>,
    is_cut: Arc<AtomicBool>,
    fails: Arc<AtomicBool>,
    /// The longest that this thread itself stood still since it was asked for last, nanoseconds.
    stood_still: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Motors {
    pub(crate) fn new(bus: BusConfig, configs: Vec<MotorConfig>, ignore_timeout: bool) -> Self {
        let flag = || Arc::new(AtomicBool::new(false));
        let (is_cut, fails, stop, stood_still) = (flag(), flag(), flag(), Arc::<AtomicU64>::default());
        let seen = Arc::<Mutex<Vec<Seen>>>::default();
        let (cut, failing, stopping, looking) =
            (Arc::clone(&is_cut), Arc::clone(&fails), Arc::clone(&stop), Arc::clone(&seen));
        let standing = Arc::clone(&stood_still);
        let bus = Bus::open(&bus).expect("it is up");
        let thread = std::thread::spawn(move || {
            let mut played: Vec<_> = configs.iter().map(|config| Played::new(config.family, DAMIAO_LIMITS)).collect();
            let mut commanded_rad = vec![Vec::new(); played.len()];
            if ignore_timeout {
                played.iter_mut().for_each(Played::ignore_timeout);
            }
            let mut before = clock::now();
            while !stopping.load(Ordering::Relaxed) {
                // A link that is down says so once.
                let arrived = bus.receive(Duration::from_millis(1)).unwrap_or(None);
                let now = clock::now();
                let gap = u64::try_from(now.nanos_since(before)).expect("the clock is monotonic");
                standing.fetch_max(gap, Ordering::Relaxed);
                before = now;
                let mut sent = Vec::new();
                if failing.swap(false, Ordering::Relaxed) {
                    played[0].fail();
                }
                for ((motor, config), commanded_rad) in played.iter_mut().zip(&configs).zip(&mut commanded_rad) {
                    sent.extend(motor.report(now).expect("it fits"));
                    if let Some((_, Arrived::Frame(frame))) = &arrived
                        && !cut.load(Ordering::Relaxed)
                    {
                        let before = motor.target();
                        sent.extend(motor.take(frame).expect("it fits"));
                        // Other frames quiet the watchdogs of axes and drives, too.
                        let has_own_loop = matches!(config.family, Family::Odrive { .. } | Family::Cia402 { .. });
                        let is_fed = motor.fed_at() == Some(now) && !has_own_loop;
                        let is_new = motor.target() != before || is_fed;
                        if let (Some(target), true) = (motor.target(), is_new) {
                            commanded_rad.push(joint_rad(config, target.position_rad));
                        }
                    }
                }
                for frame in sent.iter().filter(|_| !cut.load(Ordering::Relaxed)) {
                    let _ = bus.send(frame); // As above.
                }
                let state = played.iter().zip(&configs).zip(&commanded_rad);
                *looking.lock().unwrap_or_else(PoisonError::into_inner) = state
                    .map(|((motor, config), commanded_rad)| Seen {
                        state: motor.state(),
                        position_rad: joint_rad(config, motor.motion().position_rad),
                        velocity_rad_s: motor.motion().velocity_rad_s,
                        lost_at: motor.lost_at(),
                        commanded_rad: commanded_rad.clone(),
                    })
                    .collect();
            }
        });
        let motors = Self { seen, is_cut, fails, stood_still, stop, thread: Some(thread) };
        motors.wait_until("they are there", |seen| !seen.is_empty());
        motors
    }

    fn seen(&self) -> MutexGuard<'_, Vec<Seen>> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn wait_until(&self, what: &str, is_so: impl Fn(&[Seen]) -> bool) {
        let began = clock::now();
        while !is_so(&self.seen()) {
            let waited = clock::now().duration_since(began);
            assert!(waited < Duration::from_secs(10), "not within 10 s: {what}; {:?}", self.states());
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    pub(crate) fn states(&self) -> Vec<State> {
        self.seen().iter().map(|seen| seen.state).collect()
    }

    fn positions(&self) -> Vec<f64> {
        self.seen().iter().map(|seen| seen.position_rad).collect()
    }

    /// Waits until all have stopped by themselves, each within its timeout, and says after how long.
    fn wait_until_lost(&self, since: Stamp, state: State) -> Vec<f64> {
        self.wait_until("all have stopped by themselves", |seen| {
            seen.iter().all(|seen| seen.state == state && seen.lost_at.is_some_and(|lost| lost >= since))
        });
        let after = |seen: &Seen| seen.lost_at.expect("as waited for").duration_since(since);
        let after: Vec<Duration> = self.seen().iter().map(after).collect();
        let stood_still = Duration::from_nanos(self.stood_still.swap(0, Ordering::Relaxed));
        assert!(after.iter().all(|after| *after < TIMEOUT + SLACK + stood_still), "{after:?} {stood_still:?}");
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
        odrive_endpoints: Some(played::endpoints()),
    }
}

fn drive(number: u8) -> MotorConfig {
    let node = canopen::Node::new(number).expect("a node");
    motor(&format!("drive{number}"), Family::Cia402 { node, units: UNITS })
}

/// One motor of each family that has a watchdog.
fn watched() -> Vec<MotorConfig> {
    vec![
        damiao(1),
        motor("robstride", Family::Robstride { motor: 3, model: robstride::Model::Rs02 }),
        motor("odrive", Family::Odrive { node: odrive::Node::new(4).expect("a node") }),
        drive(5),
    ]
}

/// Waits until the arm is held, and a moment more until its shafts rest.
fn wait_until_held(arm: &mut MovableCanArm) {
    let began = clock::now();
    while arm.motion() != Motion::Held {
        assert!(!matches!(arm.motion(), Motion::Stopped { .. }), "{:?}", arm.motion());
        assert!(clock::now().duration_since(began) < Duration::from_secs(20), "it never arrives");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(1500));
    while arm.read(Duration::ZERO).is_ok() {}
}

/// Why it stopped, once it has.
pub(crate) fn wait_until_stopped(arm: &MovableCanArm) -> String {
    let began = clock::now();
    loop {
        if let Motion::Stopped { reason } = arm.motion() {
            return reason;
        }
        assert!(clock::now().duration_since(began) < Duration::from_secs(5), "it goes on");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn motors_of_all_families_go_where_they_are_sent_and_back() {
    let wire = Wire::new("vcan6", false);
    let configs = all_families();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let config = movable(wire.config(false), &configs, OnLoss::Release);
    let mut arm = MovableCanArm::open(&config).expect("all are switched on");
    assert_eq!(motors.states(), [State::Obeys; 6]);
    assert_eq!(arm.motion(), Motion::Held);
    // The motors were found at 0, and those joints are elsewhere: nothing has moved by being switched on.
    let found: Vec<f64> = configs.iter().map(|config| config.offset_rad).collect();
    // Half a count in the command and half in the answer; drives and ODrives resolve finer. In MIT mode no count of velocity is 0: half
    // a one pushes a motor as far aside as damping is to stiffness.
    let pushed = |limit_rad_s: f64, counts: f64| limit_rad_s / counts * GAINS.damping_nm_s_rad / GAINS.stiffness_nm_rad;
    let counts = [
        25.0 / 65_535.0 + pushed(30.0, 4095.0),
        25.0 / 65_535.0 + pushed(30.0, 4095.0),
        25.2 / 65_535.0 + pushed(44.0, 65_535.0),
        1e-5,
        1e-4,
        25.0 / 65_535.0 + pushed(50.0, 4095.0),
    ];
    let off = |got: &[f64], wanted: &[f64]| -> Vec<f64> {
        got.iter().zip(wanted).map(|(got, wanted)| (got - wanted).abs()).collect()
    };
    let is_right = |off: &[f64]| off.iter().zip(counts).all(|(off, count)| *off <= count);
    let still = off(&motors.positions(), &found);
    assert!(is_right(&still), "{still:?}");
    for target in [vec![0.7, -0.5, 0.3, 1.1, -0.9, 0.4], found.clone()] {
        let target = JointTarget { position: target };
        assert_eq!(arm.command(&target).expect("within the limits"), target);
        wait_until_held(&mut arm);
        // Half a count of velocity carries a reading on for as long as the others' take.
        const CARRIED_RAD: f64 = 1e-4;
        let mut told = [f64::INFINITY; 6];
        for _ in 0..50 {
            let state = arm.read(Duration::from_secs(1)).unwrap_or_else(|e| panic!("{e}; {:?}", arm.motion()));
            for (least, off) in told.iter_mut().zip(off(&state.position, &target.position)) {
                *least = least.min(off - CARRIED_RAD);
            }
        }
        let true_ = off(&motors.positions(), &target.position);
        println!("can: sent to {:?}, off by {true_:.6?} rad", target.position);
        assert!(is_right(&told) && is_right(&true_), "{told:?} {true_:?}");
    }
    // Targets outside the range are brought into it; others change nothing.
    let far = arm.command(&JointTarget { position: vec![9.0; 6] }).expect("six numbers");
    assert!(far.position.iter().all(|position| *position <= 2.0), "{far:?}");
    assert!(arm.command(&JointTarget { position: vec![0.0; 5] }).is_err());
    arm.stop().expect("it moves");
    wait_until_held(&mut arm);
    let rest = motors.positions();
    assert!(rest.iter().all(|position| position.abs() < 1.0), "it stopped on its way: {rest:?}");
    drop(arm);
    motors.wait_until("they are released", |seen| seen.iter().all(|seen| seen.state == State::Free));
}

#[test]
#[ignore = "needs the virtual kernel"]
fn motors_without_a_watchdog_are_told_until_they_have_heard_it() {
    let wire = Wire::new("vcan13", false);
    let configs: Vec<_> =
        all_families().into_iter().filter(|config| matches!(config.family, Family::TMotor { .. })).collect();
    // The program ends in order, and while the arm looks on the cable fails: nothing of what is said then arrives.
    for is_dropped in [true, false] {
        let motors = Motors::new(wire.config(false), configs.clone(), false);
        let arm = MovableCanArm::open(&movable(wire.config(false), &configs, OnLoss::Release)).expect("it is there");
        assert_eq!(motors.states(), [State::Obeys]);
        motors.is_cut.store(true, Ordering::Relaxed);
        std::thread::scope(|threads| {
            let kept = if is_dropped {
                threads.spawn(|| drop(arm));
                None
            } else {
                wait_until_stopped(&arm);
                Some(arm)
            };
            std::thread::sleep(TIMEOUT / 2);
            assert_eq!(motors.states(), [State::Obeys], "it obeys its last command as long as it hears nothing else");
            motors.is_cut.store(false, Ordering::Relaxed);
            motors.wait_until("they are released", |seen| seen.iter().all(|seen| seen.state == State::Free));
            drop(kept);
        });
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn commands_keep_the_limits_and_joints_arrive_together() {
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
    wait_until_held(&mut arm);
    let ways = [&one, &two].map(|motors| motors.seen()[0].commanded_rad.clone());
    let last_change = ways.each_ref().map(|way| {
        let last = *way.last().expect("it moved");
        way.iter().rposition(|rad| (rad - last).abs() > 2e-3).expect("it moved")
    });
    // Alone the second joint would be there hundreds of cycles earlier; the last counts of a short way are long ones.
    assert!(last_change[0].abs_diff(last_change[1]) < 40, "{last_change:?}");
    const WINDOW: usize = 40;
    const COUNT_RAD: f64 = 25.0 / 65_535.0;
    let secs = WINDOW as f64 / RATE_HZ;
    let mut most = [0.0_f64; 2];
    for way in &ways {
        let speeds: Vec<f64> = way.windows(WINDOW + 1).map(|way| (way[WINDOW] - way[0]) / secs).collect();
        for (ix, speed) in speeds.iter().enumerate() {
            most[0] = most[0].max(speed.abs());
            if let Some(later) = speeds.get(ix + WINDOW) {
                most[1] = most[1].max((later - speed).abs() / secs);
            }
        }
    }
    println!("can: commands on two buses: at most {:.3} rad/s of 1 and {:.3} rad/s2 of 2", most[0], most[1]);
    assert!(most[0] <= LIMITS.velocity + COUNT_RAD / secs, "{most:?}");
    assert!(most[1] <= LIMITS.acceleration + 2.0 * COUNT_RAD / secs.powi(2), "{most:?}");
    assert!(most[0] > 0.9, "it was fast: {most:?}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn what_cannot_be_made_safe_is_not_switched_on() {
    let wire = Wire::new("vcan9", false);
    let configs = all_families();
    let motors = Motors::new(wire.config(false), configs.clone(), false);
    let refused = |config: &MovableArmConfig, expected: &str| {
        let told = MovableCanArm::open(config).map(drop).expect_err("it cannot be moved so").to_string();
        println!("can: refused: {told}");
        assert!(told.contains(expected), "{told}");
    };
    let good = movable(wire.config(false), &configs, OnLoss::Release);
    let with = |change: &dyn Fn(&mut MovableArmConfig)| {
        let mut config = good.clone();
        change(&mut config);
        config
    };
    refused(&with(&|config| config.motion.on_loss = OnLoss::Hold), "can only \"release\"");
    refused(&with(&|config| config.motion.on_loss = OnLoss::Damp), "can only \"release\"");
    refused(&with(&|config| config.motion.accept_no_watchdog = false), "accept_no_watchdog = true");
    refused(&with(&|config| config.arm.motors[0].gains = None), "needs its stiffness_nm_rad");
    refused(&with(&|config| config.motion.timeout = Duration::from_millis(10)), "room for 4 cycles");
    let too_stiff = Gains { stiffness_nm_rad: 900.0, ..GAINS };
    refused(&with(&|config| config.arm.motors[0].gains = Some(too_stiff)), "counts hold up to 500");
    let older = || Some(odrive::Endpoints { firmware: "0.6.8".to_owned(), ..played::endpoints() });
    refused(&with(&|config| config.odrive_endpoints = older()), "of firmware 0.6.8");
    let narrow = MotionLimits { position: [1.0, 2.0], ..LIMITS };
    refused(&with(&|config| config.motion.limits[0] = narrow), "outside its range");
    refused(&movable(wire.config(false), &[damiao(7)], OnLoss::Release), "no answer");
    assert!(motors.seen().iter().all(|seen| seen.state == State::Free && seen.commanded_rad.is_empty()));
    drop(motors);

    for config in watched() {
        let deaf = Motors::new(wire.config(false), vec![config.clone()], true);
        refused(&movable(wire.config(false), &[config], OnLoss::Release), "reads back as");
        assert!(deaf.seen().iter().all(|seen| seen.state == State::Free && seen.commanded_rad.is_empty()));
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn a_cut_cable_a_link_that_is_down_and_a_lost_bus_stop_the_arm_for_good() {
    let wire = Wire::new("vcan10", false);
    for (configs, on_loss, state) in
        [(watched(), OnLoss::Release, State::Free), (vec![drive(5), drive(6)], OnLoss::Hold, State::Held)]
    {
        let n = configs.len();
        let motors = Motors::new(wire.config(false), configs.clone(), false);
        let mut arm =
            MovableCanArm::open(&movable(wire.config(false), &configs, on_loss)).expect("they are switched on");
        for how in ["the cable is cut", "the link is down", "the bus is lost", "a motor fails"] {
            let side = if motors.positions()[0] > 0.0 { -1.0 } else { 1.0 };
            arm.command(&JointTarget { position: vec![side; n] }).expect("it is switched on");
            std::thread::sleep(Duration::from_millis(600));
            motors.stood_still.store(0, Ordering::Relaxed);
            let began = clock::now();
            match how {
                "the cable is cut" => motors.is_cut.store(true, Ordering::Relaxed),
                "the link is down" => ip("link set vcan10 down"),
                "the bus is lost" => lose_the_bus("vcan10"),
                _ => motors.fails.store(true, Ordering::Relaxed),
            }
            // The program that takes a link down takes its time: now it is down.
            let is_so_from = clock::now();
            let reason = wait_until_stopped(&arm);
            let told_after = clock::now().duration_since(began);
            assert!(told_after < TIMEOUT + TOLD_SLACK, "{how}: {told_after:?}");
            // Where nothing of us reaches them they stop by themselves; else they were told to.
            let is_mute = ["the cable is cut", "the link is down"].contains(&how);
            let after_millis = if is_mute { motors.wait_until_lost(is_so_from, state) } else { Vec::new() };
            motors.wait_until("none obeys", |seen| seen.iter().all(|seen| seen.state != State::Obeys));
            println!(
                "can: {how}, on_loss = {:?}: told after {:.0} ms ({reason}); motors stopped by themselves after {after_millis:.0?} ms",
                on_loss.word(),
                1e3 * told_after.as_secs_f64()
            );
            motors.is_cut.store(false, Ordering::Relaxed);
            ip("link set vcan10 up");
            // Whatever comes back, nobody is switched on, and what is held does not move.
            std::thread::sleep(Duration::from_millis(600));
            let before = motors.seen().clone();
            assert!(before.iter().all(|seen| seen.state != State::Obeys), "{how}: {:?}", motors.states());
            if on_loss == OnLoss::Hold && how != "a motor fails" {
                assert!(before.iter().all(|seen| seen.velocity_rad_s == 0.0 && seen.state == State::Held), "{how}");
            }
            let refused = arm.command(&JointTarget { position: vec![0.0; n] }).expect_err("it was not recovered");
            assert!(refused.to_string().contains("not recovered"), "{refused}");
            let n_commands: usize = before.iter().map(|seen| seen.commanded_rad.len()).sum();
            assert_eq!(motors.seen().iter().map(|seen| seen.commanded_rad.len()).sum::<usize>(), n_commands);
            // The free ones have coasted on: within the joints' range, or it says so.
            let free: Vec<f64> = motors.positions();
            match arm.recover() {
                Ok(()) => {
                    assert!(motors.states().iter().all(|state| *state == State::Obeys), "{how}");
                    let moved: Vec<f64> =
                        motors.positions().iter().zip(&free).map(|(now, free)| (now - free).abs()).collect();
                    assert!(moved.iter().all(|moved| *moved < 0.1), "{how}: switched on where it is: {moved:?}");
                }
                Err(error) => panic!("{how}: {error}; the motors are at {free:?}"),
            }
        }
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn nonsense_in_the_motors_names_stops_the_arm_at_worst() {
    let wire = Wire::new("vcan12", false);
    let configs = watched();
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
    motors.wait_until("none obeys", |seen| seen.iter().all(|seen| seen.state != State::Obeys));
    for seen in motors.seen().iter() {
        let steps = seen.commanded_rad.windows(2).map(|way| (way[1] - way[0]).abs());
        let most = steps.fold(0.0, f64::max);
        assert!(most <= LIMITS.velocity / RATE_HZ + 25.2 / 65_535.0, "a step of {most} rad");
    }
    std::thread::sleep(Duration::from_millis(500));
    arm.recover().expect("the motors answer as before");
    assert!(motors.states().iter().all(|state| *state == State::Obeys));
}

/// What a controller tells that goes off the bus.
fn lose_the_bus(interface: &str) {
    const CAN_ERR_BUSOFF: u32 = 0x40;
    let socket = CanSocket::open(interface).expect("it is up");
    socket.write_frame(&CanErrorFrame::new_error(CAN_ERR_BUSOFF, &[0; 8]).expect("eight bytes")).expect("it is up");
}

/// The program that moves an arm until it is killed: this one, with a bus to do so on. It is told to recover by a line.
#[test]
#[ignore = "started by another test"]
fn a_child_that_moves_an_arm() {
    let Ok(words) = std::env::var(CHILD) else { return };
    let is_held = words.ends_with("hold");
    let (configs, on_loss) =
        if is_held { (vec![drive(5), drive(6)], OnLoss::Hold) } else { (watched(), OnLoss::Release) };
    let bus = words.split(' ').next().expect("a name").to_owned();
    let wire = BusConfig { interface: bus, bitrate_hz: 1_000_000, data_bitrate_hz: None, accept_no_restart: false };
    let mut arm = MovableCanArm::open(&movable(wire, &configs, on_loss)).expect("they are switched on");
    let mut lines = std::io::stdin().lines();
    let mut side = 1.0;
    loop {
        match arm.motion() {
            Motion::Held => {
                let target = JointTarget { position: vec![side; configs.len()] };
                // It may have stopped since.
                if arm.command(&target).is_ok() {
                    side = -side;
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

fn start_child(words: &str) -> Child {
    Command::new("/bin/hil")
        .args(["--ignored", "--exact", "can_motion::a_child_that_moves_an_arm", "--nocapture"])
        .env(CHILD, words)
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
fn a_program_that_is_killed_or_stopped_leaves_the_motors_to_their_watchdogs() {
    let wire = Wire::new("vcan11", false);
    for (configs, word, state) in [(watched(), "release", State::Free), (vec![drive(5), drive(6)], "hold", State::Held)]
    {
        let motors = Motors::new(wire.config(false), configs, false);
        let mut child = start_child(&format!("vcan11 {word}"));
        let is_on_its_way =
            |seen: &[Seen]| seen.iter().all(|seen| seen.state == State::Obeys && seen.velocity_rad_s.abs() > 0.3);
        motors.wait_until("the child moves the arm", is_on_its_way);

        motors.stood_still.store(0, Ordering::Relaxed);
        signal(&child, "-STOP");
        let began = clock::now();
        let after = motors.wait_until_lost(began, state);
        println!("can: SIGSTOP, on_loss = {word:?}: motors stopped by themselves after {after:.0?} ms");
        std::thread::sleep(Duration::from_millis(500));
        let before = motors.seen().clone();
        signal(&child, "-CONT");
        let mut told = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut next = |wanted: &str| loop {
            let line = told.next().expect("it lives").expect("text");
            if line.contains(wanted) {
                return line;
            }
        };
        let line = next("child: stopped");
        println!("can: SIGCONT: {line}");
        assert!(line.contains("stood still"), "{line}");
        std::thread::sleep(Duration::from_millis(500));
        for (before, after) in before.iter().zip(motors.seen().iter()) {
            assert_eq!(after.state, if word == "hold" { State::Held } else { State::Free }, "{after:?}");
            assert_eq!(after.commanded_rad.len(), before.commanded_rad.len(), "an old setpoint was obeyed");
            assert!(word == "release" || after.position_rad == before.position_rad, "it was held and moved");
        }
        // Only on request, and from where they are.
        child.stdin.as_mut().expect("piped").write_all(b"recover\n").expect("it reads");
        next("child: recovered");
        motors.wait_until("the child moves the arm again", is_on_its_way);

        motors.stood_still.store(0, Ordering::Relaxed);
        signal(&child, "-KILL");
        let began = clock::now();
        let after = motors.wait_until_lost(began, state);
        println!("can: kill -9, on_loss = {word:?}: motors stopped by themselves after {after:.0?} ms");
        child.wait().expect("our own child");
    }
}
