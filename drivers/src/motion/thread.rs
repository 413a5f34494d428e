//! The thread that moves an arm, and the requests of its owner.

use super::mover::Mover;
use super::steering_port::SteeringPort;
use super::{CommandedArm, JointTarget, Motion, MotionLimits};
use crate::Error;
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum time to recover. Preparing and enabling takes some hundred milliseconds per motor.
const MAX_RECOVERY: Duration = Duration::from_secs(60);

/// Maximum number of requests that wait. The owner and the holders of a steering port each wait for
/// their reply, so more would mean that the thread is stuck.
const MAX_REQUESTS: usize = 4;

pub(crate) type Reply<T> = SyncSender<Result<T, Error>>;

/// A request from the owner of the arm.
#[derive(Debug)]
pub(crate) enum Request {
    /// Move to a target. The reply is the target that was accepted.
    SetTarget(JointTarget, Reply<JointTarget>),
    /// Come to rest.
    Stop(Reply<()>),
    /// Prepare and enable the motors. The reply comes when they are enabled.
    Recover(Reply<()>),
    /// The reply is the limits of the enabled joints.
    Limits(Reply<Vec<MotionLimits>>),
    /// Follow a steering port from now on.
    Steer(SteeringPort, Reply<()>),
}

impl Request {
    /// Answers a request to an arm that is not enabled, for this reason.
    pub(crate) fn refuse(self, reason: Error) {
        // The requester may have gone away, so errors of replies are ignored.
        match self {
            Self::SetTarget(_, answer) => drop(answer.try_send(Err(reason))),
            Self::Limits(answer) => drop(answer.try_send(Err(reason))),
            Self::Steer(_, answer) => drop(answer.try_send(Err(reason))),
            // The arm does not move, or is being enabled already.
            Self::Stop(answer) | Self::Recover(answer) => drop(answer.try_send(Ok(()))),
        }
    }
}

impl Mover {
    /// Answers a request to an enabled arm. `motion` is the state that the owner sees.
    pub(crate) fn handle(&mut self, request: Request, motion: &Mutex<Motion>) {
        // The requester may have gone away, so errors of replies are ignored.
        match request {
            Request::SetTarget(target, answer) => {
                let accepted = self.set_target(&target);
                if accepted.is_ok() {
                    // The state is set before the reply, because the requester may wait for the end
                    // of the motion as soon as its target is accepted.
                    *motion.lock() = Motion::Moving;
                }
                let _ = answer.try_send(accepted);
            }
            Request::Stop(answer) => {
                self.stop();
                let _ = answer.try_send(Ok(()));
            }
            Request::Limits(answer) => drop(answer.try_send(Ok(self.limits().to_vec()))),
            Request::Steer(port, answer) => drop(answer.try_send(self.steer(port))),
            // The arm is enabled.
            Request::Recover(answer) => drop(answer.try_send(Ok(()))),
        }
    }
}

/// What the thread shares with the owner of the arm.
#[derive(Debug)]
pub(crate) struct SharedWithOwner {
    pub(crate) requests: Receiver<Request>,
    /// Motion state of the arm. The thread sets it.
    pub(crate) motion: Arc<Mutex<Motion>>,
    /// Whether the thread must bring the arm to rest, apply the fail-safe and end.
    pub(crate) is_shutting_down: Arc<AtomicBool>,
}

/// The owner's side of the thread that moves an arm.
///
/// Dropping this value ends the thread and waits for its end, and thus until the arm is at rest and
/// has its fail-safe.
#[derive(Debug)]
pub(crate) struct MotionThread {
    requests: SyncSender<Request>,
    /// The port, if the arm is steered.
    port: Option<SteeringPort>,
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    max_answer: Duration,
}

impl MotionThread {
    /// Returns the sides of the owner and of the thread, which has not started yet. The thread
    /// replies to targets and stops within `max_answer`, if it is not stuck.
    pub(crate) fn new(max_answer: Duration) -> (Self, SharedWithOwner) {
        let (requests, receiver) = sync_channel(MAX_REQUESTS);
        let motion = Arc::new(Mutex::new(Motion::Stopped {
            reason: "the arm has not been enabled yet".to_owned(),
        }));
        let is_shutting_down = Arc::new(AtomicBool::new(false));
        let shared = SharedWithOwner {
            requests: receiver,
            motion: Arc::clone(&motion),
            is_shutting_down: Arc::clone(&is_shutting_down),
        };
        let owner = Self {
            requests,
            port: None,
            motion,
            is_shutting_down,
            thread: None,
            max_answer,
        };
        (owner, shared)
    }

    /// Starts the thread. `run` returns after the arm has its fail-safe.
    ///
    /// # Errors
    /// If the system cannot start a thread.
    pub(crate) fn start(
        &mut self,
        name: &str,
        run: impl FnOnce() + Send + 'static,
    ) -> Result<(), Error> {
        let commanded = CommandedArm::new();
        // `apply_fail_safe` waits until `commanded` is dropped. It must therefore not be dropped
        // before each motor has its fail-safe command.
        let run = move || {
            run();
            drop(commanded);
        };
        let thread = std::thread::Builder::new().name(name.to_owned()).spawn(run);
        self.thread = Some(thread.map_err(|source| Error::Thread {
            device: name.to_owned(),
            source,
        })?);
        Ok(())
    }

    /// See [`MovableArm::command`](super::MovableArm::command).
    pub(crate) fn command(&self, target: &JointTarget) -> Result<JointTarget, Error> {
        request_and_wait(
            &self.requests,
            |answer| Request::SetTarget(target.clone(), answer),
            self.max_answer,
        )
    }

    /// The arm's motion state.
    pub(crate) fn motion(&self) -> Motion {
        self.motion.lock().clone()
    }

    /// See [`MovableArm::stop`](super::MovableArm::stop).
    pub(crate) fn stop(&self) -> Result<(), Error> {
        request_and_wait(&self.requests, Request::Stop, self.max_answer)
    }

    /// See [`MovableArm::recover`](super::MovableArm::recover).
    pub(crate) fn recover(&self) -> Result<(), Error> {
        request_and_wait(&self.requests, Request::Recover, MAX_RECOVERY)
    }

    /// See [`MovableArm::steering_port`](super::MovableArm::steering_port).
    pub(crate) fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        if let Some(port) = &self.port {
            return Ok(port.clone());
        }
        let limits = request_and_wait(&self.requests, Request::Limits, self.max_answer)?;
        let requests = self.requests.clone();
        let recover = move || request_and_wait(&requests, Request::Recover, MAX_RECOVERY);
        let port = SteeringPort::new(&limits, brake_factor, recover)?;
        request_and_wait(
            &self.requests,
            |answer| Request::Steer(port.clone(), answer),
            self.max_answer,
        )?;
        self.port = Some(port.clone());
        Ok(port)
    }
}

/// Sends a request to the thread of an arm, and waits for the reply.
fn request_and_wait<T>(
    requests: &SyncSender<Request>,
    request: impl FnOnce(Reply<T>) -> Request,
    timeout: Duration,
) -> Result<T, Error> {
    // Each request has its own channel. A reply that comes after the timeout cannot be mistaken for
    // the reply to the next request.
    let (sender, answer) = sync_channel(1);
    // Waits have a timeout, because the thread may have ended after a panic.
    let no_answer = || Error::Motion {
        reason: "the arm's thread does not answer".to_owned(),
    };
    requests
        .try_send(request(sender))
        .map_err(|_| no_answer())?;
    answer.recv_timeout(timeout).map_err(|_| no_answer())?
}

impl Drop for MotionThread {
    fn drop(&mut self) {
        self.is_shutting_down.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}
