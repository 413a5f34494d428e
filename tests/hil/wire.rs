//! Tests of an emulated mobile arm inside the virtual kernel: motors of four families on one CAN
//! bus, a base that sends datagrams, and a camera as a file. The production binary reads the arm
//! and then moves it.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use test_support::wire_difference;

/// Recording that was simulated on the host.
pub(crate) const SCRIPT: &str = "rigs/mobile-arm.mcap";
pub(crate) const SECONDS: &str = "6";

/// Simulates the rig and records it into a root folder.
pub(crate) fn install_root(root: &Path) {
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/wire/mobile-arm.toml");
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .arg("record")
        .arg(rig)
        .args(["--sim", "--lockstep", "--seconds", SECONDS, "--out"])
        .arg(root.join(SCRIPT));
    let output = command.output().expect("fieldrig starts");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
#[ignore = "needs the virtual kernel"]
fn mobile_arm_is_read_and_moved_through_drivers() {
    let script = Path::new("/").join(SCRIPT);
    let mut playing = Command::new("/bin/fieldrig")
        .args(["sim", "mobile-arm", "--from"])
        .arg(&script)
        .args([
            "--seconds",
            SECONDS,
            "--start-in",
            "10",
            "--out",
            "/tmp/mobile",
            "--json",
        ])
        .stdout(Stdio::piped())
        .spawn()
        .expect("fieldrig is installed");
    let mut line = String::new();
    // The pipe is kept open, so that the program does not lose output.
    let mut stdout = BufReader::new(playing.stdout.take().expect("piped"));
    stdout.read_line(&mut line).expect("fieldrig prints a line");
    assert!(
        line.contains("\"event\":\"ready\"") && line.contains("7 motors on vcan0"),
        "{line}"
    );
    let fieldrig = |arguments: &[&str]| {
        let output = Command::new("/bin/fieldrig")
            .args(arguments)
            .output()
            .expect("fieldrig is installed");
        let printed =
            String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        println!("fieldrig {}: {printed}", arguments.join(" "));
        (output.status.code(), printed)
    };
    let (code, printed) = fieldrig(&[
        "record",
        "/tmp/mobile/rig.toml",
        "--out",
        "/tmp/mobile.mcap",
        "--json",
    ]);
    assert_eq!(code, Some(0), "{printed}");
    let difference = wire_difference::difference(&script, Path::new("/tmp/mobile.mcap"));
    println!("wire: {difference:?}");
    assert!(difference.n_images >= 20, "{difference:?}");
    // Motors that report automatically do so every 10 ms, and joints rotate by less than half a
    // radian per second.
    assert!(difference.joints_rad[0] < 2e-3, "{difference:?}");
    assert!(difference.base_m < 1e-6, "{difference:?}");

    let arguments = [
        "move",
        "/tmp/mobile/rig.toml",
        "--by",
        "panda_joint1=0.1",
        "--enable-motion",
        "--exit-on-arrival",
        "--json",
    ];
    let (code, printed) = fieldrig(&arguments);
    assert_eq!(code, Some(0), "{printed}");
    assert!(wire_difference::error_of_move(&printed) < 0.01, "{printed}");
    let _ = playing.kill(); // The program runs until it is stopped.
    let _ = playing.wait();
}
