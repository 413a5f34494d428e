//! An arm of motors on CAN buses that may be moved.
//!
//! One thread serves all buses of the arm, so that all joints start and arrive at the same time. In
//! each cycle it sends every motor its setpoint, which also resets the motors' watchdogs.

use super::arm::MAX_WAITING;
use super::arm_loop::{ArmLoop, Request};
use super::config::MovableArmConfig;
use super::joints::{JointReading, Joints};
use super::plan::watchdog_plan;
use crate::motion::{CommandedArm, JointTarget, Motion, MotionLock, MovableArm};
use crate::{Arm, Error};
use kinematics::JointState;
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum time for the arm's thread to reply. It checks for requests once per cycle, so a reply
/// that takes longer means that the thread has ended or is stuck.
const MAX_ANSWER: Duration = Duration::from_secs(1);
/// Maximum time to recover. Preparing and enabling takes some hundred milliseconds per motor.
const MAX_RECOVERY: Duration = Duration::from_secs(60);

/// An arm that may be moved. After opening, it holds its current position.
///
/// Dropping this value brings the arm to rest within its limits. Then each motor gets the fail-safe
/// command for `on_loss`. Motors without a watchdog get the command repeatedly until they answer,
/// for a limited time.
#[derive(Debug)]
pub struct MovableCanArm {
    names: Vec<String>,
    readings: Receiver<Result<JointReading, Error>>,
    joints: Joints,
    requests: SyncSender<Request>,
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
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
        // Only one request waits at a time, because the owner waits for each reply.
        let (requests, request_receiver) = sync_channel(1);
        let motion = Arc::new(Mutex::new(Motion::Stopped {
            reason: "the arm has not been enabled yet".to_owned(),
        }));
        let is_shutting_down = Arc::new(AtomicBool::new(false));
        // The configuration is checked before the lock is taken, so that a mistake in the rig file
        // is reported even while another program moves the arm.
        let arm_loop = ArmLoop::new(
            config,
            request_receiver,
            sender,
            Arc::clone(&motion),
            Arc::clone(&is_shutting_down),
        )?;
        // The lock is taken before the thread starts, and thus before any frame is sent. If two
        // programs commanded the same motors, the motors would alternate between two targets.
        let locks = config
            .arm
            .buses
            .iter()
            .map(|bus| MotionLock::take(&bus.interface))
            .collect::<Result<_, _>>()?;
        let device = "movable CAN arm".to_owned();
        let commanded = CommandedArm::new();
        // `apply_fail_safe` waits until `commanded` is dropped. It must therefore not be dropped
        // before each motor has its fail-safe command.
        let run = move || {
            arm_loop.run();
            drop(commanded);
        };
        let thread = std::thread::Builder::new().name(device.clone()).spawn(run);
        let thread = Some(thread.map_err(|source| Error::Thread { device, source })?);
        let joints = Joints::new(names.len());
        let mut arm = Self {
            names,
            readings,
            joints,
            requests,
            motion,
            is_shutting_down,
            thread,
            _locks: locks,
        };
        // If enabling fails, dropping the arm ends the thread, which disables the motors.
        arm.recover()?;
        Ok(arm)
    }

    /// Sends a request to the arm's thread, and waits for the reply.
    fn request_and_wait<T>(
        &self,
        request: impl FnOnce(SyncSender<Result<T, Error>>) -> Request,
        timeout: Duration,
    ) -> Result<T, Error> {
        // Each request has its own channel. A reply that comes after the timeout cannot be mistaken
        // for the reply to the next request.
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

impl Drop for MovableCanArm {
    fn drop(&mut self) {
        // Joining the thread waits until the arm is at rest and each motor has its fail-safe
        // command. After that, the locks are released.
        self.is_shutting_down.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}
