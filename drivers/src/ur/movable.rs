//! A movable arm. A motion starts with the first target and ends one second after the arm has come
//! to rest.

use super::address::{ControllerAddress, Interface};
use super::arm::fault;
use super::mailbox::{MailboxState, MotionMailbox};
use super::motion_loop::MotionLoop;
use super::program::{ProgramConfig, program};
use super::statistics::MotionStatistics;
use super::{ArmConfig, StateStatistics, UrArm, dashboard};
use crate::motion::{
    JointTarget, Motion, MotionCommand, MotionConfig, MotionLimits, MotionLock, MovableArm, OnLoss,
};
use crate::{Arm, Error, clock};
use kinematics::JointState;
use std::io::Write;
use std::sync::Arc;
use std::time::Duration;

/// Minimum time after which the program on the controller brakes the arm: five cycles of a CB3
/// controller, so that a single late setpoint does not stop a motion.
const MIN_TIMEOUT: Duration = Duration::from_millis(40);
/// Minimum deceleration for braking the arm. Slower joints brake as fast.
const MIN_BRAKE_RAD_S2: f64 = 2.0;
/// Maximum time for starting the program.
const START_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for an arm to come to rest and end its motion.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time until the states agree with the end of a protective stop.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(3);

/// An arm of Universal Robots that is moved by joint positions.
///
/// A motion lasts from the first target until the arm has been at rest for a second. Between
/// motions, no program runs on the controller. Dropping this value brings the arm to rest and
/// closes the connection.
#[derive(Debug)]
pub struct MovableUrArm {
    address: String,
    controller: ControllerAddress,
    arm: UrArm,
    mailbox: Arc<MotionMailbox>,
    limits: Vec<MotionLimits>,
    timeout: Duration,
    _lock: MotionLock,
}

impl MovableUrArm {
    /// Makes the checks that need no connection to the controller. The error is the reason why the
    /// arm cannot be moved as configured.
    pub fn check(motion: &MotionConfig) -> Result<(), String> {
        if motion.on_loss != OnLoss::Hold {
            let reason = "without setpoints it brakes and holds, which cannot be changed: \
                          set arm.motion.on_loss = \"hold\"";
            return Err(reason.to_owned());
        }
        if motion.timeout < MIN_TIMEOUT {
            let timeout = motion.timeout;
            return Err(format!(
                "arm.motion.timeout_millis is {timeout:?}, shorter than five cycles of a controller: set at least {MIN_TIMEOUT:?}"
            ));
        }
        Ok(())
    }

    /// Connects like [`UrArm::open`], and prepares to move. Before the first target, nothing moves,
    /// and no program is sent.
    ///
    /// `motion.limits` are in the order of the joints.
    pub fn open(config: &ArmConfig, motion: &MotionConfig) -> Result<Self, Error> {
        let address = config.address.clone();
        let failed = |reason| fault(&address, reason);
        Self::check(motion).map_err(failed)?;
        let controller = ControllerAddress::parse(&address).map_err(failed)?;
        // One controller may have several names.
        let resolved = controller.resolve(Interface::Rtde).map_err(failed)?;
        let lock = MotionLock::take(&resolved[0].ip().to_string())?;
        let mailbox = Arc::new(MotionMailbox::default());
        let device = format!("arm at {address}");
        let arm = UrArm::open_to_move(config, |rate_hz| {
            MotionLoop::new(device, Arc::clone(&mailbox), motion.limits.clone(), rate_hz)
        })?;
        Ok(Self {
            address,
            controller,
            arm,
            mailbox,
            limits: motion.limits.clone(),
            timeout: motion.timeout,
            _lock: lock,
        })
    }

    /// Statistics of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.arm.statistics()
    }

    /// Statistics of the setpoints so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.mailbox.lock().statistics.clone()
    }

    /// The reason why the robot accepts no motion, according to its newest state.
    #[cfg(test)]
    pub(super) fn blocking_reason(&self) -> Option<String> {
        self.mailbox.lock().blocking_reason.clone()
    }

    fn fault(&self, reason: impl Into<String>) -> Error {
        fault(&self.address, reason.into())
    }

    /// Starts a motion towards a target, and waits until its program runs.
    fn start_motion(&mut self, target: &JointTarget) -> Result<(), Error> {
        // Wait for a motion that is just ending.
        let Some(mailbox_state) = self
            .mailbox
            .wait(STOP_TIMEOUT, |mailbox_state| mailbox_state.is_idle)
        else {
            return Err(self.fault("the previous motion does not end"));
        };
        let problem = refusal(&mailbox_state).or_else(|| mailbox_state.blocking_reason.clone());
        // The requests below wait for the controller, and the thread needs the lock in every cycle.
        drop(mailbox_state);
        if let Some(reason) = problem {
            return Err(self.fault(reason));
        }
        // A controller in local control ignores programs from the network without an answer. A
        // dashboard server that is missing or disabled is no reason to refuse.
        if dashboard::is_in_remote_control(&self.controller) == Ok(Some(false)) {
            return Err(self.fault(
                "it is in local control: select Remote Control in the upper right corner of the pendant",
            ));
        }
        let session = new_session();
        self.mailbox.update(|mailbox_state| {
            mailbox_state.requested_session = Some(session);
            mailbox_state.start_error = None;
            mailbox_state.accepts_commands = true;
            mailbox_state.is_idle = false;
            mailbox_state.command = Some(MotionCommand::SetTarget(target.clone()));
            // The motion is set here and not by the thread, because a caller may wait for its end
            // as soon as this function returns.
            if !matches!(mailbox_state.motion, Motion::Stopped { .. }) {
                mailbox_state.motion = Motion::Moving;
            }
        });
        // The connection stays open until the program runs. The controller reads it when it has
        // time.
        let connection = self.send_program(session);
        if let Err(reason) = &connection {
            self.mailbox
                .update(|mailbox_state| mailbox_state.start_error = Some(reason.clone()));
        }
        let Some(mailbox_state) = self.mailbox.wait(START_TIMEOUT, |mailbox_state| {
            mailbox_state.is_running || mailbox_state.is_idle || mailbox_state.is_lost
        }) else {
            return Err(self.fault("it sends no states while its program starts"));
        };
        let failure = mailbox_state.start_error.clone();
        let failure = failure.or_else(|| refusal(&mailbox_state));
        drop(mailbox_state);
        match failure {
            Some(reason) => Err(self.fault(reason)),
            None => Ok(()),
        }
    }

    fn send_program(&self, session: i32) -> Result<std::net::TcpStream, String> {
        let brake_rad_s2 = self
            .limits
            .iter()
            .map(|joint| joint.acceleration)
            .fold(MIN_BRAKE_RAD_S2, f64::max);
        let max_rad_s = self
            .limits
            .iter()
            .map(|joint| joint.velocity)
            .fold(0.0, f64::max);
        let text = program(&ProgramConfig {
            session,
            timeout: self.timeout,
            brake_rad_s2,
            brake_time: Duration::from_secs_f64(max_rad_s / brake_rad_s2),
        });
        let mut stream = self.controller.connect(Interface::Script)?;
        stream
            .write_all(text.as_bytes())
            .map_err(|error| format!("cannot send the program to it: {error}"))?;
        Ok(stream)
    }

    /// Clamps a target to the joints' ranges.
    fn clamp(&self, target: &JointTarget) -> Result<JointTarget, String> {
        let n = target.position.len();
        if n != self.limits.len() {
            return Err(format!(
                "the target has {n} joints, but the arm has {}",
                self.limits.len()
            ));
        }
        let mut position = target.position.clone();
        for (ix, (position, joint)) in position.iter_mut().zip(&self.limits).enumerate() {
            if !position.is_finite() {
                return Err(format!(
                    "the target of joint {} is not a finite number: {position}",
                    ix + 1
                ));
            }
            *position = position.clamp(joint.position[0], joint.position[1]);
        }
        Ok(JointTarget { position })
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

/// A number for a motion that differs from those of earlier motions, also of other processes.
#[expect(clippy::cast_possible_truncation, reason = "any bits will do")]
fn new_session() -> i32 {
    // A session is positive, because zero means that no motion is requested.
    ((clock::now().0 / 1000) as i32 & i32::MAX).max(1)
}

impl Arm for MovableUrArm {
    fn joint_names(&self) -> &[String] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        self.arm.read(timeout)
    }
}

impl MovableArm for MovableUrArm {
    fn command(&mut self, target: &JointTarget) -> Result<JointTarget, Error> {
        // The generator clamps as well, but on another thread. Clamping here gives the caller the
        // accepted target at once.
        let target = self.clamp(target).map_err(|reason| self.fault(reason))?;
        let mut mailbox_state = self.mailbox.lock();
        if let Some(reason) = refusal(&mailbox_state) {
            drop(mailbox_state);
            return Err(self.fault(reason));
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

    /// Ends a protective stop if there is one. Other stops must be ended by a person first. In this
    /// case, the error names the cause.
    fn recover(&mut self) -> Result<(), Error> {
        let Some(mailbox_state) = self.mailbox.wait(STOP_TIMEOUT, |mailbox_state| {
            mailbox_state.is_idle || mailbox_state.is_lost
        }) else {
            return Err(self.fault("a motion is active"));
        };
        let Motion::Stopped { reason } = mailbox_state.motion.clone() else {
            return Ok(());
        };
        let is_lost = mailbox_state.is_lost;
        let is_protective_stop = mailbox_state.is_protective_stop;
        let blocking_reason = mailbox_state.blocking_reason.clone();
        drop(mailbox_state);
        if is_lost {
            return Err(self.fault(reason));
        }
        if is_protective_stop {
            dashboard::unlock_protective_stop(&self.controller)
                .map_err(|reason| self.fault(reason))?;
        } else if let Some(reason) = blocking_reason {
            return Err(self.fault(reason));
        }
        // States from before the end of the stop may still arrive.
        let Some(mut mailbox_state) = self.mailbox.wait(SETTLE_TIMEOUT, |mailbox_state| {
            mailbox_state.blocking_reason.is_none()
        }) else {
            return Err(self.fault("it ended the protective stop but is not ready"));
        };
        mailbox_state.motion = Motion::Holding;
        Ok(())
    }
}

impl Drop for MovableUrArm {
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
