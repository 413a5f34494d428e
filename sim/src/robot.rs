//! The whole robot: base motion and, if there is an arm, arm motion.

use crate::Error;
use crate::arm::{Arm, JointReading, STEP_NANOS};
use crate::base::BaseMotion;
use crate::motors::MotorizedArm;
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
        let arm_from_flange = self
            .joints_rad
            .as_ref()
            .map_or_else(Transform::identity, panda::base_from_flange);
        self.world_from_base * self.base_from_arm * arm_from_flange
    }
}

/// What moves the joints of an arm.
enum ArmMotion {
    /// MuJoCo's dynamics.
    Simulated(Box<Arm>),
    /// Emulated motors, in real time.
    Motorized(MotorizedArm),
}

/// The moving robot.
pub(crate) struct Robot {
    arm: Option<ArmMotion>,
    motion: BaseMotion,
    base_from_arm: Transform,
    n_steps: i64,
}

impl Robot {
    pub(crate) fn new(arm: Option<Arm>, motion: BaseMotion, base_from_arm: Transform) -> Self {
        let arm = arm.map(|arm| ArmMotion::Simulated(Box::new(arm)));
        Self {
            arm,
            motion,
            base_from_arm,
            n_steps: 0,
        }
    }

    pub(crate) fn motion(&self) -> &BaseMotion {
        &self.motion
    }

    /// The arm, if there is one that the simulation moves.
    pub(crate) fn arm_mut(&mut self) -> Option<&mut Arm> {
        match &mut self.arm {
            Some(ArmMotion::Simulated(arm)) => Some(arm),
            Some(ArmMotion::Motorized(_)) | None => None,
        }
    }

    /// Replaces the arm by one that emulated motors move.
    pub(crate) fn follow_motors(&mut self, arm: MotorizedArm) {
        self.arm = Some(ArmMotion::Motorized(arm));
    }

    /// Advances by one step. Returns the time before the step, nanoseconds, and the joint reading
    /// at that time. Emulated motors report their joints themselves. In this case, the step waits
    /// for their reports, and fails if the motors have stopped.
    pub(crate) fn step(&mut self) -> Result<(i64, Option<JointReading>), Error> {
        let nanos = self.n_steps * STEP_NANOS;
        self.n_steps += 1;
        let reading = match &mut self.arm {
            Some(ArmMotion::Simulated(arm)) => Some(arm.step()),
            // The motors run on another clock, which the simulation follows.
            Some(ArmMotion::Motorized(arm)) if !arm.wait_until(nanos) => {
                return Err(Error::MotorsStopped);
            }
            Some(ArmMotion::Motorized(_)) | None => None,
        };
        Ok((nanos, reading))
    }

    /// The robot at a time in its recent past; `None` if the stored positions of the arm do not
    /// cover that time.
    pub(crate) fn at(&self, nanos: i64) -> Option<RobotPose> {
        let joints_rad = match &self.arm {
            Some(ArmMotion::Simulated(arm)) => Some(arm.position_at(nanos)?),
            Some(ArmMotion::Motorized(arm)) => Some(arm.position_at(nanos)?),
            None => None,
        };
        let world_from_base = self.motion.world_from_base(nanos as f64 * 1e-9);
        Some(RobotPose {
            world_from_base,
            base_from_arm: self.base_from_arm,
            joints_rad,
        })
    }
}
