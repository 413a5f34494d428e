//! The owner's side of an arm whose motions run on the robot's own controller.

use super::control::{Control, Exchange};
use super::mailbox::{Mailbox, MotionCommand};
use super::steering_port::SteeringPort;
use super::{JointTarget, Motion, MotionLimits, motion_error};
use crate::Error;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Maximum time for an arm to come to rest and end its motion.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time until the states agree with the end of a stop.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(3);
/// Interval at which the thread that starts motions checks whether it must end.
const POLL: Duration = Duration::from_secs(1);

/// Why a port cannot recover an arm that was dropped.
const GONE: &str = "it is not connected any more";

/// The requests to the controller of a robot.
pub(crate) trait MotionController: Send + Sync + 'static {
    /// What the owner and the thread of the arm exchange beside [`Control`].
    type Robot: Send + 'static;

    /// The exchanged state.
    fn mailbox(&self) -> &Mailbox<Exchange<Self::Robot>>;
    /// Limits of motions, in the order of the joints.
    fn limits(&self) -> &[MotionLimits];
    /// Starts a motion with its first command. An arm that is steered has none. Returns when the
    /// controller has accepted the motion. No motion is active.
    ///
    /// # Errors
    /// The reason why the robot does not start it.
    fn start(&self, command: Option<MotionCommand>) -> Result<(), String>;
    /// Ends the stop of a robot. No motion is active.
    ///
    /// # Errors
    /// The reason why the stop cannot be ended.
    fn recover(&self) -> Result<(), String>;
    /// Whether the robot accepts motions, according to its newest state.
    fn is_ready(robot: &Self::Robot) -> bool;
    /// Checks that the robot can brake this much harder than it moves.
    ///
    /// # Errors
    /// The reason why it cannot.
    fn check_brake_factor(&self, factor: f64) -> Result<(), String>;
    /// An error that names the robot.
    fn fault(&self, reason: String) -> Error;
}

/// Moves an arm through its controller.
pub(crate) struct ControlledArm<C: MotionController> {
    controller: Arc<C>,
    /// The port, if the arm is steered.
    port: Option<SteeringPort>,
    /// Starts the motions of a steered arm. Requests to a controller wait for its answer, so they
    /// must not delay the thread that moves the arm, and the owner may be busy.
    starter: Option<JoinHandle<()>>,
}

impl<C: MotionController> ControlledArm<C> {
    pub(crate) fn new(controller: C) -> Self {
        Self {
            controller: Arc::new(controller),
            port: None,
            starter: None,
        }
    }

    pub(crate) fn controller(&self) -> &C {
        &self.controller
    }

    /// See [`MovableArm::command`](super::MovableArm::command).
    pub(crate) fn command(&self, target: &JointTarget) -> Result<JointTarget, Error> {
        self.set_target(target)
            .map_err(|reason| self.controller.fault(reason))
    }

    fn set_target(&self, target: &JointTarget) -> Result<JointTarget, String> {
        // The generator clamps as well, but on another thread. Clamping here gives the caller the
        // accepted target at once.
        let target = clamp_to_range(target, self.controller.limits())?;
        let is_taken = self.controller.mailbox().lock().control.offer(&target)?;
        if !is_taken {
            start(
                &*self.controller,
                Some(MotionCommand::SetTarget(target.clone())),
            )?;
        }
        Ok(target)
    }

    /// See [`MovableArm::motion`](super::MovableArm::motion).
    pub(crate) fn motion(&self) -> Motion {
        self.controller.mailbox().lock().control.motion.clone()
    }

    /// See [`MovableArm::stop`](super::MovableArm::stop).
    pub(crate) fn stop(&self) {
        // Targets that wait for a motion must not start one.
        if let Some(port) = &self.port {
            port.end_motions();
        }
        self.controller.mailbox().lock().control.stop();
    }

    /// See [`MovableArm::recover`](super::MovableArm::recover).
    pub(crate) fn recover(&self) -> Result<(), Error> {
        recover(&*self.controller)
    }

    /// See [`MovableArm::steering_port`](super::MovableArm::steering_port).
    pub(crate) fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        if let Some(port) = &self.port {
            return Ok(port.clone());
        }
        // The arm keeps the port, so the port must not keep the arm.
        let controller = Arc::downgrade(&self.controller);
        let recover = move || {
            let controller = controller.upgrade();
            controller.map_or_else(|| Err(motion_error(GONE.to_owned())), |arm| recover(&*arm))
        };
        let port = SteeringPort::new(self.controller.limits(), brake_factor, recover)?;
        let refusal = self.controller.mailbox().lock().control.refusal();
        refusal
            .map_or(Ok(()), Err)
            .and_then(|()| self.controller.check_brake_factor(brake_factor))
            .map_err(|reason| self.controller.fault(reason))?;
        let controller = Arc::clone(&self.controller);
        let starter = std::thread::Builder::new()
            .name("motion starter".to_owned())
            .spawn(move || start_when_wanted(&*controller));
        self.starter = Some(starter.map_err(|source| Error::Thread {
            device: "motion starter".to_owned(),
            source,
        })?);
        self.controller
            .mailbox()
            .update(|exchange| exchange.control.steer(port.clone()));
        self.port = Some(port.clone());
        Ok(port)
    }

    /// Brings the arm to rest and ends its motion. Returns whether this succeeded.
    pub(crate) fn shut_down(&mut self) -> bool {
        let mailbox = self.controller.mailbox();
        mailbox.update(|exchange| exchange.control.shut_down());
        if let Some(starter) = self.starter.take() {
            // A thread that panicked has already printed the panic message.
            let _ = starter.join();
        }
        wait_until_idle(&*self.controller)
    }
}

impl<C: MotionController> std::fmt::Debug for ControlledArm<C> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ControlledArm")
            .field("port", &self.port)
            .finish_non_exhaustive()
    }
}

/// Starts a motion after the previous one has ended.
fn start<C: MotionController>(
    controller: &C,
    command: Option<MotionCommand>,
) -> Result<(), String> {
    if !wait_until_idle(controller) {
        return Err("the previous motion does not end".to_owned());
    }
    // The lock is released at the end of this line: the requests wait for the robot, and the thread
    // needs the lock in every cycle.
    let refusal = controller.mailbox().lock().control.refusal();
    refusal.map_or(Ok(()), Err)?;
    controller.start(command)
}

fn recover<C: MotionController>(controller: &C) -> Result<(), Error> {
    let fault = |reason: &str| Err(controller.fault(reason.to_owned()));
    if !wait_until_idle(controller) {
        return fault("a motion is active");
    }
    let (motion, is_lost) = {
        let exchange = controller.mailbox().lock();
        (exchange.control.motion.clone(), exchange.control.is_lost)
    };
    let Motion::Stopped { reason } = motion else {
        return Ok(());
    };
    if is_lost {
        return fault(&reason);
    }
    controller
        .recover()
        .map_err(|reason| controller.fault(reason))?;
    // States from before the end of the stop may still arrive.
    let is_ready = |exchange: &Exchange<C::Robot>| C::is_ready(&exchange.robot);
    let Some(mut exchange) = controller.mailbox().wait(SETTLE_TIMEOUT, is_ready) else {
        return fault("its stop was ended, but it is not ready");
    };
    exchange.control.motion = Motion::Holding;
    Ok(())
}

/// Starts a motion whenever a target waits at the port, until the arm is shut down or lost.
fn start_when_wanted<C: MotionController>(controller: &C) {
    let mailbox = controller.mailbox();
    loop {
        let is_due = |exchange: &Exchange<C::Robot>| {
            exchange.control.wants_motion || exchange.control.is_over()
        };
        let Some(exchange) = mailbox.wait(POLL, is_due) else {
            continue;
        };
        if exchange.control.is_over() {
            return;
        }
        drop(exchange);
        if let Err(reason) = start(controller, None) {
            mailbox.update(|exchange| fail_to_start(&mut exchange.control, reason));
        }
    }
}

/// Stops an arm that cannot start a motion, so that targets do not repeat the attempt until a
/// person asks for it.
fn fail_to_start(control: &mut Control, reason: String) {
    // The reason of a stop must be kept.
    if !matches!(control.motion, Motion::Stopped { .. }) {
        log::warn!("the arm stopped: {reason}");
        control.stop_because(reason);
    }
}

/// Waits until no motion is active, or the connection is lost.
fn wait_until_idle<C: MotionController>(controller: &C) -> bool {
    let is_over =
        |exchange: &Exchange<C::Robot>| exchange.control.is_idle || exchange.control.is_lost;
    controller.mailbox().wait(STOP_TIMEOUT, is_over).is_some()
}

/// Clamps a target to the joints' ranges.
fn clamp_to_range(target: &JointTarget, limits: &[MotionLimits]) -> Result<JointTarget, String> {
    let n = target.position.len();
    if n != limits.len() {
        return Err(format!(
            "the target has {n} joints, but the arm has {}",
            limits.len()
        ));
    }
    let not_finite = target.position.iter().position(|q| !q.is_finite());
    if let Some(ix) = not_finite {
        return Err(format!(
            "the target of joint {} is not a finite number: {}",
            ix + 1,
            target.position[ix]
        ));
    }
    let joints = target.position.iter().zip(limits);
    let clamped = joints.map(|(q, joint)| q.clamp(joint.position[0], joint.position[1]));
    Ok(JointTarget {
        position: clamped.collect(),
    })
}
