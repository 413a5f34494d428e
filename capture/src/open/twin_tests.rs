//! The choice of the simulated scene and robot.

use super::simulated::unlimited;
use super::use_simulated_devices;
use crate::config::{BaseDriver, Override, Rig};
use sim::Scene;
use std::path::{Path, PathBuf};

fn rigs_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs")
}

/// The simulator configuration of a rig with `--sim`.
fn simulated(rig: &Rig) -> anyhow::Result<sim::Config> {
    let mut rig = rig.clone();
    use_simulated_devices(&mut rig);
    unlimited(&rig)
}

/// All rig files of this repository.
fn bundled() -> Vec<PathBuf> {
    let list = |folder: PathBuf| std::fs::read_dir(folder).expect("a folder");
    let entries = list(rigs_folder()).chain(list(rigs_folder().join("wire")));
    let mut files: Vec<PathBuf> = entries
        .map(|entry| entry.expect("readable").path())
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "toml")
        })
        .collect();
    files.sort();
    assert!(files.len() >= 9, "{files:?}");
    files
}

#[test]
fn bundled_rigs_keep_the_robots_of_their_scenes() {
    for path in bundled() {
        let rig = Rig::load(&path, &[]).expect("a bundled rig file");
        if rig.sim.scene.is_none() {
            continue;
        }
        let config = simulated(&rig).expect("a scene");
        assert!(config.robot.is_none(), "{}", path.display());
        assert_eq!(Some(config.scene.name()), rig.sim.scene.as_deref());
    }
}

#[test]
fn rigs_of_bundled_robots_get_their_scene_without_naming_it() {
    for (name, scene) in [
        ("static-arm.toml", Scene::StaticArm),
        ("mobile-arm.toml", Scene::MobileArm),
    ] {
        let mut rig = Rig::load(&rigs_folder().join(name), &[]).expect("a bundled rig file");
        rig.sim.scene = None;
        let config = simulated(&rig).expect("a scene");
        assert_eq!(config.scene, scene);
        assert!(config.robot.is_none(), "{name}");
    }
}

#[test]
fn arm_with_other_lengths_is_simulated_as_itself() {
    let mut rig =
        Rig::load(&rigs_folder().join("static-arm.toml"), &[]).expect("a bundled rig file");
    let longer = rig.arm.urdf_text.replace("0.316", "0.516");
    assert_ne!(longer, rig.arm.urdf_text);
    rig.arm.urdf_text = longer;
    let config = simulated(&rig).expect("a scene");
    assert_eq!(
        config.robot.expect("the robot of the rig").urdf,
        rig.arm.urdf_text
    );
}

#[test]
fn long_exposure_or_a_shifted_base_needs_another_place() {
    let load = |overrides: &[Override]| {
        let mut rig = Rig::load(&rigs_folder().join("static-arm.toml"), overrides)
            .expect("a bundled rig file");
        rig.sim.scene = None;
        rig
    };
    let long = load(&[Override::new("camera.wrist.exposure_micros", 20_000.0)]);
    assert!(simulated(&long).expect("a scene").robot.is_some());
    let mut shifted = load(&[]);
    shifted.base.world_from_base = kinematics::Transform::translation(1.0, 2.0, 0.5);
    let robot = simulated(&shifted).expect("a scene").robot;
    assert_eq!(
        robot.expect("the robot of the rig").world_from_base,
        shifted.base.world_from_base
    );
}

#[test]
fn base_without_an_arm_moves_in_the_laboratory() {
    let text = "[arm]\ndriver = \"none\"\n[base]\ndriver = \"udp\"\n[camera.front]\ndriver = \"v4l2\"\nsize_px = [640, 480]\n\
                rate_hz = 15\nparent = \"base\"\nintrinsics = { focal_px = [600, 600], principal_px = [320, 240] }\n";
    let urdf = r#"<robot name="none"><link name="base"/></robot>"#;
    let mut rig = Rig::parse("rig.toml", text, urdf, &[]).expect("a rig");
    use_simulated_devices(&mut rig);
    assert_eq!(rig.base.driver, BaseDriver::Sim);
    let config = unlimited(&rig).expect("a scene");
    assert_eq!(config.scene, Scene::MobileBase);
    assert!(config.robot.is_none());
}
