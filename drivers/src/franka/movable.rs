//! An arm that is moved: motions begin with the first target and end a second after the arm came to rest.

use super::desk::{Board, Desk, Order};
use super::limits::{RobotLimits, into_range};
use super::mover::Mover;
use super::request::{self, ContactConfig};
use super::session::Session;
use super::{ArmConfig, FrankaArm, MotionStatistics, Statistics};
use crate::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use crate::{Arm, Error};
use franka::{FciVersion, RobotMode};
use kinematics::JointState;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// A robot stops by itself after 20 ms without a command.
const ROBOT_TIMEOUT: Duration = Duration::from_millis(20);
/// How long an arm may take to come to rest and end its motion.
const MAX_STOPPING: Duration = Duration::from_secs(5);
/// How long states may say otherwise after the robot answered.
const MAX_SETTLING: Duration = Duration::from_secs(2);

/// A Franka arm that is moved by joint positions, under the robot's own joint impedance controller.
///
/// A motion of the robot runs from the first target until the arm has been at rest for a second; in between the robot holds
/// the arm by itself and lets a person guide it by hand. Dropping it brings the arm to rest and frees the robot's interface.
#[derive(Debug)]
pub struct MovableFrankaArm {
    address: String,
    arm: FrankaArm,
    session: Arc<Session>,
    desk: Arc<Desk>,
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
        let desk = Arc::new(Desk::default());
        let made = OnceLock::new();
        let arm = FrankaArm::open_with(config, |session, first| {
            let robot = match session.version {
                FciVersion::V5 => RobotLimits::panda(),
                FciVersion::V10 => RobotLimits::of_description(&request::description(session)?)?,
            };
            let limits = robot.allowed(&motion.limits)?;
            let device = format!("arm at {}", config.address);
            // The closure is called once.
            let _ = made.set((Arc::clone(session), limits.clone()));
            let mut mover = Mover::new(device, Arc::clone(session), Arc::clone(&desk), robot, limits);
            mover.take_mode(first);
            Ok(Some(mover))
        })?;
        let (session, limits) = made.into_inner().expect("an arm that is open has a session");
        Ok(Self { address, arm, session, desk, contact: contact.clone(), limits, is_set: false })
    }

    /// What became of the states so far.
    pub fn statistics(&self) -> Statistics {
        self.arm.statistics()
    }

    /// What became of the commands so far.
    pub fn motion_statistics(&self) -> MotionStatistics {
        self.desk.lock().statistics.clone()
    }

    /// What is asked of the joints at most, in their order.
    pub fn limits(&self) -> &[MotionLimits] {
        &self.limits
    }

    fn fault(&self, reason: impl Into<String>) -> Error {
        Error::Fci { address: self.address.clone(), reason: reason.into() }
    }

    /// Begins a motion that heads for a target.
    fn begin(&mut self, target: &JointTarget) -> Result<(), Error> {
        // A motion that is just ending ends first.
        let Some(board) = self.desk.wait(MAX_STOPPING, |board| board.is_idle) else {
            return Err(self.fault("a motion before this does not end"));
        };
        let mode = board.mode;
        let refusal = refusal(&board);
        drop(board);
        if let Some(why) = refusal.or_else(|| request::hindrance(mode).map(str::to_owned)) {
            return Err(self.fault(why));
        }
        if !self.is_set {
            request::set(&self.session, &self.contact).map_err(|why| self.fault(why))?;
            self.is_set = true;
        }
        let id = request::begin(&self.session);
        let id = id.map_err(|why| self.fault(format!("it lets no motion begin: {why}")))?;
        self.desk.tell(|board| {
            (board.begun, board.takes_orders, board.is_idle) = (Some(id), true, false);
            (board.order, board.motion) = (Some(Order::Head(target.clone())), Motion::Moving);
        });
        Ok(())
    }
}

/// Why an arm takes no target.
fn refusal(board: &Board) -> Option<String> {
    match &board.motion {
        Motion::Stopped { reason } => Some(format!("it takes no target before it is recovered: {reason}")),
        Motion::Held | Motion::Moving => None,
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
        let target = into_range(target, &self.limits).map_err(|why| self.fault(why))?;
        let mut board = self.desk.lock();
        if let Some(why) = refusal(&board) {
            drop(board);
            return Err(self.fault(why));
        }
        if board.takes_orders {
            (board.order, board.motion) = (Some(Order::Head(target.clone())), Motion::Moving);
            return Ok(target);
        }
        drop(board);
        self.begin(&target)?;
        Ok(target)
    }

    fn motion(&self) -> Motion {
        self.desk.lock().motion.clone()
    }

    fn stop(&mut self) -> Result<(), Error> {
        let mut board = self.desk.lock();
        if board.takes_orders {
            board.order = Some(Order::Stop);
        }
        Ok(())
    }

    /// Clears the reflex where one stopped it; a person has to release a user stop or unlock joints first, and is told so.
    fn recover(&mut self) -> Result<(), Error> {
        let Some(board) = self.desk.wait(MAX_STOPPING, |board| board.is_idle || board.is_lost) else {
            return Err(self.fault("a motion runs"));
        };
        let (mode, is_lost, motion) = (board.mode, board.is_lost, board.motion.clone());
        drop(board);
        match (motion, mode) {
            (Motion::Stopped { reason }, _) if is_lost => return Err(self.fault(reason)),
            (Motion::Stopped { .. }, RobotMode::Reflex) => {
                request::recover(&self.session).map_err(|why| self.fault(why))?;
            }
            (Motion::Stopped { .. }, mode) => {
                if let Some(why) = request::hindrance(mode) {
                    return Err(self.fault(why));
                }
            }
            (Motion::Held | Motion::Moving, _) => return Ok(()),
        }
        // States from before may still be on their way.
        let Some(mut board) = self.desk.wait(MAX_SETTLING, |board| board.mode == RobotMode::Idle) else {
            return Err(self.fault("it says that it recovered, and is not ready"));
        };
        board.motion = Motion::Held;
        Ok(())
    }
}

impl Drop for MovableFrankaArm {
    fn drop(&mut self) {
        self.desk.tell(|board| {
            board.is_leaving = true;
            board.order = board.takes_orders.then_some(Order::Stop);
        });
        if self.desk.wait(MAX_STOPPING, |board| board.is_idle || board.is_lost).is_none() {
            log::warn!("arm at {}: its motion does not end", self.address);
        }
        let statistics = self.motion_statistics();
        if statistics.n_motions > 0 {
            log::info!("arm at {}: {statistics}", self.address);
        }
    }
}
