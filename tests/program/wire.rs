//! Runs `fieldrig sim` in one process and the production drivers in others. Emulated samples must
//! arrive unchanged, and the arm must be movable.

#![cfg(target_os = "linux")]

use crate::output::OnTerminal;
use parking_lot::{Mutex, MutexGuard};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use test_support::wire_difference;

/// Start delay in seconds, sufficient for busy machines.
const START_IN: &str = "5";

/// All emulated robots listen on the port of real ones.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// A ready `fieldrig sim`; killed on drop.
struct EmulatedRig {
    _alone: MutexGuard<'static, ()>,
    child: Child,
    /// Keeps the pipe open, so that `fieldrig sim` does not lose output.
    _stdout: BufReader<ChildStdout>,
}

impl EmulatedRig {
    fn start(folder: &Path) -> Self {
        let alone = ONE_AT_A_TIME.lock();
        let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .args([
                "sim",
                "static-arm",
                "--seconds",
                "3",
                "--start-in",
                START_IN,
                "--answer-wait",
                "15",
                "--json",
                "--out",
            ])
            .arg(folder)
            .stdout(Stdio::piped())
            .spawn()
            .expect("it is built");
        let mut line = String::new();
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        stdout.read_line(&mut line).expect("it prints a line");
        assert!(
            line.contains("\"event\":\"ready\"") && line.contains("FCI 10"),
            "{line}"
        );
        Self {
            _alone: alone,
            child,
            _stdout: stdout,
        }
    }
}

impl Drop for EmulatedRig {
    fn drop(&mut self) {
        let _ = self.child.kill(); // Fails if the process has already ended.
        let _ = self.child.wait(); // The exit code does not matter.
    }
}

fn fieldrig(words: &[&str], rig: &Path) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .arg(words[0])
        .arg(rig)
        .args(&words[1..])
        .output();
    let output = output.expect("it is built");
    let printed = [output.stdout, output.stderr].concat();
    (
        output.status.code(),
        String::from_utf8_lossy(&printed).into_owned(),
    )
}

#[test]
fn emulated_franka_rig_is_recorded_and_moved() {
    let folder = tempfile::tempdir().expect("a folder");
    let emulated_rig = EmulatedRig::start(folder.path());
    let (rig, script, wire) = (
        folder.path().join("rig.toml"),
        folder.path().join("script.mcap"),
        folder.path().join("wire.mcap"),
    );
    // The recording ends at the end of the file, which does not count as a loss. A busy machine may
    // drop images, which counts as a loss.
    let (code, printed) = fieldrig(
        &["record", "--out", &wire.to_string_lossy(), "--json"],
        &rig,
    );
    assert!(matches!(code, Some(0 | 3)), "{printed}");
    let difference = wire_difference::difference(&script, &wire);
    assert!(difference.n_images >= 60, "{difference:?}");
    // Here, joints rotate by at most half a radian per second, that is, half a milliradian per
    // millisecond.
    assert!(difference.joints_rad[0] < 5e-4, "{difference:?}");
    assert_eq!(difference.base_m, 0.0, "the base is stationary");

    let (code, printed) = fieldrig(
        &[
            "move",
            "--by",
            "panda_joint1=0.05",
            "--enable-motion",
            "--json",
        ],
        &rig,
    );
    assert_eq!(code, Some(0), "{printed}");
    assert!(wire_difference::error_of_move(&printed) < 1e-3, "{printed}");
    let (code, printed) = fieldrig(
        &[
            "move",
            "--by",
            "panda_joint1=9",
            "--enable-motion",
            "--json",
        ],
        &rig,
    );
    assert_eq!(
        code,
        Some(2),
        "a typing error must not move the joint to the end of its range: {printed}"
    );
    let (code, printed) = fieldrig(&["move", "--by", "panda_joint1=0.05", "--json"], &rig);
    assert_eq!(
        code,
        Some(2),
        "the arm does not move without --enable-motion: {printed}"
    );
    drop(emulated_rig);
}

/// After each kind of loss, the state is as in the table of docs/guide/moving-arms.md.
#[test]
fn lost_terminal_stops_franka_motion_and_kill_is_a_reflex() {
    let folder = tempfile::tempdir().expect("a folder");
    let _emulated_rig = EmulatedRig::start(folder.path());
    let rig = folder.path().join("rig.toml");
    let rig_text = rig.to_string_lossy().into_owned();
    let begin = || {
        let words = [
            "move",
            &rig_text,
            "--by",
            "panda_joint1=-0.8",
            "--enable-motion",
        ];
        // Without a controlling terminal, closing it sends no SIGHUP.
        let mut moving = OnTerminal::start(folder.path(), &words, false);
        moving.wait_for(" of "); // It shows its position and its target.
        moving
    };
    let nudge = |recover: &[&str]| {
        let words = [
            &[
                "move",
                "--by",
                "panda_joint1=0.01",
                "--enable-motion",
                "--json",
            ],
            recover,
        ]
        .concat();
        fieldrig(&words, &rig)
    };
    let (code, printed) = nudge(&[]);
    assert_eq!(code, Some(0), "{printed}");
    let begin_rad = first_position(&printed);
    assert_eq!(begin().close().code(), Some(1));
    let (code, printed) = nudge(&[]);
    assert_eq!(
        code,
        Some(0),
        "it came to rest, and needs no recovery: {printed}"
    );
    let moved_rad = (first_position(&printed) - begin_rad).abs();
    assert!(
        moved_rad < 0.6,
        "moved by {moved_rad} of 0.8 rad after its terminal was closed"
    );

    let mut killed = begin();
    killed.child.kill().expect("our own child");
    killed.child.wait().expect("our own child");
    let (code, printed) = nudge(&[]);
    assert!(
        code == Some(1) && printed.contains("stopped by a reflex"),
        "{printed}"
    );
    let is_warning = |line: &&str| line.contains("WARN") && line.contains("stopped by a reflex");
    assert_eq!(printed.lines().filter(is_warning).count(), 1, "{printed}");
    let (code, printed) = nudge(&["--recover"]);
    assert_eq!(code, Some(0), "{printed}");
}

/// Position of the first joint at the end of `fieldrig move --json`.
fn first_position(printed: &str) -> f64 {
    let line = printed
        .lines()
        .find(|line| line.contains("\"event\":\"done\""))
        .expect("it arrived");
    let event: serde_json::Value = serde_json::from_str(line).expect("JSON");
    event["position"][0].as_f64().expect("a number")
}
