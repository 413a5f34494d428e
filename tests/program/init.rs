//! Tests `fieldrig init` with emulated devices, and what other commands do with its rig files.

#![cfg(target_os = "linux")]

use crate::command::{fieldrig, stderr};
use drivers::servos::emulated::{EmulatedServo, EmulatedServoBus, ServoKind};
use drivers::ur::emulated::{ControllerConfig, EmulatedController, Joints};
use kinematics::Chain;
use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::Path;

/// Joint angles at which the arms of Universal Robots differ by decimeters.
const REST_RAD: [f64; 6] = [0.3, -1.4, 1.6, -1.8, -1.5, 0.4];

/// Runs `init` and returns its output and the rig file.
fn init(folder: &Path, args: &[&str]) -> (String, toml::Table) {
    let output = fieldrig(folder, &[&["init"], args].concat());
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{printed}{}", stderr(&output));
    let text = std::fs::read_to_string(folder.join("rig.toml")).expect("a rig file");
    (printed, text.parse().expect("TOML"))
}

/// The checks of `doctor` that fail.
fn failed_checks(folder: &Path, args: &[&str]) -> BTreeSet<String> {
    let output = fieldrig(folder, &[&["doctor", "--json"], args].concat());
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    let findings = printed.lines().map(|line| -> serde_json::Value {
        serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))
    });
    findings
        .filter(|finding| finding["verdict"] == "fail")
        .map(|finding| finding.to_string())
        .collect()
}

/// Asserts that the rig file causes no problem that this computer does not have anyway.
fn assert_doctor_accepts(folder: &Path) {
    assert_eq!(
        failed_checks(folder, &["rig.toml"]),
        failed_checks(folder, &[])
    );
}

/// An address whose port, and the ports below it for the other interfaces, are free.
fn free_address() -> SocketAddr {
    // Each test process has its own loopback address.
    let [_, _, high, low] = std::process::id().to_be_bytes();
    (Ipv4Addr::new(127, 39, high, low.clamp(1, 254)), 30004).into()
}

#[test]
fn controller_is_identified_by_its_flange() {
    let folder = tempfile::tempdir().expect("a folder");
    let urdf = include_str!("../../rigs/robots/ur10e.urdf");
    let chain = Chain::from_urdf(urdf, "base", "tool0").expect("a known robot");
    let address = free_address();
    let rest = Joints {
        position_rad: REST_RAD,
        ..Joints::default()
    };
    let config = ControllerConfig::e_series(address, chain);
    let emulated = EmulatedController::start(config, Box::new(move |_, _| rest));
    let emulated = emulated.expect("the address is free");
    let (printed, rig) = init(folder.path(), &["--ur", &address.to_string()]);
    assert!(printed.contains("Universal Robots UR10e"), "{printed}");
    assert_eq!(rig["arm"]["driver"].as_str(), Some("ur"));
    assert_eq!(rig["arm"]["urdf"].as_str(), Some("builtin:ur10e"));
    assert_doctor_accepts(folder.path());
    drop(emulated);
    assert!(
        !failed_checks(folder.path(), &["rig.toml"]).is_empty(),
        "the controller is gone"
    );
}

#[test]
fn a_server_of_another_kind_is_not_found_as_a_controller() {
    let folder = tempfile::tempdir().expect("a folder");
    let server = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = server.local_addr().expect("bound").to_string();
    // It accepts connections and closes them, as a server does with requests of other protocols.
    std::thread::spawn(move || server.incoming().for_each(drop));
    let (printed, rig) = init(folder.path(), &["--ur", &address]);
    let row = printed.lines().find(|line| line.contains(&*address));
    assert!(
        row.is_some_and(|row| row.starts_with("  not found")),
        "{printed}"
    );
    // The user may know better: the controller may be switched off.
    assert_eq!(rig["arm"]["address"].as_str(), Some(&*address));
}

#[test]
fn servos_become_the_joints_of_an_so101() {
    let folder = tempfile::tempdir().expect("a folder");
    let port = folder.path().join("servos");
    let servos = (1..=6).map(|id| EmulatedServo::new(ServoKind::Feetech, id, 2048));
    let bus = EmulatedServoBus::start(ServoKind::Feetech, servos.collect(), &port, |_, _| {});
    let bus = bus.expect("a pseudo terminal");
    let port = port.display().to_string();
    // The robot is named, so that a controller in the network of the developer is not used.
    let (printed, rig) = init(
        folder.path(),
        &[
            "--robot", "so101", "--serial", &port, "--camera", "flange", "--camera", "world",
        ],
    );
    assert!(
        printed.contains("feetech servos 1, 2, 3, 4, 5, 6"),
        "{printed}"
    );
    assert_eq!(rig["arm"]["driver"].as_str(), Some("feetech"));
    assert_eq!(
        rig["arm"]["servo"]["wrist_roll"]["id"].as_integer(),
        Some(5)
    );
    assert_eq!(rig["camera"].as_table().map(toml::Table::len), Some(2));
    assert!(bus.line().servos.iter().all(|servo| !servo.is_enabled()));
    assert_doctor_accepts(folder.path());
}

#[test]
fn existing_files_are_only_replaced_by_force() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, "# mine\n").expect("written");
    let output = fieldrig(folder.path(), &["init", "--robot", "ur5e"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        stderr(&output).contains("rig.toml exists"),
        "{}",
        stderr(&output)
    );
    let kept = std::fs::read_to_string(&path).expect("kept");
    assert_eq!(kept, "# mine\n");
    init(folder.path(), &["--robot", "ur5e", "--force"]);
}

#[test]
fn init_checks_the_folder_before_it_searches() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = fieldrig(
        folder.path(),
        &["init", "absent/rig.toml", "--robot", "ur5e"],
    );
    let printed = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{printed}");
    assert!(
        printed.contains("the folder absent does not exist; create it"),
        "{printed}"
    );
    assert!(!printed.contains("searching"), "{printed}");
}

#[test]
fn urdf_is_named_relative_to_the_rig_file() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(folder.path().join("robots")).expect("a folder");
    let urdf = include_str!("../../kinematics/tests/data/ur5e-dh.urdf");
    let mesh = "<visual><geometry><mesh filename=\"package://arm/base.dae\"/></geometry></visual>";
    let with_mesh = format!("<link name=\"base_link\">{mesh}</link>");
    let urdf = urdf.replace("<link name=\"base_link\"/>", &with_mesh);
    std::fs::write(folder.path().join("robots/arm.urdf"), urdf).expect("written");
    let (printed, rig) = init(folder.path(), &["--urdf", "robots/arm.urdf", "--yes"]);
    assert_eq!(rig["arm"]["urdf"].as_str(), Some("robots/arm.urdf"));
    assert_eq!(rig["arm"]["flange_link"].as_str(), Some("tool0"));
    assert!(printed.contains("wrist_3_joint"), "{printed}");
    assert!(
        printed.contains("1 of 1 mesh file of the robot description is missing, the first is \"package://arm/base.dae\""),
        "{printed}"
    );
    assert_doctor_accepts(folder.path());
}

#[test]
fn unknown_robots_and_places_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    for (args, words) in [
        (
            ["--robot", "ur5"],
            "a UR5 has a shoulder that is 73 mm lower",
        ),
        (["--camera", "wrist"], "flange, base or world"),
        (["--urdf", "absent.urdf"], "absent.urdf"),
        (["--ur", "192.168.1"], "four numbers from 0 to 255"),
        (["--franka", "robot:fci"], "is not a number up to 65535"),
    ] {
        let output = fieldrig(folder.path(), &[&["init"], &args[..]].concat());
        assert!(!output.status.success());
        assert!(stderr(&output).contains(words), "{}", stderr(&output));
    }
    let output = fieldrig(folder.path(), &["init", "--robot", "list"]);
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        printed.contains("so101") && printed.contains("Franka Research 3"),
        "{printed}"
    );
    assert!(!folder.path().join("rig.toml").exists());
}

/// Every known robot, and cameras at every place, are simulated from the written file.
#[cfg(feature = "sim")]
#[test]
fn written_files_run_in_the_simulation() {
    const CAMERAS: [(&str, &[&str]); 3] = [
        ("ur5e", &[]),
        ("so101", &["--camera", "flange", "--camera", "world"]),
        ("panda", &["--camera", "world"]),
    ];
    for (robot, cameras) in CAMERAS {
        let folder = tempfile::tempdir().expect("a folder");
        init(folder.path(), &[&["--robot", robot], cameras].concat());
        let args = "run rig.toml --sim --lockstep --steps 5 --listen 127.0.0.1:0 --out run";
        let args: Vec<&str> = args.split(' ').collect();
        let output = fieldrig(folder.path(), &args);
        assert!(output.status.success(), "{robot}: {}", stderr(&output));
        assert!(folder.path().join("run/report.json").exists(), "{robot}");
    }
}
