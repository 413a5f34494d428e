//! Plans the motion of a moving base with an arm through the room.

use super::body::lowest_z_m;
use super::follower::{TwinFollower, TwinTour};
use super::model::TwinModel;
use super::viewpoints::sampled;
use crate::base::BaseMotion;
use crate::config::{Config, Parent};
use crate::joints::Joints;
use kinematics::Transform;
use nalgebra::Vector3;
use std::sync::Arc;

/// How the robot moves in the room.
pub(crate) struct RoomPlan {
    pub(crate) motion: BaseMotion,
    /// The motion of the arm. `None` without an arm.
    pub(crate) follower: Option<TwinFollower>,
}

/// Plans a lap around the pedestal. The arm points its camera ahead, and sways a little.
pub(crate) fn plan(config: &Config, model: &Arc<TwinModel>) -> RoomPlan {
    let follower = (model.n_joints() > 0).then(|| {
        TwinFollower::new(
            Arc::clone(model),
            TwinTour::Sway(config.speed),
            posture(config, model),
        )
    });
    let motion = BaseMotion::Rolling {
        speed: config.speed,
        height_m: -lowest_z_m(model, &Transform::identity()),
    };
    RoomPlan { motion, follower }
}

/// The sampled posture in which the camera on the flange looks ahead and is upright, close to the
/// rest posture.
fn posture(config: &Config, model: &TwinModel) -> Joints {
    /// Weight of the distance from the rest posture. With this weight, the closest of several equal
    /// views is selected.
    const REST_WEIGHT: f64 = 0.05;
    let rest = model.rest();
    let Some(camera) = config
        .cameras
        .iter()
        .find(|camera| camera.parent == Parent::Flange)
    else {
        return rest;
    };
    let viewpoints = sampled(model, &Transform::identity(), &camera.parent_from_camera);
    let rating = |base_from_camera: &Transform, position: &Joints| {
        let forward = base_from_camera.rotation * Vector3::z();
        let down = base_from_camera.rotation * Vector3::y();
        // The motion of the base keeps the pedestal ahead. The pedestal is lower than most cameras.
        forward.x
            - 0.5 * (forward.z + 0.15).abs()
            - 0.5 * down.z
            - REST_WEIGHT * (position - &rest).norm()
    };
    viewpoints
        .into_iter()
        .map(|viewpoint| {
            let rating = rating(&viewpoint.world_from_camera, &viewpoint.position);
            (rating, viewpoint.position)
        })
        .max_by(|(a, _), (b, _)| a.total_cmp(b))
        .map_or(rest.clone(), |(_, position)| position)
}
