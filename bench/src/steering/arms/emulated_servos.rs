//! The driver of Dynamixel servos with emulated servos on a pseudo terminal, as the joints of a
//! Panda.

use super::super::trace::Recorder;
use super::{
    ArmKind, ArmThread, BRAKE_FACTOR, BenchArm, BenchRobot, Emulated, Moved, Patience, Period,
    motion_limits, robot,
};
use anyhow::{Context, Result};
use drivers::can::FollowingLimits;
use drivers::motion::{MotionConfig, MovableArm, OnLoss, Setpoint};
use drivers::servos::emulated::{EmulatedServo, EmulatedServoBus, ServoKind};
use drivers::servos::{
    DynamixelProtocol, MovableServoArm, MovableServoArmConfig, PortConfig, ServoArmConfig,
    ServoConfig,
};
use drivers::{Arm, clock};
use kinematics::Stamp;
use std::f64::consts::TAU;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Rate at which the servos are read and commanded.
const RATE_HZ: f64 = 200.0;
const COUNTS_PER_TURN: f64 = 4096.0;
/// Position at joint angle 0, counts: the middle of the range of a servo.
const ZERO_COUNTS: i32 = 2048;
/// Lowest ID of a servo.
const FIRST_ID: u8 = 1;
/// A posture with space around it, radians.
const START_RAD: [f64; 7] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
/// Long enough for a busy computer: a servo that answers late would end the motion.
const MAX_ANSWER: Duration = Duration::from_millis(500);
/// Maximum time of a read.
const READ_TIMEOUT: Duration = Duration::from_millis(20);
/// Time between two looks at the positions of the servos.
const LOOK_PERIOD: Duration = Duration::from_millis(2);

/// Starts the servos. Their positions are recorded.
pub(super) fn emulate() -> Result<Emulated> {
    let device = port();
    let servos = (FIRST_ID..).zip(START_RAD);
    let servos = servos
        .map(|(id, rad)| EmulatedServo::new(ServoKind::Dynamixel, id, counts_of(rad)))
        .collect();
    let bus = EmulatedServoBus::start(ServoKind::Dynamixel, servos, &device, |_, _| {})?;
    let recorder = Recorder::default();
    let thread = ArmThread::spawn({
        let recorder = recorder.clone();
        move |must_stop| record(&bus, &recorder, must_stop)
    })?;
    Ok(Emulated {
        address: device.display().to_string(),
        recorder,
        _device: Box::new(thread),
    })
}

fn counts_of(rad: f64) -> i32 {
    let counts = f64::from(ZERO_COUNTS) + rad * COUNTS_PER_TURN / TAU;
    #[expect(clippy::cast_possible_truncation, reason = "a turn has 4096 counts")]
    let counts = counts.round() as i32;
    counts
}

/// Records the positions and velocities of the shafts.
fn record(bus: &EmulatedServoBus, recorder: &Recorder, must_stop: &AtomicBool) {
    let mut last: Option<(Stamp, Vec<f64>)> = None;
    while !must_stop.load(Ordering::Relaxed) {
        let line = bus.line();
        let now = clock::now();
        let of = |servo: &EmulatedServo| {
            (servo.position_counts() - f64::from(ZERO_COUNTS)) * TAU / COUNTS_PER_TURN
        };
        let position: Vec<f64> = line.servos.iter().map(of).collect();
        drop(line);
        let velocity = match &last {
            None => vec![0.0; position.len()],
            Some((at, before)) => {
                let secs = now.secs_since(*at);
                let joints = position.iter().zip(before);
                joints.map(|(now, before)| (now - before) / secs).collect()
            }
        };
        recorder.push(
            now,
            Setpoint {
                acceleration: vec![0.0; position.len()],
                velocity,
                position: position.clone(),
            },
        );
        last = Some((now, position));
        std::thread::sleep(LOOK_PERIOD);
    }
}

/// Opens the arm of the servos at a port.
pub(super) fn connect(address: &str, patience: Patience) -> Result<BenchRobot> {
    let (robot, chain) = robot("panda")?;
    let device = PathBuf::from(address);
    let names = chain.joint_names().iter();
    let servo = |(id, joint): (u8, &String)| ServoConfig {
        joint: joint.clone(),
        id,
        zero_counts: ZERO_COUNTS,
        is_reversed: false,
        gear_ratio: 1.0,
        following: FollowingLimits::default(),
    };
    let config = MovableServoArmConfig {
        arm: ServoArmConfig {
            protocol: &DynamixelProtocol,
            port: PortConfig {
                device,
                baud_hz: 1_000_000,
                reconnect_for: MAX_ANSWER,
                max_answer_delay: MAX_ANSWER,
            },
            servos: (FIRST_ID..).zip(names.clone()).map(servo).collect(),
            rate_hz: RATE_HZ,
        },
        motion: MotionConfig {
            limits: motion_limits(&chain),
            on_loss: OnLoss::Hold,
            timeout: patience.watchdog(),
            accept_no_watchdog: false,
        },
    };
    let mut arm = MovableServoArm::open(&config)?;
    let port = arm.steering_port(BRAKE_FACTOR)?;
    let recorder = Recorder::default();
    port.observe_setpoints({
        let recorder = recorder.clone();
        move |at, setpoint| recorder.push(at, setpoint.clone())
    });
    // The positions of servos are rounded, so the arm does not start exactly at the posture.
    let start = arm.read(MAX_ANSWER).context("the servos report nothing")?;
    let thread = ArmThread::spawn(|must_stop| read(arm, must_stop))?;
    Ok(BenchRobot {
        kind: ArmKind::Servos,
        recorder,
        checked_limits: port.brake_limits().to_vec(),
        brake_limits: port.brake_limits().to_vec(),
        moved: Moved::Arm(BenchArm {
            robot,
            chain,
            start: start.position,
            port,
        }),
        period: Period::Constant(Duration::from_secs_f64(1.0 / RATE_HZ)),
        running: Box::new(thread),
    })
}

/// A path for the port, of this program alone.
fn port() -> PathBuf {
    static N_PORTS: AtomicU64 = AtomicU64::new(0);
    let number = N_PORTS.fetch_add(1, Ordering::Relaxed);
    let name = format!("fieldrig-bench-servos-{}-{number}", std::process::id());
    std::env::temp_dir().join(name)
}

/// Reads the states until the bench ends, and then brings the arm to rest. Errors are reported by
/// the port.
fn read(mut arm: MovableServoArm, must_stop: &AtomicBool) {
    while !must_stop.load(Ordering::Relaxed) {
        if arm.read(READ_TIMEOUT).is_err() {
            std::thread::sleep(READ_TIMEOUT);
        }
    }
}
