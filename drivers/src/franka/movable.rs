//! An arm that is moved: motions begin with the first target and end a second after the arm came to rest.

use super::limits::{RobotLimits, clamp_to_range};
use super::mailbox::{MailboxState, MotionMailbox, MotionOrder};
use super::motion_loop::MotionLoop;
use super::request::{self, ContactConfig};
use super::session::Session;
use super::{ArmConfig, FrankaArm, MotionStatistics, StateStatistics};
use crate::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use crate::{Arm, Error};
use franka::{FciVersion, RobotMode};
use kinematics::JointState;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// A robot stops by itself after 20 ms without a command.
const ROBOT_TIMEOUT: Duration = Duration::from_millis(20);
/// How long an arm may take to come to rest and end its motion.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// How long states may say otherwise after the robot answered.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(2);

/// A Franka arm that is moved by joint positions, under the robot's own joint impedance controller.
///
/// A motion of the robot runs from the first target until the arm has been at rest for a second; in between the robot holds
/// the arm by itself and lets a person guide it by hand. Dropping it brings the arm to rest and frees the robot's interface.
#[derive(Debug)]
pub struct MovableFrankaArm {
    address: String,
    arm: FrankaArm,
    session: Arc<Session>,
    mailbox: Arc<MotionMailbox>,
    contact: ContactConfig,
    limits: Vec<MotionLimits>,
    is_set: bool,
}

impl MovableFrankaArm {
    /// Checks what can be checked without the robot; why it cannot be moved so is told.
    pub fn check(motion: &MotionConfig) -> Result<(), String> {
        if motion.on_loss != OnLoss::Hold {
            let reason = "when its commands cease it brakes and holds by itself, and cannot be told to do otherwise: \
                          arm.motion.on_loss = \"hold\" is the one that it does";
            return Err(reason.to_owned());
        }
        if motion.timeout < ROBOT_TIMEOUT {
            let timeout = motion.timeout;
            return Err(format!(
                "it notices missing commands after {ROBOT_TIMEOUT:?}, which cannot be set; arm.motion.timeout_millis asks for {timeout:?}"
            ));
        }
        Ok(())
    }

    /// Connects as [`FrankaArm::open`] does, and prepares to move; nothing moves, and nothing is set, before the first target.
    ///
    /// `motion.limits` are in the order of the joints. They are brought within half of what the robot allows (of its jerk an
    /// eighth), and a little into its joints' ranges. A Franka arm brakes and holds when it is not commanded for 20 ms, whatever it is told: other wishes are
    /// refused.
    pub fn open(config: &ArmConfig, motion: &MotionConfig, contact: &ContactConfig) -> Result<Self, Error> {
        let address = config.address.clone();
        Self::check(motion).map_err(|reason| Error::Fci { address: address.clone(), reason })?;
        let mailbox = Arc::new(MotionMailbox::default());
        let connected = OnceLock::new();
        let arm = FrankaArm::open_with(config, |session, first| {
            let robot = match session.version {
                FciVersion::V5 => RobotLimits::panda(),
                FciVersion::V10 => RobotLimits::of_description(&request::description(session)?)?,
            };
            let limits = robot.allowed(&motion.limits)?;
            let device = format!("arm at {}", config.address);
            // The closure is called once.
            let _ = connected.set((Arc::clone(session), limits.clone()));
            let mut motion_loop = MotionLoop::new(device, Arc::clone(session), Arc::clone(&mailbox), robot, limits);
            motion_loop.take_mode(first);
            Ok(Some(motion_loop))
        })?;
        let (session, limits) = connected.into_inner().expect("an arm that is open has a session");
        Ok(Self { address, arm, session, mailbox, contact: contact.clone(), limits, is_set: false })
    }

    /// What became of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.arm.statistics()
    }

    /// What became of the commands so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.mailbox.lock().statistics.clone()
    }

    /// What is asked of the joints at most, in their order.
    pub fn limits(&self) -> &[MotionLimits] {
        &self.limits
    }

    fn fault(&self, reason: impl Into<String>) -> Error {
        Error::Fci { address: self.address.clone(), reason: reason.into() }
    }

    /// Begins a motion that heads for a target.
    fn start_motion(&mut self, target: &JointTarget) -> Result<(), Error> {
        // A motion that is just ending ends first.
        let Some(mailbox_state) = self.mailbox.wait(STOP_TIMEOUT, |mailbox_state| mailbox_state.is_idle) else {
            return Err(self.fault("a motion before this does not end"));
        };
        let mode = mailbox_state.mode;
        let refusal = refusal(&mailbox_state);
        drop(mailbox_state);
        if let Some(why) = refusal.or_else(|| request::blocking_reason(mode).map(str::to_owned)) {
            return Err(self.fault(why));
        }
        if !self.is_set {
            request::set(&self.session, &self.contact).map_err(|why| self.fault(why))?;
            self.is_set = true;
        }
        let id = request::start_motion(&self.session);
        let id = id.map_err(|why| self.fault(format!("it lets no motion begin: {why}")))?;
        self.mailbox.update(|mailbox_state| {
            (mailbox_state.started_motion, mailbox_state.accepts_orders, mailbox_state.is_idle) =
                (Some(id), true, false);
            (mailbox_state.order, mailbox_state.motion) =
                (Some(MotionOrder::SetTarget(target.clone())), Motion::Moving);
        });
        Ok(())
    }
}

/// Why an arm takes no target.
fn refusal(mailbox_state: &MailboxState) -> Option<String> {
    match &mailbox_state.motion {
        Motion::Stopped { reason } => Some(format!("it takes no target before it is recovered: {reason}")),
        Motion::Holding | Motion::Moving => None,
    }
}

impl Arm for MovableFrankaArm {
    fn joint_names(&self) -> &[String] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        self.arm.read(timeout)
    }
}

impl MovableArm for MovableFrankaArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        let target = clamp_to_range(target, &self.limits).map_err(|why| self.fault(why))?;
        let mut mailbox_state = self.mailbox.lock();
        if let Some(why) = refusal(&mailbox_state) {
            drop(mailbox_state);
            return Err(self.fault(why));
        }
        if mailbox_state.accepts_orders {
            (mailbox_state.order, mailbox_state.motion) =
                (Some(MotionOrder::SetTarget(target.clone())), Motion::Moving);
            return Ok(target);
        }
        drop(mailbox_state);
        self.start_motion(&target)?;
        Ok(target)
    }

    fn motion(&self) -> Motion {
        self.mailbox.lock().motion.clone()
    }

    fn stop(&mut self) -> Result<(), Error> {
        let mut mailbox_state = self.mailbox.lock();
        if mailbox_state.accepts_orders {
            mailbox_state.order = Some(MotionOrder::Stop);
        }
        Ok(())
    }

    /// Clears the reflex where one stopped it; a person has to release a user stop or unlock joints first, and is told so.
    fn recover(&mut self) -> Result<(), Error> {
        let Some(mailbox_state) =
            self.mailbox.wait(STOP_TIMEOUT, |mailbox_state| mailbox_state.is_idle || mailbox_state.is_lost)
        else {
            return Err(self.fault("a motion runs"));
        };
        let (mode, is_lost, motion) = (mailbox_state.mode, mailbox_state.is_lost, mailbox_state.motion.clone());
        drop(mailbox_state);
        match (motion, mode) {
            (Motion::Stopped { reason }, _) if is_lost => return Err(self.fault(reason)),
            (Motion::Stopped { .. }, RobotMode::Reflex) => {
                request::recover(&self.session).map_err(|why| self.fault(why))?;
            }
            (Motion::Stopped { .. }, mode) => {
                if let Some(why) = request::blocking_reason(mode) {
                    return Err(self.fault(why));
                }
            }
            (Motion::Holding | Motion::Moving, _) => return Ok(()),
        }
        // States from before may still be on their way.
        let Some(mut mailbox_state) =
            self.mailbox.wait(SETTLE_TIMEOUT, |mailbox_state| mailbox_state.mode == RobotMode::Idle)
        else {
            return Err(self.fault("it says that it recovered, and is not ready"));
        };
        mailbox_state.motion = Motion::Holding;
        Ok(())
    }
}

impl Drop for MovableFrankaArm {
    fn drop(&mut self) {
        self.mailbox.update(|mailbox_state| {
            mailbox_state.is_shutting_down = true;
            mailbox_state.order = mailbox_state.accepts_orders.then_some(MotionOrder::Stop);
        });
        if self.mailbox.wait(STOP_TIMEOUT, |mailbox_state| mailbox_state.is_idle || mailbox_state.is_lost).is_none() {
            log::warn!("arm at {}: its motion does not end", self.address);
        }
        let statistics = self.motion_statistics();
        if statistics.n_motions > 0 {
            log::info!("arm at {}: {statistics}", self.address);
        }
    }
}
