//! Tests of CAN buses and arms inside the virtual kernel. The motors are emulated on the same
//! virtual bus (`drivers::can::emulated`). A virtual bus has no bit timing, so these tests do not
//! cover bit rates, error states and bus-off.

use drivers::can::cia402::{Cia402, Units};
use drivers::can::damiao::Damiao;
use drivers::can::emulated::EmulatedMotor;
use drivers::can::odrive::{self, Odrive};
use drivers::can::robstride::{self, Robstride};
use drivers::can::tmotor::{self, TMotor};
use drivers::can::{ArmConfig, Bus, BusConfig, BusEvent, CanArm, MotorConfig, MotorProtocol};
use drivers::wire::can::mit::{Command as MitCommand, Limits, Motion};
use drivers::wire::can::{Frame, Id, canopen};
use drivers::{Arm, Error, clock};
use kinematics::Stamp;
use numbers::quantile::{Rank, median, quantile};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

pub(crate) const DAMIAO_LIMITS: Limits = Limits::of(12.5, 30.0, 10.0);
/// A motor that replies only to commands.
const AK: TMotor = TMotor {
    motor: 6,
    model: tmotor::Model::Ak80x9,
};
const UNITS: Units = Units {
    counts_per_turn: 65_536.0,
    rated_torque_nm: 10.0,
};
/// Amplitude (rad) and angular frequency (rad/s) of the joint motion.
const SWING_RAD: f64 = 0.5;
const SWING_RAD_S: f64 = 2.0;

pub(crate) fn ip(arguments: &str) {
    let output = Command::new("/bin/busybox")
        .arg("ip")
        .args(arguments.split(' '))
        .output()
        .expect("busybox has ip");
    assert!(
        output.status.success(),
        "ip {arguments}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// A virtual bus that is up. It is removed on drop.
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

/// Position and velocity of a joint at a time.
fn swing(joint_ix: usize, at: Stamp) -> (f64, f64) {
    let phase = SWING_RAD_S * at.secs_since(Stamp(0)) + joint_ix as f64;
    (
        SWING_RAD * phase.sin(),
        SWING_RAD * SWING_RAD_S * phase.cos(),
    )
}

/// Rest position of a joint.
pub(crate) fn rest_rad(joint_ix: usize) -> f64 {
    0.1234 * (joint_ix as f64 - 2.0)
}

/// Motors on a separate thread, at rest until `is_swinging` is set.
pub(crate) struct Bench {
    stop: Arc<AtomicBool>,
    is_swinging: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Bench {
    /// `commands` are frames that another master sends in each cycle.
    pub(crate) fn new(bus: BusConfig, motors: Vec<MotorConfig>, commands: Vec<Frame>) -> Self {
        let [stop, is_swinging] = [false; 2].map(|now| Arc::new(AtomicBool::new(now)));
        let bus = Bus::open(&bus).expect("the bus is up");
        let (stop_flag, swing_flag) = (Arc::clone(&stop), Arc::clone(&is_swinging));
        let thread = std::thread::spawn(move || {
            let mut emulated: Vec<EmulatedMotor> = motors
                .iter()
                .map(|motor| EmulatedMotor::new(&*motor.protocol, DAMIAO_LIMITS))
                .collect();
            while !stop_flag.load(Ordering::Relaxed) {
                // The thread ends when the bus is taken down.
                let Ok(arrived) = bus.receive(Duration::from_millis(2)) else {
                    return;
                };
                let now = clock::now();
                let mut sent = Vec::new();
                for ((ix, motor), config) in emulated.iter_mut().enumerate().zip(&motors) {
                    let (position, velocity) = if swing_flag.load(Ordering::Relaxed) {
                        swing(ix, now)
                    } else {
                        (rest_rad(ix), 0.0)
                    };
                    let per_turn = config.gear_ratio * if config.is_reversed { -1.0 } else { 1.0 };
                    motor.set_motion(Motion {
                        position_rad: (position - config.offset_rad) * per_turn,
                        velocity_rad_s: velocity * per_turn,
                        torque_nm: 0.0,
                    });
                    if let Some((_, BusEvent::Frame(frame))) = &arrived {
                        sent.extend(motor.take(frame).expect("the motion is within range"));
                    }
                    sent.extend(motor.report(now).expect("the motion is within range"));
                    for command in &commands {
                        sent.extend(motor.take(command).expect("the motion is within range"));
                    }
                }
                for frame in sent {
                    if bus.send(&frame).is_err() {
                        return;
                    }
                }
            }
        });
        Self {
            stop,
            is_swinging,
            thread: Some(thread),
        }
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

pub(crate) fn motor(joint: &str, protocol: impl MotorProtocol + 'static) -> MotorConfig {
    MotorConfig {
        joint: joint.to_owned(),
        bus_ix: 0,
        protocol: Arc::new(protocol),
        gear_ratio: 1.0,
        is_reversed: false,
        offset_rad: 0.0,
        gains: None,
        following: drivers::can::FollowingLimits::default(),
    }
}

pub(crate) fn damiao(ix: u16) -> MotorConfig {
    motor(
        &format!("damiao{ix}"),
        Damiao {
            motor: ix,
            feedback: 0x10 + ix,
        },
    )
}

/// One motor of each family, two of them with gears or reversed.
pub(crate) fn all_families() -> Vec<MotorConfig> {
    let node = |number| canopen::Node::new(number).expect("a node");
    vec![
        damiao(1),
        MotorConfig {
            is_reversed: true,
            offset_rad: 0.25,
            ..damiao(2)
        },
        motor(
            "robstride",
            Robstride {
                motor: 3,
                model: robstride::Model::Rs02,
            },
        ),
        MotorConfig {
            gear_ratio: 8.0,
            ..motor(
                "odrive",
                Odrive {
                    node: odrive::Node::new(4).expect("a node"),
                    endpoints: Some(odrive::emulated::endpoints()),
                },
            )
        },
        motor(
            "drive",
            Cia402 {
                node: node(5),
                units: UNITS,
            },
        ),
        motor("ak", AK),
    ]
}

#[test]
#[ignore = "needs the virtual kernel"]
fn ten_thousand_frames_at_1_khz_all_arrive() {
    const N_FRAMES: u32 = 10_000;
    for is_fd in [false, true] {
        let wire = Wire::new("vcan1", is_fd);
        let (sender, receiver) = (
            Bus::open(&wire.config(is_fd)).expect("up"),
            Bus::open(&wire.config(is_fd)).expect("up"),
        );
        let sending = std::thread::spawn(move || {
            let start_time = clock::now();
            for ix in 0..N_FRAMES {
                let due = start_time + Duration::from_millis(ix.into());
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
                assert!(
                    sender
                        .send(&frame.expect("a length of its format"))
                        .expect("the bus is up")
                );
            }
        });
        let mut ages = Vec::new();
        for expected in 0..N_FRAMES {
            let arrived = receiver
                .receive(Duration::from_secs(2))
                .expect("the bus is up");
            let Some((stamp, BusEvent::Frame(frame))) = arrived else {
                panic!("frame {expected} is lost: {arrived:?}")
            };
            let ix = u32::from_le_bytes(*frame.data().first_chunk().expect("four bytes"));
            assert_eq!(
                (ix, frame.id().value(), frame.is_fd()),
                (expected, expected & 0x7FF, is_fd)
            );
            if is_fd {
                let sent = Stamp(i64::from_le_bytes(
                    *frame.data().last_chunk().expect("sixteen bytes"),
                ));
                ages.push(stamp.secs_since(sent) * 1e3);
            }
        }
        sending.join().expect("all frames are sent");
        let [median, p99] = [0.5, 0.99].map(|frac| quantile(&mut ages, frac, Rank::Lower));
        match median.zip(p99) {
            None => println!("can: {N_FRAMES} classic frames at 1 kHz, none lost"),
            Some((median, p99)) => println!(
                "can: {N_FRAMES} FD frames at 1 kHz, none lost; latency from sending to stamp: median {median:.3} ms, 99th percentile {p99:.3} ms"
            ),
        }
    }
}

#[test]
#[ignore = "needs the virtual kernel"]
fn joints_are_read_from_motors_of_all_families() {
    let wire = Wire::new("vcan2", false);
    let motors = all_families();
    let command =
        tmotor::codec::encode_command(AK.motor, &MitCommand::default(), &AK.model.limits())
            .expect("zeros");
    let bench = Bench::new(wire.config(false), motors.clone(), vec![command]);
    let config = ArmConfig {
        buses: vec![wire.config(false)],
        motors: motors.clone(),
        rate_hz: 200.0,
    };
    let mut arm = CanArm::open(&config).expect("all motors answer");
    assert_eq!(
        arm.joint_names(),
        motors
            .iter()
            .map(|motor| motor.joint.clone())
            .collect::<Vec<_>>()
    );
    // The tolerance is half a count of velocity, times a few milliseconds of extrapolation.
    const EXTRAPOLATED_RAD: f64 = 1e-4;
    let half_counts = [
        12.5 / 65_535.0,
        12.5 / 65_535.0,
        12.57 / 65_535.0,
        1e-6,
        4.8e-5,
        12.5 / 65_535.0,
    ];
    for _ in 0..100 {
        let state = arm.read(Duration::from_secs(1)).expect("the motors report");
        for (ix, half_count) in half_counts.iter().enumerate() {
            let error_rad = (state.position[ix] - rest_rad(ix)).abs();
            assert!(
                error_rad < half_count + EXTRAPOLATED_RAD,
                "{}: error {error_rad} rad",
                motors[ix].joint
            );
        }
    }
    bench.is_swinging.store(true, Ordering::Relaxed);
    let mut max_error = vec![0.0_f64; motors.len()];
    let mut read_delays = Vec::new();
    let start_time = clock::now();
    while clock::now().duration_since(start_time) < Duration::from_secs(3) {
        let state = arm.read(Duration::from_secs(1)).expect("the motors report");
        read_delays.push(clock::now().secs_since(state.stamp) * 1e3);
        if state.stamp.duration_since(start_time) < Duration::from_millis(200) {
            continue; // Some motors may not have started to move.
        }
        for (ix, max_error) in max_error.iter_mut().enumerate() {
            *max_error = max_error.max((state.position[ix] - swing(ix, state.stamp).0).abs());
        }
    }
    println!(
        "can: {} states in 3 s, maximum error {max_error:.5?} rad while moving at up to 1 rad/s; median latency from stamp to read {:.2} ms",
        read_delays.len(),
        median(&read_delays).unwrap_or(f64::NAN)
    );
    assert!(
        read_delays.len() > 100,
        "ODrive and Robstride report 100 times per second"
    );
    assert!(
        max_error.iter().all(|max_error| *max_error < 1e-3),
        "{max_error:?}"
    );
}

#[test]
#[ignore = "needs the virtual kernel"]
fn missing_interfaces_and_motors_are_errors() {
    let open = |bus: BusConfig, motors: Vec<MotorConfig>| {
        let config = ArmConfig {
            buses: vec![bus],
            motors,
            rate_hz: 200.0,
        };
        CanArm::open(&config)
            .map(drop)
            .expect_err("the arm cannot be opened")
            .to_string()
    };
    let missing = BusConfig {
        interface: "can7".to_owned(),
        bitrate_hz: 1_000_000,
        data_bitrate_hz: None,
        accept_no_restart: false,
    };
    let printed = open(missing, vec![damiao(1)]);
    assert!(
        printed.contains("can7") && printed.contains("no such interface"),
        "{printed}"
    );

    let wire = Wire::new("vcan3", false);
    let printed = open(wire.config(false), vec![damiao(1)]);
    assert!(
        printed.contains("\"damiao1\" on \"vcan3\": no answer"),
        "{printed}"
    );
    let bench = Bench::new(wire.config(false), all_families(), vec![]);
    let printed = open(wire.config(false), all_families());
    assert!(
        printed.contains("\"ak\"") && printed.contains("only when another master commands it"),
        "{printed}"
    );
    drop(bench);
    ip("link set vcan3 down");
    ip("link set vcan3 mtu 16");
    ip("link set vcan3 up");
    let printed = open(wire.config(true), vec![damiao(1)]);
    assert!(
        printed.contains("FD frames")
            && printed.contains("sudo ip link set vcan3 down; sudo ip link set vcan3 mtu 72 up"),
        "{printed}"
    );
    ip("link set vcan3 down");
    let printed = open(wire.config(false), vec![damiao(1)]);
    assert!(
        printed.ends_with("it is down; fix it with: sudo ip link set vcan3 up"),
        "{printed}"
    );
}

#[test]
#[ignore = "needs the virtual kernel"]
fn silent_motor_and_bus_down_are_errors() {
    let wire = Wire::new("vcan4", false);
    let config = ArmConfig {
        buses: vec![wire.config(false)],
        motors: vec![damiao(1), damiao(2)],
        rate_hz: 500.0,
    };
    let both_motors = Bench::new(wire.config(false), config.motors.clone(), vec![]);
    let mut arm = CanArm::open(&config).expect("both motors answer");
    arm.read(Duration::from_secs(1))
        .expect("both motors report");
    drop(both_motors);
    let _first = Bench::new(wire.config(false), vec![damiao(1)], vec![]);
    let start_time = clock::now();
    let error = loop {
        match arm.read(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoJoints { .. })
                if clock::now().duration_since(start_time) < Duration::from_secs(5) => {}
            other => break other.expect_err("the second motor is silent"),
        }
    };
    assert!(
        error
            .to_string()
            .contains("\"damiao2\" on \"vcan4\": no frame from the motor for 1s"),
        "{error}"
    );

    let mut arm = CanArm::open(&ArmConfig {
        motors: vec![damiao(1)],
        ..config
    })
    .expect("the first motor answers");
    arm.read(Duration::from_secs(1)).expect("the motor reports");
    ip("link set vcan4 down");
    let start_time = clock::now();
    let error = loop {
        match arm.read(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoJoints { .. })
                if clock::now().duration_since(start_time) < Duration::from_secs(5) => {}
            other => break other.expect_err("the bus is down"),
        }
    };
    println!("can: bus down: {error}");
    assert!(matches!(error, Error::CanBus { .. }), "{error}");
}

/// Runs the production binary. Returns whether it succeeded without losses, and its output.
fn fieldrig(arguments: &[&str]) -> (bool, String) {
    let output = Command::new("/bin/fieldrig")
        .args(arguments)
        .output()
        .expect("fieldrig is installed");
    let printed = [output.stdout, output.stderr].concat();
    (
        output.status.code() == Some(0),
        String::from_utf8_lossy(&printed).into_owned(),
    )
}

#[test]
#[ignore = "needs the virtual kernel"]
fn binary_records_camera_and_can_arm() {
    let wire = Wire::new("vcan5", false);
    ip("link set vcan5 down");
    let (_, printed) = fieldrig(&["doctor", "/rigs/vivid-can.toml"]);
    assert!(
        printed.contains("vcan5: it is down") && printed.contains("sudo ip link set vcan5 up"),
        "{printed}"
    );
    let (is_done, printed) = fieldrig(&[
        "record",
        "/rigs/vivid-can.toml",
        "--out",
        "/tmp/down.mcap",
        "--seconds",
        "1",
    ]);
    assert!(
        !is_done && printed.contains("it is down; fix it with: sudo ip link set vcan5 up"),
        "{printed}"
    );
    ip("link set vcan5 up");
    let (_, printed) = fieldrig(&["devices"]);
    assert!(
        printed.contains("vcan5") && printed.contains("[arm.bus.vcan5]"),
        "{printed}"
    );
    let _bench = Bench::new(wire.config(false), vec![damiao(1), damiao(2)], vec![]);
    let arguments = [
        "record",
        "/rigs/vivid-can.toml",
        "--out",
        "/tmp/can.mcap",
        "--seconds",
        "3",
        "--json",
    ];
    let (is_done, printed) = fieldrig(&arguments);
    println!("fieldrig {}:\n{printed}", arguments.join(" "));
    assert!(is_done, "{printed}");
    let summary = printed
        .lines()
        .find(|line| line.contains("\"event\":\"done\""))
        .expect("a summary is printed");
    let n = |key: &str| -> f64 {
        let (_, rest) = summary.split_once(&format!("\"{key}\":")).expect(key);
        rest.split([',', '}'])
            .next()
            .and_then(|number| number.parse().ok())
            .expect("a number")
    };
    assert!(
        (73.0..=76.0).contains(&n("images")) && n("images_dropped_by_devices") == 0.0,
        "{summary}"
    );
    assert!((590.0..=610.0).contains(&n("joint_states")), "{summary}");
}
