//! The chain and the shape of the robot that operators steer.

use super::joint_map::JointMap;
use super::steering_loop::SteeredRobot;
use anyhow::Context;
use capture::config::Rig;
use capture::mesh_triangles;
use capture::open::SteeredArm;
use kinematics::Chain;
use kinematics::urdf::{JointKind, Robot};
use std::path::Path;
use steering::Body;

/// The chain from the base to the flange, and the shape of the whole robot.
pub(super) struct ChainAndBody {
    pub(super) chain: Chain,
    pub(super) body: Body,
    /// Whether positions are meters, for each joint of the chain.
    pub(super) is_prismatic: Vec<bool>,
}

/// Reads the robot of a rig. Warns about parts whose shape is unknown.
///
/// # Errors
///
/// If the robot description is invalid, or has no shapes.
pub(super) fn chain_and_body(rig: &Rig, urdf_folder: &Path) -> anyhow::Result<ChainAndBody> {
    let arm = &rig.arm;
    let robot = Robot::parse(&arm.urdf_text).context("the arm's URDF")?;
    let chain = Chain::new(&robot, &arm.base_link, &arm.flange_link).context("the arm's URDF")?;
    let vertices_of = |file: &str| {
        mesh_triangles(file, urdf_folder)
            .map(|triangles| triangles.into_flattened())
            .map_err(|why| log::warn!("steering: the mesh {file:?}: {why}"))
            .ok()
    };
    let body = Body::new(&robot, &chain, &vertices_of).context(
        "the arm cannot be steered, because its size is unknown: add <collision> shapes to its URDF",
    )?;
    for note in body.notes() {
        log::warn!("steering: {note}");
    }
    let is_prismatic = chain.joint_names().iter().map(|name| {
        let joint = robot.joint(name);
        joint.is_some_and(|joint| joint.kind == JointKind::Prismatic)
    });
    Ok(ChainAndBody {
        is_prismatic: is_prismatic.collect(),
        chain,
        body,
    })
}

impl ChainAndBody {
    /// The robot with its arm.
    ///
    /// # Errors
    ///
    /// If the joints do not match.
    pub(super) fn steered(
        &self,
        joint_names: &[String],
        joint_offsets: &[f64],
        arm: &SteeredArm,
    ) -> anyhow::Result<SteeredRobot> {
        Ok(SteeredRobot {
            joints: JointMap::new(&self.chain, joint_names, joint_offsets)?,
            chain: self.chain.clone(),
            body: self.body.clone(),
            port: arm.port().clone(),
        })
    }
}
