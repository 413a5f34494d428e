//! Runs `fieldrig sim` in one process and the production drivers in others. Emulated samples must arrive unchanged, and
//! the arm must be movable.

#![cfg(target_os = "linux")]

mod compare;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

/// Start delay in seconds, sufficient for busy machines.
const START_IN: &str = "5";

/// A ready `fieldrig sim`; killed on drop.
struct EmulatedRig {
    child: Child,
    /// Keeps the pipe open, so that `fieldrig sim` does not lose output.
    _stdout: BufReader<ChildStdout>,
}

impl EmulatedRig {
    fn start(folder: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .args(["sim", "static-arm", "--seconds", "3", "--start-in", START_IN, "--json", "--out"])
            .arg(folder)
            .stdout(Stdio::piped())
            .spawn()
            .expect("it is built");
        let mut line = String::new();
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        stdout.read_line(&mut line).expect("it prints a line");
        assert!(line.contains("\"event\":\"ready\"") && line.contains("FCI 10"), "{line}");
        Self { child, _stdout: stdout }
    }
}

impl Drop for EmulatedRig {
    fn drop(&mut self) {
        let _ = self.child.kill(); // Fails if the process has already ended.
        let _ = self.child.wait(); // The exit code does not matter.
    }
}

fn fieldrig(words: &[&str], rig: &Path) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig")).arg(words[0]).arg(rig).args(&words[1..]).output();
    let output = output.expect("it is built");
    let printed = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8_lossy(&printed).into_owned())
}

#[test]
fn emulated_franka_rig_is_recorded_and_moved() {
    let folder = tempfile::tempdir().expect("a folder");
    let emulated_rig = EmulatedRig::start(folder.path());
    let (rig, script, wire) =
        (folder.path().join("rig.toml"), folder.path().join("script.mcap"), folder.path().join("wire.mcap"));
    // The end of a file ends the recording and is not a loss. A busy machine may drop images, which is a loss.
    let (code, printed) = fieldrig(&["record", "--out", &wire.to_string_lossy(), "--json"], &rig);
    assert!(matches!(code, Some(0 | 3)), "{printed}");
    let difference = compare::difference(&script, &wire);
    assert!(difference.n_images >= 60, "{difference:?}");
    // Here, joints rotate by at most half a radian per second, that is, half a milliradian per millisecond.
    assert!(difference.joints_rad[0] < 5e-4, "{difference:?}");
    assert_eq!(difference.base_m, 0.0, "the base is stationary");

    let (code, printed) = fieldrig(&["move", "--by", "panda_joint1=0.05", "--enable-motion", "--json"], &rig);
    assert_eq!(code, Some(0), "{printed}");
    assert!(compare::error_of_move(&printed) < 1e-3, "{printed}");
    let (code, printed) = fieldrig(&["move", "--by", "panda_joint1=9", "--enable-motion", "--json"], &rig);
    assert_eq!(code, Some(2), "a typing error must not move the joint to the end of its range: {printed}");
    let (code, printed) = fieldrig(&["move", "--by", "panda_joint1=0.05", "--json"], &rig);
    assert_eq!(code, Some(2), "the arm does not move without --enable-motion: {printed}");
    drop(emulated_rig);
}
