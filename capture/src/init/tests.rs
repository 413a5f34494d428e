//! Tests that every planned rig file is valid, and contains what was found and wanted.

use super::*;
use crate::config::schema_tests::problems_of;
use crate::config::{ArmDriver, BaseDriver, CameraDriver, Parent};
use crate::doctor::{Finding, guesses, suspicious_values};
use crate::known_robots::{KNOWN_ROBOTS, KnownRobot};
use crate::{Override, Rig};
use drivers::can::SettingValue;

/// A URDF with a joint for each name, and a gripper.
fn urdf(joints: &[&str]) -> String {
    let mut links = vec!["base".to_owned()];
    let mut text = String::new();
    let all: Vec<&str> = joints.iter().copied().chain(["gripper"]).collect();
    for (ix, name) in all.into_iter().enumerate() {
        let parent = links[ix].clone();
        let child = format!("link{ix}");
        text += &format!(
            r#"<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
            <origin xyz="0 0 0.2"/><axis xyz="0 {} {}"/>
            <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"#,
            ix % 2,
            (ix + 1) % 2
        );
        links.push(child);
    }
    let links: String = links
        .iter()
        .map(|link| format!(r#"<link name="{link}"/>"#))
        .collect();
    format!(r#"<robot name="arm">{links}{text}</robot>"#)
}

fn own_robot(joints: &[&str]) -> RobotChoice {
    RobotChoice::Urdf {
        path: "arm.urdf".to_owned(),
        text: urdf(joints),
    }
}

fn known(name: &str) -> RobotChoice {
    RobotChoice::Known(KnownRobot::find(name).expect(name))
}

fn wishes(robot: RobotChoice) -> Wishes {
    Wishes {
        robot,
        base_link: None,
        tip: None,
        cameras: Vec::new(),
        field_of_view_deg: 65.0,
        has_moving_base: false,
    }
}

fn wanted(parent: Parent) -> WantedCamera {
    WantedCamera {
        parent,
        device: None,
    }
}

fn webcam(device: &str) -> FoundCamera {
    FoundCamera {
        driver: CameraDriver::V4l2,
        device: device.to_owned(),
        name: "C920 \"Pro\"".to_owned(),
        size_px: [1280, 720],
        rate_hz: 30.0,
    }
}

fn realsense() -> FoundCamera {
    FoundCamera {
        driver: CameraDriver::Realsense,
        device: "817612070000".to_owned(),
        name: "Intel RealSense D435I".to_owned(),
        size_px: [640, 480],
        rate_hz: 30.0,
    }
}

fn controller(kind: ControllerKind, robot: Option<&str>) -> FoundController {
    FoundController {
        kind,
        address: "10.0.0.7".to_owned(),
        problem: None,
        robot: robot.map(|name| KnownRobot::find(name).expect(name)),
    }
}

fn damiao(id: u64) -> FoundMotor {
    FoundMotor {
        family: "damiao",
        id,
        reported: vec![("feedback_id", SettingValue::Whole(id + 16))],
    }
}

fn bus(interface: &str, motors: Vec<FoundMotor>) -> FoundBus {
    FoundBus {
        interface: interface.to_owned(),
        bitrate_hz: Some(500_000),
        restarts: true,
        motors,
    }
}

fn servos(driver: &'static str, n: u8) -> FoundServos {
    FoundServos {
        device: "/dev/serial/by-id/usb-1a86".to_owned(),
        driver,
        baud_hz: 1_000_000,
        ids: (1..=n).collect(),
    }
}

/// Writes the planned rig file, and reads it with the production reader.
fn rig(wishes: &Wishes, findings: &Findings) -> (Rig, RigPlan) {
    let plan = RigPlan::new(wishes, findings).expect("a plan");
    let text = plan.to_toml("rig.toml");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, &text).expect("written");
    if let RobotChoice::Urdf { path, text } = &wishes.robot {
        std::fs::write(folder.path().join(path), text).expect("written");
    }
    let rig =
        Rig::load(&path, &[] as &[Override]).unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_eq!(suspicious_values(&rig), [], "{text}");
    assert_eq!(problems_of(&text), Vec::<String>::new(), "{text}");
    for line in text.lines() {
        assert!(line.chars().count() <= 200, "{line}");
    }
    (rig, plan)
}

/// The keys that `doctor` calls guesses.
fn guessed_keys(plan: &RigPlan) -> Vec<String> {
    let findings = guesses(&plan.to_toml("rig.toml"));
    let key = |finding: &Finding| finding.message.split(' ').next().map(str::to_owned);
    findings.iter().filter_map(key).collect()
}

#[test]
fn commands_that_measure_guesses_are_complete() {
    let (_, plan) = rig(&wishes(RobotChoice::Automatic), &Findings::default());
    let remedies: Vec<String> = guesses(&plan.to_toml("my rig.toml"))
        .iter()
        .map(Finding::to_string)
        .collect();
    let remedies = remedies.join("\n");
    for command in [
        "`fieldrig calibrate intrinsics 'my rig.toml' camera wrist target charuco:",
        "`fieldrig calibrate hand-eye 'my rig.toml' camera wrist target charuco:",
        "`fieldrig calibrate scene 'my rig.toml' write_rig 'my rig.toml'`",
    ] {
        assert!(remedies.contains(command), "{remedies}");
    }
}

#[test]
fn doctor_names_every_guess_and_nothing_that_is_known() {
    let (_, plan) = rig(&wishes(RobotChoice::Automatic), &Findings::default());
    assert_eq!(
        guessed_keys(&plan),
        [
            "arm.urdf",
            "camera.wrist.parent",
            "camera.wrist.parent_from_camera",
            "camera.wrist.intrinsics"
        ]
    );
    let known = Wishes {
        cameras: vec![wanted(Parent::Flange)],
        ..wishes(known("ur5e"))
    };
    let findings = Findings {
        cameras: vec![realsense()],
        ..Findings::default()
    };
    let (_, plan) = rig(&known, &findings);
    assert_eq!(guessed_keys(&plan), ["camera.wrist.parent_from_camera"]);
    // The order of the servos and the flange of a file are guesses, too.
    let own = Wishes {
        cameras: vec![wanted(Parent::Flange)],
        ..wishes(own_robot(&["a", "b"]))
    };
    let findings = Findings {
        cameras: vec![realsense()],
        servos: vec![servos("feetech", 2)],
        ..Findings::default()
    };
    let (_, plan) = rig(&own, &findings);
    assert_eq!(
        guessed_keys(&plan),
        [
            "arm.flange_link",
            "arm.servo.a.id",
            "camera.wrist.parent_from_camera"
        ]
    );
}

/// Keys that are comments become keys of a valid rig file if their number sign is removed.
#[test]
fn commented_keys_are_valid() {
    let findings = Findings {
        servos: vec![servos("feetech", 6)],
        cameras: vec![webcam("/dev/video0")],
        ..Findings::default()
    };
    let plan = RigPlan::new(&wishes(RobotChoice::Automatic), &findings).expect("a plan");
    let text = plan.to_toml("rig.toml");
    let is_key = |line: &&str| {
        let key = line
            .trim_start_matches("# ")
            .split(' ')
            .next()
            .unwrap_or("");
        line.starts_with("# ") && line.contains(" = ") && key.contains('_')
            || line.starts_with("# [")
    };
    let with_keys: Vec<String> = text
        .lines()
        .map(|line| match is_key(&line) {
            true => line.trim_start_matches("# ").to_owned(),
            false => line.to_owned(),
        })
        .collect();
    let n_keys = text.lines().filter(|line| is_key(line)).count();
    assert_eq!(n_keys, 5, "{text}");
    let with_keys = with_keys.join("\n");
    Rig::parse("rig.toml", &with_keys, "", &[])
        .unwrap_or_else(|error| panic!("{error}\n{with_keys}"));
}

#[test]
fn rig_without_devices_is_an_example() {
    let (rig, plan) = rig(&wishes(RobotChoice::Automatic), &Findings::default());
    assert_eq!(rig.arm.driver, ArmDriver::Sim);
    assert_eq!(rig.arm.flange_link, "tool0");
    let camera = &rig.cameras[0];
    assert_eq!(
        (&*camera.name, camera.driver, camera.parent),
        ("wrist", CameraDriver::Sim, Parent::Flange)
    );
    assert_eq!(camera.intrinsics.principal_px, [320.0, 240.0]);
    let assumptions = plan.assumptions.join("\n");
    for words in [
        "no arm was found",
        "is simulated",
        "field of view of 65 degrees",
    ] {
        assert!(assumptions.contains(words), "{assumptions}");
    }
    assert!(plan.cameras_without_lens().is_empty());
}

#[test]
fn every_known_robot_has_a_rig() {
    for robot in KNOWN_ROBOTS {
        let mut wishes = wishes(RobotChoice::Known(robot));
        wishes.cameras = [Parent::Flange, Parent::Base, Parent::World, Parent::World]
            .map(wanted)
            .to_vec();
        let (rig, _) = rig(&wishes, &Findings::default());
        assert_eq!(rig.arm.joints, robot.joints);
        let names: Vec<_> = rig.cameras.iter().map(|camera| &*camera.name).collect();
        assert_eq!(names, ["front", "overview", "overview2", "wrist"]);
    }
}

#[test]
fn controllers_determine_robot_and_driver() {
    for (kind, identified, expected) in [
        (ControllerKind::Ur, Some("ur10e"), "ur10e"),
        (ControllerKind::Ur, None, "ur5e"),
        (ControllerKind::Franka, None, "fr3"),
    ] {
        let findings = Findings {
            controllers: vec![controller(kind, identified)],
            cameras: vec![realsense(), webcam("/dev/video4")],
            ..Findings::default()
        };
        let (rig, plan) = rig(&wishes(RobotChoice::Automatic), &findings);
        let driver = match kind {
            ControllerKind::Franka => ArmDriver::Franka,
            ControllerKind::Ur => ArmDriver::Ur,
        };
        assert_eq!((rig.arm.driver, &*rig.arm.address), (driver, "10.0.0.7"));
        let robot = KnownRobot::find(expected).expect(expected);
        assert_eq!(rig.arm.joints, robot.joints);
        assert_eq!(rig.arm.urdf_text, robot.urdf);
        let cameras: Vec<_> = rig
            .cameras
            .iter()
            .map(|camera| {
                (
                    &*camera.name,
                    camera.driver,
                    &*camera.device,
                    camera.depth.is_some(),
                )
            })
            .collect();
        assert_eq!(
            cameras,
            [
                ("overview", CameraDriver::V4l2, "/dev/video4", false),
                ("wrist", CameraDriver::Realsense, "817612070000", true),
            ]
        );
        assert_eq!(plan.cameras_without_lens(), ["overview"]);
    }
}

#[test]
fn controller_of_another_robot_is_not_used() {
    let findings = Findings {
        controllers: vec![controller(ControllerKind::Franka, None)],
        ..Findings::default()
    };
    let (rig, plan) = rig(&wishes(known("ur5e")), &findings);
    assert_eq!(rig.arm.driver, ArmDriver::Sim);
    let assumptions = plan.assumptions.join("\n");
    assert!(
        assumptions.contains("belongs to another robot"),
        "{assumptions}"
    );
}

#[test]
fn servos_move_the_joints_in_the_order_of_their_ids() {
    let findings = Findings {
        servos: vec![servos("feetech", 6)],
        cameras: vec![webcam("/dev/video0"), webcam("/dev/video2")],
        ..Findings::default()
    };
    let (rig, _) = rig(&wishes(RobotChoice::Automatic), &findings);
    assert_eq!(rig.arm.driver, ArmDriver::Feetech);
    let servos: Vec<_> = rig
        .arm
        .servos
        .iter()
        .map(|servo| (&*servo.joint, servo.id))
        .collect();
    let expected = [
        ("shoulder_pan", 1),
        ("shoulder_lift", 2),
        ("elbow_flex", 3),
        ("wrist_flex", 4),
        ("wrist_roll", 5),
    ];
    assert_eq!(servos, expected);
    let parents: Vec<_> = rig.cameras.iter().map(|camera| camera.parent).collect();
    assert_eq!(parents, [Parent::World, Parent::Flange]);
}

#[test]
fn too_few_servos_are_left_out() {
    let findings = Findings {
        servos: vec![servos("feetech", 4)],
        ..Findings::default()
    };
    let (rig, plan) = rig(&wishes(known("so101")), &findings);
    assert_eq!(rig.arm.driver, ArmDriver::Sim);
    assert!(plan.assumptions.join("\n").contains("the 4 feetech servos"));
}

#[test]
fn dynamixel_servos_need_a_urdf() {
    let findings = Findings {
        servos: vec![servos("dynamixel", 6)],
        ..Findings::default()
    };
    let error = RigPlan::new(&wishes(RobotChoice::Automatic), &findings).expect_err("no robot");
    assert!(error.to_string().contains("urdf FILE"), "{error}");
    let (rig, _) = rig(
        &wishes(own_robot(&["waist", "my elbow", "wrist"])),
        &findings,
    );
    assert_eq!(rig.arm.driver, ArmDriver::Dynamixel);
    assert_eq!(rig.arm.joints, ["waist", "my elbow", "wrist"]);
    assert_eq!(rig.arm.servos[1].joint, "my elbow");
}

#[test]
fn motors_of_all_buses_move_the_joints() {
    let slow = FoundBus {
        restarts: false,
        ..bus(
            "can1",
            vec![FoundMotor {
                family: "robstride",
                id: 127,
                reported: Vec::new(),
            }],
        )
    };
    let findings = Findings {
        buses: vec![
            bus("can0", vec![damiao(1), damiao(2)]),
            slow,
            bus("can2", Vec::new()),
        ],
        ..Findings::default()
    };
    let error = RigPlan::new(&wishes(RobotChoice::Automatic), &findings).expect_err("no robot");
    assert!(
        error.to_string().contains("motors were found, but"),
        "{error}"
    );
    let (rig, plan) = rig(&wishes(own_robot(&["a", "b", "c"])), &findings);
    assert_eq!(rig.arm.driver, ArmDriver::Can);
    let motors: Vec<_> = rig
        .arm
        .motors
        .iter()
        .map(|motor| (&*motor.joint, motor.protocol.family().name(), motor.bus_ix))
        .collect();
    assert_eq!(
        motors,
        [
            ("a", "damiao", 0),
            ("b", "damiao", 0),
            ("c", "robstride", 1)
        ]
    );
    assert_eq!(
        rig.arm.motors[1].protocol.settings().whole("feedback_id"),
        Some(18)
    );
    assert_eq!(rig.arm.buses.len(), 2);
    assert!(rig.arm.buses[1].accept_no_restart);
    assert_eq!(rig.arm.buses[0].bitrate_hz, 500_000);
    assert!(plan.assumptions.join("\n").contains("without gears"));
    // With another number of joints, it is unknown which motor moves which joint.
    let (rig, plan) = self::rig(&wishes(own_robot(&["a", "b"])), &findings);
    assert_eq!(rig.arm.driver, ArmDriver::Sim);
    assert!(
        plan.assumptions
            .join("\n")
            .contains("the 3 motors on CAN buses are left out")
    );
}

#[test]
fn every_family_gives_a_valid_file() {
    for family in drivers::can::FAMILIES {
        let motor = FoundMotor {
            family: family.name(),
            id: 5,
            reported: Vec::new(),
        };
        let findings = Findings {
            buses: vec![bus("can0", vec![motor])],
            ..Findings::default()
        };
        let (rig, _) = rig(&wishes(own_robot(&["only"])), &findings);
        assert_eq!(rig.arm.motors[0].protocol.family().name(), family.name());
    }
}

#[test]
fn robots_without_arm_and_moving_bases_are_possible() {
    let (fixed, _) = rig(&wishes(RobotChoice::None), &Findings::default());
    assert_eq!(
        (fixed.arm.driver, fixed.base.driver),
        (ArmDriver::None, BaseDriver::Fixed)
    );
    assert_eq!(fixed.cameras[0].parent, Parent::World);
    let wishes = Wishes {
        has_moving_base: true,
        ..wishes(RobotChoice::None)
    };
    let findings = Findings {
        cameras: vec![webcam("/dev/video0"), realsense()],
        ..Findings::default()
    };
    let (mobile, _) = rig(&wishes, &findings);
    assert_eq!(mobile.base.driver, BaseDriver::Udp);
    assert!(
        mobile
            .cameras
            .iter()
            .all(|camera| camera.parent == Parent::Base)
    );
    let wishes = Wishes {
        cameras: vec![wanted(Parent::Flange)],
        ..wishes
    };
    let error = RigPlan::new(&wishes, &findings).expect_err("no flange");
    assert!(
        error.to_string().contains("camera base or camera world"),
        "{error}"
    );
}

#[test]
fn named_devices_are_used_whether_or_not_they_are_connected() {
    let findings = Findings {
        cameras: vec![webcam("/dev/video0"), webcam("/dev/video2")],
        ..Findings::default()
    };
    let camera = |parent, device: Option<&str>| WantedCamera {
        parent,
        device: device.map(str::to_owned),
    };
    let wishes = Wishes {
        cameras: vec![
            camera(Parent::Flange, Some("/dev/video2")),
            camera(Parent::World, None),
            camera(Parent::Base, Some("/dev/video8")),
        ],
        ..wishes(known("panda"))
    };
    let (rig, _) = rig(&wishes, &findings);
    let device = |name: &str| {
        let camera = rig.cameras.iter().find(|camera| &*camera.name == name);
        camera.expect(name).device.clone()
    };
    assert_eq!(
        ["wrist", "overview", "front"].map(device),
        ["/dev/video2", "/dev/video0", "/dev/video8"]
    );
}
