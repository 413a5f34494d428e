//! The arms that are steered: a simulated one, and drivers with emulated controllers.
//!
//! Every arm records each setpoint that it gets, so that the limits can be checked in each cycle.

#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_franka;
#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated_ur;
mod simulated;

use super::trace::Recorder;
use anyhow::{Context, Result};
use capture::known_robots::KnownRobot;
use drivers::motion::{MotionLimits, SteeringPort, brake_limits};
use kinematics::Chain;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Acceleration and jerk of braking, as a factor of the limits of motions, as in runs.
const BRAKE_FACTOR: f64 = 2.0;
/// Maximum speed of a joint, rad/s, and times to full speed and full acceleration: the defaults of
/// rig files.
const MAX_SPEED_RAD_S: f64 = 1.0;
const ACCELERATION_SECS: f64 = 0.5;
const JERK_SECS: f64 = 0.1;

/// A kind of arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ArmKind {
    /// An arm that follows its setpoints without error, with the controller of simulated arms.
    Simulated,
    /// The driver of Franka arms with an emulated controller that checks each command.
    Franka,
    /// The driver of arms of Universal Robots with an emulated controller.
    Ur,
}

impl ArmKind {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::Simulated, Self::Franka, Self::Ur];

    /// The name of the kind for flags and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Simulated => "simulated",
            Self::Franka => "franka",
            Self::Ur => "ur",
        }
    }

    /// The kinds that this program contains. Only a program with the simulator contains emulated
    /// controllers.
    #[must_use]
    pub fn available() -> Vec<Self> {
        let is_available = |kind: &Self| {
            *kind == Self::Simulated || cfg!(all(feature = "sim", target_os = "linux"))
        };
        Self::ALL.into_iter().filter(is_available).collect()
    }
}

/// An arm that can be steered, and the record of its setpoints.
pub(super) struct BenchArm {
    pub(super) kind: ArmKind,
    /// The robot that it is.
    pub(super) robot: &'static KnownRobot,
    /// The chain of its joints, from the base to the flange.
    pub(super) chain: Chain,
    /// Where it rests at first.
    pub(super) start: Vec<f64>,
    pub(super) port: SteeringPort,
    pub(super) recorder: Recorder,
    /// Limits that each setpoint must keep.
    pub(super) checked_limits: Vec<MotionLimits>,
    /// Time between two setpoints.
    pub(super) period: Duration,
    pub(super) running: Box<dyn RunningArm>,
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

/// Starts an arm at rest.
///
/// # Errors
///
/// If this program does not contain the arm, or it cannot be started.
pub(super) fn start(kind: ArmKind) -> Result<BenchArm> {
    match kind {
        ArmKind::Simulated => simulated::start(),
        #[cfg(all(feature = "sim", target_os = "linux"))]
        ArmKind::Franka => emulated_franka::start(),
        #[cfg(all(feature = "sim", target_os = "linux"))]
        ArmKind::Ur => emulated_ur::start(),
        #[cfg(not(all(feature = "sim", target_os = "linux")))]
        _ => Err(messages::BadInput(format!(
            "the arm {:?} needs an emulated controller: use Linux and a program built with \
             `cargo build --release --features sim`, or choose the arm {:?}",
            kind.name(),
            ArmKind::Simulated.name()
        ))
        .into()),
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
