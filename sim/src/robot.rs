//! The whole robot, with the motion of its base and, if it has an arm, the motion of the arm.

use crate::Error;
use crate::arm::{Arm, JointReading, STEP_NANOS};
use crate::base::{BaseMotion, LAP_M};
use crate::joints::Joints;
use crate::motors::MotorizedArm;
use crate::panda;
use crate::steered_base::BasePath;
use crate::twin::TwinModel;
use kinematics::Transform;
use std::sync::Arc;

/// Pose of the robot at one instant.
#[derive(Clone, Debug)]
pub(crate) struct RobotPose {
    pub(crate) world_from_base: Transform,
    /// Pose of the flange, or of the arm's mounting point if there is no arm.
    pub(crate) world_from_flange: Transform,
    /// Positions of all joints of the MuJoCo model, in its order. The list is empty without joints.
    pub(crate) model_positions: Vec<f64>,
}

/// Where the links of the robot are.
#[derive(Clone)]
pub(crate) enum RobotKinematics {
    /// The robot of a scene without an arm. Contains the pose of the mounting point on the base.
    NoArm(Transform),
    /// The scene's own arm. Contains its pose on the base.
    Panda(Transform),
    /// The robot of a rig file.
    Twin(Arc<TwinModel>),
}

impl RobotKinematics {
    /// The robot with its joints at `position`, which is `None` if there is no arm.
    fn pose(&self, world_from_base: Transform, position: Option<&Joints>) -> RobotPose {
        let (world_from_flange, model_positions) = match (self, position) {
            (Self::Panda(base_from_arm), Some(position)) => {
                let arm_from_flange =
                    panda::base_from_flange(&panda::Joints::from_column_slice(position.as_slice()));
                (
                    world_from_base * base_from_arm * arm_from_flange,
                    position.as_slice().to_vec(),
                )
            }
            (Self::NoArm(base_from_arm) | Self::Panda(base_from_arm), _) => {
                (world_from_base * base_from_arm, Vec::new())
            }
            (Self::Twin(model), position) => {
                let rest = Joints::zeros(0);
                let position = position.unwrap_or(&rest);
                (
                    world_from_base * model.base_from_flange(position),
                    model.model_positions(position),
                )
            }
        };
        RobotPose {
            world_from_base,
            world_from_flange,
            model_positions,
        }
    }
}

/// What moves the joints of an arm.
enum ArmMotion {
    /// The simulation.
    Simulated(Box<Arm>),
    /// Emulated motors, in real time.
    Motorized(MotorizedArm),
}

/// The moving robot.
pub(crate) struct Robot {
    arm: Option<ArmMotion>,
    motion: BaseMotion,
    /// The path of the base after its tour, if an operator may drive it.
    path: Option<BasePath>,
    kinematics: RobotKinematics,
    n_steps: i64,
}

impl Robot {
    pub(crate) fn new(arm: Option<Arm>, motion: BaseMotion, kinematics: RobotKinematics) -> Self {
        let arm = arm.map(|arm| ArmMotion::Simulated(Box::new(arm)));
        Self {
            arm,
            motion,
            path: None,
            kinematics,
            n_steps: 0,
        }
    }

    /// The tour of the base.
    pub(crate) fn motion(&self) -> &BaseMotion {
        &self.motion
    }

    /// Lets an operator take the base over from its tour.
    pub(crate) fn steer_base(&mut self, path: BasePath) {
        self.path = Some(path);
    }

    /// True pose of the base at a time, nanoseconds.
    pub(crate) fn world_from_base(&self, nanos: i64) -> Transform {
        let steered = self
            .path
            .as_ref()
            .and_then(|path| path.world_from_base(nanos));
        steered.unwrap_or_else(|| self.motion.world_from_base(nanos as f64 * 1e-9))
    }

    /// Completed fraction of the walk. The reported pose drifts with it.
    pub(crate) fn walked_frac(&self, nanos: i64) -> f64 {
        let steered = self
            .path
            .as_ref()
            .and_then(|path| path.walked_frac(nanos, LAP_M));
        steered.unwrap_or_else(|| self.motion.walked_frac(nanos as f64 * 1e-9))
    }

    /// The arm, if there is one that the simulation moves.
    pub(crate) fn arm_mut(&mut self) -> Option<&mut Arm> {
        match &mut self.arm {
            Some(ArmMotion::Simulated(arm)) => Some(arm),
            Some(ArmMotion::Motorized(_)) | None => None,
        }
    }

    /// Whether a client or an operator commands the arm or the base. Commands may come at any time.
    pub(crate) fn is_commanded(&self) -> bool {
        matches!(&self.arm, Some(ArmMotion::Simulated(arm)) if arm.is_commanded())
            || self.path.as_ref().is_some_and(BasePath::has_begun)
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
        if let Some(path) = &self.path {
            path.step(nanos);
        }
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

    /// The robot at a time in its recent past. `None` if the stored positions of the arm do not
    /// cover this time.
    pub(crate) fn at(&self, nanos: i64) -> Option<RobotPose> {
        let position = match &self.arm {
            Some(ArmMotion::Simulated(arm)) => Some(arm.position_at(nanos)?),
            Some(ArmMotion::Motorized(arm)) => Some(arm.position_at(nanos)?),
            None => None,
        };
        let world_from_base = self.world_from_base(nanos);
        Some(self.kinematics.pose(world_from_base, position.as_ref()))
    }
}
