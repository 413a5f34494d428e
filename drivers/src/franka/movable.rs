//! A movable arm. A motion starts with the first target and ends one second after the arm has come
//! to rest.

use super::connection::Connection;
use super::limits::RobotLimits;
use super::mailbox::{MotionMailbox, RobotExchange};
use super::motion_loop::MotionLoop;
use super::request::{self, ContactConfig};
use super::{ArmConfig, FrankaArm, MotionStatistics, StateStatistics};
use crate::motion::{
    ControlledArm, JointTarget, Motion, MotionCommand, MotionConfig, MotionController,
    MotionLimits, MotionLock, MovableArm, OnLoss, SteeringPort,
};
use crate::{Arm, Error};
use franka::{FciVersion, RobotMode};
use kinematics::JointState;
use std::net::ToSocketAddrs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// A robot stops on its own after 20 ms without a command.
const ROBOT_TIMEOUT: Duration = Duration::from_millis(20);
/// A Franka arm that is moved by joint positions, under the joint impedance controller of the
/// robot.
///
/// A motion of the robot lasts from the first target until the arm has been at rest for a second.
/// Between motions, the robot holds the arm, and a person may guide it by hand. Dropping this value
/// brings the arm to rest and frees the robot's interface.
#[derive(Debug)]
pub struct MovableFrankaArm {
    arm: FrankaArm,
    moved: ControlledArm<Controller>,
    _lock: MotionLock,
}

/// The requests that start motions and end stops.
struct Controller {
    address: String,
    connection: Arc<Connection>,
    mailbox: Arc<MotionMailbox>,
    contact: ContactConfig,
    robot: RobotLimits,
    limits: Vec<MotionLimits>,
    /// Whether the settings have been sent.
    is_set: AtomicBool,
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
            let _ = connected.set((Arc::clone(connection), robot.clone(), limits.clone()));
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
        let (connection, robot, limits) = connected
            .into_inner()
            .expect("an arm that is open has a connection");
        let controller = Controller {
            address,
            connection,
            mailbox,
            contact: contact.clone(),
            robot,
            limits,
            is_set: AtomicBool::new(false),
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

    /// Statistics of the commands so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.moved
            .controller()
            .mailbox
            .lock()
            .robot
            .statistics
            .clone()
    }

    /// Limits of the commanded motions, in the order of the joints.
    pub fn limits(&self) -> &[MotionLimits] {
        self.moved.controller().limits()
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

    fn start(&self, command: Option<MotionCommand>) -> Result<(), String> {
        let mode = self.mailbox.lock().robot.mode;
        if let Some(why) = request::blocking_reason(mode) {
            return Err(why.to_owned());
        }
        // Settings are sent with the first motion. A program that only opens the arm therefore
        // changes no settings.
        if !self.is_set.load(Ordering::Relaxed) {
            request::set(&self.connection, &self.contact)?;
            self.is_set.store(true, Ordering::Relaxed);
        }
        let id = request::start_motion(&self.connection)
            .map_err(|why| format!("it refused to start a motion: {why}"))?;
        self.mailbox.update(|mailbox_state| {
            mailbox_state.robot.started_motion = Some(id);
            mailbox_state.control.begin(command);
        });
        Ok(())
    }

    /// Clears the reflex if a reflex stopped the arm. If the user stop is active or joints are
    /// locked, a person must release them first. In this case, the error names the cause.
    fn recover(&self) -> Result<(), String> {
        let mode = self.mailbox.lock().robot.mode;
        if mode == RobotMode::Reflex {
            return request::recover(&self.connection);
        }
        // There is no reflex to clear. The robot either became ready in the meantime, or needs a
        // person.
        match request::blocking_reason(mode) {
            Some(why) => Err(why.to_owned()),
            None => Ok(()),
        }
    }

    fn is_ready(robot: &RobotExchange) -> bool {
        robot.mode == RobotMode::Idle
    }

    fn check_brake_factor(&self, factor: f64) -> Result<(), String> {
        self.robot.check_brake_factor(&self.limits, factor)
    }

    fn fault(&self, reason: String) -> Error {
        Error::Fci {
            address: self.address.clone(),
            reason,
        }
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

impl Drop for MovableFrankaArm {
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
