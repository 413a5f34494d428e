//! A movable arm. A motion starts with the first target and ends one second after the arm has come
//! to rest.

use super::address::{ControllerAddress, Interface};
use super::arm::fault;
use super::mailbox::{MotionMailbox, RobotExchange};
use super::motion_loop::MotionLoop;
use super::program::{ProgramConfig, program};
use super::statistics::MotionStatistics;
use super::{ArmConfig, StateStatistics, UrArm, dashboard};
use crate::motion::{
    ControlledArm, Exchange, JointTarget, Motion, MotionCommand, MotionConfig, MotionController,
    MotionLimits, MotionLock, MovableArm, OnLoss, SteeringPort,
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
/// An arm of Universal Robots that is moved by joint positions.
///
/// A motion lasts from the first target until the arm has been at rest for a second. Between
/// motions, no program runs on the controller. Dropping this value brings the arm to rest and
/// closes the connection.
#[derive(Debug)]
pub struct MovableUrArm {
    arm: UrArm,
    moved: ControlledArm<Controller>,
    _lock: MotionLock,
}

/// The requests that start motions and end stops.
struct Controller {
    address: String,
    controller: ControllerAddress,
    mailbox: Arc<MotionMailbox>,
    limits: Vec<MotionLimits>,
    timeout: Duration,
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
        let controller = Controller {
            address,
            controller,
            mailbox,
            limits: motion.limits.clone(),
            timeout: motion.timeout,
        };
        Ok(Self {
            arm,
            moved: ControlledArm::new(controller),
            _lock: lock,
        })
    }

    /// Statistics of the states so far.
    pub fn statistics(&self) -> StateStatistics {
        self.arm.statistics()
    }

    /// Statistics of the setpoints so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.moved
            .controller()
            .mailbox
            .lock()
            .robot
            .statistics
            .clone()
    }

    /// The reason why the robot accepts no motion, according to its newest state.
    #[cfg(test)]
    pub(super) fn blocking_reason(&self) -> Option<String> {
        self.moved
            .controller()
            .mailbox
            .lock()
            .robot
            .blocking_reason
            .clone()
    }
}

impl MotionController for Controller {
    type Robot = RobotExchange;

    fn mailbox(&self) -> &MotionMailbox {
        &self.mailbox
    }

    fn limits(&self) -> &[MotionLimits] {
        &self.limits
    }

    /// Returns when the program of the motion runs.
    fn start(&self, command: Option<MotionCommand>) -> Result<(), String> {
        // The lock is released at the end of this line, because the requests below wait for the
        // controller.
        let problem = self.mailbox.lock().robot.blocking_reason.clone();
        problem.map_or(Ok(()), Err)?;
        // A controller in local control ignores programs from the network without an answer. A
        // dashboard server that is missing or disabled is no reason to refuse.
        if dashboard::is_in_remote_control(&self.controller) == Ok(Some(false)) {
            return Err("it is in local control: select Remote Control in the upper right corner of the pendant".to_owned());
        }
        let session = new_session();
        self.mailbox.update(|mailbox_state| {
            mailbox_state.robot.requested_session = Some(session);
            mailbox_state.robot.start_error = None;
            mailbox_state.control.begin(command);
        });
        // The connection stays open until the program runs. The controller reads it when it has
        // time.
        let connection = self.send_program(session);
        if let Err(reason) = &connection {
            self.mailbox
                .update(|mailbox_state| mailbox_state.robot.start_error = Some(reason.clone()));
        }
        let is_decided = |mailbox_state: &Exchange<RobotExchange>| {
            let control = &mailbox_state.control;
            mailbox_state.robot.is_running || control.is_idle || control.is_lost
        };
        let Some(mailbox_state) = self.mailbox.wait(START_TIMEOUT, is_decided) else {
            return Err("it sends no states while its program starts".to_owned());
        };
        let failure = mailbox_state.robot.start_error.clone();
        let failure = failure.or_else(|| mailbox_state.control.refusal());
        failure.map_or(Ok(()), Err)
    }

    /// Ends a protective stop if there is one. Other stops must be ended by a person first. In this
    /// case, the error names the cause.
    fn recover(&self) -> Result<(), String> {
        let (is_protective_stop, blocking_reason) = {
            let exchange = self.mailbox.lock();
            let robot = &exchange.robot;
            (robot.is_protective_stop, robot.blocking_reason.clone())
        };
        if is_protective_stop {
            return dashboard::unlock_protective_stop(&self.controller);
        }
        blocking_reason.map_or(Ok(()), Err)
    }

    fn is_ready(robot: &RobotExchange) -> bool {
        robot.blocking_reason.is_none()
    }

    fn check_brake_factor(&self, _: f64) -> Result<(), String> {
        // The controller publishes no limits of the acceleration.
        Ok(())
    }

    fn fault(&self, reason: String) -> Error {
        fault(&self.address, reason)
    }
}

impl Controller {
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
        self.moved.command(target)
    }

    fn motion(&self) -> Motion {
        self.moved.motion()
    }

    fn stop(&mut self) -> Result<(), Error> {
        self.moved.stop();
        Ok(())
    }

    fn recover(&mut self) -> Result<(), Error> {
        self.moved.recover()
    }

    fn steering_port(&mut self, brake_factor: f64) -> Result<SteeringPort, Error> {
        self.moved.steering_port(brake_factor)
    }
}

impl Drop for MovableUrArm {
    fn drop(&mut self) {
        let is_over = self.moved.shut_down();
        let address = &self.moved.controller().address;
        if !is_over {
            log::warn!("arm at {address}: the motion did not end");
        }
        let statistics = self.motion_statistics();
        if statistics.n_motions > 0 {
            log::info!("arm at {address}: {statistics}");
        }
    }
}
