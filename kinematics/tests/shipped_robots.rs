//! Checks the robot descriptions in `rigs/robots` against the figures of the makers: Denavit-
//! Hartenberg tables, limits, and poses that MuJoCo computes from the makers' own model.
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use kinematics::Chain;
use kinematics::urdf::{JointKind, Robot};
use nalgebra::{Matrix3, Matrix4, Vector3};
use numbers::random::Random;
use serde_json::Value;
use std::f64::consts::{FRAC_PI_2, PI};

const PANDA: &str = include_str!("../../rigs/robots/panda.urdf");
const FR3: &str = include_str!("../../rigs/robots/fr3.urdf");
const UR3E: &str = include_str!("../../rigs/robots/ur3e.urdf");
const UR5E: &str = include_str!("../../rigs/robots/ur5e.urdf");
const UR10E: &str = include_str!("../../rigs/robots/ur10e.urdf");
const SO101: &str = include_str!("../../rigs/robots/so101.urdf");
const ALL: [&str; 6] = [PANDA, FR3, UR3E, UR5E, UR10E, SO101];

/// Tolerance for meters and rotation matrix elements. The products have up to eight factors.
const CLOSE: f64 = 1e-12;

/// Tolerance for meters and rotation matrix elements. The makers' model of the SO-101 has six
/// decimals.
const CLOSE_TO_SIX_DECIMALS: f64 = 1e-5;

const N_CONFIGURATIONS: usize = 200;

/// One row of a Denavit-Hartenberg table: a and d in meters, alpha in radians.
struct Row(f64, f64, f64);

/// "DH parameters for calculations of kinematics and dynamics", Universal Robots. The order of a
/// link's factors is `Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha)`.
fn ur_table([d1, a2, a3, d4, d5, d6]: [f64; 6]) -> [Row; 6] {
    [
        Row(0.0, d1, FRAC_PI_2),
        Row(a2, 0.0, 0.0),
        Row(a3, 0.0, 0.0),
        Row(0.0, d4, FRAC_PI_2),
        Row(0.0, d5, -FRAC_PI_2),
        Row(0.0, d6, 0.0),
    ]
}

const UR3E_M: [f64; 6] = [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921];
const UR5E_M: [f64; 6] = [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996];
const UR10E_M: [f64; 6] = [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655];

/// "Robot and interface specifications", Franka Robotics: the table of a Panda and an FR3, with the
/// flange as last row. The order of a link's factors follows Craig and is `Rot(x, alpha) Trans(x,
/// a) Rot(z, theta) Trans(z, d)`.
const FRANKA: [Row; 8] = [
    Row(0.0, 0.333, 0.0),
    Row(0.0, 0.0, -FRAC_PI_2),
    Row(0.0, 0.316, FRAC_PI_2),
    Row(0.0825, 0.0, FRAC_PI_2),
    Row(-0.0825, 0.384, -FRAC_PI_2),
    Row(0.0, 0.0, FRAC_PI_2),
    Row(0.088, 0.0, FRAC_PI_2),
    Row(0.0, 0.107, 0.0),
];

fn about_z(angle_rad: f64, distance_m: f64) -> Matrix4<f64> {
    let (sin, cos) = angle_rad.sin_cos();
    Matrix4::new(
        cos, -sin, 0.0, 0.0, //
        sin, cos, 0.0, 0.0, //
        0.0, 0.0, 1.0, distance_m, //
        0.0, 0.0, 0.0, 1.0,
    )
}

fn about_x(angle_rad: f64, distance_m: f64) -> Matrix4<f64> {
    let (sin, cos) = angle_rad.sin_cos();
    Matrix4::new(
        1.0, 0.0, 0.0, distance_m, //
        0.0, cos, -sin, 0.0, //
        0.0, sin, cos, 0.0, //
        0.0, 0.0, 0.0, 1.0,
    )
}

fn classic_pose(table: &[Row], q_rad: &[f64]) -> Matrix4<f64> {
    table
        .iter()
        .zip(q_rad)
        .map(|(Row(a, d, alpha), theta)| about_z(*theta, *d) * about_x(*alpha, *a))
        .product()
}

/// The flange has no joint, so its angle is 0.
fn craig_pose(table: &[Row], q_rad: &[f64]) -> Matrix4<f64> {
    let angles_rad = q_rad.iter().chain([&0.0]);
    table
        .iter()
        .zip(angles_rad)
        .map(|(Row(a, d, alpha), theta)| about_x(*alpha, *a) * about_z(*theta, *d))
        .product()
}

/// Largest difference between the poses of a chain and `expected_pose` over random configurations
/// within two turns, m and rotation matrix elements.
fn max_difference(chain: &Chain, expected_pose: impl Fn(&[f64]) -> Matrix4<f64>) -> f64 {
    let mut random = Random::new(1);
    (0..N_CONFIGURATIONS)
        .map(|_| {
            let q_rad: Vec<f64> = (0..chain.n_joints())
                .map(|_| random.uniform(-2.0 * PI, 2.0 * PI))
                .collect();
            let pose = chain.forward(&q_rad).unwrap().to_homogeneous();
            (pose - expected_pose(&q_rad)).abs().max()
        })
        .fold(0.0, f64::max)
}

#[test]
fn universal_robots_match_the_tables_of_their_maker() {
    for (urdf, lengths_m) in [(UR3E, UR3E_M), (UR5E, UR5E_M), (UR10E, UR10E_M)] {
        let table = ur_table(lengths_m);
        let chain = Chain::from_urdf(urdf, "base", "tool0").unwrap();
        let difference = max_difference(&chain, |q| classic_pose(&table, q));
        assert!(difference < CLOSE, "{lengths_m:?}: {difference:e}");
        // The base of the ROS description is rotated by 180 degrees relative to the base of the
        // controller.
        let from_ros_base = Chain::from_urdf(urdf, "base_link", "tool0").unwrap();
        let difference = max_difference(&from_ros_base, |q| {
            about_z(PI, 0.0) * classic_pose(&table, q)
        });
        assert!(difference < CLOSE, "{lengths_m:?}: {difference:e}");
    }
}

#[test]
fn franka_arms_match_the_table_of_their_maker() {
    for (urdf, base, flange) in [
        (PANDA, "panda_link0", "panda_link8"),
        (FR3, "fr3_link0", "fr3_link8"),
    ] {
        let chain = Chain::from_urdf(urdf, base, flange).unwrap();
        let difference = max_difference(&chain, |q| craig_pose(&FRANKA, q));
        assert!(difference < CLOSE, "{flange}: {difference:e}");
    }
}

#[test]
fn a_table_of_another_robot_is_rejected() {
    let mut lengths_m = UR5E_M;
    lengths_m[3] += 1e-4;
    let chain = Chain::from_urdf(UR5E, "base", "tool0").unwrap();
    assert!(max_difference(&chain, |q| classic_pose(&ur_table(lengths_m), q)) > 5e-5);
}

/// Poses of a Franka arm with the same kinematics, from an independent rigid-body library.
#[test]
fn franka_arms_match_an_independent_library() {
    let Some(robots) = test_support::data_folder("robots") else {
        return;
    };
    let text = std::fs::read_to_string(robots.join("fk_fer.json")).unwrap();
    let expected: Value = serde_json::from_str(&text).unwrap();
    let chain = Chain::from_urdf(FR3, "fr3_link0", "fr3_link8").unwrap();
    let samples = expected["samples"].as_array().unwrap();
    assert!(samples.len() >= 100, "only {} samples", samples.len());
    for sample in samples {
        // The last two of its nine joints are the fingers.
        let q_rad: Vec<f64> = floats(&sample["q"])[..chain.n_joints()].to_vec();
        let rows: Vec<f64> = sample["T"]["fer_link8"]
            .as_array()
            .unwrap()
            .iter()
            .flat_map(floats)
            .collect();
        let pose = chain.forward(&q_rad).unwrap().to_homogeneous();
        let difference = (pose - Matrix4::from_row_slice(&rows)).abs().max();
        assert!(difference < CLOSE, "{q_rad:?}: {difference:e}");
    }
}

fn floats(value: &Value) -> Vec<f64> {
    let numbers = value.as_array().unwrap().iter();
    numbers.map(|number| number.as_f64().unwrap()).collect()
}

/// A pose of an SO-101 that MuJoCo computes.
struct So101Pose {
    q_rad: [f64; 5],
    /// Origin of `gripper_frame_link` in `base_link`.
    tip_m: [f64; 3],
    /// Orientation of `gripper_link` in `base_link`.
    gripper_rows: [[f64; 3]; 3],
}

/// Computed by MuJoCo 4.0.0 from `Simulation/SO101/so101_new_calib.xml` of
/// `github.com/TheRobotStudio/SO-ARM100`, commit fda892cb, without its meshes.
const SO101_POSES: [So101Pose; 4] = [
    So101Pose {
        q_rad: [0.0; 5],
        tip_m: [0.391362, -0.000011, 0.226469],
        gripper_rows: [
            [0.0, 0.0, -1.0],
            [-0.04866, 0.998815, 0.0],
            [0.998815, 0.04866, 0.0],
        ],
    },
    So101Pose {
        q_rad: [0.5, -0.8, 1.1, 0.6, -1.2],
        tip_m: [0.214686, -0.08781, 0.053806],
        gripper_rows: [
            [-0.237143, 0.803852, -0.545514],
            [-0.951335, -0.078411, 0.298016],
            [0.196786, 0.589639, 0.783327],
        ],
    },
    So101Pose {
        q_rad: [-1.3, 0.4, -0.9, -1.1, 2.1],
        tip_m: [0.101146, 0.197972, 0.437665],
        gripper_rows: [
            [-0.730841, 0.682503, 0.007811],
            [0.682414, 0.730424, 0.028135],
            [0.013497, 0.025893, -0.999574],
        ],
    },
    So101Pose {
        q_rad: [1.7, 1.5, -1.4, 1.2, -2.5],
        tip_m: [0.000929, -0.326035, -0.063365],
        gripper_rows: [
            [-0.451163, -0.891776, 0.034466],
            [0.86443, -0.427076, 0.265269],
            [-0.221841, 0.149473, 0.963558],
        ],
    },
];

#[test]
fn the_so_101_matches_the_model_of_its_maker() {
    let tip = Chain::from_urdf(SO101, "base_link", "gripper_frame_link").unwrap();
    let gripper = Chain::from_urdf(SO101, "base_link", "gripper_link").unwrap();
    for expected in SO101_POSES {
        let q_rad = expected.q_rad;
        let tip_m = tip.forward(&q_rad).unwrap().translation.vector;
        let difference = (tip_m - Vector3::from(expected.tip_m)).abs().max();
        assert!(difference < CLOSE_TO_SIX_DECIMALS, "{q_rad:?}: {tip_m}");
        let rotation = gripper.forward(&q_rad).unwrap().rotation;
        let rows: Vec<f64> = expected.gripper_rows.concat();
        let difference = rotation.to_rotation_matrix().matrix() - Matrix3::from_row_slice(&rows);
        assert!(
            difference.abs().max() < CLOSE_TO_SIX_DECIMALS,
            "{q_rad:?}: {difference}"
        );
    }
}

#[test]
fn every_shipped_arm_has_limits_and_a_body() {
    for urdf in ALL {
        let robot = Robot::parse(urdf).unwrap();
        assert!(robot.notes().is_empty(), "{:?}", robot.notes());
        robot.root().unwrap();
        for joint in robot.joints() {
            assert!(joint.problem.is_none(), "{joint:?}");
            if joint.kind == JointKind::Fixed {
                continue;
            }
            let limits = joint.limits;
            assert!(limits.velocity.is_finite(), "{joint:?}");
            assert!(limits.effort.is_finite(), "{joint:?}");
            // Only the last joint of a UR3e turns without end.
            let is_endless = robot.name() == "ur3e" && joint.name == "wrist_3_joint";
            assert_eq!(limits.lower.is_finite(), !is_endless, "{joint:?}");
            assert_eq!(limits.upper.is_finite(), !is_endless, "{joint:?}");
            assert!(limits.lower < limits.upper, "{joint:?}");
            let visuals = robot.visuals(&joint.child);
            assert!(!visuals.is_empty(), "{} has no body", joint.child);
            for visual in visuals {
                assert!(visual.color_srgba.is_some(), "{}", joint.child);
            }
        }
    }
}
