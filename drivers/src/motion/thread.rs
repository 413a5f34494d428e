//! The thread that moves an arm, and the requests of its owner.

use super::{CommandedArm, JointTarget, Motion};
use crate::Error;
use parking_lot::Mutex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum time to recover. Preparing and enabling takes some hundred milliseconds per motor.
const MAX_RECOVERY: Duration = Duration::from_secs(60);

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
    motion: Arc<Mutex<Motion>>,
    is_shutting_down: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    max_answer: Duration,
}

impl MotionThread {
    /// Returns the sides of the owner and of the thread, which has not started yet. The thread
    /// replies to targets and stops within `max_answer`, if it is not stuck.
    pub(crate) fn new(max_answer: Duration) -> (Self, SharedWithOwner) {
        // Only one request waits at a time, because the owner waits for each reply.
        let (requests, receiver) = sync_channel(1);
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
        self.request_and_wait(
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
        self.request_and_wait(Request::Stop, self.max_answer)
    }

    /// See [`MovableArm::recover`](super::MovableArm::recover).
    pub(crate) fn recover(&self) -> Result<(), Error> {
        self.request_and_wait(Request::Recover, MAX_RECOVERY)
    }

    /// Sends a request to the thread, and waits for the reply.
    fn request_and_wait<T>(
        &self,
        request: impl FnOnce(Reply<T>) -> Request,
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

impl Drop for MotionThread {
    fn drop(&mut self) {
        self.is_shutting_down.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already printed the panic message.
            let _ = thread.join();
        }
    }
}
