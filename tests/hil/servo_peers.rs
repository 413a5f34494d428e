//! Tests of the emulated servos against independent implementations of their protocols: the clients
//! of the makers, Feetech's `scservo_sdk` and ROBOTIS's `dynamixel_sdk`. Both are installed once
//! from the Python Package Index into a virtual environment. If that is not possible, the tests are
//! skipped.

#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use drivers::servos::emulated::{EmulatedServo, EmulatedServoBus, ServoKind};
use parking_lot::Mutex;
use std::path::{Path, PathBuf};
use std::process::Command;

const REQUIREMENTS: &str = include_str!("servo_requirements.txt");
/// The environment is created only once.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

#[test]
fn feetech_client_reads_and_moves_emulated_servos() {
    check_client("feetech", ServoKind::Feetech, 777);
}

#[test]
fn dynamixel_client_reads_and_moves_emulated_servos() {
    check_client("dynamixel", ServoKind::Dynamixel, 1060);
}

/// Lets a client find, read and move three servos.
fn check_client(name: &str, kind: ServoKind, model: u64) {
    const POSITIONS: [i32; 3] = [2048, 1000, 3001];
    const BY_COUNTS: f64 = 150.0;
    let Some(python) = environment() else { return };
    let folder = tempfile::tempdir().unwrap();
    let port = folder.path().join("arm");
    let ids = [1, 2, 7];
    let servo = |(id, position): (&u8, &i32)| EmulatedServo::new(kind, *id, *position);
    let servos = ids.iter().zip(&POSITIONS).map(servo).collect();
    let bus = EmulatedServoBus::start(kind, servos, &port, |_, _| {}).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/hil/servo_client.py");
    let output = Command::new(python)
        .arg(script)
        .arg(name)
        .arg(&port)
        .args(ids.map(|id| id.to_string()))
        .output()
        .unwrap();
    let [reported, errors] =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(output.status.success(), "{reported}{errors}");
    let reported: serde_json::Value = serde_json::from_str(&reported).unwrap();
    assert_eq!(reported["models"], serde_json::json!(vec![model; 3]));
    assert_eq!(reported["start"], serde_json::json!(POSITIONS.to_vec()));
    assert_ne!(reported["absent"], 0, "no servo has this ID");
    let line = bus.line();
    for (servo, start) in line.servos.iter().zip(POSITIONS) {
        let moved = servo.position_counts() - f64::from(start);
        assert!((moved - BY_COUNTS).abs() <= 1.5, "{moved}");
        assert!(servo.is_enabled());
    }
    assert_eq!(line.n_fast_reads() > 0, kind == ServoKind::Dynamixel);
}

/// The Python interpreter of the virtual environment. `None` if it cannot be created.
fn environment() -> Option<PathBuf> {
    let _alone = ONE_AT_A_TIME.lock();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../hil/servo-clients");
    match make_environment(&folder) {
        Ok(()) => Some(folder.join("bin/python")),
        Err(reason) => {
            assert!(!test_support::is_demanded(), "{reason}");
            test_support::skip(reason);
            None
        }
    }
}

/// Creates the virtual environment if it is not complete.
fn make_environment(folder: &Path) -> Result<(), String> {
    let marker = folder.join("complete");
    if std::fs::read_to_string(&marker).is_ok_and(|installed| installed == REQUIREMENTS) {
        return Ok(());
    }
    // The folder may contain leftovers of an interrupted run.
    let _ = std::fs::remove_dir_all(folder);
    run(
        Path::new("python3"),
        &["-m", "venv", &folder.display().to_string()],
    )?;
    let requirements = folder.join("requirements.txt");
    std::fs::write(&requirements, REQUIREMENTS).map_err(|error| error.to_string())?;
    let pip = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--require-hashes",
        "-r",
    ];
    let requirements = requirements.display().to_string();
    run(
        &folder.join("bin/python"),
        &[&pip[..], &[&requirements]].concat(),
    )?;
    std::fs::write(marker, REQUIREMENTS).map_err(|error| error.to_string())
}

fn run(program: &Path, arguments: &[&str]) -> Result<(), String> {
    let install = "cannot install the clients of the servo makers";
    let output = Command::new(program)
        .args(arguments)
        .output()
        .map_err(|error| format!("{install}: cannot start {}: {error}", program.display()))?;
    if output.status.success() {
        return Ok(());
    }
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let last = errors.lines().last().unwrap_or_default();
    Err(format!("{install}: {last}"))
}
