//! An arm of servos that may be moved. One thread serves the bus, so that all joints start and
//! arrive at the same time.

use super::arm::MAX_WAITING;
use super::config::MovableServoArmConfig;
use super::motion_loop::{MotionLoop, Request};
use super::plan;
use crate::motion::{CommandedArm, JointTarget, Motion, MotionLock, MovableArm};
use crate::{Arm, Error};
use kinematics::JointState;
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum time for the arm's thread to reply. It checks for requests once per cycle, so a reply
/// that takes longer means that the thread has ended or is stuck.
const MAX_ANSWER: Duration = Duration::from_secs(5);
/// Maximum time to recover. Finding and enabling takes some hundred milliseconds per servo.
const MAX_RECOVERY: Duration = Duration::from_secs(60);

/// An arm that may be moved. After opening, it holds its current position.
///
/// Dropping this value brings the arm to rest within its limits. Then `on_loss` is applied to each
/// servo.
#[derive(Debug)]
pub struct MovableServoArm {
    names: Vec<String>,
    states: Receiver<Result<JointState, Error>>,
    requests: SyncSender<Request>,
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
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
        // Only one request waits at a time, because the owner waits for each reply.
        let (requests, request_receiver) = sync_channel(1);
        let motion = Arc::new(Mutex::new(Motion::Stopped {
            reason: "the arm has not been enabled yet".to_owned(),
        }));
        let is_shutting_down = Arc::new(AtomicBool::new(false));
        // The configuration is checked before the lock is taken, so that a mistake in the rig file
        // is reported even while another program moves the arm.
        let motion_loop = MotionLoop::new(
            config,
            request_receiver,
            sender,
            Arc::clone(&motion),
            Arc::clone(&is_shutting_down),
        )?;
        // The same port can have several names.
        let device = &config.arm.port.device;
        let port = std::fs::canonicalize(device).unwrap_or_else(|_| device.clone());
        let lock = MotionLock::take(&port.display().to_string())?;
        let commanded = CommandedArm::new();
        // `apply_fail_safe` waits until `commanded` is dropped. It must therefore not be dropped
        // before each servo has its fail-safe command.
        let run = move || {
            motion_loop.run();
            drop(commanded);
        };
        let device = "movable servo arm".to_owned();
        let thread = std::thread::Builder::new().name(device.clone()).spawn(run);
        let thread = Some(thread.map_err(|source| Error::Thread { device, source })?);
        let mut arm = Self {
            names: config.arm.joint_names(),
            states,
            requests,
            motion,
            is_shutting_down,
            thread,
            _lock: lock,
        };
        // If this fails, dropping the arm ends the thread.
        arm.recover()?;
        Ok(arm)
    }

    /// Sends a request to the thread and waits for its reply.
    fn request_and_wait<T>(
        &self,
        request: impl FnOnce(SyncSender<Result<T, Error>>) -> Request,
        timeout: Duration,
    ) -> Result<T, Error> {
        // Each request has its own channel, so that a reply that comes after the timeout cannot be
        // mistaken for the reply to the next request.
        let (sender, answer) = sync_channel(1);
        // Waits have a timeout, because the thread may have ended after a panic.
        let no_answer = || Error::Motion {
            reason: "the arm's thread does not answer".to_owned(),
        };
        self.requests
            .try_send(request(sender))
            .map_err(|_| no_answer())?;
        answer.recv_timeout(timeout).map_err(|_| no_answer())?
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
        self.request_and_wait(
            |answer| Request::SetTarget(target.clone(), answer),
            MAX_ANSWER,
        )
    }

    fn motion(&self) -> Motion {
        self.motion.lock().clone()
    }

    fn stop(&mut self) -> Result<(), Error> {
        self.request_and_wait(Request::Stop, MAX_ANSWER)
    }

    fn recover(&mut self) -> Result<(), Error> {
        self.request_and_wait(Request::Recover, MAX_RECOVERY)
    }
}

impl Drop for MovableServoArm {
    fn drop(&mut self) {
        // Joining the thread waits until the arm is at rest and `on_loss` is applied. After that,
        // the lock is released.
        self.is_shutting_down.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}
