//! The whole robot: base motion and, if there is an arm, arm motion.

use crate::arm::{Arm, JointReading, STEP_NANOS};
use crate::base::BaseMotion;
use crate::panda::{self, Joints};
use kinematics::Transform;

/// Pose of the robot at one instant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RobotPose {
    pub(crate) world_from_base: Transform,
    pub(crate) base_from_arm: Transform,
    /// Joint positions; `None` without an arm.
    pub(crate) joints_rad: Option<Joints>,
}

impl RobotPose {
    /// Pose of the flange, or of the arm's mounting point if there is no arm.
    pub(crate) fn world_from_flange(&self) -> Transform {
        let arm_from_flange = self.joints_rad.as_ref().map_or_else(Transform::identity, panda::base_from_flange);
        self.world_from_base * self.base_from_arm * arm_from_flange
    }
}

/// The moving robot.
pub(crate) struct Robot {
    arm: Option<Arm>,
    motion: BaseMotion,
    base_from_arm: Transform,
    n_steps: i64,
}

impl Robot {
    pub(crate) fn new(arm: Option<Arm>, motion: BaseMotion, base_from_arm: Transform) -> Self {
        Self { arm, motion, base_from_arm, n_steps: 0 }
    }

    pub(crate) fn motion(&self) -> &BaseMotion {
        &self.motion
    }

    /// The arm, if there is one.
    pub(crate) fn arm_mut(&mut self) -> Option<&mut Arm> {
        self.arm.as_mut()
    }

    /// Advances by one step. Returns the time before the step, nanoseconds, and the joint reading at that time.
    pub(crate) fn step(&mut self) -> (i64, Option<JointReading>) {
        let nanos = self.n_steps * STEP_NANOS;
        self.n_steps += 1;
        (nanos, self.arm.as_mut().map(Arm::step))
    }

    /// The robot at a time in its recent past; `None` if the arm's readings do not cover it.
    pub(crate) fn at(&self, nanos: i64) -> Option<RobotPose> {
        let joints_rad = match &self.arm {
            Some(arm) => Some(arm.position_at(nanos)?),
            None => None,
        };
        let world_from_base = self.motion.world_from_base(nanos as f64 * 1e-9);
        Some(RobotPose { world_from_base, base_from_arm: self.base_from_arm, joints_rad })
    }
}
