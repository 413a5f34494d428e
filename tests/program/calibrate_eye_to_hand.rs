//! `fieldrig calibrate hand-eye` in simulation, with a fixed camera and a target on the flange.
#![cfg(feature = "sim")]

use crate::command::{fieldrig, json_of, stderr};
use kinematics::{Transform, transform};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::Path;

const TARGET: &str = "charuco:5x7:18mm:14mm:5X5_100";

/// A camera above the table that looks up to the arm at the start of its scan.
fn base_from_camera() -> Transform {
    let position = Vector3::new(0.691, 0.046, 0.279);
    let forward = Vector3::new(-0.410, 0.380, 0.829).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Transform::from_parts(position.into(), rotation)
}

/// A board on a bracket, facing where a camera on the wrist would look.
fn flange_from_board() -> Transform {
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 50f64.to_radians());
    let around = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI);
    let rotation = quarter * tilt * around;
    let center = Vector3::new(0.045, 0.063, 0.0);
    Transform::from_parts(
        (Vector3::new(0.06, 0.0, 0.1) - rotation * center).into(),
        rotation,
    )
}

fn pose_toml(pose: &Transform) -> String {
    let list = |values: &[f64]| {
        values
            .iter()
            .map(|value| format!("{value:.12}"))
            .collect::<Vec<_>>()
            .join(", ")
    };
    let (xyz, quat) = (pose.translation.vector, pose.rotation.coords);
    format!(
        "{{ xyz_m = [{}], quat_xyzw = [{}] }}",
        list(xyz.as_slice()),
        list(quat.as_slice())
    )
}

/// The given pose of the camera is wrong by 40 mm and 4 degrees.
fn write_rig(folder: &Path, parent: &str) {
    let wrong = base_from_camera()
        * Transform::new(
            Vector3::new(0.03, -0.02, 0.02),
            Vector3::new(0.04, 0.05, -0.02),
        );
    let urdf = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/robots/panda.urdf");
    let rig = format!(
        "[arm]\ndriver = \"sim\"\nurdf = {:?}\nflange_link = \"panda_link8\"\n\
         [camera.front]\ndriver = \"sim\"\nsize_px = [640, 480]\nrate_hz = 2\nexposure_micros = 1000\n\
         readout_micros = 0\nparent = {parent:?}\nparent_from_camera = {}\n\
         intrinsics = {{ focal_px = [614.6, 614.2], principal_px = [323.7, 236.4], lens = \"pinhole\" }}\n\
         [camera.front.sim]\nsupersample = 2\n[camera.front.sim.truth]\nparent_from_camera = {}\n\
         [sim]\nseed = 3\nspeed = 0.3\n[sim.target.board]\nspec = {TARGET:?}\nflange_from_board = {}\n",
        urdf.display().to_string(),
        pose_toml(&wrong),
        pose_toml(&base_from_camera()),
        pose_toml(&flange_from_board()),
    );
    std::fs::write(folder.join("rig.toml"), rig).expect("the disk has space");
}

fn numbers(value: &Value) -> Vec<f64> {
    let inner = |values: &Vec<Value>| values.iter().flat_map(numbers).collect();
    value
        .as_array()
        .map_or_else(|| value.as_f64().into_iter().collect(), inner)
}

fn check(result: &Value, key: &str, truth: &Transform) {
    let found = numbers(&result[key]).try_into().expect("16 numbers");
    let error = truth.inverse() * transform::from_rows(&found).expect("a rigid transform");
    let (mm, deg) = (
        1e3 * error.translation.vector.norm(),
        error.rotation.angle().to_degrees(),
    );
    assert!(mm < 0.5 && deg < 0.05, "{key}: {mm} mm, {deg} degrees");
}

#[test]
fn fixed_camera_is_calibrated_while_the_arm_carries_the_target() {
    let folder = tempfile::tempdir().expect("a folder");
    for (parent, motion, file) in [
        ("base", &["--move"][..], "moved.toml"),
        ("world", &["--move", "--max-poses", "12"], "world.toml"),
    ] {
        write_rig(folder.path(), parent);
        let args = [
            "calibrate",
            "hand-eye",
            "rig.toml",
            "--sim",
            "--target",
            TARGET,
            "--json",
            "--write-rig",
            file,
        ];
        let output = fieldrig(folder.path(), &[&args, motion].concat());
        assert!(output.status.success(), "{parent}: {}", stderr(&output));
        let result = json_of(&output);
        check(&result, "base_from_camera", &base_from_camera());
        check(&result, "flange_from_board", &flange_from_board());
        let text = std::fs::read_to_string(folder.path().join(file)).expect("a rig file");
        let rig: toml::Table = text.parse().expect("TOML");
        let x_m = rig["camera"]["front"]["parent_from_camera"]["xyz_m"][0]
            .as_float()
            .expect("a number");
        assert!(
            (x_m - base_from_camera().translation.x).abs() < 5e-4,
            "{parent}: {text}"
        );
    }
}

#[test]
fn target_on_the_flange_and_in_the_world_is_rejected() {
    let folder = tempfile::tempdir().expect("a folder");
    write_rig(folder.path(), "base");
    let text = std::fs::read_to_string(folder.path().join("rig.toml")).expect("a rig file");
    std::fs::write(
        folder.path().join("rig.toml"),
        text + "world_from_board = { xyz_m = [0, 0, 0] }\n",
    )
    .expect("a file");
    let output = fieldrig(
        folder.path(),
        &[
            "calibrate",
            "hand-eye",
            "rig.toml",
            "--sim",
            "--target",
            TARGET,
        ],
    );
    assert!(
        !output.status.success()
            && stderr(&output).contains("either world_from_board or flange_from_board")
    );
}
