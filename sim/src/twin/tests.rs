//! Plans scans for arms with four to seven joints, and checks MuJoCo's model against the kinematics.

use super::description::RobotConfig;
use super::plan::{TwinPlan, plan};
use super::trial::{Trial, sees};
use crate::config::{CameraConfig, Config, Parent, Scene, SensorConfig};
use crate::joints::Joints;
use crate::objects::{TABLE_Z_M, TARGET_XY_M};
use crate::scan::LOOK_AT_HEIGHT_M;
use crate::{Error, scene};
use kinematics::Transform;
use mujoco_rs::prelude::{MjData, MjtObjBase};
use nalgebra::{Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;

const SCARA4: &str = include_str!("../../tests/robots/scara4.urdf");
const DESK5: &str = include_str!("../../tests/robots/desk5.urdf");
const BENCH6: &str = include_str!("../../tests/robots/bench6.urdf");
const RAIL6: &str = include_str!("../../tests/robots/rail6.urdf");

/// A rig with one camera on the flange.
fn config(urdf: &str, base_link: &str, flange_link: &str, flange_from_camera: Transform) -> Config {
    let chain = kinematics::Chain::from_urdf(urdf, base_link, flange_link).expect("a fixture");
    let camera = CameraConfig {
        parent_from_camera: flange_from_camera,
        depth: None,
        ..CameraConfig::wrist("wrist")
    };
    Config {
        joint_names: chain.joint_names().to_vec(),
        reading_order: chain.joint_names().to_vec(),
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

/// A camera that looks along -z of its frame.
fn downward() -> Transform {
    Transform::from_parts(
        Translation3::new(0.05, 0.0, 0.0),
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
    )
}

/// A camera that looks along x of its frame.
fn forward() -> Transform {
    let axes =
        nalgebra::Rotation3::from_basis_unchecked(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
    Transform::from_parts(
        Translation3::new(0.0, 0.0, 0.04),
        UnitQuaternion::from_rotation_matrix(&axes),
    )
}

fn arms() -> Vec<(&'static str, Config)> {
    let along_z = Transform::translation(0.0, 0.06, 0.0);
    let longer = crate::PANDA_URDF.replace("0.316", "0.416");
    assert_ne!(longer, crate::PANDA_URDF);
    vec![
        ("scara4", config(SCARA4, "base", "tool", downward())),
        ("desk5", config(DESK5, "base", "gripper", forward())),
        ("bench6", config(BENCH6, "base_link", "tool0", along_z)),
        ("rail6", config(RAIL6, "rail", "tool", along_z)),
        (
            "longer Panda",
            config(&longer, "panda_link0", "panda_link8", along_z),
        ),
    ]
}

fn planned(config: &Config) -> TwinPlan {
    let robot = config.robot.as_ref().expect("a robot");
    plan(config, robot).expect("a scene")
}

fn center_in_world(plan: &TwinPlan) -> Point3<f64> {
    let [x, y] = TARGET_XY_M;
    plan.world_from_scene * Point3::new(x, y, TABLE_Z_M + LOOK_AT_HEIGHT_M)
}

#[test]
fn arms_of_four_to_seven_joints_scan_the_table() {
    /// A SCARA arm cannot tilt its camera, so its views differ less.
    const MIN_SPREAD_RAD: f64 = 0.12;
    for (name, config) in arms() {
        let plan = planned(&config);
        let follower = plan.follower.clone().expect("it has joints");
        let trial = Trial::of(follower, &config.cameras[0], &center_in_world(&plan));
        assert!(trial.visible_frac > 0.7, "{name}: {trial:?}");
        assert!(trial.spread_rad > MIN_SPREAD_RAD, "{name}: {trial:?}");
    }
}

#[test]
fn scans_stay_within_limits_and_above_the_table() {
    const STEP_SECS: f64 = 0.005;
    for (name, config) in arms() {
        let plan = planned(&config);
        let mut follower = plan.follower.clone().expect("it has joints");
        let table_z_m = center_in_world(&plan).z - LOOK_AT_HEIGHT_M;
        let mut secs = 0.0;
        while secs < 20.0 {
            secs += STEP_SECS;
            follower.advance(secs, STEP_SECS);
            let eye = follower
                .base_from_camera(&config.cameras[0].parent_from_camera)
                .translation
                .vector;
            assert!(eye.z > table_z_m + 0.03, "{name}: {eye} at {secs} s");
            for (ix, range) in plan.model.ranges().iter().enumerate() {
                let (position, velocity) = (follower.position()[ix], follower.velocity()[ix]);
                assert!(
                    (range.lower..=range.upper).contains(&position),
                    "{name}: joint {ix} at {position}"
                );
                assert!(
                    velocity.abs() <= 0.75 * range.max_speed,
                    "{name}: joint {ix} moves at {velocity}"
                );
            }
        }
    }
}

#[test]
fn links_in_mujoco_match_the_kinematics() {
    const TOLERANCE_M: f64 = 1e-9;
    const TOLERANCE_RAD: f64 = 1e-7; // Of an angle that is computed by an arc cosine.
    for (name, config) in arms() {
        let plan = planned(&config);
        let robot = config.robot.as_ref().expect("a robot");
        let model = scene::build_twin(&config, (robot, &plan), [64, 64]).expect("a model");
        let mut data = MjData::new(&model);
        let position = Joints::from_iterator(
            plan.model.n_joints(),
            plan.model.ranges().iter().enumerate().map(|(ix, range)| {
                range.lower + (0.3 + 0.05 * ix as f64) * (range.upper - range.lower)
            }),
        );
        data.qpos_mut()
            .copy_from_slice(&plan.model.model_positions(&position));
        data.forward_kinematics();
        let poses = plan.model.base_from_links(&position);
        for (ix, pose) in poses.iter().enumerate() {
            let body = model
                .name_to_id(MjtObjBase::mjOBJ_BODY, &format!("link{ix}"))
                .expect("a body");
            let [w, x, y, z] = data.xquat()[body];
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let error_m = (pose.translation.vector - Vector3::from(data.xpos()[body])).norm();
            assert!(error_m < TOLERANCE_M, "{name}, link {ix}: {error_m} m");
            assert!(
                pose.rotation.angle_to(&rotation) < TOLERANCE_RAD,
                "{name}, link {ix}"
            );
        }
    }
}

#[test]
fn long_exposures_slow_the_scan_down() {
    let mut config = config(
        BENCH6,
        "base_link",
        "tool0",
        Transform::translation(0.0, 0.06, 0.0),
    );
    config.cameras[0].sensor = SensorConfig {
        exposure_micros: 8000.0,
        ..SensorConfig::default()
    };
    let plan = planned(&config);
    let follower = plan.follower.clone().expect("it has joints");
    let trial = Trial::of(follower, &config.cameras[0], &center_in_world(&plan));
    let blur_px = 0.008 * trial.fast_px_s;
    assert!(blur_px < 1.5 && blur_px > 0.2, "{blur_px} px");
}

fn fixed_camera(name: &str, eye: Point3<f64>, at: Point3<f64>) -> CameraConfig {
    CameraConfig {
        parent: Parent::World,
        parent_from_camera: Transform::from_parts(
            eye.into(),
            UnitQuaternion::face_towards(&(at - eye), &-Vector3::z()),
        ),
        depth: None,
        ..CameraConfig::wrist(name)
    }
}

const NO_ARM: &str = r#"<robot name="none"><link name="base"/></robot>"#;

#[test]
fn fixed_cameras_get_a_table_in_front_of_them() {
    let mut config = config(NO_ARM, "base", "base", Transform::identity());
    let at = Point3::new(1.0, 2.0, 0.3);
    config.cameras = vec![
        fixed_camera("left", Point3::new(0.4, 1.7, 0.9), at),
        fixed_camera("right", Point3::new(1.7, 1.6, 0.8), at),
    ];
    let plan = planned(&config);
    assert!(plan.follower.is_none());
    let center = center_in_world(&plan);
    for camera in &config.cameras {
        assert!(sees(
            &camera.intrinsics,
            &camera.parent_from_camera,
            &center
        ));
    }
    assert!((center - at).norm() < 0.4, "{center}");
}

#[test]
fn cameras_that_cannot_see_the_scene_are_errors() {
    let mut config = config(
        BENCH6,
        "base_link",
        "tool0",
        Transform::translation(0.0, 0.06, 0.0),
    );
    config.cameras.push(fixed_camera(
        "ceiling",
        Point3::new(0.0, 0.0, 1.0),
        Point3::new(0.1, 0.0, 3.0),
    ));
    let robot = config.robot.clone().expect("a robot");
    let error = plan(&config, &robot).err().expect("it looks up");
    let message = error.to_string();
    assert!(
        message.contains("\"ceiling\"") && message.contains("camera.ceiling.parent_from_camera"),
        "{message}"
    );
    config.scene = Scene::MobileArm;
    let error = plan(&config, &robot).err().expect("another robot");
    assert!(
        matches!(error, Error::SceneOfAnotherRobot { .. }),
        "{error}"
    );
}

#[test]
fn moving_bases_stand_on_the_floor_of_a_room() {
    const MANIPULATOR: &str = r#"<robot name="m"><link name="base_link">
        <visual><origin xyz="0 0 0.05"/><geometry><box size="0.5 0.4 0.3"/></geometry></visual></link>
      <link name="arm"/> <link name="tool"/>
      <joint name="a" type="continuous"><parent link="base_link"/><child link="arm"/><origin xyz="0.1 0 0.2"/><axis xyz="0 0 1"/></joint>
      <joint name="b" type="continuous"><parent link="arm"/><child link="tool"/><origin xyz="0.2 0 0.3"/><axis xyz="0 1 0"/></joint>
    </robot>"#;
    let mut config = config(MANIPULATOR, "base_link", "tool", forward());
    config.scene = Scene::MobileBase;
    config.robot.as_mut().expect("a robot").has_moving_base = true;
    let plan = planned(&config);
    let at = |secs: f64| plan.motion.world_from_base(secs).translation.vector;
    assert!((at(3.0).z - 0.1).abs() < 1e-9, "{}", at(3.0));
    assert!((at(3.0) - at(9.0)).norm() > 0.5);
    // The camera looks ahead.
    let follower = plan.follower.clone().expect("an arm");
    let camera = follower.base_from_camera(&config.cameras[0].parent_from_camera);
    let ahead = (camera.rotation * Vector3::z()).x;
    assert!(ahead > 0.8, "{ahead}");
}
