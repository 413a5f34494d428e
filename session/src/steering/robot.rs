//! The chain and the shape of the robot that operators steer.

use super::joint_map::JointMap;
use super::steering_loop::SteeredRobot;
use anyhow::Context;
use capture::config::Rig;
use capture::mesh_triangles;
use capture::open::SteeredArm;
use files::Budget;
use kinematics::Chain;
use kinematics::urdf::{JointKind, Robot};
use messages::counted;
use std::cell::RefCell;
use std::collections::BTreeMap;
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
pub(super) fn chain_and_body(rig: &Rig) -> anyhow::Result<ChainAndBody> {
    let arm = &rig.arm;
    let robot = Robot::parse(&arm.urdf_text).context("the arm's URDF")?;
    let chain = Chain::new(&robot, &arm.base_link, &arm.flange_link).context("the arm's URDF")?;
    let unreadable = RefCell::new(BTreeMap::new());
    let vertices_of = |file: &str| {
        mesh_triangles(file, &arm.urdf_folder, Budget::MESH)
            .map(|triangles| triangles.into_flattened())
            .map_err(|why| unreadable.borrow_mut().insert(file.to_owned(), why))
            .ok()
    };
    let body = Body::new(&robot, &chain, &vertices_of);
    // One line for all of them, because they usually have the same cause.
    if let Some(warning) = describe(&unreadable.into_inner()) {
        log::warn!("steering: {warning}");
    }
    let body = body.context(
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

/// How many mesh files cannot be read, and why the first one cannot; `None` if all can be read.
fn describe(unreadable: &BTreeMap<String, String>) -> Option<String> {
    let (file, why) = unreadable.first_key_value()?;
    let files = counted(unreadable.len() as u64, "mesh file");
    Some(format!("cannot read {files}, the first is {file:?}: {why}"))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_warning_describes_all_unreadable_meshes() {
        let all = [("a.dae", "convert it"), ("b.stl", "no such file")];
        let all = all.map(|(file, why)| (file.to_owned(), why.to_owned()));
        let warning = describe(&BTreeMap::from(all)).expect("a warning");
        assert_eq!(
            warning,
            "cannot read 2 mesh files, the first is \"a.dae\": convert it"
        );
        assert_eq!(describe(&BTreeMap::new()), None);
    }
}
