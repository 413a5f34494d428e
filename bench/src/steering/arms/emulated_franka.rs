//! The driver of Franka arms with an emulated controller, which refuses each command beyond the
//! limits of a Panda.

use super::super::trace::Recorder;
use super::{
    ArmKind, ArmThread, BRAKE_FACTOR, BenchArm, BenchRobot, Emulated, Moved, Patience, Period,
    RunningArm, motion_limits, robot,
};
use anyhow::Result;
use drivers::Arm;
use drivers::franka::emulated::{CommandedJoints, EmulatedRobot, Joints, Limits, RobotConfig};
use drivers::franka::{ArmConfig, ContactConfig, FciVersion, MovableFrankaArm, N_JOINTS};
use drivers::motion::{MotionConfig, MotionLimits, MovableArm, OnLoss, Setpoint};
use kinematics::{Stamp, Transform};
use parking_lot::Mutex;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Time between two commands.
const PERIOD: Duration = Duration::from_millis(1);
/// How long the emulated controller waits for the answer to a state. A real one does not wait, and
/// its driver runs with real-time priority on a computer without other work. Emulated arms of runs
/// wait equally long.
const PATIENT_WAIT: Duration = Duration::from_millis(15);
/// The same for a program that is stopped: the controller must notice it soon.
const PROMPT_WAIT: Duration = Duration::from_millis(2);
/// A posture with space around it, radians.
const START_RAD: [f64; N_JOINTS] = [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8];
/// Maximum time of a read, so that the statistics can be read in between.
const READ_TIMEOUT: Duration = Duration::from_millis(20);
/// Watchdog of the rig file. The robot brakes earlier, after 20 ms without a command.
const WATCHDOG: Duration = Duration::from_millis(100);

/// The arm, whose states are read as in a run.
struct Franka {
    arm: Arc<Mutex<MovableFrankaArm>>,
    _thread: ArmThread,
}

impl RunningArm for Franka {
    fn success_frac(&self) -> Option<f64> {
        Some(self.arm.lock().motion_statistics().success_frac())
    }
}

/// Starts the controller.
pub(super) fn emulate(patience: Patience) -> Result<Emulated> {
    let (_, chain) = robot("panda")?;
    let recorder = Recorder::default();
    let config = RobotConfig {
        address: (Ipv4Addr::LOCALHOST, 0).into(),
        version: FciVersion::V5,
        chain: chain.clone(),
        flange_from_tool: Transform::identity(),
        limits: Limits::panda(),
    };
    let answer_wait = match patience {
        Patience::BusyComputer => PATIENT_WAIT,
        Patience::Little => PROMPT_WAIT,
    };
    let controller = EmulatedRobot::start_waiting(
        config,
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
pub(super) fn connect(address: &str) -> Result<BenchRobot> {
    let (robot, chain) = robot("panda")?;
    let config = ArmConfig {
        address: address.to_owned(),
        joint_names: chain.joint_names().to_vec(),
        chain: chain.clone(),
    };
    let motion = MotionConfig {
        limits: motion_limits(&chain),
        on_loss: OnLoss::Hold,
        timeout: WATCHDOG,
        accept_no_watchdog: false,
    };
    let mut arm = MovableFrankaArm::open(&config, &motion, &ContactConfig::default())?;
    let port = arm.steering_port(BRAKE_FACTOR)?;
    let arm = Arc::new(Mutex::new(arm));
    let thread = ArmThread::spawn({
        let arm = Arc::clone(&arm);
        move |must_stop| read(&arm, must_stop)
    })?;
    Ok(BenchRobot {
        kind: ArmKind::Franka,
        brake_limits: port.brake_limits().to_vec(),
        // The controller records the commands that it gets.
        recorder: Recorder::default(),
        checked_limits: checked_limits(port.brake_limits()),
        moved: Moved::Arm(BenchArm {
            robot,
            chain,
            start: START_RAD.to_vec(),
            port,
        }),
        period: Period::Constant(PERIOD),
        running: Box::new(Franka {
            arm,
            _thread: thread,
        }),
    })
}

/// Reads the states, as a run does. Errors are reported by the port.
fn read(arm: &Mutex<MovableFrankaArm>, must_stop: &AtomicBool) {
    while !must_stop.load(Ordering::Relaxed) {
        let result = arm.lock().read(READ_TIMEOUT);
        if result.is_err() {
            std::thread::sleep(READ_TIMEOUT);
        }
    }
}

/// Joints that follow their commands without error. Each command is recorded.
fn recorded_joints(recorder: Recorder) -> impl FnMut(Stamp, &CommandedJoints) -> Joints + Send {
    let mut is_first = true;
    move |_, commanded| {
        let position_rad = if std::mem::take(&mut is_first) {
            START_RAD
        } else {
            commanded.position_rad
        };
        let setpoint = Setpoint {
            position: position_rad.to_vec(),
            velocity: commanded.velocity_rad_s.to_vec(),
            acceleration: commanded.acceleration_rad_s2.to_vec(),
        };
        // The stamp of the controller is when a state was due. The command may have come later.
        recorder.push(drivers::clock::now(), setpoint);
        Joints {
            position_rad,
            velocity_rad_s: commanded.velocity_rad_s,
            ..Joints::default()
        }
    }
}

/// The brake limits for velocities and ranges, and the limits of the robot for accelerations and
/// jerks: if a command is late, the robot continues without it, and the driver makes up for the
/// difference with more jerk than it planned.
fn checked_limits(brake_limits: &[MotionLimits]) -> Vec<MotionLimits> {
    let robot = Limits::panda();
    brake_limits
        .iter()
        .enumerate()
        .map(|(ix, limits)| MotionLimits {
            acceleration: robot.acceleration_rad_s2[ix],
            jerk: robot.jerk_rad_s3[ix],
            ..*limits
        })
        .collect()
}
