//! Tests `fieldrig runs`, the log in a run folder, and a Ctrl-C whose signal arrives twice.

use crate::command::{fieldrig, json_of, stderr};
use crate::photos::dataset;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Trains in `folder/out` for some steps.
fn train(folder: &Path, out: &str, steps: &str) {
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["train", "data", "-v", "--max-splats", "300"])
        .args(["--steps", steps, "--out", out])
        .env_remove("RUST_LOG")
        .current_dir(folder)
        .output()
        .expect("fieldrig starts");
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn runs_have_a_log_and_are_listed_and_removed() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    dataset(&folder.join("data"));
    train(folder, "runs/a", "4");
    train(folder, "runs/b", "4");

    // The log begins with the program and the command.
    let log = fs::read_to_string(folder.join("runs/a/log.txt")).expect("a log");
    let first = log.lines().next().expect("a line");
    assert!(
        first.starts_with(concat!("fieldrig ", env!("CARGO_PKG_VERSION"), " ("))
            && first.contains(" train data ")
            && first.ends_with("--out runs/a"),
        "{first}"
    );
    // The same lines as on stderr follow.
    assert!(log.contains(" DEBUG] ") && log.ends_with('\n'), "{log}");

    let listed = fieldrig(folder, &["runs", "--json"]);
    let lines = String::from_utf8_lossy(&listed.stdout);
    let events: Vec<Value> = lines
        .lines()
        .map(|line| serde_json::from_str(line).expect("an object per line"))
        .collect();
    let names: Vec<&Value> = events.iter().map(|event| &event["name"]).collect();
    assert_eq!(names, ["a".into(), "b".into(), Value::Null].each_ref());
    assert_eq!(
        (&events[0]["state"], &events[0]["rig"]),
        (&"done".into(), &"data".into())
    );
    assert_eq!(events[0]["models"][0]["method"], "splat");
    let total = events[0]["bytes"].as_u64().zip(events[1]["bytes"].as_u64());
    let total = total.map(|(a, b)| a + b);
    assert_eq!(
        (&events[2]["event"], events[2]["bytes"].as_u64()),
        (&"total".into(), total)
    );

    // Without a terminal, nothing is removed without --yes.
    let asked = fieldrig(folder, &["runs", "remove", "a"]);
    assert_eq!(asked.status.code(), Some(2));
    assert!(stderr(&asked).contains("--yes"), "{}", stderr(&asked));
    // A folder with other files is refused, and then no run is removed.
    fs::write(folder.join("runs/b/scan.mcap"), "x").expect("space");
    let refused = fieldrig(folder, &["runs", "remove", "a", "runs/b", "--yes"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        stderr(&refused).contains("runs/b/scan.mcap"),
        "{}",
        stderr(&refused)
    );
    assert!(folder.join("runs/a").exists());
    // Everything else in the folder of a real run is known.
    let removed = fieldrig(folder, &["runs", "remove", "--keep", "0", "--yes"]);
    assert!(removed.status.success(), "{}", stderr(&removed));
    assert!(!folder.join("runs/a").exists() && folder.join("runs/b/scan.mcap").exists());
    let listed = fieldrig(folder, &["runs", "list", "--in", "absent", "--json"]);
    assert_eq!(json_of(&listed)["runs"], 0);
}

/// `timeout -s INT` sends the signal to the process and to its group.
#[test]
fn ctrl_c_that_arrives_twice_saves_the_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    dataset(&folder.join("data"));
    let mut training = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["train", "data", "--max-splats", "300", "--seconds", "600"])
        .args(["--out", "out", "--checkpoint-secs", "0.1"])
        .env_remove("RUST_LOG")
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig starts");
    let began = Instant::now();
    while !folder.join("out/training.ckpt").exists() {
        let is_running = training.try_wait().expect("our own child").is_none();
        assert!(
            is_running && began.elapsed() < Duration::from_secs(300),
            "no checkpoint"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    let pid = training.id().to_string();
    let sent = Command::new("sh")
        .args(["-c", "kill -INT $0; kill -INT $0", &pid])
        .status()
        .expect("sh starts");
    assert!(sent.success());
    let ended = training.wait_with_output().expect("our own child");
    assert_eq!(ended.status.code(), Some(0), "{}", stderr(&ended));
    assert!(folder.join("out/splats.ply").exists() && folder.join("out/report.json").exists());
    assert!(
        stderr(&ended).contains("stopping and saving"),
        "{}",
        stderr(&ended)
    );
}
