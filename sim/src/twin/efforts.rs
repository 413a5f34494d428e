//! Efforts of the joints of a robot from a URDF, by MuJoCo's inverse dynamics.

use super::model::TwinModel;
use crate::joints::Joints;
use mujoco_rs::prelude::{MjData, MjModel};
use std::sync::Arc;

/// Computes the efforts that a motion needs.
pub(crate) struct Efforts {
    data: MjData<Arc<MjModel>>,
    model: Arc<TwinModel>,
    velocity_before: Option<Joints>,
}

impl Efforts {
    /// `scene`: MuJoCo's model with the body of `model`.
    pub(crate) fn new(scene: Arc<MjModel>, model: Arc<TwinModel>) -> Self {
        Self {
            data: MjData::new(scene),
            model,
            velocity_before: None,
        }
    }

    /// Efforts at a position and velocity, newton meters or newtons. Accelerations are differences
    /// to the velocity of the previous call, `step_secs` earlier.
    pub(crate) fn at(&mut self, position: &Joints, velocity: &Joints, step_secs: f64) -> Joints {
        let acceleration = match &self.velocity_before {
            Some(before) => (velocity - before) / step_secs,
            None => Joints::zeros(velocity.len()),
        };
        self.velocity_before = Some(velocity.clone());
        let model = &self.model;
        self.data
            .qpos_mut()
            .copy_from_slice(&model.model_positions(position));
        self.data
            .qvel_mut()
            .copy_from_slice(&model.model_velocities(velocity));
        self.data
            .qacc_mut()
            .copy_from_slice(&model.model_velocities(&acceleration));
        self.data.inverse();
        model.arm_efforts(self.data.qfrc_inverse())
    }
}
