//! Inside the virtual kernel: CAN buses and arms on them. The motors are played on the same virtual bus (`drivers::can::played`);
//! a virtual bus has no bits, so rates, error states and loss of the bus are not seen here.

use drivers::can::played::Played;
use drivers::can::{ArmConfig, Arrived, Bus, BusConfig, CanArm, Family, MotorConfig};
use drivers::wire::can::cia402::Units;
use drivers::wire::can::mit::{Command as MitCommand, Limits, Motion};
use drivers::wire::can::{Frame, Id, canopen, odrive, robstride, tmotor};
use drivers::{Arm, Error, clock};
use kinematics::Stamp;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

pub(crate) const DAMIAO_LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
const UNITS: Units = Units { counts_per_turn: 65_536.0, rated_torque_nm: 10.0 };
/// The joints swing so far, rad, and so fast, rad/s.
const SWING_RAD: f64 = 0.5;
const SWING_RAD_S: f64 = 2.0;

pub(crate) fn ip(words: &str) {
    let output = Command::new("/bin/busybox").arg("ip").args(words.split(' ')).output().expect("busybox has ip");
    assert!(output.status.success(), "ip {words}: {}", String::from_utf8_lossy(&output.stderr));
}

/// A virtual bus that is up; removed again when dropped.
pub(crate) struct Wire(&'static str);

impl Wire {
    pub(crate) fn new(name: &'static str, is_fd: bool) -> Self {
        ip(&format!("link add dev {name} type vcan"));
        if is_fd {
            ip(&format!("link set {name} mtu 72"));
        }
        ip(&format!("link set {name} up"));
        Self(name)
    }

    pub(crate) fn config(&self, is_fd: bool) -> BusConfig {
        BusConfig {
            interface: self.0.to_owned(),
            bitrate_hz: 1_000_000,
            data_bitrate_hz: is_fd.then_some(5_000_000),
            accept_no_restart: false,
        }
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        ip(&format!("link del {}", self.0));
    }
}

/// Where a joint is at a time, and how fast.
fn swing(joint_ix: usize, at: Stamp) -> (f64, f64) {
    let phase = SWING_RAD_S * at.secs_since(Stamp(0)) + joint_ix as f64;
    (SWING_RAD * phase.sin(), SWING_RAD * SWING_RAD_S * phase.cos())
}

/// Where a joint rests.
pub(crate) fn rest_rad(joint_ix: usize) -> f64 {
    0.1234 * (joint_ix as f64 - 2.0)
}

/// Motors on a thread of their own, at rest until they swing.
pub(crate) struct Bench {
    stop: Arc<AtomicBool>,
    swings: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Bench {
    /// `commanded`: numbers of AK motors that another master commands.
    pub(crate) fn new(bus: BusConfig, motors: Vec<MotorConfig>, commanded: Vec<u8>) -> Self {
        let [stop, swings] = [false; 2].map(|now| Arc::new(AtomicBool::new(now)));
        let bus = Bus::open(&bus).expect("it is up");
        let (stopping, swinging) = (Arc::clone(&stop), Arc::clone(&swings));
        let thread = std::thread::spawn(move || {
            let mut played: Vec<Played> = motors.iter().map(|motor| Played::new(motor.family, DAMIAO_LIMITS)).collect();
            while !stopping.load(Ordering::Relaxed) {
                // A bus that is taken down ends this.
                let Ok(arrived) = bus.receive(Duration::from_millis(2)) else { return };
                let now = clock::now();
                let mut sent = Vec::new();
                for ((ix, motor), config) in played.iter_mut().enumerate().zip(&motors) {
                    let (position, velocity) =
                        if swinging.load(Ordering::Relaxed) { swing(ix, now) } else { (rest_rad(ix), 0.0) };
                    let per_turn = config.gear_ratio * if config.is_reversed { -1.0 } else { 1.0 };
                    motor.set_motion(Motion {
                        position_rad: (position - config.offset_rad) * per_turn,
                        velocity_rad_s: velocity * per_turn,
                        torque_nm: 0.0,
                    });
                    if let Some((_, Arrived::Frame(frame))) = &arrived {
                        sent.extend(motor.take(frame).expect("the swing fits"));
                    }
                    sent.extend(motor.report(now).expect("the swing fits"));
                    if let Family::TMotor { motor: number, model } = config.family
                        && commanded.contains(&number)
                    {
                        let command = tmotor::encode_command(number, &MitCommand::default(), &model.limits());
                        sent.extend(motor.take(&command.expect("zeros")).expect("the swing fits"));
                    }
                }
                for frame in sent {
                    if bus.send(&frame).is_err() {
                        return;
                    }
                }
            }
        });
        Self { stop, swings, thread: Some(thread) }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().expect("motors do not panic");
        }
    }
}

pub(crate) fn motor(joint: &str, family: Family) -> MotorConfig {
    MotorConfig {
        joint: joint.to_owned(),
        bus_ix: 0,
        family,
        gear_ratio: 1.0,
        is_reversed: false,
        offset_rad: 0.0,
        gains: None,
    }
}

pub(crate) fn damiao(ix: u16) -> MotorConfig {
    motor(&format!("damiao{ix}"), Family::Damiao { motor: ix, feedback: 0x10 + ix })
}

/// One motor of each family, two of them behind gears or reversed.
pub(crate) fn all_families() -> Vec<MotorConfig> {
    let node = |number| canopen::Node::new(number).expect("a node");
    vec![
        damiao(1),
        MotorConfig { is_reversed: true, offset_rad: 0.25, ..damiao(2) },
        motor("robstride", Family::Robstride { motor: 3, model: robstride::Model::Rs02 }),
        MotorConfig {
            gear_ratio: 8.0,
            ..motor("odrive", Family::Odrive { node: odrive::Node::new(4).expect("a node") })
        },
        motor("drive", Family::Cia402 { node: node(5), units: UNITS }),
        motor("ak", Family::TMotor { motor: 6, model: tmotor::Model::Ak80x9 }),
    ]
}

#[test]
#[ignore = "needs the virtual kernel"]
fn ten_thousand_frames_at_1_khz_all_arrive_classic_and_fd() {
    const N_FRAMES: u32 = 10_000;
    for is_fd in [false, true] {
        let wire = Wire::new("vcan1", is_fd);
        let (sender, receiver) =
            (Bus::open(&wire.config(is_fd)).expect("up"), Bus::open(&wire.config(is_fd)).expect("up"));
        let sending = std::thread::spawn(move || {
            let began = clock::now();
            for ix in 0..N_FRAMES {
                let due = began + Duration::from_millis(ix.into());
                std::thread::sleep(due.duration_since(clock::now()));
                let id = Id::standard(ix & 0x7FF).expect("11 bits");
                let [a, b, c, d] = ix.to_le_bytes();
                let now = clock::now().0.to_le_bytes();
                let frame = if is_fd {
                    let bytes = [[a, b, c, d, 0, 0, 0, 0], now].concat();
                    Frame::fd(id, &bytes, true)
                } else {
                    Frame::classic(id, &[a, b, c, d])
                };
                assert!(sender.send(&frame.expect("a length of its format")).expect("it is up"));
            }
        });
        let mut ages = Vec::new();
        for expected in 0..N_FRAMES {
            let arrived = receiver.receive(Duration::from_secs(2)).expect("it is up");
            let Some((stamp, Arrived::Frame(frame))) = arrived else { panic!("frame {expected} is lost: {arrived:?}") };
            let ix = u32::from_le_bytes(*frame.data().first_chunk().expect("four bytes"));
            assert_eq!((ix, frame.id().value(), frame.is_fd()), (expected, expected & 0x7FF, is_fd));
            if is_fd {
                let sent = Stamp(i64::from_le_bytes(*frame.data().last_chunk().expect("sixteen bytes")));
                ages.push(stamp.nanos_since(sent));
            }
        }
        sending.join().expect("all are sent");
        ages.sort_unstable();
        match ages.as_slice() {
            [] => println!("can: {N_FRAMES} classic frames at 1 kHz, none lost"),
            ages => println!(
                "can: {N_FRAMES} FD frames at 1 kHz, none lost; from sending to stamp {:.3} ms in the median, {:.3} ms at 99 %",
                ages[ages.len() / 2] as f64 / 1e6,
                ages[ages.len() * 99 / 100] as f64 / 1e6
            ),
        }
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn joints_are_read_from_motors_of_all_families() {
    let wire = Wire::new("vcan2", false);
    let motors = all_families();
    let bench = Bench::new(wire.config(false), motors.clone(), vec![6]);
    let config = ArmConfig { buses: vec![wire.config(false)], motors: motors.clone(), rate_hz: 200.0 };
    let mut arm = CanArm::open(&config).expect("all answer");
    assert_eq!(arm.joint_names(), motors.iter().map(|motor| motor.joint.clone()).collect::<Vec<_>>());
    // Half a count of each; and half a count of velocity, by which readings are carried on for some milliseconds.
    const CARRIED_RAD: f64 = 1e-4;
    let half_counts = [12.5 / 65_535.0, 12.5 / 65_535.0, 12.57 / 65_535.0, 1e-6, 4.8e-5, 12.5 / 65_535.0];
    // On a busy machine single readings are carried on for longer.
    const CARRIED_LONGER_RAD: f64 = 2e-3;
    let mut least = [f64::INFINITY; 6];
    for _ in 0..100 {
        let state = arm.read(Duration::from_secs(1)).expect("they report");
        for (ix, half_count) in half_counts.iter().enumerate() {
            let off = (state.position[ix] - rest_rad(ix)).abs();
            least[ix] = least[ix].min(off);
            assert!(off < half_count + CARRIED_LONGER_RAD, "{}: off by {off} rad", motors[ix].joint);
        }
    }
    for (ix, off) in least.iter().enumerate() {
        assert!(*off < half_counts[ix] + CARRIED_RAD, "{}: off by {off} rad at least", motors[ix].joint);
    }
    bench.swings.store(true, Ordering::Relaxed);
    let mut worst = vec![0.0_f64; motors.len()];
    let mut late = Vec::new();
    let began = clock::now();
    while clock::now().duration_since(began) < Duration::from_secs(3) {
        let state = arm.read(Duration::from_secs(1)).expect("they report");
        late.push(clock::now().nanos_since(state.stamp));
        if state.stamp.duration_since(began) < Duration::from_millis(200) {
            continue; // Some of them may not have begun to swing.
        }
        for (ix, worst) in worst.iter_mut().enumerate() {
            *worst = worst.max((state.position[ix] - swing(ix, state.stamp).0).abs());
        }
    }
    late.sort_unstable();
    println!(
        "can: {} states in 3 s, off by {worst:.5?} rad at most while swinging at 1 rad/s; read {:.2} ms after their stamp in the median",
        late.len(),
        late[late.len() / 2] as f64 / 1e6
    );
    assert!(late.len() > 100, "ODrive and Robstride report 100 times a second");
    // A kernel without real time on a busy machine stands still for tens of milliseconds at a time.
    assert!(worst.iter().all(|worst| *worst < 0.1 * SWING_RAD * SWING_RAD_S), "{worst:?}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn what_is_missing_is_told() {
    let open = |bus: BusConfig, motors: Vec<MotorConfig>| {
        let config = ArmConfig { buses: vec![bus], motors, rate_hz: 200.0 };
        CanArm::open(&config).map(drop).expect_err("it cannot be opened").to_string()
    };
    let missing = BusConfig {
        interface: "can7".to_owned(),
        bitrate_hz: 1_000_000,
        data_bitrate_hz: None,
        accept_no_restart: false,
    };
    let told = open(missing, vec![damiao(1)]);
    assert!(told.contains("can7") && told.contains("no such interface"), "{told}");

    let wire = Wire::new("vcan3", false);
    let told = open(wire.config(false), vec![damiao(1)]);
    assert!(told.contains("\"damiao1\" on \"vcan3\": no answer"), "{told}");
    let bench = Bench::new(wire.config(false), all_families(), vec![]);
    let told = open(wire.config(false), all_families());
    assert!(told.contains("\"ak\"") && told.contains("only when another master commands it"), "{told}");
    drop(bench);
    ip("link set vcan3 down");
    ip("link set vcan3 mtu 16");
    ip("link set vcan3 up");
    let told = open(wire.config(true), vec![damiao(1)]);
    assert!(
        told.contains("FD frames") && told.contains("sudo ip link set vcan3 down; sudo ip link set vcan3 mtu 72 up"),
        "{told}"
    );
    ip("link set vcan3 down");
    let told = open(wire.config(false), vec![damiao(1)]);
    assert!(told.ends_with("it is down; mend it with: sudo ip link set vcan3 up"), "{told}");
}

#[test]
#[ignore = "needs the virtual kernel"]
fn a_motor_that_falls_silent_and_a_bus_that_goes_down_are_told() {
    let wire = Wire::new("vcan4", false);
    let config = ArmConfig { buses: vec![wire.config(false)], motors: vec![damiao(1), damiao(2)], rate_hz: 500.0 };
    let both = Bench::new(wire.config(false), config.motors.clone(), vec![]);
    let mut arm = CanArm::open(&config).expect("both answer");
    arm.read(Duration::from_secs(1)).expect("both report");
    drop(both);
    let _first = Bench::new(wire.config(false), vec![damiao(1)], vec![]);
    let began = clock::now();
    let error = loop {
        match arm.read(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoJoints { .. }) if clock::now().duration_since(began) < Duration::from_secs(5) => {}
            other => break other.expect_err("the second motor is silent"),
        }
    };
    assert!(error.to_string().contains("\"damiao2\" on \"vcan4\": it has said nothing for 1s"), "{error}");

    let mut arm = CanArm::open(&ArmConfig { motors: vec![damiao(1)], ..config }).expect("the first answers");
    arm.read(Duration::from_secs(1)).expect("it reports");
    ip("link set vcan4 down");
    let began = clock::now();
    let error = loop {
        match arm.read(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoJoints { .. }) if clock::now().duration_since(began) < Duration::from_secs(5) => {}
            other => break other.expect_err("the bus is down"),
        }
    };
    println!("can: a bus that goes down: {error}");
    assert!(matches!(error, Error::CanBus { .. }), "{error}");
}

/// The production binary, with a rig file whose arm is two motors on a bus: whether it did its work, and what it told.
fn fieldrig(words: &[&str]) -> (bool, String) {
    let output = Command::new("/bin/fieldrig").args(words).output().expect("it is laid out");
    let told = [output.stdout, output.stderr].concat();
    // 3 is done with loss: a busy machine loses images, which are counted.
    let is_done = matches!(output.status.code(), Some(0 | 3));
    (is_done, String::from_utf8_lossy(&told).into_owned())
}

#[test]
#[ignore = "needs the virtual kernel"]
fn the_binary_records_a_camera_and_an_arm_on_a_bus() {
    let wire = Wire::new("vcan5", false);
    ip("link set vcan5 down");
    let (_, told) = fieldrig(&["doctor", "/rigs/vivid-can.toml"]);
    assert!(told.contains("vcan5: it is down") && told.contains("sudo ip link set vcan5 up"), "{told}");
    let (is_done, told) = fieldrig(&["record", "/rigs/vivid-can.toml", "--out", "/tmp/down.mcap", "--seconds", "1"]);
    assert!(!is_done && told.contains("it is down; mend it with: sudo ip link set vcan5 up"), "{told}");
    ip("link set vcan5 up");
    let (_, told) = fieldrig(&["devices"]);
    assert!(told.contains("vcan5") && told.contains("[arm.bus.vcan5]"), "{told}");
    let _bench = Bench::new(wire.config(false), vec![damiao(1), damiao(2)], vec![]);
    let words = ["record", "/rigs/vivid-can.toml", "--out", "/tmp/can.mcap", "--seconds", "3", "--json"];
    let (is_done, told) = fieldrig(&words);
    println!("fieldrig {}:\n{told}", words.join(" "));
    assert!(is_done, "{told}");
    let done = told.lines().find(|line| line.contains("\"event\":\"done\"")).expect("it says what it recorded");
    let n = |key: &str| -> f64 {
        let (_, rest) = done.split_once(&format!("\"{key}\":")).expect(key);
        rest.split([',', '}']).next().and_then(|number| number.parse().ok()).expect("a number")
    };
    assert!(n("images") + n("images_lost_by_devices") > 65.0 && n("images") > 15.0, "{done}");
    // Two motors at 200 Hz, less what a kernel without real time on a busy machine misses.
    assert!(n("joint_states") > 200.0, "{done}");
}
