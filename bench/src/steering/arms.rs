//! The arms and bases that are steered: simulated ones, and drivers with emulated devices.
//!
//! Each of them records every setpoint that it gets, so that the limits can be checked in each cycle.

#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_base;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_franka;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_servos;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_ur;
mod simulated;
mod simulated_base;

use super::trace::{Period, Recorder};
use anyhow::{Context, Result};
use capture::known_robots::KnownRobot;
use drivers::base_motion::{BaseDrive, BasePort, BaseState};
use drivers::motion::{ArmState, MotionLimits, SteeringPort, brake_limits};
use kinematics::Chain;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
#[cfg(all(feature = "sim", target_os = "linux"))]
use std::time::Duration;

/// Acceleration and jerk of braking, as a factor of the limits of motions, as in runs.
const BRAKE_FACTOR: f64 = 2.0;
/// Maximum speed of a joint, rad/s, and times to full speed and full acceleration: the defaults of
/// rig files.
const MAX_SPEED_RAD_S: f64 = 1.0;
const ACCELERATION_SECS: f64 = 0.5;
const JERK_SECS: f64 = 0.1;

/// A kind of arm or base.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ArmKind {
    /// An arm that follows its setpoints without error, with the controller of simulated arms.
    Simulated,
    /// The driver of Franka arms with an emulated controller that checks each command.
    Franka,
    /// The driver of arms of Universal Robots with an emulated controller.
    Ur,
    /// The driver of Dynamixel servos with emulated servos on a pseudo terminal.
    Servos,
    /// A base that follows its velocities without error, with the controller of simulated bases.
    Base,
    /// The driver of bases over UDP with an emulated controller.
    UdpBase,
}

impl ArmKind {
    /// All kinds.
    pub const ALL: [Self; 6] = [
        Self::Simulated,
        Self::Franka,
        Self::Ur,
        Self::Servos,
        Self::Base,
        Self::UdpBase,
    ];

    /// The name of the kind for flags and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Simulated => "simulated",
            Self::Franka => "franka",
            Self::Ur => "ur",
            Self::Servos => "servos",
            Self::Base => "base",
            Self::UdpBase => "udp-base",
        }
    }

    /// Time between two setpoints, milliseconds.
    pub(super) fn cycle_millis(self) -> f64 {
        match self {
            Self::Simulated | Self::Franka => 1.0,
            Self::Ur => 2.0,
            Self::Servos => 5.0,
            Self::Base | Self::UdpBase => 20.0,
        }
    }

    /// Whether it is an emulated device that another process can move.
    #[must_use]
    pub fn is_device(self) -> bool {
        !matches!(self, Self::Simulated | Self::Base)
    }

    /// Whether it is a base, not an arm.
    #[must_use]
    pub fn is_base(self) -> bool {
        matches!(self, Self::Base | Self::UdpBase)
    }

    /// The kinds that this program contains. Only a program with the simulator contains emulated
    /// devices.
    #[must_use]
    pub fn available() -> Vec<Self> {
        let is_available = |kind: &Self| {
            matches!(kind, Self::Simulated | Self::Base)
                || cfg!(all(feature = "sim", target_os = "linux"))
        };
        Self::ALL.into_iter().filter(is_available).collect()
    }
}

/// An arm or a base that can be steered, and the record of its setpoints.
pub(super) struct BenchRobot {
    pub(super) kind: ArmKind,
    pub(super) moved: Moved,
    pub(super) recorder: Recorder,
    /// Limits that each setpoint must keep.
    pub(super) checked_limits: Vec<MotionLimits>,
    /// Limits of braking, from which the time to rest is predicted.
    pub(super) brake_limits: Vec<MotionLimits>,
    /// Time between two setpoints.
    pub(super) period: Period,
    pub(super) running: Box<dyn RunningArm>,
}

/// What an operator moves.
pub(super) enum Moved {
    Arm(BenchArm),
    Base(BenchBase),
}

/// An arm.
pub(super) struct BenchArm {
    /// The robot that it is.
    pub(super) robot: &'static KnownRobot,
    /// The chain of its joints, from the base to the flange.
    pub(super) chain: Chain,
    /// Where it rests at first.
    pub(super) start: Vec<f64>,
    pub(super) port: SteeringPort,
}

/// A base.
pub(super) struct BenchBase {
    pub(super) port: BasePort,
    /// Its thread, until the program that steers it takes it.
    pub(super) drive: Option<BaseDrive>,
}

impl BenchRobot {
    /// The arm.
    ///
    /// # Errors
    ///
    /// If it is a base.
    pub(super) fn arm(&self) -> Result<&BenchArm> {
        match &self.moved {
            Moved::Arm(arm) => Ok(arm),
            Moved::Base(_) => anyhow::bail!("the base has no arm"),
        }
    }

    /// The newest state that the thread of the arm or base has reported. A base has no joints.
    pub(super) fn state(&self) -> Option<ArmState> {
        match &self.moved {
            Moved::Arm(arm) => arm.port.state(),
            Moved::Base(base) => base.port.state().map(arm_state),
        }
    }
}

/// The state of a base in the terms of an arm without joints.
fn arm_state(base: BaseState) -> ArmState {
    ArmState {
        reported_at: base.reported_at,
        position: Vec::new(),
        is_at_rest: base.is_at_rest,
        braked_motion: base.braked_motion,
        stopped: base.fault.or(base.refusal),
    }
}

/// Whether an emulated controller waits for a program that is late.
#[cfg(all(feature = "sim", target_os = "linux"))]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Patience {
    /// As long as a busy computer may need.
    BusyComputer,
    /// Hardly, as a real controller.
    Little,
}

#[cfg(all(feature = "sim", target_os = "linux"))]
impl Patience {
    /// Time without a command after which motors or a controller brake.
    fn watchdog(self) -> Duration {
        match self {
            Self::BusyComputer => Duration::from_secs(1),
            // The default of rig files.
            Self::Little => Duration::from_millis(100),
        }
    }
}

/// An emulated controller or motors. Dropping it ends its threads.
#[cfg(all(feature = "sim", target_os = "linux"))]
pub(super) struct Emulated {
    /// Where a driver reaches it.
    pub(super) address: String,
    /// The motion of its joints or of its base.
    pub(super) recorder: Recorder,
    _device: Box<dyn std::any::Any + Send>,
}

/// A driver and its emulated device.
#[cfg(all(feature = "sim", target_os = "linux"))]
struct WithDevice {
    driver: Box<dyn RunningArm>,
    /// This field is dropped last, so that the device answers until it is at rest.
    _emulated: Emulated,
}

#[cfg(all(feature = "sim", target_os = "linux"))]
impl RunningArm for WithDevice {
    fn success_frac(&self) -> Option<f64> {
        self.driver.success_frac()
    }
}

/// A running arm. Dropping it ends its threads.
pub(super) trait RunningArm: Send {
    /// The fraction of the robot's cycles that got a command in time, if the arm counts it.
    fn success_frac(&self) -> Option<f64> {
        None
    }
}

/// A thread of an arm. Dropping it ends the thread.
struct ArmThread {
    must_stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ArmThread {
    /// * `run`: called in the thread. It returns soon after its argument has become true.
    fn spawn(run: impl FnOnce(&AtomicBool) + Send + 'static) -> Result<Self> {
        let must_stop = Arc::<AtomicBool>::default();
        let thread = std::thread::Builder::new()
            .name("bench arm".to_owned())
            .spawn({
                let must_stop = Arc::clone(&must_stop);
                move || run(&must_stop)
            })
            .context("cannot start a thread")?;
        Ok(Self {
            must_stop,
            thread: Some(thread),
        })
    }
}

impl RunningArm for ArmThread {}

impl Drop for ArmThread {
    fn drop(&mut self) {
        self.must_stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The panic hook has already reported a panic of the thread.
            let _ = thread.join();
        }
    }
}

/// Starts an arm or a base at rest.
///
/// # Errors
///
/// If this program does not contain the arm, or it cannot be started.
pub(super) fn start(kind: ArmKind) -> Result<BenchRobot> {
    match kind {
        ArmKind::Simulated => simulated::start(),
        ArmKind::Base => simulated_base::start(),
        #[cfg(all(feature = "sim", target_os = "linux"))]
        _ => {
            let emulated = emulate(kind, Patience::BusyComputer)?;
            let mut robot = connect(kind, &emulated.address, Patience::BusyComputer)?;
            if matches!(kind, ArmKind::Franka | ArmKind::Ur) {
                robot.recorder = emulated.recorder.clone();
            }
            robot.running = Box::new(WithDevice {
                driver: robot.running,
                _emulated: emulated,
            });
            Ok(robot)
        }
        #[cfg(not(all(feature = "sim", target_os = "linux")))]
        _ => Err(messages::BadInput(format!(
            "{:?} needs emulated devices: use Linux and a program built with \
             `cargo build --release --features sim`, or choose {:?}",
            kind.name(),
            ArmKind::Simulated.name()
        ))
        .into()),
    }
}

/// Starts the emulated device of a driver.
///
/// # Errors
///
/// If the kind has none, or it cannot be started.
#[cfg(all(feature = "sim", target_os = "linux"))]
pub(super) fn emulate(kind: ArmKind, patience: Patience) -> Result<Emulated> {
    match kind {
        ArmKind::Franka => emulated_franka::emulate(patience),
        ArmKind::Ur => emulated_ur::emulate(patience),
        ArmKind::Servos => emulated_servos::emulate(),
        ArmKind::UdpBase => emulated_base::emulate(),
        ArmKind::Simulated | ArmKind::Base => {
            anyhow::bail!(
                "{:?} is part of the program, and has no device",
                kind.name()
            )
        }
    }
}

/// Opens the driver of a device.
///
/// # Errors
///
/// If the kind has none, or the device cannot be reached.
#[cfg(all(feature = "sim", target_os = "linux"))]
pub(super) fn connect(kind: ArmKind, address: &str, patience: Patience) -> Result<BenchRobot> {
    match kind {
        ArmKind::Franka => emulated_franka::connect(address),
        ArmKind::Ur => emulated_ur::connect(address, patience),
        ArmKind::Servos => emulated_servos::connect(address, patience),
        ArmKind::UdpBase => emulated_base::connect(address),
        ArmKind::Simulated | ArmKind::Base => {
            anyhow::bail!(
                "{:?} is part of the program, and has no device",
                kind.name()
            )
        }
    }
}

/// The robot and its chain.
fn robot(name: &str) -> Result<(&'static KnownRobot, Chain)> {
    let robot = KnownRobot::find(name).context("a robot of the program is missing")?;
    let chain = Chain::from_urdf(robot.urdf, robot.base_link, robot.flange_link)?;
    Ok((robot, chain))
}

/// Default limits of motions.
pub(super) fn motion_limits(chain: &Chain) -> Vec<MotionLimits> {
    let joints = chain.limits().iter();
    joints
        .map(|joint| MotionLimits::new(joint, MAX_SPEED_RAD_S, ACCELERATION_SECS, JERK_SECS))
        .collect()
}
