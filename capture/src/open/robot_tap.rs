//! The newest reports of the base and the arm of a run, for a program that cannot wait for the
//! input of the run. The input waits while the trainer is busy, but each device is read by its own
//! thread.

use drivers::{Arm, Base, BasePose, Error, FlangeDifference};
use kinematics::JointState;
use parking_lot::Mutex;
use std::sync::Arc;
use std::time::Duration;

/// The newest reports of a robot. Clones refer to the same robot.
#[derive(Clone, Debug, Default)]
pub(super) struct RobotTap(Arc<Mutex<Reports>>);

#[derive(Debug, Default)]
struct Reports {
    pose: Option<BasePose>,
    joints: Option<JointState>,
}

impl RobotTap {
    /// A base whose poses are also stored here.
    pub(super) fn of_base(&self, base: Box<dyn Base>) -> Box<dyn Base> {
        Box::new(TappedBase {
            base,
            tap: self.clone(),
        })
    }

    /// An arm whose joint states are also stored here.
    pub(super) fn of_arm(&self, arm: Box<dyn Arm>) -> Box<dyn Arm> {
        Box::new(TappedArm {
            arm,
            tap: self.clone(),
        })
    }

    /// The newest pose of the base.
    pub(super) fn pose(&self) -> Option<BasePose> {
        self.0.lock().pose.clone()
    }

    /// The newest joint state of the arm, without offsets.
    pub(super) fn joints(&self) -> Option<JointState> {
        self.0.lock().joints.clone()
    }
}

struct TappedBase {
    base: Box<dyn Base>,
    tap: RobotTap,
}

impl Base for TappedBase {
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error> {
        let pose = self.base.next_pose(timeout)?;
        self.tap.0.lock().pose = Some(pose.clone());
        Ok(pose)
    }
}

struct TappedArm {
    arm: Box<dyn Arm>,
    tap: RobotTap,
}

impl Arm for TappedArm {
    fn joint_names(&self) -> &[String] {
        self.arm.joint_names()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, Error> {
        let state = self.arm.read(timeout)?;
        self.tap.0.lock().joints = Some(state.clone());
        Ok(state)
    }

    fn flange_difference(&self) -> Option<FlangeDifference> {
        self.arm.flange_difference()
    }
}
