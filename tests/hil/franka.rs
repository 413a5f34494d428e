//! Tests of the Franka driver and of the emulated controller against independent implementations of
//! the protocol: libfranka as a client (`pylibfranka`) and `franka-sim` as a controller. Both are
//! installed once from the Python Package Index into a virtual environment.

#![cfg(target_os = "linux")]

use drivers::Arm;
use drivers::franka::emulated::{EmulatedRobot, JointSimulator, Joints, Limits, RobotConfig};
use drivers::franka::{
    ArmConfig, ContactConfig, FciVersion, FrankaArm, MotionStatistics, MovableFrankaArm, N_JOINTS,
};
use drivers::motion::{JointTarget, Motion, MotionConfig, MotionLimits, MovableArm, OnLoss};
use kinematics::{Chain, Transform};
use parking_lot::Mutex;
use std::fs;
use std::io::Write;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use test_support::Stalls;

/// Timeout for steps that are slow on a busy machine.
const TEST_TIMEOUT: Duration = Duration::from_secs(60);
const URDF: &str = include_str!("../../rigs/robots/panda.urdf");
const PINS: &str = include_str!("sources.sha256");
/// These tests must not run in parallel.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

#[test]
fn libfranka_moves_emulated_robot_and_recovers_from_reflex() {
    const REST_RAD: [f64; N_JOINTS] = [0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7];
    // This client does not correct its motion after a missed answer.
    const ANSWER_WAIT: Duration = Duration::from_millis(200);
    let _alone = ONE_AT_A_TIME.lock();
    let Some(python) = environment() else { return };
    // libfranka always connects to port 1337, so each test process uses its own loopback address.
    let [_, _, high, low] = std::process::id().to_be_bytes();
    let ip = Ipv4Addr::new(127, 37, high, low.clamp(1, 254));
    let config = RobotConfig {
        address: (ip, 1337).into(),
        version: FciVersion::V10,
        chain: chain("panda_link8"),
        flange_from_tool: Transform::identity(),
        limits: Limits::fr3(),
    };
    let emulated =
        EmulatedRobot::start_waiting(config, ANSWER_WAIT, ideal_joints(REST_RAD)).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/hil/libfranka_client.py");
    let output = Command::new(python)
        .arg(script)
        .arg(ip.to_string())
        .output()
        .unwrap();
    let [reported, errors] =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(output.status.success(), "{reported}{errors}");
    report(&format!("libfranka against the emulated robot: {reported}"));
    let reported: serde_json::Value = serde_json::from_str(&reported).unwrap();
    let number = |key: &str| reported[key].as_f64().unwrap();
    assert!(
        number("cycles") > 0.99 * 2000.0 && number("answered") > 0.999,
        "{reported}"
    );
    for (ix, by) in reported["moved_rad"].as_array().unwrap().iter().enumerate() {
        let expected = if ix == 3 { 0.2 } else { 0.0 };
        assert!((by.as_f64().unwrap() - expected).abs() < 1e-6, "{reported}");
    }
    let stopped = reported["stopped"].as_str().unwrap();
    assert!(
        stopped.contains("reflex") && stopped.contains("discontinuity"),
        "{reported}"
    );
    assert!(
        reported["reflex"] == true
            && reported["recovered"] == true
            && number("cycles_again") > 0.99 * 2000.0,
        "{reported}"
    );
    drop(emulated);
}

#[test]
fn ten_thousand_states_are_received_from_franka_sim() {
    let _alone = ONE_AT_A_TIME.lock();
    let Some(python) = environment() else { return };
    let server = FrankaSim::start(&python);
    let mut arm = server.open(FrankaArm::open);
    let mut last = None;
    for _ in 0..10_000 {
        let state = arm.read(TEST_TIMEOUT).unwrap();
        assert!(last.is_none_or(|last| state.stamp > last));
        assert_eq!(
            (
                state.position.len(),
                state.velocity.len(),
                state.effort.len()
            ),
            (N_JOINTS, N_JOINTS, N_JOINTS)
        );
        last = Some(state.stamp);
    }
    let statistics = arm.statistics();
    report(&format!("our driver against franka-sim: {statistics}\n"));
    assert!(statistics.success_frac() > 0.99, "{statistics}");
    // FCI accepts one client at a time.
    let second_client_error = FrankaArm::open(&server.config()).unwrap_err().to_string();
    assert!(
        second_client_error.contains("one client") && second_client_error.contains("udp"),
        "{second_client_error}"
    );
}

#[test]
fn ten_thousand_motion_cycles_with_both_controllers() {
    let _alone = ONE_AT_A_TIME.lock();
    let Some(python) = environment() else { return };
    let server = FrankaSim::start(&python);
    follow_for_ten_thousand_cycles("franka-sim", || {
        server.open(|config| MovableFrankaArm::open(config, &motion(), &ContactConfig::default()))
    });
    drop(server);
    let config = RobotConfig {
        address: (Ipv4Addr::LOCALHOST, 0).into(),
        version: FciVersion::V10,
        chain: chain("panda_link8"),
        flange_from_tool: Transform::identity(),
        limits: Limits::fr3(),
    };
    let emulated =
        EmulatedRobot::start(config, ideal_joints([0.1, -0.5, 0.2, -2.0, 0.3, 1.8, 0.7])).unwrap();
    let chain = chain("panda_link8");
    let config = ArmConfig {
        address: emulated.address().to_string(),
        joint_names: chain.joint_names().to_vec(),
        chain,
    };
    follow_for_ten_thousand_cycles("the emulated robot", || {
        MovableFrankaArm::open(&config, &motion(), &ContactConfig::default()).unwrap()
    });
}

/// Motion configuration of these tests.
fn motion() -> MotionConfig {
    MotionConfig {
        limits: chain("panda_link8")
            .limits()
            .iter()
            .map(|joint| MotionLimits::new(joint, 0.5, 0.5, 0.1))
            .collect(),
        on_loss: OnLoss::Hold,
        timeout: Duration::from_millis(100),
        accept_no_watchdog: false,
    }
}

/// Moves back and forth for 10 000 cycles. Checks on both sides that more than 99 % of the states
/// are answered in time, not counting the time for which a processor was stalled.
///
/// On a busy machine, up to three attempts are made. A reflex caused by a violated limit fails,
/// unless a processor was stalled just before: `franka-sim` then catches up on several cycles at
/// once, and uses a command that arrives too late for its cycle.
fn follow_for_ten_thousand_cycles(name: &str, open: impl Fn() -> MovableFrankaArm) {
    const MAX_ATTEMPTS: usize = 3;
    const BY_RAD: f64 = 0.3;
    const NEAR_RAD: f64 = 5e-3; // The joints of franka-sim have inertia.
    const STALL_BEFORE: Duration = Duration::from_millis(200);
    for attempt in 1..=MAX_ATTEMPTS {
        let mut arm = open();
        let rest = arm
            .read(TEST_TIMEOUT)
            .expect("the arm reports its joints")
            .position;
        let (stalls, began) = (Stalls::start(), Instant::now());
        let mut violations: Vec<(Instant, String)> = Vec::new();
        let mut directions = [-1.0, 0.0, 1.0, 0.0].into_iter().cycle();
        while arm.motion_statistics().n_answered < 10_000 {
            let by_rad = BY_RAD * directions.next().expect("the iterator is infinite");
            let target = JointTarget {
                position: rest.iter().map(|rest| rest + by_rad).collect(),
            };
            let mut recover = |arm: &mut MovableFrankaArm, reason: &str| {
                if !reason.contains("communication_constraints_violation") {
                    violations.push((Instant::now(), reason.to_owned()));
                }
                arm.recover().expect("the arm recovers");
            };
            match arm.command(&target) {
                Ok(commanded) => assert_eq!(commanded, target),
                // Holding a position also requires answers.
                Err(error) => {
                    recover(&mut arm, &error.to_string());
                    continue;
                }
            }
            let until = Instant::now() + TEST_TIMEOUT;
            while arm.motion() == Motion::Moving {
                assert!(
                    Instant::now() < until,
                    "the arm does not come to rest: {}",
                    arm.motion_statistics()
                );
                std::thread::sleep(Duration::from_millis(5));
            }
            if let Motion::Stopped { reason } = arm.motion() {
                recover(&mut arm, &reason);
                continue;
            }
            let position = settled_position(&mut arm);
            let off = position
                .iter()
                .zip(&target.position)
                .map(|(actual, expected)| (actual - expected).abs())
                .fold(0.0, f64::max);
            assert!(off < NEAR_RAD, "{name}: {off} rad from its target");
        }
        let statistics = arm.motion_statistics();
        let stalled = stalls.stop();
        for (at, reason) in violations {
            assert!(
                stalled.frac(at - STALL_BEFORE, at) > 0.0,
                "{name}: {reason}; no processor was stalled"
            );
        }
        let stalled_frac = stalled.frac(began, Instant::now());
        let outcome = format!(
            "{name}: {statistics}; stalled for {:.1} % of the time",
            100.0 * stalled_frac
        );
        report(&format!("our driver moves {outcome}\n"));
        if is_in_time(&statistics, stalled_frac) {
            return;
        }
        assert!(attempt < MAX_ATTEMPTS, "{outcome}");
    }
}

/// Whether more than 99 % of the states were answered in time according to both sides, not counting
/// a fraction of them.
fn is_in_time(statistics: &MotionStatistics, stalled_frac: f64) -> bool {
    let [reported, _] = statistics.robot_success_frac().expect("the arm has moved");
    statistics.n_motions > 0 && statistics.success_frac().min(reported) > 0.99 - stalled_frac
}

/// Joint positions after the arm has come to rest. Skips older states in the queue.
fn settled_position(arm: &mut MovableFrankaArm) -> Vec<f64> {
    std::thread::sleep(Duration::from_millis(100));
    let mut position = arm
        .read(TEST_TIMEOUT)
        .expect("the arm reports its joints")
        .position;
    while let Ok(state) = arm.read(Duration::ZERO) {
        position = state.position;
    }
    position
}

/// A running `franka-sim`, which enforces the limits of a real robot.
struct FrankaSim {
    address: String,
    _process: KillOnDrop,
}

impl FrankaSim {
    fn start(python: &Path) -> Self {
        let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))
            .expect("a free port")
            .local_addr()
            .expect("a free port")
            .port();
        let log = fs::File::create(folder().join("franka-sim.log")).expect("creating the log file");
        // The model of franka-sim is a separate download, so this test uses our model of primitive
        // shapes.
        let (root, model) = (
            Path::new(env!("CARGO_MANIFEST_DIR")).join(".."),
            folder().join("panda.xml"),
        );
        let model_output = Command::new(python)
            .arg(root.join("tests/hil/franka_sim_model.py"))
            .args([&root.join("rigs/robots/panda.urdf"), &model])
            .output()
            .expect("Python starts");
        assert!(
            model_output.status.success(),
            "{}",
            String::from_utf8_lossy(&model_output.stderr)
        );
        let child = Command::new(python)
            .args(["-m", "franka_sim.run_server", "--no-gripper"])
            .args([
                "--enforce-comm-constraints",
                "--enforce-motion-limits",
                "--port",
                &port.to_string(),
            ])
            .env("FR3_MJCF", &model)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("Python starts");
        Self {
            address: SocketAddr::from((Ipv4Addr::LOCALHOST, port)).to_string(),
            _process: KillOnDrop(child),
        }
    }

    /// Configuration for franka-sim, which reports the pose of its seventh link as the flange pose.
    /// The real flange is 107 mm further along the axis.
    fn config(&self) -> ArmConfig {
        let chain = chain("panda_link7");
        ArmConfig {
            address: self.address.clone(),
            joint_names: chain.joint_names().to_vec(),
            chain,
        }
    }

    /// Opens the arm once the server is ready.
    fn open<T>(&self, open: impl Fn(&ArmConfig) -> Result<T, drivers::Error>) -> T {
        let until = Instant::now() + TEST_TIMEOUT;
        loop {
            match open(&self.config()) {
                Ok(arm) => return arm,
                Err(error) => assert!(Instant::now() < until, "{error}"),
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }
}

/// Joints that start at a rest position and then follow the commands without delay.
fn ideal_joints(rest_rad: [f64; N_JOINTS]) -> JointSimulator {
    let mut is_first = true;
    Box::new(move |_, command| {
        let position_rad = if std::mem::take(&mut is_first) {
            rest_rad
        } else {
            command.position_rad
        };
        Joints {
            position_rad,
            velocity_rad_s: command.velocity_rad_s,
            ..Joints::default()
        }
    })
}

fn chain(tip: &str) -> Chain {
    Chain::from_urdf(URDF, "panda_link0", tip).expect("the URDF is valid")
}

/// A child process that is killed on drop.
struct KillOnDrop(Child);

impl Drop for KillOnDrop {
    fn drop(&mut self) {
        // It may already have ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Writes to stderr directly, because the test harness hides the output of passing tests.
fn report(text: &str) {
    std::io::stderr()
        .write_all(text.as_bytes())
        .expect("stderr is open");
}

/// Python of the virtual environment. Returns `None` and prints the reason if it cannot be created.
fn environment() -> Option<PathBuf> {
    if let Err(reason) = make_environment() {
        assert!(!test_support::is_demanded(), "{reason}");
        test_support::skip(reason);
        return None;
    }
    Some(folder().join("bin/python"))
}

/// Creates the virtual environment if it is not complete.
fn make_environment() -> Result<(), String> {
    let (folder, complete_marker) = (folder(), folder().join("complete"));
    if complete_marker.exists() {
        return Ok(());
    }
    if !cfg!(target_arch = "x86_64") {
        return Err("the Python packages of the Franka tests require x86-64".to_owned());
    }
    let run = |program: &Path, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output();
        let output =
            output.map_err(|error| format!("cannot start {}: {error}", program.display()))?;
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        let last = errors.lines().last().unwrap_or_default().to_owned();
        if output.status.success() {
            Ok(())
        } else {
            Err(last)
        }
    };
    let is_python_3_11 = "import sys; sys.exit(sys.version_info[:2] != (3, 11))";
    run(Path::new("python3"), &["-c", is_python_3_11]).map_err(|_| {
        "the Python packages of the Franka tests require Python 3.11 (Debian 12)".to_owned()
    })?;
    // The folder may contain leftovers of an interrupted run.
    let _ = fs::remove_dir_all(&folder);
    let [at, requirements] =
        [&folder, &folder.join("requirements.txt")].map(|path| path.display().to_string());
    run(Path::new("python3"), &["-m", "venv", &at])
        .map_err(|error| format!("cannot create a virtual environment: {error}"))?;
    let requirements_text: String = pins()
        .map(|[sha256, _, wheel]| format!("{wheel} --hash=sha256:{sha256}\n"))
        .collect();
    fs::write(&requirements, requirements_text).map_err(|error| error.to_string())?;
    let pip = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--only-binary=:all:",
        "--no-deps",
        "--require-hashes",
        "-r",
        &requirements,
    ];
    run(&folder.join("bin/python"), &pip).map_err(|error| {
        format!("cannot install the Python packages of the Franka tests: {error}")
    })?;
    fs::write(complete_marker, "").map_err(|error| error.to_string())
}

/// Folder of the virtual environment in the target folder. Its name depends on the pinned wheels.
fn folder() -> PathBuf {
    let shas: String = pins().map(|[sha256, ..]| &sha256[..4]).collect();
    Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("../hil")
        .join(format!("franka-{shas}"))
}

/// The pinned wheels: sha256, file, requirement.
fn pins() -> impl Iterator<Item = [&'static str; 3]> {
    let columns = |line: &'static str| {
        let columns: Vec<&str> = line.split_whitespace().collect();
        <[&str; 3]>::try_from(columns).ok()
    };
    let lines = PINS
        .lines()
        .filter(|line| !line.starts_with('#'))
        .filter_map(columns);
    lines.filter(|[_, _, requirement]| requirement.contains("=="))
}
