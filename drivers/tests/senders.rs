//! Tests of the programs in `scripts/senders`: their datagrams are read by the drivers for arms and
//! bases that send UDP. The packages of the robots are replaced by small fakes in `senders/fakes`. If a
//! package is installed, it is also tested against an emulated controller.
#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use drivers::udp::{UdpArm, UdpBase};
use drivers::{Arm, Base, Error, clock};
use kinematics::JointState;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Time in which a program must have started on a slow machine.
const MAX_START: Duration = Duration::from_secs(120);

/// Rounding of decimal numbers in JSON.
const CLOSE: f64 = 1e-9;

const UR_JOINTS: [&str; 6] = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
];

/// Pose and speed of the emulated Universal Robots arm, rad and rad/s.
const UR_POSITION_RAD: [f64; 6] = [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3];
const UR_VELOCITY_RAD_S: [f64; 6] = [0.0, 0.01, 0.02, 0.03, 0.04, 0.05];

const SO101_JOINTS: [&str; 5] = [
    "shoulder_pan",
    "shoulder_lift",
    "elbow_flex",
    "wrist_flex",
    "wrist_roll",
];

/// Readings of the emulated servos, and the middles of the ranges in `so101-calibration.json`.
const SO101_READINGS: [f64; 5] = [2048.0, 1024.0, 3000.0, 2100.0, 2047.0];
const SO101_MIDDLES: [f64; 5] = [2048.0, 2050.0, 1950.0, 2050.0, 2047.5];

/// Steps of a servo per turn, as `lerobot` counts them.
const STEPS_PER_TURN: f64 = 4095.0;

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn test_file(name: &str) -> PathBuf {
    repository().join("drivers/tests/senders").join(name)
}

fn sender(name: &str) -> PathBuf {
    repository().join("scripts/senders").join(name)
}

/// Python with these folders on its path. It writes no compiled files into the repository.
fn python(folders: &[PathBuf]) -> Command {
    let mut python = Command::new("python3");
    let path = std::env::join_paths(folders).unwrap();
    python
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .stdin(Stdio::null());
    if !folders.is_empty() {
        python.env("PYTHONPATH", path);
    }
    python
}

/// Whether `python3` runs this code. If not, the calling test is skipped.
fn is_runnable(code: &str, reason: &str) -> bool {
    let status = python(&[])
        .args(["-c", code])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    let is_runnable = status.is_ok_and(|status| status.success());
    if !is_runnable {
        test_support::skip(reason);
    }
    is_runnable
}

fn has_python() -> bool {
    is_runnable("import json", "python3 is not installed")
}

/// A running program, which ends with the test.
struct Running(Child);

impl Running {
    fn start(command: &mut Command) -> Self {
        Self(
            command
                .stdout(Stdio::piped())
                .stderr(Stdio::piped())
                .spawn()
                .unwrap(),
        )
    }

    fn has_ended(&mut self) -> bool {
        self.0.try_wait().unwrap().is_some()
    }

    /// The first line that the program prints.
    fn first_line(&mut self) -> String {
        let mut line = String::new();
        let out = self.0.stdout.as_mut().unwrap();
        BufReader::new(out).read_line(&mut line).unwrap();
        line.trim().to_owned()
    }

    /// What a program that has ended printed as errors.
    fn errors(&mut self) -> String {
        let mut text = String::new();
        let errors = self.0.stderr.as_mut().unwrap();
        errors.read_to_string(&mut text).unwrap();
        text
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn open_arm(joints: &[&str]) -> UdpArm {
    let joints: Vec<String> = joints.iter().map(|&joint| joint.to_owned()).collect();
    UdpArm::open(&joints, "127.0.0.1:0".parse().unwrap()).unwrap()
}

/// Runs `command` with the address of the arm, and returns the first states that arrive. If the
/// program ends before, it is started again while `may_fail` returns true for its errors.
fn states(
    arm: &mut UdpArm,
    n_states: usize,
    command: &mut Command,
    may_fail: impl Fn(&str) -> bool,
) -> Vec<JointState> {
    command.args(["--to", &arm.address().to_string()]);
    let start = Instant::now();
    let mut program = Running::start(command);
    let mut states = Vec::new();
    while states.len() < n_states {
        match arm.read(Duration::from_millis(200)) {
            Ok(state) => states.push(state),
            Err(Error::NoJoints { .. }) => {
                assert!(start.elapsed() < MAX_START, "no states: {:?}", arm.counts());
                if program.has_ended() {
                    let errors = program.errors();
                    assert!(may_fail(&errors), "{errors}");
                    program = Running::start(command);
                }
            }
            Err(other) => panic!("{other}"),
        }
    }
    let counts = arm.counts();
    assert_eq!(counts.n_rejected, 0, "{counts:?}");
    assert_eq!(counts.n_foreign, 0, "{counts:?}");
    states
}

fn never(_: &str) -> bool {
    false
}

fn assert_close(numbers: &[f64], expected: &[f64]) {
    assert_eq!(numbers.len(), expected.len(), "{numbers:?}");
    for (number, expected) in numbers.iter().zip(expected) {
        assert!((number - expected).abs() < CLOSE, "{numbers:?}");
    }
}

fn assert_stamps_increase(states: &[JointState]) {
    let is_later = |pair: &[JointState]| pair[0].stamp < pair[1].stamp;
    assert!(states.windows(2).all(is_later));
}

#[test]
fn ros_states_are_matched_by_name_beside_other_joints() {
    if !has_python() {
        return;
    }
    let mut arm = open_arm(&["a", "b", "c"]);
    let mut command = python(&[test_file("fakes")]);
    command
        .arg(sender("ros2_joints.py"))
        .args(["--topic", "/arm/joint_states"]);
    let states = states(&mut arm, 20, &mut command, never);
    for state in &states {
        assert_close(&state.position, &[0.1, 0.2, 0.3]);
        assert_close(&state.velocity, &[1.0, 2.0, 3.0]);
        assert!(state.effort.is_empty());
    }
    assert_stamps_increase(&states);
    // States of the gripper are on the same topic.
    assert!(arm.counts().n_other > 0, "{:?}", arm.counts());
}

#[test]
fn ros_stamps_of_the_same_computer_become_monotonic() {
    if !has_python() {
        return;
    }
    let start = clock::now();
    let mut arm = open_arm(&["a", "b", "c"]);
    let mut command = python(&[test_file("fakes")]);
    command
        .arg(sender("ros2_joints.py"))
        .args(["--topic", "/arm/joint_states", "--same-computer"]);
    let states = states(&mut arm, 20, &mut command, never);
    let end = clock::now();
    assert_stamps_increase(&states);
    for state in &states {
        assert!(start < state.stamp && state.stamp < end, "{state:?}");
    }
}

#[test]
fn ros_odometry_becomes_base_poses() {
    if !has_python() {
        return;
    }
    const MAX_SIGMA: [f64; 2] = [0.1, 0.1];
    let mut base = UdpBase::open("127.0.0.1:0".parse().unwrap(), MAX_SIGMA).unwrap();
    let mut command = python(&[test_file("fakes")]);
    command
        .arg(sender("ros2_base.py"))
        .args(["--to", &base.address().to_string()]);
    let start = Instant::now();
    let mut program = Running::start(&mut command);
    let mut poses = Vec::new();
    while poses.len() < 20 {
        match base.next_pose(Duration::from_millis(200)) {
            Ok(pose) => poses.push(pose),
            Err(Error::NoBasePose { .. }) => {
                assert!(!program.has_ended(), "{}", program.errors());
                assert!(start.elapsed() < MAX_START, "{:?}", base.counts());
            }
            Err(other) => panic!("{other}"),
        }
    }
    for pose in &poses {
        let position_m = pose.world_from_base.translation.vector;
        assert_close(position_m.as_slice(), &[1.25, -0.5, 0.0]);
        let rotation = pose.world_from_base.rotation;
        assert_close(rotation.coords.as_slice(), &[0.0, 0.0, 0.6, 0.8]);
    }
    assert!(poses.windows(2).all(|pair| pair[0].stamp < pair[1].stamp));
    assert_eq!(base.counts().n_rejected, 0, "{:?}", base.counts());
}

fn check_ur_states(states: &[JointState]) {
    for state in states {
        assert_close(&state.position, &UR_POSITION_RAD);
        assert_close(&state.velocity, &UR_VELOCITY_RAD_S);
    }
    assert_stamps_increase(states);
}

#[test]
fn states_of_a_universal_robots_arm_are_sent() {
    if !has_python() {
        return;
    }
    let mut arm = open_arm(&UR_JOINTS);
    let mut command = python(&[test_file("fakes")]);
    command.arg(sender("ur_joints.py")).arg("127.0.0.2");
    check_ur_states(&states(&mut arm, 20, &mut command, never));
}

#[test]
fn the_package_ur_rtde_reads_an_emulated_controller() {
    // The emulator uses `match`.
    let code = "import sys, rtde_receive; sys.exit(sys.version_info < (3, 10))";
    if !is_runnable(code, "the Python package ur_rtde is not installed") {
        return;
    }
    // No other test listens on this address. The package always connects to port 30004.
    let address = "127.0.0.77";
    let mut controller =
        Running::start(python(&[]).arg(test_file("ur_controller.py")).arg(address));
    assert_eq!(controller.first_line(), "listening");
    let mut arm = open_arm(&UR_JOINTS);
    let mut command = python(&[]);
    command.arg(sender("ur_joints.py")).arg(address);
    let is_too_slow = |errors: &str| errors.contains("no connection to");
    check_ur_states(&states(&mut arm, 20, &mut command, is_too_slow));
}

fn check_so101_states(states: &[JointState]) {
    let expected: Vec<f64> = SO101_READINGS
        .iter()
        .zip(SO101_MIDDLES)
        .map(|(reading, middle)| (reading - middle) / STEPS_PER_TURN * std::f64::consts::TAU)
        .collect();
    for state in states {
        assert_close(&state.position, &expected);
        assert!(state.velocity.is_empty());
    }
    assert_stamps_increase(states);
}

#[test]
fn states_of_an_so_101_are_sent_in_radians() {
    if !has_python() {
        return;
    }
    let start = clock::now();
    let mut arm = open_arm(&SO101_JOINTS);
    let mut command = python(&[test_file("fakes")]);
    command
        .arg(sender("lerobot_joints.py"))
        .arg("/dev/arm")
        .arg("--calibration")
        .arg(test_file("so101-calibration.json"));
    let states = states(&mut arm, 20, &mut command, never);
    check_so101_states(&states);
    let end = clock::now();
    for state in &states {
        assert!(start < state.stamp && state.stamp < end, "{state:?}");
    }
}

#[test]
fn the_package_lerobot_reads_emulated_servos() {
    let code = "import lerobot.motors.feetech, scservo_sdk";
    if !is_runnable(code, "the Python package lerobot[feetech] is not installed") {
        return;
    }
    let calibration = test_file("so101-calibration.json");
    let mut servos = Running::start(
        python(&[])
            .arg(test_file("feetech_servos.py"))
            .arg(&calibration),
    );
    let terminal = servos.first_line();
    let mut arm = open_arm(&SO101_JOINTS);
    let mut command = python(&[]);
    command
        .arg(sender("lerobot_joints.py"))
        .arg(terminal)
        .arg("--calibration")
        .arg(&calibration);
    // The package waits for a reply for a few tens of milliseconds only.
    let is_too_slow =
        |errors: &str| errors.contains("motor check failed") || errors.contains("do not answer");
    check_so101_states(&states(&mut arm, 3, &mut command, is_too_slow));
}

#[test]
fn a_control_loop_can_send_its_own_states() {
    if !has_python() {
        return;
    }
    let mut arm = open_arm(&["a", "b"]);
    let mut command = python(&[repository().join("scripts/senders")]);
    command.arg(test_file("own_loop.py"));
    let states = states(&mut arm, 20, &mut command, never);
    for state in &states {
        assert_close(&state.position, &[0.1, 0.2]);
        assert_close(&state.effort, &[1.0, 2.0]);
    }
    assert_stamps_increase(&states);
}

#[test]
fn senders_keep_to_their_rates() {
    if !has_python() {
        return;
    }
    let output = python(&[repository().join("scripts/senders")])
        .arg(test_file("rates.py"))
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn problems_are_one_sentence() {
    if !has_python() {
        return;
    }
    let calibration = test_file("so101-calibration.json");
    let calibration = calibration.to_str().unwrap();
    let lerobot = ["/dev/other", "--calibration", calibration];
    for (folder, name, args, expected) in [
        (
            "missing",
            "ros2_joints.py",
            &[][..],
            "error: the Python package rclpy is missing; \
             first run: source /opt/ros/jazzy/setup.bash\n",
        ),
        (
            "missing",
            "ur_joints.py",
            &["127.0.0.1"],
            "error: the Python package rtde_receive is missing; \
             install it: pip install ur_rtde\n",
        ),
        (
            "missing",
            "lerobot_joints.py",
            &lerobot,
            "error: the Python package lerobot is missing; \
             install it: pip install 'lerobot[feetech]'\n",
        ),
        (
            "fakes",
            "ur_joints.py",
            &["127.0.0.1"],
            "error: no connection to 127.0.0.1, port 30004",
        ),
        (
            "fakes",
            "lerobot_joints.py",
            &lerobot,
            "error: no connection to the servos on /dev/other: could not open",
        ),
        (
            "fakes",
            "lerobot_joints.py",
            &["/dev/arm", "--calibration", "none.json"],
            "error: none.json is not a calibration of LeRobot",
        ),
        (
            "fakes",
            "ur_joints.py",
            &["127.0.0.1", "--rate", "0"],
            "0 Hz is not a rate above 0 and up to 2000 Hz",
        ),
        (
            "fakes",
            "ur_joints.py",
            &["127.0.0.1", "--to", "127.0.0.1"],
            "'127.0.0.1' is not an IP address and a port",
        ),
    ] {
        let output = python(&[test_file(folder)])
            .arg(sender(name))
            .args(args)
            .output()
            .unwrap();
        assert!(!output.status.success(), "{name} {args:?}");
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(errors.contains(expected), "{errors}");
    }
}

#[test]
fn a_calibration_of_another_arm_is_refused() {
    if !has_python() {
        return;
    }
    let text = std::fs::read_to_string(test_file("so101-calibration.json")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let other = folder.path().join("other.json");
    std::fs::write(
        &other,
        text.replace("\"homing_offset\": -12", "\"homing_offset\": 3"),
    )
    .unwrap();
    let output = python(&[test_file("fakes")])
        .arg(sender("lerobot_joints.py"))
        .args(["/dev/arm", "--calibration"])
        .arg(&other)
        .output()
        .unwrap();
    assert!(!output.status.success());
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        errors.contains("the servos have another calibration than"),
        "{errors}"
    );
}
