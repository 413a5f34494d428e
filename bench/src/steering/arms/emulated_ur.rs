//! The driver of arms of Universal Robots with an emulated controller.

use super::super::trace::Recorder;
use super::{
    ArmKind, ArmThread, BRAKE_FACTOR, BenchArm, BenchRobot, Emulated, Moved, Patience, Period,
    motion_limits, robot,
};
use anyhow::Result;
use drivers::Arm;
use drivers::motion::{MotionConfig, MovableArm, OnLoss, Setpoint};
use drivers::ur::emulated::{CommandedJoints, ControllerConfig, EmulatedController, Joints};
use drivers::ur::{ArmConfig, MovableUrArm, N_JOINTS, RTDE_PORT};
use kinematics::Stamp;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Time between two setpoints of an e-Series controller.
const PERIOD: Duration = Duration::from_millis(2);
/// How long the emulated controller waits for the setpoint after a state, so that a busy computer
/// does not look like an exceeded limit.
const PATIENT_WAIT: Duration = Duration::from_millis(500);
/// The same for a program that is stopped: the controller must notice it soon.
const PROMPT_WAIT: Duration = Duration::from_millis(2);
/// A posture with space around it, radians.
const START_RAD: [f64; N_JOINTS] = [0.3, -1.4, 1.6, -1.8, -1.5, 0.4];
/// Maximum time of a read.
const READ_TIMEOUT: Duration = Duration::from_millis(20);
/// Starts the controller.
pub(super) fn emulate(patience: Patience) -> Result<Emulated> {
    let (_, chain) = robot("ur5e")?;
    let recorder = Recorder::default();
    let answer_wait = match patience {
        Patience::BusyComputer => PATIENT_WAIT,
        Patience::Little => PROMPT_WAIT,
    };
    let controller = EmulatedController::start_waiting(
        ControllerConfig::e_series(own_address(), chain),
        answer_wait,
        Box::new(recorded_joints(recorder.clone())),
    )?;
    Ok(Emulated {
        address: controller.address().to_string(),
        recorder,
        _device: Box::new(controller),
    })
}

/// Opens the arm of a controller.
pub(super) fn connect(address: &str, patience: Patience) -> Result<BenchRobot> {
    let (robot, chain) = robot("ur5e")?;
    let config = ArmConfig {
        address: address.to_owned(),
        joint_names: chain.joint_names().to_vec(),
        chain: chain.clone(),
    };
    let motion = MotionConfig {
        limits: motion_limits(&chain),
        on_loss: OnLoss::Hold,
        timeout: patience.watchdog(),
        accept_no_watchdog: false,
    };
    let mut arm = MovableUrArm::open(&config, &motion)?;
    let port = arm.steering_port(BRAKE_FACTOR)?;
    let thread = ArmThread::spawn(|must_stop| read(arm, must_stop))?;
    Ok(BenchRobot {
        kind: ArmKind::Ur,
        brake_limits: port.brake_limits().to_vec(),
        // The controller records the setpoints that it gets.
        recorder: Recorder::default(),
        checked_limits: port.brake_limits().to_vec(),
        moved: Moved::Arm(BenchArm {
            robot,
            chain,
            start: START_RAD.to_vec(),
            port,
        }),
        period: Period::Constant(PERIOD),
        running: Box::new(thread),
    })
}

/// An address of this computer for this process. The ports of a controller cannot be chosen by the
/// system.
fn own_address() -> SocketAddr {
    let [_, _, high, low] = std::process::id().to_be_bytes();
    (Ipv4Addr::new(127, 41, high, low.max(1)), RTDE_PORT).into()
}

/// Reads the states until the bench ends, and then brings the arm to rest. Errors are reported by
/// the port.
fn read(mut arm: MovableUrArm, must_stop: &AtomicBool) {
    while !must_stop.load(Ordering::Relaxed) {
        if arm.read(READ_TIMEOUT).is_err() {
            std::thread::sleep(READ_TIMEOUT);
        }
    }
}

/// Joints that follow their setpoints without error. Each setpoint is recorded, with the
/// acceleration as the difference of two velocities.
fn recorded_joints(recorder: Recorder) -> impl FnMut(Stamp, &CommandedJoints) -> Joints + Send {
    let mut last_velocity_rad_s = None::<[f64; N_JOINTS]>;
    move |_, commanded| {
        let last_velocity = last_velocity_rad_s.replace(commanded.velocity_rad_s);
        // Before the first cycle, the controller has commanded nothing.
        let Some(last_velocity) = last_velocity else {
            return Joints {
                position_rad: START_RAD,
                ..Joints::default()
            };
        };
        let change = |ix: usize| commanded.velocity_rad_s[ix] - last_velocity[ix];
        let setpoint = Setpoint {
            position: commanded.position_rad.to_vec(),
            velocity: commanded.velocity_rad_s.to_vec(),
            acceleration: (0..N_JOINTS)
                .map(|ix| change(ix) / PERIOD.as_secs_f64())
                .collect(),
        };
        recorder.push(drivers::clock::now(), setpoint);
        Joints {
            position_rad: commanded.position_rad,
            velocity_rad_s: commanded.velocity_rad_s,
            ..Joints::default()
        }
    }
}
