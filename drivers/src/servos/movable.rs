//! An arm of servos that may be moved. One thread serves the bus, so that all joints start and
//! arrive at the same time.

use super::arm::MAX_WAITING;
use super::config::MovableServoArmConfig;
use super::motion_loop::MotionLoop;
use super::plan;
use crate::motion::{JointTarget, Motion, MotionLock, MotionThread, MovableArm, SteeringPort};
use crate::{Arm, Error};
use kinematics::JointState;
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

/// Maximum time for the arm's thread to reply. It checks for requests once per cycle, so a reply
/// that takes longer means that the thread has ended or is stuck.
const MAX_ANSWER: Duration = Duration::from_secs(5);

/// An arm that may be moved. After opening, it holds its current position.
///
/// Dropping this value brings the arm to rest within its limits. Then `on_loss` is applied to each
/// servo.
#[derive(Debug)]
pub struct MovableServoArm {
    // Fields are dropped in this order: the thread ends while its results can still be received, and
    // before the locks are released.
    thread: MotionThread,
    names: Vec<String>,
    states: Receiver<Result<JointState, Error>>,
    /// The lock is held until the thread has ended.
    _lock: MotionLock,
}

impl MovableServoArm {
    /// Makes the checks that need no connection to the servos.
    ///
    /// # Errors
    /// If the servos do not support the configuration.
    pub fn check(config: &MovableServoArmConfig) -> Result<(), Error> {
        plan::check(config)
    }

    /// Finds the servos, sets their speed limits and watchdogs, and enables them.
    ///
    /// # Errors
    /// If another program moves servos on the port. In this case, nothing is sent. If any later
    /// step fails. In this case, no servo stays enabled that was disabled before.
    pub fn open(config: &MovableServoArmConfig) -> Result<Self, Error> {
        let (sender, states) = sync_channel(MAX_WAITING);
        let (mut thread, shared) = MotionThread::new(MAX_ANSWER);
        // The configuration is checked before the lock is taken, so that a mistake in the rig file
        // is reported even while another program moves the arm.
        let motion_loop = MotionLoop::new(config, shared, sender)?;
        // The same port can have several names.
        let device = &config.arm.port.device;
        let port = std::fs::canonicalize(device).unwrap_or_else(|_| device.clone());
        let lock = MotionLock::take(&port.display().to_string())?;
        thread.start("movable servo arm", move || motion_loop.run())?;
        let mut arm = Self {
            names: config.arm.joint_names(),
            states,
            thread,
            _lock: lock,
        };
        // If this fails, dropping the arm ends the thread.
        arm.recover()?;
        Ok(arm)
    }
}

impl Arm for MovableServoArm {
    fn joint_names(&self) -> &[String] {
        &self.names
    }

    /// Returns the next state. A stopped arm can still be read if its port is connected.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        // A stopped arm may report no state. That is not another error, because `motion` contains
        // the reason and the arm may be recovered.
        self.states
            .recv_timeout(timeout)
            .unwrap_or(Err(Error::NoJoints { waited: timeout }))
    }
}

impl MovableArm for MovableServoArm {
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
