//! A movable arm. A motion starts with the first target and ends one second after the arm has come
//! to rest.

use super::connection::Connection;
use super::limits::{RobotLimits, clamp_to_range};
use super::mailbox::{MailboxState, MotionMailbox};
use super::motion_loop::MotionLoop;
use super::request::{self, ContactConfig};
use super::{ArmConfig, FrankaArm, MotionStatistics, StateStatistics};
use crate::motion::{
    JointTarget, Motion, MotionCommand, MotionConfig, MotionLimits, MotionLock, MovableArm, OnLoss,
};
use crate::{Arm, Error};
use franka::{FciVersion, RobotMode};
use kinematics::JointState;
use std::net::ToSocketAddrs;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// A robot stops on its own after 20 ms without a command.
const ROBOT_TIMEOUT: Duration = Duration::from_millis(20);
/// Maximum time for an arm to come to rest and end its motion.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time until the states agree with the robot's reply. States come over another connection,
/// so states from before the reply may still arrive.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(2);

/// A Franka arm that is moved by joint positions, under the joint impedance controller of the
/// robot.
///
/// A motion of the robot lasts from the first target until the arm has been at rest for a second.
/// Between motions, the robot holds the arm, and a person may guide it by hand. Dropping this value
/// brings the arm to rest and frees the robot's interface.
#[derive(Debug)]
pub struct MovableFrankaArm {
    address: String,
    arm: FrankaArm,
    connection: Arc<Connection>,
    mailbox: Arc<MotionMailbox>,
    contact: ContactConfig,
    limits: Vec<MotionLimits>,
    is_set: bool,
    _lock: MotionLock,
}

impl MovableFrankaArm {
    /// Makes the checks that need no connection to the robot. The error is the reason why the arm
    /// cannot be moved as configured.
    pub fn check(motion: &MotionConfig) -> Result<(), String> {
        if motion.on_loss != OnLoss::Hold {
            let reason = "without commands it brakes and holds, which cannot be changed: \
                          set arm.motion.on_loss = \"hold\"";
            return Err(reason.to_owned());
        }
        if motion.timeout < ROBOT_TIMEOUT {
            let timeout = motion.timeout;
            return Err(format!(
                "it detects missing commands after {ROBOT_TIMEOUT:?}, which cannot be changed; arm.motion.timeout_millis is {timeout:?}, set a longer one"
            ));
        }
        Ok(())
    }

    /// Connects like [`FrankaArm::open`], and prepares to move. Before the first target, nothing
    /// moves and no setting of the robot changes.
    ///
    /// `motion.limits` are in the order of the joints. They are reduced to at most half of the
    /// robot's limits (an eighth for the jerk), and to slightly less than its joint ranges. A
    /// Franka arm always brakes and holds after 20 ms without a command. Other fail-safe settings
    /// are rejected.
    pub fn open(
        config: &ArmConfig,
        motion: &MotionConfig,
        contact: &ContactConfig,
    ) -> Result<Self, Error> {
        let address = config.address.clone();
        Self::check(motion).map_err(|reason| Error::Fci {
            address: address.clone(),
            reason,
        })?;
        // One controller may have several names.
        let resolved = (&*address, 0)
            .to_socket_addrs()
            .ok()
            .and_then(|mut resolved| resolved.next());
        let lock = MotionLock::take(
            &resolved.map_or_else(|| address.clone(), |resolved| resolved.ip().to_string()),
        )?;
        let mailbox = Arc::new(MotionMailbox::default());
        // The limits depend on the robot, which is known only after the connection. The closure
        // stores the limits, because the returned value needs them.
        let connected = OnceLock::new();
        let arm = FrankaArm::open_with(config, |connection, first| {
            // A Panda serves no description, so its limits are built in.
            let robot = match connection.version {
                FciVersion::V5 => RobotLimits::panda(),
                FciVersion::V10 => RobotLimits::of_description(&request::description(connection)?)?,
            };
            let limits = robot.allowed(&motion.limits)?;
            let device = format!("arm at {}", config.address);
            // The closure is called once.
            let _ = connected.set((Arc::clone(connection), limits.clone()));
            let mut motion_loop = MotionLoop::new(
                device,
                Arc::clone(connection),
                Arc::clone(&mailbox),
                robot,
                limits,
            );
            // A robot that is stopped already is reported at once, and not at the first target.
            motion_loop.take_mode(first);
            Ok(Some(motion_loop))
        })?;
        let (connection, limits) = connected
            .into_inner()
            .expect("an arm that is open has a connection");
        Ok(Self {
            address,
            arm,
            connection,
            mailbox,
            contact: contact.clone(),
            limits,
            is_set: false,
            _lock: lock,
        })
    }

    /// Statistics of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.arm.statistics()
    }

    /// Statistics of the commands so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.mailbox.lock().statistics.clone()
    }

    /// Limits of the commanded motions, in the order of the joints.
    pub fn limits(&self) -> &[MotionLimits] {
        &self.limits
    }

    fn fault(&self, reason: impl Into<String>) -> Error {
        Error::Fci {
            address: self.address.clone(),
            reason: reason.into(),
        }
    }

    /// Starts a motion towards a target.
    fn start_motion(&mut self, target: &JointTarget) -> Result<(), Error> {
        // Wait for a motion that is just ending.
        let Some(mailbox_state) = self
            .mailbox
            .wait(STOP_TIMEOUT, |mailbox_state| mailbox_state.is_idle)
        else {
            return Err(self.fault("the previous motion does not end"));
        };
        let mode = mailbox_state.mode;
        let refusal = refusal(&mailbox_state);
        // The requests below wait for the robot, and the thread needs the lock in every
        // millisecond.
        drop(mailbox_state);
        if let Some(why) = refusal.or_else(|| request::blocking_reason(mode).map(str::to_owned)) {
            return Err(self.fault(why));
        }
        // Settings are sent with the first motion. A program that only opens the arm therefore
        // changes no settings.
        if !self.is_set {
            request::set(&self.connection, &self.contact).map_err(|why| self.fault(why))?;
            self.is_set = true;
        }
        let id = request::start_motion(&self.connection);
        let id = id.map_err(|why| self.fault(format!("it refused to start a motion: {why}")))?;
        self.mailbox.update(|mailbox_state| {
            mailbox_state.started_motion = Some(id);
            mailbox_state.accepts_commands = true;
            mailbox_state.is_idle = false;
            mailbox_state.command = Some(MotionCommand::SetTarget(target.clone()));
            // The motion is set here and not by the thread, because a caller may wait for its end
            // as soon as this function returns. If the robot has stopped since the request was
            // sent, the reason must be kept.
            if !matches!(mailbox_state.motion, Motion::Stopped { .. }) {
                mailbox_state.motion = Motion::Moving;
            }
        });
        Ok(())
    }
}

/// The reason why an arm accepts no target.
fn refusal(mailbox_state: &MailboxState) -> Option<String> {
    match &mailbox_state.motion {
        Motion::Stopped { reason } => Some(format!(
            "it accepts no target before it is recovered: {reason}"
        )),
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
        // The generator clamps as well, but on another thread. Clamping here gives the caller the
        // accepted target at once.
        let target = clamp_to_range(target, &self.limits).map_err(|why| self.fault(why))?;
        let mut mailbox_state = self.mailbox.lock();
        if let Some(why) = refusal(&mailbox_state) {
            drop(mailbox_state);
            return Err(self.fault(why));
        }
        if mailbox_state.accepts_commands {
            mailbox_state.command = Some(MotionCommand::SetTarget(target.clone()));
            mailbox_state.motion = Motion::Moving;
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
        if mailbox_state.accepts_commands {
            mailbox_state.command = Some(MotionCommand::Stop);
        }
        Ok(())
    }

    /// Clears the reflex if a reflex stopped the arm. If the user stop is active or joints are
    /// locked, a person must release them first. In this case, the error names the cause.
    fn recover(&mut self) -> Result<(), Error> {
        let Some(mailbox_state) = self.mailbox.wait(STOP_TIMEOUT, |mailbox_state| {
            mailbox_state.is_idle || mailbox_state.is_lost
        }) else {
            return Err(self.fault("a motion is active"));
        };
        let mode = mailbox_state.mode;
        let is_lost = mailbox_state.is_lost;
        let motion = mailbox_state.motion.clone();
        drop(mailbox_state);
        match (motion, mode) {
            (Motion::Stopped { reason }, _) if is_lost => return Err(self.fault(reason)),
            (Motion::Stopped { .. }, RobotMode::Reflex) => {
                request::recover(&self.connection).map_err(|why| self.fault(why))?;
            }
            // There is no reflex to clear. The robot either became ready in the meantime, or needs
            // a person.
            (Motion::Stopped { .. }, mode) => {
                if let Some(why) = request::blocking_reason(mode) {
                    return Err(self.fault(why));
                }
            }
            (Motion::Holding | Motion::Moving, _) => return Ok(()),
        }
        // States from before the recovery may still be in flight.
        let Some(mut mailbox_state) = self.mailbox.wait(SETTLE_TIMEOUT, |mailbox_state| {
            mailbox_state.mode == RobotMode::Idle
        }) else {
            return Err(self.fault("it reported a successful recovery but is not ready"));
        };
        mailbox_state.motion = Motion::Holding;
        Ok(())
    }
}

impl Drop for MovableFrankaArm {
    fn drop(&mut self) {
        self.mailbox.update(|mailbox_state| {
            mailbox_state.is_shutting_down = true;
            // The stop replaces a pending target. Without a motion, the stop is not stored, because
            // it would wait in the mailbox until the next motion.
            mailbox_state.command = mailbox_state
                .accepts_commands
                .then_some(MotionCommand::Stop);
        });
        if self
            .mailbox
            .wait(STOP_TIMEOUT, |mailbox_state| {
                mailbox_state.is_idle || mailbox_state.is_lost
            })
            .is_none()
        {
            log::warn!("arm at {}: the motion did not end", self.address);
        }
        let statistics = self.motion_statistics();
        if statistics.n_motions > 0 {
            log::info!("arm at {}: {statistics}", self.address);
        }
    }
}
