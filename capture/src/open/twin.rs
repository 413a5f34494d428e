//! Chooses the simulated scene of a rig, and whether its robot is that of the scene or that of the
//! rig file.

use crate::config::{ArmDriver, BaseDriver, Parent, Rig};
use crate::mesh_files::found_mesh_file;
use anyhow::{Context, bail};
use files::Budget;
use kinematics::shape::Geometry;
use kinematics::urdf::Robot;
use kinematics::{Chain, Transform};
use sim::Scene;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Whether the base of a simulated rig moves.
pub(super) fn base_moves(rig: &Rig) -> bool {
    match &rig.sim.scene {
        Some(name) => Scene::from_name(name).is_some_and(Scene::has_moving_base),
        None => match rig.base.driver {
            BaseDriver::Udp | BaseDriver::Sim => true,
            // An arm scans from a base that stands still. Without an arm, only the base can move.
            BaseDriver::Tags => rig.arm.joints.is_empty(),
            BaseDriver::Fixed | BaseDriver::Rgbd => false,
        },
    }
}

/// The chain of the simulated arm. A robot that is not read stays at rest, so it has no joints.
pub(super) fn simulated_chain(rig: &Rig) -> anyhow::Result<Chain> {
    let arm = &rig.arm;
    Chain::from_urdf(&arm.urdf_text, &arm.base_link, flange_link(rig)).context("the arm's URDF")
}

/// The flange link of the simulated arm.
fn flange_link(rig: &Rig) -> &str {
    if rig.arm.driver == ArmDriver::None {
        &rig.arm.base_link
    } else {
        &rig.arm.flange_link
    }
}

/// Sets the scene and the robot of a simulator configuration whose other fields are set.
///
/// # Errors
///
/// If the rig names an unknown scene, or the base does not match the scene.
pub(super) fn choose(rig: &Rig, config: sim::Config) -> anyhow::Result<sim::Config> {
    let chain = simulated_chain(rig)?;
    let has_moving_base = rig.base.driver == BaseDriver::Sim;
    let own_scenes = match (&rig.sim.scene, has_moving_base) {
        (Some(name), _) => vec![scene_named(name)?],
        (None, true) => vec![Scene::MobileArm, Scene::MobileBase],
        (None, false) => vec![Scene::StaticArm],
    };
    let is_chosen = rig.sim.scene.is_some();
    for scene in &own_scenes {
        let own = sim::Config {
            scene: *scene,
            ..config.clone()
        };
        if sim::has_robot_of(*scene, &chain) && (is_chosen || suits(rig, &own)?) {
            check_base(rig, *scene)?;
            // Ground truth is in the coordinates of the scene. Another origin would make every
            // comparison with it wrong.
            if rig.base.world_from_base != Transform::identity() {
                bail!(
                    "the base of the scene {:?} is at the world origin: base.world_from_base must be the identity, or \
                     remove sim.scene from the rig file",
                    scene.name()
                );
            }
            return Ok(own);
        }
    }
    let scene = match own_scenes[..] {
        [scene] => scene,
        _ => Scene::MobileBase,
    };
    check_base(rig, scene)?;
    Ok(sim::Config {
        scene,
        robot: Some(robot(rig, has_moving_base)?),
        ..config
    })
}

fn scene_named(name: &str) -> anyhow::Result<Scene> {
    Scene::from_name(name).with_context(|| {
        let known: Vec<_> = Scene::ALL.iter().map(|scene| scene.name()).collect();
        format!("sim.scene is {name:?}; known scenes: {}", known.join(", "))
    })
}

/// Whether a rig without `sim.scene` can be simulated with the scene's own robot.
fn suits(rig: &Rig, own: &sim::Config) -> anyhow::Result<bool> {
    // A robot description with several links is drawn and stands on its wheels.
    let has_own_body = !own.scene.has_arm()
        && Robot::parse(&rig.arm.urdf_text)
            .context("the arm's URDF")?
            .links()
            .len()
            > 1;
    // Cameras of a rig with a printed target need not see the rest of the scene.
    let sees_enough =
        || !rig.sim.targets.is_empty() || sim::suits_own_robot(own, rig.join.max_blur_px);
    Ok(!has_own_body
        && rig.base.world_from_base == Transform::identity()
        && !own.cameras.is_empty()
        && sees_enough())
}

fn check_base(rig: &Rig, scene: Scene) -> anyhow::Result<()> {
    if scene.has_moving_base() != (rig.base.driver == BaseDriver::Sim) {
        let driver = if scene.has_moving_base() {
            "sim"
        } else {
            "fixed"
        };
        bail!(
            "the scene {:?} needs base.driver = {driver:?}",
            scene.name()
        );
    }
    Ok(())
}

/// The robot of the rig file.
fn robot(rig: &Rig, has_moving_base: bool) -> anyhow::Result<sim::RobotConfig> {
    let description = Robot::parse(&rig.arm.urdf_text).context("the arm's URDF")?;
    // Cameras on the robot do not show it, and reading meshes takes time.
    let is_drawn = !rig.scanners.is_empty()
        || rig
            .cameras
            .iter()
            .any(|camera| camera.parent == Parent::World);
    let meshes = match rig.arm.urdf_folder.path() {
        Some(folder) if is_drawn => meshes(&description, folder),
        _ => BTreeMap::new(),
    };
    Ok(sim::RobotConfig {
        urdf: rig.arm.urdf_text.clone(),
        base_link: rig.arm.base_link.clone(),
        flange_link: flange_link(rig).to_owned(),
        meshes,
        world_from_base: rig.base.world_from_base,
        has_moving_base,
        max_blur_px: rig.join.max_blur_px,
        max_shear_px: rig.join.max_shear_px,
    })
}

/// Contents of the mesh files of all shapes. Files that cannot be read are left out; the simulator
/// names the links without meshes.
fn meshes(robot: &Robot, urdf_folder: &Path) -> BTreeMap<String, Arc<[u8]>> {
    let mut meshes = BTreeMap::new();
    let mut budget = Budget::MESHES;
    let links = robot.links().iter();
    let shapes = links.flat_map(|link| robot.visuals(link).iter().chain(robot.collisions(link)));
    for shape in shapes {
        let Geometry::Mesh { file, .. } = &shape.geometry else {
            continue;
        };
        if meshes.contains_key(file) {
            continue;
        }
        let Some(path) = found_mesh_file(file, urdf_folder) else {
            continue;
        };
        let max_bytes = Budget::MESH.max_bytes.min(budget.max_bytes);
        let limit = Budget {
            max_bytes,
            ..Budget::MESH
        };
        if let Ok(bytes) = files::read(&path, limit) {
            budget = budget.after(bytes.len() as u64);
            meshes.insert(file.clone(), bytes.into());
        }
    }
    meshes
}
