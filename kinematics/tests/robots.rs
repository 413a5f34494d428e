//! Checks forward kinematics against poses from an independent rigid-body library, for every robot
//! of the test data.
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use kinematics::Chain;
use kinematics::urdf::Robot;
use nalgebra::Matrix4;
use serde_json::Value;

/// Tolerance for meters and rotation matrix elements. Rounding differs between the libraries by a
/// few 1e-16 per joint.
const CLOSE: f64 = 1e-12;

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|number| number.as_f64().unwrap())
        .collect()
}

fn words(value: &Value) -> Vec<String> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|word| word.as_str().unwrap().to_owned())
        .collect()
}

#[test]
fn poses_match_independent_library() {
    let Some(robots) = test_support::data_folder("robots") else {
        return;
    };
    let mut n_poses = 0;
    let mut max_difference: f64 = 0.0;
    for entry in robots.read_dir().unwrap() {
        let path = entry.unwrap().path();
        if !path
            .file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with("fk_")
        {
            continue;
        }
        let expected_poses: Value =
            serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
        let urdf =
            std::fs::read_to_string(robots.join(expected_poses["urdf"].as_str().unwrap())).unwrap();
        let robot = Robot::parse(&urdf).unwrap();
        let root = expected_poses["root"].as_str().unwrap();
        assert_eq!(robot.root().unwrap(), root);
        let names = words(&expected_poses["joint_names"]);
        for frame in words(&expected_poses["frames"]) {
            let chain = Chain::new(&robot, root, &frame).unwrap();
            let order = chain.order_in(&names).unwrap();
            let mut max_frame_difference: f64 = 0.0;
            for sample in expected_poses["samples"].as_array().unwrap() {
                let all = numbers(&sample["q"]);
                let q: Vec<f64> = order.iter().map(|&at| all[at]).collect();
                let rows: Vec<f64> = sample["T"][&frame]
                    .as_array()
                    .unwrap()
                    .iter()
                    .flat_map(numbers)
                    .collect();
                let pose = chain.forward(&q).unwrap().to_homogeneous();
                max_frame_difference =
                    max_frame_difference.max((pose - Matrix4::from_row_slice(&rows)).abs().max());
                n_poses += 1;
            }
            eprintln!(
                "{}: {frame}: largest difference {max_frame_difference:.1e}",
                path.display()
            );
            max_difference = max_difference.max(max_frame_difference);
        }
    }
    assert!(n_poses >= 1000, "only {n_poses} poses compared");
    assert!(
        max_difference < CLOSE,
        "largest difference {max_difference:e}"
    );
}

#[test]
fn file_without_robot_is_rejected() {
    let Some(robots) = test_support::data_folder("robots") else {
        return;
    };
    let urdf = std::fs::read_to_string(robots.join("invalid_ur3.urdf")).unwrap();
    let message = Chain::from_urdf(&urdf, "base_link", "tool0")
        .unwrap_err()
        .to_string();
    assert_eq!(
        message,
        r#"urdf: robot "" has no <link> (an export that failed or was never expanded from xacro?)"#
    );
}
