//! Robots from rig files: images against their kinematics, repeatability, how they look, and
//! commands.

use crate::common::{Run, run_rig};
use drivers::motion::{JointTarget, Motion, MotionLimits};
use kinematics::{Chain, Intrinsics, JointState, Stamp, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use sim::{CameraConfig, Config, Parent, RobotConfig};
use std::collections::BTreeMap;
use std::time::Duration;

const SCARA4: &str = include_str!("../robots/scara4.urdf");
const BENCH6: &str = include_str!("../robots/bench6.urdf");

/// A quarter of the wrist camera's size, so that rendering in software is fast.
fn small_lens() -> Intrinsics {
    CameraConfig::wrist("wrist").intrinsics.resized([160, 120])
}

fn config(
    urdf: &str,
    [base_link, flange_link]: [&str; 2],
    flange_from_camera: Transform,
) -> Config {
    let chain = Chain::from_urdf(urdf, base_link, flange_link).expect("a fixture");
    let names = chain.joint_names().to_vec();
    let camera = CameraConfig {
        intrinsics: small_lens(),
        parent_from_camera: flange_from_camera,
        depth: None,
        ..CameraConfig::wrist("wrist")
    };
    Config {
        ideal: true,
        n_images: Some(6),
        joint_names: names.clone(),
        reading_order: names,
        cameras: vec![camera],
        robot: Some(RobotConfig {
            urdf: urdf.to_owned(),
            base_link: base_link.to_owned(),
            flange_link: flange_link.to_owned(),
            meshes: BTreeMap::new(),
            world_from_base: Transform::identity(),
            has_moving_base: false,
            max_blur_px: 1.5,
            max_shear_px: 40.0,
        }),
        ..Config::default()
    }
}

/// A camera that looks along -z of the flange.
fn downward() -> Transform {
    Transform::from_parts(
        Translation3::new(0.05, 0.0, 0.0),
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
    )
}

fn bench6() -> Config {
    config(
        BENCH6,
        ["base_link", "tool0"],
        Transform::translation(0.0, 0.06, 0.0),
    )
}

fn position_at(joints: &[JointState], stamp: Stamp) -> Vec<f64> {
    let after = joints.partition_point(|state| state.stamp < stamp).max(1);
    let (a, b) = (&joints[after - 1], &joints[after]);
    let share = (stamp.0 - a.stamp.0) as f64 / (b.stamp.0 - a.stamp.0) as f64;
    let both = a.position.iter().zip(&b.position);
    both.map(|(a, b)| a + share * (b - a)).collect()
}

/// Standard deviation of the gray values of the first image. A view of nothing has almost none.
fn contrast(run: &Run) -> f64 {
    let gray: Vec<f64> = run.color[0]
        .data
        .chunks_exact(3)
        .map(|rgb| rgb.iter().map(|byte| f64::from(*byte)).sum::<f64>() / 3.0)
        .collect();
    let mean = gray.iter().sum::<f64>() / gray.len() as f64;
    (gray.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / gray.len() as f64).sqrt()
}

#[test]
fn images_are_taken_where_the_kinematics_say() {
    /// Joint positions are interpolated linearly here, and the arm accelerates.
    const TOLERANCE_M: f64 = 1e-5;
    const TOLERANCE_RAD: f64 = 1e-4;
    let cases = [
        (bench6(), BENCH6, ["base_link", "tool0"]),
        (
            config(SCARA4, ["base", "tool"], downward()),
            SCARA4,
            ["base", "tool"],
        ),
    ];
    for (config, urdf, [base, flange]) in cases {
        let run = run_rig(&config);
        let chain = Chain::from_urdf(urdf, base, flange).expect("a fixture");
        assert_eq!(run.truth.len(), 6);
        for truth in &run.truth {
            let position = position_at(&run.joints, truth.image.stamp);
            let expected =
                chain.forward(&position).expect("finite") * config.cameras[0].parent_from_camera;
            let difference = expected.inverse() * truth.world_from_camera;
            assert!(
                difference.translation.vector.norm() < TOLERANCE_M
                    && difference.rotation.angle() < TOLERANCE_RAD,
                "{difference}"
            );
        }
        assert!(contrast(&run) > 12.0, "{}", contrast(&run));
        assert_eq!(run.info.joint_names, config.joint_names);
        assert!(
            run.joints
                .iter()
                .all(|state| state.effort.iter().all(|effort| effort.is_finite()))
        );
    }
}

#[test]
fn same_configuration_gives_the_same_samples() {
    let config = Config {
        n_images: Some(3),
        ideal: false,
        ..bench6()
    };
    assert!(run_rig(&config) == run_rig(&config));
}

/// A binary STL file of a square plate of 0.3 m in the plane x = 0, drawn from both sides.
fn plate_stl() -> Vec<u8> {
    const HALF_M: f32 = 0.15;
    let [a, b, c, d] = [
        [0.0, -HALF_M, -HALF_M],
        [0.0, HALF_M, -HALF_M],
        [0.0, HALF_M, HALF_M],
        [0.0, -HALF_M, HALF_M],
    ];
    let triangles = [[a, b, c], [a, c, d], [c, b, a], [d, c, a]];
    let mut bytes = vec![0; 80];
    bytes.extend(4_u32.to_le_bytes());
    for corners in triangles {
        bytes.extend([0; 12]);
        bytes.extend(
            corners
                .iter()
                .flatten()
                .flat_map(|number| number.to_le_bytes()),
        );
        bytes.extend([0; 2]);
    }
    bytes
}

/// Number of pixels of the last image of a camera whose color is close to magenta.
fn n_magenta(run: &Run, camera: &str) -> usize {
    let image = run
        .color
        .iter()
        .rfind(|image| &*image.camera == camera)
        .expect("it delivered images");
    image
        .data
        .chunks_exact(3)
        .filter(|rgb| rgb[0] > 90 && rgb[2] > 90 && u32::from(rgb[1]) * 2 < u32::from(rgb[0]))
        .count()
}

#[test]
fn fixed_cameras_show_the_shapes_and_meshes_of_the_urdf() {
    let plate = |geometry: &str| {
        BENCH6.replace(
            r#"<link name="l1">"#,
            &format!(
                r#"<link name="l1"><visual><origin xyz="0 0 0.3"/><geometry>{geometry}</geometry>
                <material name="m"><color rgba="1 0 1 1"/></material></visual>"#
            ),
        )
    };
    // Behind the robot, where the table has no walls.
    let eye = Point3::new(-1.4, 0.4, 0.9);
    let toward = Point3::new(0.0, 0.0, 0.3);
    let watcher = CameraConfig {
        parent: Parent::World,
        parent_from_camera: Transform::from_parts(
            eye.into(),
            UnitQuaternion::face_towards(&(toward - eye), &-Vector3::z()),
        ),
        intrinsics: small_lens(),
        depth: None,
        ..CameraConfig::wrist("watcher")
    };
    for geometry in [
        r#"<box size="0.02 0.3 0.3"/>"#,
        r#"<mesh filename="package://arm/plate.stl"/>"#,
    ] {
        let mut config = config(
            &plate(geometry),
            ["base_link", "tool0"],
            Transform::translation(0.0, 0.06, 0.0),
        );
        config.cameras.push(watcher.clone());
        let robot = config.robot.as_mut().expect("a robot");
        robot
            .meshes
            .insert("package://arm/plate.stl".to_owned(), plate_stl().into());
        let run = run_rig(&config);
        let seen = n_magenta(&run, "watcher");
        assert!(seen > 20, "{geometry}: {seen} pixels");
        assert_eq!(n_magenta(&run, "wrist"), 0, "{geometry}");
    }
}

#[test]
fn commands_move_a_prismatic_joint() {
    let config = Config {
        n_images: None, // The simulation does not end before the arm arrives.
        ..config(SCARA4, ["base", "tool"], downward())
    };
    let limits = vec![
        MotionLimits {
            position: [-10.0, 10.0],
            velocity: 0.4,
            acceleration: 1.0,
            jerk: 10.0,
        };
        4
    ];
    let mut rig = sim::open(&config)
        .expect("a scene")
        .into_commanded(&limits)
        .expect("the arm is in its range");
    let read =
        |rig: &mut sim::CommandedRig| rig.arm.read(Duration::from_secs(1)).expect("a reading");
    let mut target = read(&mut rig).position;
    target[2] -= 0.05;
    rig.arm
        .command(&JointTarget {
            position: target.clone(),
        })
        .expect("a valid target");
    let mut last = read(&mut rig);
    while rig.arm.motion() == Motion::Moving {
        last = read(&mut rig);
        assert!(last.stamp.0 < 5_000_000_000, "it does not arrive");
    }
    for (target, reached) in target.iter().zip(&last.position) {
        assert!(
            (target - reached).abs() < 1e-3,
            "{reached}, commanded {target}"
        );
    }
}
