//! Tests `fieldrig fk` as a program: poses against published numbers and an independent library,
//! and rejected input.
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

const PANDA: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/kinematics/tests/data/panda.urdf"
);
/// For meters and rotation matrix elements: rounding errors of a dozen products of numbers near 1.
const TOLERANCE: f64 = 1e-12;

/// Exit code, stdout and stderr of `fieldrig fk` with these joints.
fn fk(urdf: &Path, flags: &[&str], joints: &str) -> (i32, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("joints.json");
    std::fs::write(&file, joints).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    let output = command
        .arg("fk")
        .arg(urdf)
        .args(flags)
        .arg("--joints")
        .arg(&file)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (
        output.status.code().unwrap(),
        text(output.stdout),
        text(output.stderr),
    )
}

fn poses(urdf: &Path, flags: &[&str], joints: &Value) -> Vec<Vec<f64>> {
    let (code, out, err) = fk(urdf, flags, &joints.to_string());
    assert_eq!(code, 0, "{err}");
    assert_eq!(out.lines().count(), 1);
    let printed: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(printed["tip"], flags[1]);
    let numbers = |value: &Value| {
        value
            .as_array()
            .unwrap()
            .iter()
            .map(|number| number.as_f64().unwrap())
            .collect()
    };
    printed["poses"]
        .as_array()
        .unwrap()
        .iter()
        .map(numbers)
        .collect()
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!((a.len(), b.len()), (16, 16));
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

#[test]
fn stretched_panda_matches_published_pose() {
    // With all joints at zero, the flange is 0.333 + 0.316 + 0.384 - 0.107 up and 0.088 out, and
    // points down.
    let stretched = [
        1.0, 0.0, 0.0, 0.088, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.926, 0.0, 0.0, 0.0, 1.0,
    ];
    let names = [
        "joint7",
        "joint1",
        "joint2",
        "joint3",
        "joint4",
        "joint5",
        "joint6",
        "finger_joint_left",
    ];
    let stretch = [0.0; 8];
    let quarter = std::f64::consts::FRAC_PI_2;
    let first_turned = [0.0, quarter, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04];
    let joints = json!({"joint_names": names, "configurations": [stretch, first_turned]});
    let got = poses(Path::new(PANDA), &["--tip", "link8"], &joints);
    assert_eq!(got.len(), 2);
    assert!(
        largest_difference(&got[0], &stretched) < TOLERANCE,
        "{:?}",
        got[0]
    );
    // A quarter turn of the first joint rotates x into y.
    assert!(
        (got[1][3] - 0.0).abs() < TOLERANCE && (got[1][7] - 0.088).abs() < TOLERANCE,
        "{:?}",
        got[1]
    );
    let from_hand = json!({"joint_names": ["finger_joint_left"], "configurations": [[0.04]]});
    let finger = poses(
        Path::new(PANDA),
        &["--tip", "finger_right", "--base", "hand"],
        &from_hand,
    );
    assert_eq!(finger[0][7], -0.04, "a mimic joint follows");
    let none = poses(
        Path::new(PANDA),
        &["--tip", "tcp"],
        &json!({"joint_names": names, "configurations": []}),
    );
    assert!(none.is_empty());
}

#[test]
fn a_known_robot_needs_no_file() {
    let names = [
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ];
    let zero = [0.0; 6];
    let joints = json!({"joint_names": names, "configurations": [zero]});
    let flags = ["--tip", "tool0", "--base", "base"];
    let pose = &poses(Path::new("builtin:ur5e"), &flags, &joints)[0];
    // The arm is stretched along -x, and its flange points along -y.
    let position_m = [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997];
    for (at, expected_m) in [3, 7, 11].into_iter().zip(position_m) {
        assert!((pose[at] - expected_m).abs() < TOLERANCE, "{pose:?}");
    }
    let (code, _, errors) = fk(Path::new("builtin:ur5"), &flags, &joints.to_string());
    assert_eq!(code, 1, "{errors}");
    assert!(
        errors.contains("did you mean \"ur5e\" (Universal Robots UR5e; a UR5 has"),
        "{errors}"
    );
}

#[test]
fn poses_match_an_independent_library() {
    let Some(robots) = test_support::data_folder("robots") else {
        return;
    };
    for name in ["panda_erd", "fer", "ur5_erd", "anymal_c"] {
        let oracle = std::fs::read_to_string(robots.join(format!("fk_{name}.json"))).unwrap();
        let oracle: Value = serde_json::from_str(&oracle).unwrap();
        let urdf = robots.join(oracle["urdf"].as_str().unwrap());
        let samples = oracle["samples"].as_array().unwrap();
        let configurations: Vec<&Value> = samples.iter().map(|sample| &sample["q"]).collect();
        let joints =
            json!({"joint_names": oracle["joint_names"], "configurations": configurations});
        for frame in oracle["frames"].as_array().unwrap() {
            let frame = frame.as_str().unwrap();
            for (pose, sample) in poses(&urdf, &["--tip", frame], &joints).iter().zip(samples) {
                let rows = sample["T"][frame]
                    .as_array()
                    .unwrap()
                    .iter()
                    .flat_map(|row| row.as_array().unwrap());
                let rows: Vec<f64> = rows.map(|number| number.as_f64().unwrap()).collect();
                let difference = largest_difference(pose, &rows);
                assert!(
                    difference < TOLERANCE,
                    "{name} {frame}: {difference:e} from the library"
                );
            }
        }
    }
    let (code, _, err) = fk(&robots.join("invalid_ur3.urdf"), &["--tip", "tool0"], "{}");
    assert_eq!(code, 1);
    assert!(
        err.lines().count() == 1 && err.contains("has no <link>"),
        "{err}"
    );
}

#[test]
fn invalid_input_gives_one_error_and_no_output() {
    let fine = r#"{"joint_names":["joint1"],"configurations":[[0.5]]}"#;
    let cases = [
        (
            &["--tip", "wrist"][..],
            fine,
            r#"link "wrist" is not in the URDF"#,
        ),
        (
            &["--tip", "link1", "--base", "link2"],
            fine,
            r#"link "link1" is not below link "link2""#,
        ),
        (
            &["--tip", "link0", "--base", "link2"],
            fine,
            r#"link "link0" is not below link "link2"; no link is above it"#,
        ),
        (
            &["--tip", "link2"],
            fine,
            r#"joint "joint2" moves "link2" but is not among the joints given"#,
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint_1"],"configurations":[[0.5]]}"#,
            r#"joint "joint_1" is not in the URDF; did you mean "joint1"?"#,
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1","joint1"],"configurations":[]}"#,
            "listed twice",
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1"],"configurations":[[0.5],[]]}"#,
            "configuration 1 (from 0) has 0 values, joint_names has 1",
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1"],"configurations":[[null]]}"#,
            "invalid type: null",
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1"],"configurations":[[NaN]]}"#,
            "joints.json",
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1"],"configurations":[[1e999]]}"#,
            "out of range",
        ),
        (
            &["--tip", "link1"],
            r#"{"joint_names":["joint1"]}"#,
            "missing field `configurations`",
        ),
    ];
    for (flags, joints, expected) in cases {
        let (code, out, err) = fk(Path::new(PANDA), flags, joints);
        assert_eq!((code, out.as_str()), (1, ""), "{expected}: {err}");
        assert!(
            err.lines().count() == 1 && err.contains(expected),
            "expected {expected:?}, got {err:?}"
        );
    }
    let (code, _, err) = fk(Path::new("no-such-robot.urdf"), &["--tip", "link1"], fine);
    assert!(code == 1 && err.contains("no-such-robot.urdf"), "{err}");
    assert_eq!(fk(Path::new(PANDA), &[], fine).0, 2, "--tip is required");
}
