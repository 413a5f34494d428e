//! An arm of motors on CAN buses that may be moved.
//!
//! One thread serves all buses of the arm, so that all joints start and arrive at the same time. In
//! each cycle it sends every motor its setpoint, which also resets the motors' watchdogs.

use super::arm::MAX_WAITING;
use super::arm_loop::ArmLoop;
use super::config::MovableArmConfig;
use super::joints::{JointReading, Joints};
use super::plan::watchdog_plan;
use crate::motion::{JointTarget, Motion, MotionLock, MotionThread, MovableArm, SteeringPort};
use crate::{Arm, Error};
use kinematics::JointState;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

/// Maximum time for the arm's thread to reply. It checks for requests once per cycle, so a reply
/// that takes longer means that the thread has ended or is stuck.
const MAX_ANSWER: Duration = Duration::from_secs(1);

/// An arm that may be moved. After opening, it holds its current position.
///
/// Dropping this value brings the arm to rest within its limits. Then each motor gets the fail-safe
/// command for `on_loss`. Motors without a watchdog get the command repeatedly until they answer,
/// for a limited time.
#[derive(Debug)]
pub struct MovableCanArm {
    // Fields are dropped in this order: the thread ends while its results can still be received, and
    // before the locks are released.
    thread: MotionThread,
    names: Vec<String>,
    readings: Receiver<Result<JointReading, Error>>,
    joints: Joints,
    /// Locks of all buses of the arm. They are held until the thread has ended.
    _locks: Vec<MotionLock>,
}

impl MovableCanArm {
    /// Makes the checks that need no connection to the motors. It checks the limits, and whether
    /// each motor supports the configuration.
    pub fn check(config: &MovableArmConfig) -> Result<(), Error> {
        watchdog_plan(config).map(drop)
    }

    /// Checks the capabilities of the motors, sets and verifies their timeouts, and enables them.
    /// The enabled motors hold their positions.
    ///
    /// # Errors
    /// If another program moves motors on one of the buses. In this case, nothing is sent. If any
    /// later step fails. In this case, all motors are disabled.
    pub fn open(config: &MovableArmConfig) -> Result<Self, Error> {
        let names: Vec<String> = config
            .arm
            .motors
            .iter()
            .map(|motor| motor.joint.clone())
            .collect();
        let (sender, readings) = sync_channel(MAX_WAITING);
        let (mut thread, shared) = MotionThread::new(MAX_ANSWER);
        // The configuration is checked before the lock is taken, so that a mistake in the rig file
        // is reported even while another program moves the arm.
        let arm_loop = ArmLoop::new(config, shared, sender)?;
        // The lock is taken before the thread starts, and thus before any frame is sent. If two
        // programs commanded the same motors, the motors would alternate between two targets.
        let locks = config
            .arm
            .buses
            .iter()
            .map(|bus| MotionLock::take(&bus.interface))
            .collect::<Result<_, _>>()?;
        thread.start("movable CAN arm", move || arm_loop.run())?;
        let joints = Joints::new(names.len());
        let mut arm = Self {
            names,
            readings,
            joints,
            thread,
            _locks: locks,
        };
        // If enabling fails, dropping the arm ends the thread, which disables the motors.
        arm.recover()?;
        Ok(arm)
    }
}

impl Arm for MovableCanArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Reads the arm like [`CanArm`](super::CanArm). A stopped arm can still be read if its motors
    /// report without commands and without a SYNC.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let deadline = Instant::now() + timeout;
        loop {
            match self
                .readings
                .recv_timeout(deadline.saturating_duration_since(Instant::now()))
            {
                Ok(reading) => {
                    if let Some(state) = self.joints.take(&reading?) {
                        return Ok(state);
                    }
                }
                // A stopped arm reports no state. That is not an error, because `motion` contains
                // the reason and the arm may be recovered.
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    return Err(Error::NoJoints { waited: timeout });
                }
            }
        }
    }
}

impl MovableArm for MovableCanArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        self.thread.command(target)
    }

    fn motion(&self) -> Motion {
        self.thread.motion()
    }

    fn stop(&mut self) -> Result<(), Error> {
        self.thread.stop()
    }

    fn recover(&mut self) -> Result<(), Error> {
        self.thread.recover()
    }

    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        self.thread.steering_port(brake_factor)
    }
}
