//! Tests of robot descriptions that rig files name: known robots and files.

use super::Rig;
use std::path::{Component, Path, PathBuf};

/// A rig file with this `[arm]` table and a camera.
fn rig_file(arm: &str) -> String {
    format!(
        r#"
[arm]
driver = "udp"
{arm}
[camera.wrist]
driver = "v4l2"
size_px = [640, 480]
rate_hz = 30
parent = "flange"
parent_from_camera = {{ xyz_m = [0.0, 0.0, 0.1], quat_xyzw = [0.0, 0.0, 0.0, 1.0] }}
intrinsics = {{ focal_px = [600, 600], principal_px = [320.0, 240.0], lens = "pinhole" }}
"#
    )
}

#[test]
fn a_known_robot_needs_no_file_and_no_links() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, rig_file(r#"urdf = "builtin:ur5e""#)).expect("a rig file");
    let rig = Rig::load(&path, &[]).expect("a valid rig");
    assert_eq!(rig.arm.base_link, "base");
    assert_eq!(rig.arm.flange_link, "tool0");
    assert_eq!(rig.arm.joints.len(), 6);
    assert!(rig.arm.urdf_text.contains("robot name=\"ur5e\""));
    // The effective rig file names the URDF that is written beside it.
    let written = rig.write_resolved(folder.path()).expect("written");
    assert_eq!(Rig::load(&written, &[]).expect("a valid rig"), rig);
}

#[test]
fn links_of_the_rig_file_take_precedence() {
    let arm = "urdf = \"builtin:ur5e\"\nbase_link = \"base_link\"\nflange_link = \"forearm_link\"";
    let rig = Rig::parse("rig.toml", &rig_file(arm), "", &[]).expect("a valid rig");
    assert_eq!(rig.arm.base_link, "base_link");
    assert_eq!(rig.arm.flange_link, "forearm_link");
    assert_eq!(rig.arm.joints.len(), 3);
}

#[test]
fn an_unknown_robot_is_one_problem() {
    let arm = "urdf = \"builtin:ur5\"";
    let error = Rig::parse("rig.toml", &rig_file(arm), "", &[]).expect_err("no such robot");
    assert_eq!(
        error.to_string(),
        "rig.toml line 4: arm.urdf is \"builtin:ur5\", allowed: a path, or a known robot; \
         no known robot is named \"ur5\", did you mean \"ur5e\" (Universal Robots UR5e; a UR5 has a shoulder that is \
         73 mm lower, and wrist links that are up to 24 mm shorter: it needs its own URDF file)?; \
         known robots: panda, fr3, ur3e, ur5e, ur10e, so101"
    );
}

#[test]
fn a_missing_file_is_named_with_its_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let arm = "urdf = \"my-arm.urdf\"\nflange_link = \"tool0\"";
    std::fs::write(folder.path().join("rig.toml"), rig_file(arm)).expect("a rig file");
    let relative = relative_path(&folder.path().join("rig.toml"));
    let error = Rig::load(&relative, &[]).expect_err("no robot description");
    let message = error.to_string();
    assert!(
        message.starts_with("cannot read the robot description \"/"),
        "{message}"
    );
    assert!(message.ends_with("/my-arm.urdf\""), "{message}");
}

/// A path from the working directory to an absolute path.
fn relative_path(absolute: &Path) -> PathBuf {
    let here = std::env::current_dir().expect("a working directory");
    let n_folders = here.components().count() - 1;
    let up = std::iter::repeat_n(Component::ParentDir, n_folders);
    let down = absolute.components().skip(1);
    up.chain(down).collect()
}

#[test]
fn a_missing_robot_description_is_reported_before_a_missing_link() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, rig_file("urdf = \"my-arm.urdf\"")).expect("written");
    let load = || Rig::load(&path, &[]).expect_err("incomplete").to_string();
    let message = load();
    assert!(
        message.contains("robot description") && message.contains("my-arm.urdf"),
        "{message}"
    );
    std::fs::write(folder.path().join("my-arm.urdf"), "<robot name=\"a\"/>").expect("written");
    let message = load();
    assert!(
        message.contains("\"arm.flange_link\" is missing"),
        "{message}"
    );
}
