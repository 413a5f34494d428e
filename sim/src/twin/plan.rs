//! Plans the simulation of a rig file's robot. The plan contains the scene, the place of the scene,
//! and all motion.

use super::body::{BodyPlan, RobotBody, lowest_z_m, robot_body};
use super::description::RobotConfig;
use super::follower::TwinFollower;
use super::model::TwinModel;
use super::{room, table};
use crate::base::BaseMotion;
use crate::config::{Config, Scene};
use crate::{Error, objects};
use kinematics::Transform;
use std::sync::Arc;

/// A robot in its scene.
pub(crate) struct TwinPlan {
    pub(crate) model: Arc<TwinModel>,
    /// Pose of the scene's coordinates in the world.
    pub(crate) world_from_scene: Transform,
    pub(crate) motion: BaseMotion,
    /// The motion of the arm. `None` without an arm.
    pub(crate) follower: Option<TwinFollower>,
    /// The pedestal from the floor to the base. `None` if the robot needs no pedestal.
    pub(crate) pedestal: Option<Pedestal>,
}

/// A post below a robot.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pedestal {
    /// Center in the world, meters.
    pub(crate) center_m: [f64; 3],
    /// Half sizes, meters.
    pub(crate) half_m: [f64; 3],
}

/// Half the width of a pedestal, meters.
const PEDESTAL_HALF_M: f64 = 0.09;
/// Heights below this need no pedestal, meters.
const MIN_PEDESTAL_M: f64 = 0.03;

/// Plans the simulation.
///
/// # Errors
///
/// Fails if the URDF is invalid, if the scene is for another robot, or if a camera cannot see the
/// scene.
pub(crate) fn plan(config: &Config, robot: &RobotConfig) -> Result<TwinPlan, Error> {
    let model = Arc::new(TwinModel::new(robot)?);
    if model.chain().joint_names() != config.joint_names {
        return Err(Error::NJoints {
            got: config.joint_names.len(),
            expected: model.n_joints(),
        });
    }
    match config.scene {
        Scene::StaticArm => {
            let placed = table::PlacedRobot {
                model: &model,
                world_from_base: robot.world_from_base,
                max_blur_px: robot.max_blur_px,
                max_shear_px: robot.max_shear_px,
            };
            let table::TablePlan {
                world_from_scene,
                follower,
            } = table::plan(config, &placed)?;
            Ok(TwinPlan {
                pedestal: pedestal(&model, robot, &world_from_scene),
                world_from_scene,
                motion: BaseMotion::FixedAt(robot.world_from_base),
                follower,
                model,
            })
        }
        Scene::MobileBase => {
            let room::RoomPlan { motion, follower } = room::plan(config, &model);
            Ok(TwinPlan {
                world_from_scene: Transform::identity(),
                motion,
                follower,
                pedestal: None,
                model,
            })
        }
        Scene::MobileArm => Err(Error::SceneOfAnotherRobot {
            scene: config.scene.name(),
        }),
    }
}

/// A pedestal for a robot beside the table. A robot whose base link is not the root has a body
/// below it.
fn pedestal(
    model: &TwinModel,
    robot: &RobotConfig,
    world_from_scene: &Transform,
) -> Option<Pedestal> {
    if model.n_joints() == 0 || !model.stands_on_base() {
        return None;
    }
    let base = robot.world_from_base.translation.vector;
    let top_m = lowest_z_m(model, &robot.world_from_base);
    let bottom_m =
        if objects::is_over_table(&world_from_scene.inverse_transform_point(&base.into())) {
            (world_from_scene * nalgebra::Point3::new(0.0, 0.0, objects::TABLE_Z_M)).z
        } else {
            (world_from_scene * nalgebra::Point3::new(0.0, 0.0, objects::FLOOR_Z_M)).z
        };
    let height_m = top_m - bottom_m;
    (height_m > MIN_PEDESTAL_M).then_some(Pedestal {
        center_m: [base.x, base.y, bottom_m + 0.5 * height_m],
        half_m: [PEDESTAL_HALF_M, PEDESTAL_HALF_M, 0.5 * height_m],
    })
}

impl TwinPlan {
    /// MJCF of the robot.
    pub(crate) fn body(&self, robot: &RobotConfig, on_flange: &str) -> RobotBody {
        robot_body(&self.body_plan(robot, on_flange))
    }

    /// The same robot for another model, without the log.
    pub(crate) fn quiet_body(&self, robot: &RobotConfig, on_flange: &str) -> RobotBody {
        robot_body(&BodyPlan {
            is_logged: false,
            ..self.body_plan(robot, on_flange)
        })
    }

    fn body_plan<'a>(&'a self, robot: &'a RobotConfig, on_flange: &'a str) -> BodyPlan<'a> {
        BodyPlan {
            model: &self.model,
            meshes: &robot.meshes,
            on_flange,
            world_from_base: self.motion.world_from_base(0.0),
            has_moving_base: robot.has_moving_base,
            is_logged: true,
        }
    }
}
