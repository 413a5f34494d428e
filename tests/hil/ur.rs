//! Tests of the emulated controller of Universal Robots against an independent implementation of
//! the protocol: the client library `ur_rtde`. It is installed once from the Python Package Index
//! into a virtual environment.

#![cfg(target_os = "linux")]

use drivers::ur::RTDE_PORT;
use drivers::ur::emulated::{ControllerConfig, EmulatedController, Joints};
use kinematics::{Chain, Transform};
use std::fs;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::Command;

const URDF: &str = include_str!("../../kinematics/tests/data/ur5e-dh.urdf");
/// The wheel of `ur_rtde` for `CPython` 3.11 on x86-64. It has no dependencies.
const REQUIREMENT: &str = "ur-rtde==1.6.5 --hash=sha256:6f9a25c98bf77be9fe7c559b2d0e56053dca2896ad4a56fd4ef7fe331aeb749f\n";
const REST_RAD: [f64; 6] = [0.3, -1.4, 1.6, -1.8, -1.5, 0.4];

#[test]
fn ur_rtde_reads_the_emulated_controller() {
    const N_STATES: usize = 200;
    let python = match environment() {
        Ok(python) => python,
        Err(reason) => {
            assert!(!test_support::is_demanded(), "{reason}");
            test_support::skip(reason);
            return;
        }
    };
    // The library always connects to port 30004, so each test process uses its own loopback
    // address.
    let [_, _, high, low] = std::process::id().to_be_bytes();
    let ip = Ipv4Addr::new(127, 38, high, low.clamp(1, 254));
    let chain = Chain::from_urdf(URDF, "base_link_inertia", "tool0").unwrap();
    let tool = Transform::translation(0.0, 0.02, 0.1);
    let base_from_tool = chain.forward(&REST_RAD).unwrap() * tool;
    let config = ControllerConfig {
        flange_from_tool: tool,
        ..ControllerConfig::e_series((ip, RTDE_PORT).into(), chain)
    };
    let rest = Joints {
        position_rad: REST_RAD,
        velocity_rad_s: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        torque_nm: [0.0; 6],
    };
    let _emulated = EmulatedController::start(config, Box::new(move |_, _| rest)).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/hil/ur_rtde_client.py");
    let output = Command::new(python)
        .arg(script)
        .args([ip.to_string(), N_STATES.to_string()])
        .output()
        .unwrap();
    let [reported, errors] =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(
        output.status.success(),
        "{}: {reported}{errors}",
        output.status
    );
    let reported: serde_json::Value = serde_json::from_str(&reported).unwrap();
    let numbers = |value: &serde_json::Value| -> Vec<f64> {
        let values = value.as_array().unwrap();
        values
            .iter()
            .map(|number| number.as_f64().unwrap())
            .collect()
    };
    let states = reported["states"].as_array().unwrap();
    assert_eq!(states.len(), N_STATES);
    let [x, y, z] = base_from_tool.translation.vector.into();
    for state in states {
        assert_eq!(numbers(&state["q"]), REST_RAD);
        let tcp = numbers(&state["tcp"]);
        for (reported, expected) in std::iter::zip(&tcp, [x, y, z]) {
            assert!((reported - expected).abs() < 1e-9, "{tcp:?}");
        }
    }
    // The library may skip states, but its clock has the steps of the controller.
    for pair in states.windows(2) {
        let secs = pair[1]["timestamp"].as_f64().unwrap() - pair[0]["timestamp"].as_f64().unwrap();
        let n_steps = secs / 0.002;
        assert!(
            (n_steps - n_steps.round()).abs() < 1e-3 && n_steps > 0.5,
            "{secs} s"
        );
    }
    assert_eq!(numbers(&reported["qd"]), rest.velocity_rad_s);
    assert_eq!(numbers(&reported["target_q"]), REST_RAD);
    for (key, expected) in [
        ("robot_mode", 7),
        ("safety_mode", 1),
        ("runtime_state", 1),
        ("status_bits", 1),
    ] {
        assert_eq!(reported[key], expected, "{key}");
    }
    assert_eq!(reported["is_connected"], true);
}

/// Python of the virtual environment, which is created if it is not complete.
fn environment() -> Result<PathBuf, String> {
    let sha256 = REQUIREMENT
        .rsplit(':')
        .next()
        .expect("the hash is at the end");
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("../hil")
        .join(format!("ur-{}", &sha256[..8]));
    let [python, complete_marker] = ["bin/python", "complete"].map(|name| folder.join(name));
    if complete_marker.exists() {
        return Ok(python);
    }
    if !cfg!(target_arch = "x86_64") {
        return Err("the wheel of ur_rtde requires x86-64".to_owned());
    }
    run(
        Path::new("python3"),
        &[
            "-c",
            "import sys; sys.exit(sys.version_info[:2] != (3, 11))",
        ],
    )
    .map_err(|_| "the wheel of ur_rtde requires Python 3.11 (Debian 12)".to_owned())?;
    // The folder may contain leftovers of an interrupted run.
    let _ = fs::remove_dir_all(&folder);
    run(
        Path::new("python3"),
        &["-m", "venv", &folder.display().to_string()],
    )
    .map_err(|error| format!("cannot create a virtual environment: {error}"))?;
    let requirements = folder.join("requirements.txt");
    fs::write(&requirements, REQUIREMENT).map_err(|error| error.to_string())?;
    let pip = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--only-binary=:all:",
        "--no-deps",
        "--require-hashes",
        "-r",
        &requirements.display().to_string(),
    ];
    run(&python, &pip).map_err(|error| format!("cannot install ur_rtde: {error}"))?;
    fs::write(complete_marker, "").map_err(|error| error.to_string())?;
    Ok(python)
}

/// Runs a program. The error is the last line that it printed.
fn run(program: &Path, arguments: &[&str]) -> Result<(), String> {
    let output = Command::new(program)
        .args(arguments)
        .output()
        .map_err(|error| format!("cannot start {}: {error}", program.display()))?;
    if output.status.success() {
        return Ok(());
    }
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    Err(errors.lines().last().unwrap_or_default().to_owned())
}
