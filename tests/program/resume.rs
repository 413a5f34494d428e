//! Tests `fieldrig train --resume`: runs that stopped or were killed continue as if uninterrupted.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use crate::photos::dataset;
#[cfg(feature = "sim")]
use crate::small_rig;
#[cfg(feature = "sim")]
use model_files::RunHistory;
use model_files::checkpoint::Checkpoint;
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

const N_STEPS: &str = "260";
const HALF: &str = "130";
const N_KILLS: u32 = 6;

fn train(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .args(["train", "data", "--json"])
        .args(args)
        .current_dir(folder);
    command
}

/// Trains to the end and returns the final event.
fn done(folder: &Path, args: &[&str]) -> Value {
    let output = train(folder, args).output().unwrap();
    assert!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    let printed = String::from_utf8(output.stdout).unwrap();
    let last: Value = serde_json::from_str(printed.lines().last().unwrap()).unwrap();
    assert_eq!(last["event"], "done");
    last
}

fn assert_fails(output: &Output, code: i32) -> String {
    let printed = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{printed}");
    assert!(!printed.contains("panicked"), "{printed}");
    printed
}

#[test]
fn resumed_training_equals_uninterrupted_training() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let common = ["--max-splats", "600", "--seed", "3"];
    let whole = done(
        folder,
        &[&["--steps", N_STEPS, "--out", "whole"], &common[..]].concat(),
    );
    let half = done(
        folder,
        &[
            &["--steps", HALF, "--plan-steps", N_STEPS, "--out", "half"],
            &common[..],
        ]
        .concat(),
    );
    assert_ne!(half["checkpoint_sha256"], whole["checkpoint_sha256"]);
    let report = std::fs::read(folder.join("half/report.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    let resume = report["resume_command"].as_str().unwrap();
    assert!(
        resume.contains("fieldrig train ") && resume.ends_with(" --resume half"),
        "{resume}"
    );
    let both = done(
        folder,
        &["--resume", "half", "--steps", N_STEPS, "--out", "both"],
    );
    assert_eq!(both["checkpoint_sha256"], whole["checkpoint_sha256"]);
    assert_eq!(
        (&both["steps"], &both["psnr"], &both["bytes"]),
        (&whole["steps"], &whole["psnr"], &whole["bytes"])
    );
    assert!(
        both["seconds"].as_f64() > half["seconds"].as_f64(),
        "the clock continues"
    );
    // The whole state is identical, not only the model, so both runs can be resumed.
    let [one, other] = ["whole", "both"]
        .map(|run| Checkpoint::read(&folder.join(run).join("training.ckpt")).unwrap());
    assert!(one.state == other.state && one.arrays == other.arrays);

    // Resuming a finished run changes nothing and reports `finished`.
    let finished = train(folder, &["--resume", "both"]).output().unwrap();
    assert_eq!(
        finished.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&finished.stderr)
    );
    let finished: Value = serde_json::from_slice(&finished.stdout).unwrap();
    assert_eq!(
        (&finished["event"], &finished["out"]),
        (&json!("finished"), &json!("both"))
    );
    assert!(!folder.join("runs").exists());

    // If the requested number of steps is already reached, the model is saved in a new folder,
    // because the folder of the run already contains a model.
    let again = done(
        folder,
        &[
            "--resume",
            "both",
            "--steps",
            N_STEPS,
            "--checkpoint-secs",
            "0",
        ],
    );
    assert_eq!(again["checkpoint_sha256"], whole["checkpoint_sha256"]);
    let out = folder.join(again["out"].as_str().unwrap());
    assert!(out.starts_with(folder.join("runs")) && !out.join("training.ckpt").exists());

    check_invalid_checkpoints_are_reported(folder);
}

fn check_invalid_checkpoints_are_reported(folder: &Path) {
    let file = folder.join("half/training.ckpt");
    let whole = std::fs::read(&file).unwrap();
    let printed = |bytes: &[u8]| {
        std::fs::write(&file, bytes).unwrap();
        assert_fails(
            &train(folder, &["--resume", "half", "--out", "x"])
                .output()
                .unwrap(),
            1,
        )
    };
    assert!(printed(&whole[..whole.len() / 2]).contains("truncated"));
    assert!(
        printed(&[&whole[..8], &[9], &whole[9..]].concat())
            .contains("format version 9, this program reads version 6")
    );
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 1;
    assert!(printed(&damaged).contains("damaged"));
    std::fs::write(&file, &whole).unwrap();
    let other_data = |args: &[&str]| {
        let output = train(
            folder,
            &[&["--resume", "half", "--out", "x"], args].concat(),
        )
        .output()
        .unwrap();
        let printed = assert_fails(&output, 1);
        assert!(
            printed.contains("error: the checkpoint belongs to different data: "),
            "{printed}"
        );
        printed
    };
    assert!(other_data(&["--scale", "0.5"]).contains("has 32x24 pixels, had 64x48"));
    assert!(
        other_data(&["--holdout", "2"]).contains("of its images are missing, the first is image")
    );
    for flag in ["--seed", "--max-splats", "--plan-steps"] {
        assert!(
            assert_fails(
                &train(folder, &["--resume", "half", flag, "5"])
                    .output()
                    .unwrap(),
                2
            )
            .contains(flag)
        );
    }
    let printed = assert_fails(&train(folder, &["--resume", "data"]).output().unwrap(), 1);
    assert!(
        printed.contains("no checkpoint to resume from in data")
            && printed.contains("training.ckpt"),
        "{printed}"
    );
    assert!(
        !folder.join("x").exists(),
        "a rejected command leaves no files behind"
    );
}

#[test]
fn decision_log_reproduces_a_timed_training() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let settings = [
        "--max-splats",
        "600",
        "--seed",
        "3",
        "--scale",
        "0.5",
        "--holdout",
        "5",
        "--refine",
        "image-poses",
    ];
    let timed = done(
        folder,
        &[&["--seconds", "1", "--out", "timed"], &settings[..]].concat(),
    );
    let again = done(
        folder,
        &[
            "--replay-decisions",
            "timed/decisions.jsonl",
            "--out",
            "again",
        ],
    );
    assert!(timed["steps"].as_u64() > Some(0));
    assert_eq!(
        (&again["checkpoint_sha256"], &again["steps"]),
        (&timed["checkpoint_sha256"], &timed["steps"])
    );

    // A resumed run can be replayed only from its checkpoint, which also defines scale and test
    // images.
    let both = done(
        folder,
        &["--resume", "timed", "--seconds", "2", "--out", "both"],
    );
    assert_ne!(both["checkpoint_sha256"], timed["checkpoint_sha256"]);
    let log = format!("both/decisions-from-{}.jsonl", timed["steps"]);
    let replay = ["--replay-decisions", &log, "--out", "both again"];
    let both_again = done(folder, &[&["--resume", "timed"], &replay[..]].concat());
    assert_eq!(both_again["checkpoint_sha256"], both["checkpoint_sha256"]);
    let printed = |args: &[&str]| {
        assert_fails(
            &train(folder, &[args, &["--out", "x"]].concat())
                .output()
                .unwrap(),
            2,
        )
    };
    assert!(printed(&["--replay-decisions", &log]).contains("with --resume"));
    assert!(
        printed(&["--resume", "timed", "--scale", "1"])
            .contains("--scale 1: the checkpoint in timed was trained with --scale 0.5")
    );
    assert!(printed(&["--resume", "timed", "--holdout", "8"]).contains("with --holdout 5"));
    assert!(
        printed(&["--resume", "timed", "--seconds", "0.5"])
            .contains("--seconds 0.5: the checkpoint in timed has already been trained for 1.")
    );
    assert!(
        printed(&["--replay-decisions", &log, "--resume", "both"])
            .contains("the checkpoint is at step")
    );
    assert!(
        printed(&[
            "--replay-decisions",
            "timed/decisions.jsonl",
            "--resume",
            "timed"
        ])
        .contains("remove --resume")
    );
    for flag in [
        "--seed",
        "--seconds",
        "--steps",
        "--holdout",
        "--scale",
        "--max-splats",
    ] {
        let printed = printed(&["--replay-decisions", "timed/decisions.jsonl", flag, "1"]);
        assert!(printed.contains(flag), "{printed}");
    }
    assert!(
        !folder.join("x").exists(),
        "a rejected command leaves no files behind"
    );
}

#[test]
fn repeatedly_killed_training_is_identical() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let first = [
        "--max-splats",
        "600",
        "--out",
        "killed",
        "--steps",
        N_STEPS,
        "--checkpoint-secs",
        "0.001",
    ];
    let whole = done(
        folder,
        &["--steps", N_STEPS, "--max-splats", "600", "--out", "whole"],
    );

    let file = folder.join("killed/training.ckpt");
    let changed = || {
        std::fs::metadata(&file)
            .and_then(|metadata| metadata.modified())
            .ok()
    };
    let resumed = ["--resume", "killed"]; // No other flag: the checkpoint contains the limit and the checkpoint interval.
    let mut steps = Vec::new();
    for kill in 0..N_KILLS {
        let from = if file.exists() {
            &resumed[..]
        } else {
            &first[..]
        };
        let before: Option<SystemTime> = changed();
        let mut run = train(folder, from).stdout(Stdio::null()).spawn().unwrap();
        let spawned = Instant::now();
        while changed() == before && run.try_wait().unwrap().is_none() {
            assert!(
                spawned.elapsed() < Duration::from_secs(120),
                "no checkpoint"
            );
            std::thread::sleep(Duration::from_millis(1));
        }
        // Each kill happens at a different point in the cycle of steps and checkpoints.
        std::thread::sleep(Duration::from_micros(
            u64::from(kill * 23 % 37) * 8000 + 137 * u64::from(kill),
        ));
        run.kill().unwrap();
        run.wait().unwrap();
        let checkpoint = Checkpoint::read(&file).unwrap();
        steps.push(checkpoint.state["step"].as_u64().unwrap());
    }
    assert!(steps.is_sorted() && steps[0] > 0, "{steps:?}");
    eprintln!("killed at steps {steps:?}");
    if folder.join("killed/splats.ply").exists() {
        return; // On a very fast machine, training ends before the last kill.
    }
    let end = done(folder, &resumed);
    assert_eq!(end["checkpoint_sha256"], whole["checkpoint_sha256"]);
    assert!(
        folder.join("killed/splats.ply").exists(),
        "it continued in the same folder"
    );
}

/// Kills a live run, resumes it, and checks that the result is like that of a single run: time and
/// keyframes are kept, and steps are added.
#[cfg(feature = "sim")]
#[test]
fn killed_live_run_resumes_keyframes_and_clock() {
    const SECONDS: &str = "14";
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    small_rig::write(folder, small_rig::Pace::RealTime);
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
        command
            .args(["run", "rig.toml", "--json", "--listen", "127.0.0.1:0"])
            .args(args)
            .current_dir(folder);
        command
    };
    let limits = [
        "--seconds",
        SECONDS,
        "--checkpoint-secs",
        "0.5",
        "--max-splats",
        "3000",
    ];
    let first = [
        &["--sim", "--out", "out", "--record", "first.mcap"],
        &limits[..],
    ]
    .concat();
    let mut killed = run(&first).stdout(Stdio::null()).spawn().unwrap();
    let file = folder.join("out/training.ckpt");
    let spawned = Instant::now();
    let has_learned =
        || Checkpoint::read(&file).is_ok_and(|read| read.state["step"].as_u64() > Some(0));
    while !has_learned() {
        assert!(
            spawned.elapsed() < Duration::from_secs(120) && killed.try_wait().unwrap().is_none(),
            "no checkpoint"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    let checkpoint = Checkpoint::read(&file).unwrap();
    let n_stored = || {
        std::fs::read_dir(folder.join("out/keyframes"))
            .unwrap()
            .count()
    };
    let n_stored_at_kill = n_stored();
    assert!(
        n_stored_at_kill > 1 && !checkpoint.is_finished,
        "{n_stored_at_kill} keyframes"
    );

    let output = run(&["--resume", "out"]).output().unwrap();
    let stderr_text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr_text}");
    assert!(
        stderr_text.contains("recorded to first.mcap; this part is not"),
        "{stderr_text}"
    );
    let printed = String::from_utf8(output.stdout).unwrap();
    let done: Value = serde_json::from_str(printed.lines().last().unwrap()).unwrap();
    assert_eq!(
        (&done["event"], &done["out"]),
        (&json!("done"), &json!("out"))
    );
    assert!(
        done["steps"].as_u64() > checkpoint.state["step"].as_u64(),
        "{done}"
    );
    let seconds = done["seconds"].as_f64().unwrap();
    assert!(
        (14.0..16.0).contains(&seconds),
        "the clock continued: {seconds} s"
    );
    let list = std::fs::read_to_string(folder.join("out/keyframes.txt")).unwrap();
    let stamps = list
        .lines()
        .filter_map(|line| line.split(' ').nth(1)?.parse::<i64>().ok());
    assert!(
        stamps.clone().count() >= n_stored_at_kill && stamps.is_sorted(),
        "{list}"
    );

    let history = |run: &str| {
        Checkpoint::read(&folder.join(run).join("training.ckpt"))
            .unwrap()
            .history
    };
    let resumed = history("out");
    expect_continued(&checkpoint.history, &resumed);

    // The run is finished. With a longer time limit, it continues in a new folder.
    let finished = run(&["--resume", "out"]).output().unwrap();
    assert!(finished.status.success());
    assert!(String::from_utf8_lossy(&finished.stdout).contains("\"finished\""));
    let more = run(&["--resume", "out", "--seconds", "16", "--out", "more"])
        .output()
        .unwrap();
    assert!(
        more.status.success(),
        "{}",
        String::from_utf8_lossy(&more.stderr)
    );
    assert!(folder.join("more/splats.ply").exists());
    assert!(!resumed.psnr().is_empty() && !resumed.rejected().is_empty());
    expect_continued(&resumed, &history("more"));
    let assert_fails = |args: &[&str], words: &str| {
        let output = run(args).output().unwrap();
        let stderr_text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            !output.status.success() && stderr_text.contains(words),
            "{args:?}: {stderr_text}"
        );
    };
    assert_fails(&["--resume", "out", "--seed", "5"], "--seed");
    std::fs::remove_dir_all(folder.join("out/keyframes")).unwrap();
    assert_fails(
        &["--resume", "out", "--seconds", "30", "--out", "x"],
        "has no usable keyframes",
    );
}

/// Fails unless the curve and the numbers of rejected images begin with those of the first part.
#[cfg(feature = "sim")]
fn expect_continued(first: &RunHistory, both: &RunHistory) {
    assert!(
        both.psnr().starts_with(first.psnr()),
        "{first:?}, then {both:?}"
    );
    for (reason, n) in first.rejected() {
        assert!(
            both.rejected().get(reason) >= Some(n),
            "{first:?}, then {both:?}"
        );
    }
}
