//! Tests runs whose files disappear. They disappear while the run continues, or before it is
//! resumed.

use crate::small_rig::{self, Pace};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

const N_STEPS: &str = "120";
const N_MORE_STEPS: &str = "140";

fn fieldrig(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .args(args)
        .args(["--sim", "--json", "--listen", "127.0.0.1:0"])
        .current_dir(folder);
    command
}

/// Runs a command to its end, and calls `disturb` once the run has logged its first keyframes.
fn disturbed(folder: &Path, args: &[&str], disturb: impl FnOnce()) -> Output {
    let mut run = fieldrig(folder, args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig starts");
    let has_keyframes = || {
        fs::read_to_string(folder.join("run/decisions.jsonl"))
            .is_ok_and(|log| log.matches("push").count() > 2)
    };
    while !has_keyframes() && run.try_wait().expect("a child").is_none() {
        std::thread::sleep(Duration::from_millis(20));
    }
    disturb();
    run.wait_with_output().expect("fieldrig ends")
}

fn stored_keyframes(run: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(run.join("keyframes"))
        .expect("a folder")
        .flatten()
        .map(|entry| entry.path())
        .collect();
    files.sort();
    files
}

#[test]
fn run_outlives_its_folder_and_its_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write(folder, Pace::Lockstep);
    let run = folder.join("run");
    let args = [
        "run",
        "rig.toml",
        "--steps",
        N_STEPS,
        "--max-splats",
        "500",
        "--record",
        "scan.mcap",
        "--out",
        "run",
    ];
    let output = disturbed(folder, &args, || {
        fs::remove_dir_all(&run).expect("the run has made it");
        fs::remove_file(folder.join("scan.mcap")).expect("the run has made it");
    });
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{printed}");
    for expected in [
        "the run folder run was removed",
        "the recording scan.mcap was removed",
        "scan.mcap was written again",
    ] {
        assert!(printed.contains(expected), "{expected}: {printed}");
    }
    for file in [
        "rig.toml",
        "robot.urdf",
        ".lock",
        "decisions.jsonl",
        "keyframes.txt",
        "model.json",
        "report.json",
        "training.ckpt",
    ] {
        assert!(run.join(file).exists(), "{file} is missing: {printed}");
    }
    let log = fs::read_to_string(run.join("decisions.jsonl")).expect("text");
    assert!(
        log.lines().last().is_some_and(|line| line.contains("end")),
        "{log}"
    );
    let eval = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["eval", "run", "scan.mcap"])
        .current_dir(folder)
        .output();
    let eval = eval.expect("fieldrig starts");
    assert!(
        eval.status.success(),
        "{}",
        String::from_utf8_lossy(&eval.stderr)
    );
    check_resume_without_keyframes(folder, &run);
}

/// Damages a keyframe and deletes another one. The run must continue with the other keyframes.
fn check_resume_without_keyframes(folder: &Path, run: &Path) {
    let stored = stored_keyframes(run);
    let mut bytes = fs::read(&stored[0]).expect("a keyframe");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&stored[0], bytes).expect("space");
    fs::remove_file(&stored[1]).expect("a keyframe");
    let args = [
        "run",
        "rig.toml",
        "--resume",
        "run",
        "--steps",
        N_MORE_STEPS,
        "--out",
        "resumed",
    ];
    let resumed = fieldrig(folder, &args).output().expect("fieldrig starts");
    let printed = String::from_utf8_lossy(&resumed.stderr);
    assert_eq!(resumed.status.code(), Some(0), "{printed}");
    let damaged = stored[0]
        .file_name()
        .expect("a name")
        .to_string_lossy()
        .into_owned();
    for expected in [
        &damaged,
        "the run continues without it",
        "of the earlier run",
    ] {
        assert!(printed.contains(expected), "{expected}: {printed}");
    }
    let lists = ["run", "resumed"]
        .map(|run| fs::read_to_string(folder.join(run).join("keyframes.txt")).expect("text"));
    let first = |list: &str| {
        list.lines()
            .find(|line| !line.starts_with('#'))
            .map(str::to_owned)
    };
    assert_ne!(
        first(&lists[0]),
        first(&lists[1]),
        "the damaged keyframe is no longer part of the run"
    );
}

#[test]
fn run_that_fails_before_its_first_keyframe_leaves_no_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    small_rig::write(folder, Pace::Lockstep);
    fs::write(folder.join("scan.mcap"), "of another program").expect("space");
    for out in [&["--out", "run"][..], &[]] {
        let args = [
            &["run", "rig.toml", "--steps", "1", "--record", "scan.mcap"][..],
            out,
        ]
        .concat();
        let output = fieldrig(folder, &args).output().expect("fieldrig starts");
        let printed = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.code() == Some(1) && printed.contains("exists already"),
            "{printed}"
        );
        assert!(
            !folder.join("run").exists() && !folder.join("runs").exists(),
            "{printed}"
        );
    }
    assert_eq!(
        fs::read(folder.join("scan.mcap")).expect("it is still there"),
        b"of another program"
    );
}
