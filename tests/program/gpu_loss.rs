//! Tests runs whose GPU is lost or has too little memory: they continue, or stop without losing
//! their results.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use crate::photos::dataset;
use model_files::checkpoint::Checkpoint;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

fn fieldrig(folder: &Path, args: &[&str], env: &[(&str, &str)]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
    command
        .args(args)
        .envs(env.iter().copied())
        .current_dir(folder)
        .output()
        .unwrap()
}

fn stderr(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!text.contains("panicked"), "{text}");
    text
}

/// The last event of a successful run.
fn done(output: &Output) -> Value {
    assert!(output.status.success(), "{}", stderr(output));
    let stdout = String::from_utf8_lossy(&output.stdout);
    let last: Value = serde_json::from_str(stdout.lines().last().unwrap()).unwrap();
    assert_eq!(last["event"], "done");
    last
}

#[test]
fn training_after_gpu_loss_is_identical() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let train = |out: &str, checkpoint_secs: &str, env: &[(&str, &str)]| {
        let args = [
            "train",
            "data",
            "--json",
            "--steps",
            "300",
            "--max-splats",
            "600",
            "--out",
            out,
        ];
        fieldrig(
            folder,
            &[&args[..], &["--checkpoint-secs", checkpoint_secs]].concat(),
            env,
        )
    };
    let whole = done(&train("whole", "60", &[]));
    for (name, checkpoint_secs, continues_from) in [
        ("early", "100000", "from the start"),
        ("late", "0.01", "from the checkpoint of step"),
    ] {
        let lost = train(
            name,
            checkpoint_secs,
            &[("FIELDRIG_TEST_LOSE_GPU_AT_STEP", "150")],
        );
        let text = stderr(&lost);
        assert!(
            text.contains("attempt 1 of 3") && text.contains(continues_from),
            "{text}"
        );
        assert!(!text.contains("attempt 2"), "{text}");
        let lost = done(&lost);
        assert_eq!(
            lost["checkpoint_sha256"], whole["checkpoint_sha256"],
            "{name}: {text}"
        );
        assert_eq!(lost["steps"], whole["steps"]);
    }
}

#[test]
fn permanent_gpu_loss_error_names_checkpoint_and_command() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let common = ["train", "data", "--json", "--steps", "300"];
    let first = [&common[..], &["--max-splats", "600"]].concat();
    let whole = done(&fieldrig(
        folder,
        &[&first[..], &["--out", "whole"]].concat(),
        &[],
    ));
    let env = [
        ("FIELDRIG_TEST_LOSE_GPU_AT_STEP", "150"),
        ("FIELDRIG_TEST_OPEN_GPU_ONCE", "1"),
    ];

    let lost = fieldrig(
        folder,
        &[&first[..], &["--out", "lost", "--checkpoint-secs", "0.01"]].concat(),
        &env,
    );
    let text = stderr(&lost);
    assert_eq!(lost.status.code(), Some(1), "{text}");
    assert!(
        text.contains("no GPU adapter found") && text.contains("attempt 3 of 3"),
        "{text}"
    );
    assert!(
        text.contains("lost/training.ckpt: `")
            && text.contains(" train data --resume lost` continues from it"),
        "{text}"
    );
    let step = Checkpoint::read(&folder.join("lost/training.ckpt"))
        .unwrap()
        .state["step"]
        .as_u64()
        .unwrap();
    assert!((1..300).contains(&step), "{step}");
    let resumed = done(&fieldrig(
        folder,
        &[&common[..], &["--resume", "lost"]].concat(),
        &[],
    ));
    assert_eq!(resumed["checkpoint_sha256"], whole["checkpoint_sha256"]);

    let early = fieldrig(folder, &[&first[..], &["--out", "early"]].concat(), &env);
    assert_eq!(early.status.code(), Some(1));
    assert!(
        stderr(&early).contains("no checkpoint was written yet: start the run again"),
        "{}",
        stderr(&early)
    );
}

#[test]
fn out_of_gpu_memory_stops_growth() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    dataset(&folder.join("data"));
    let train = |out: &str, env: &[(&str, &str)]| {
        fieldrig(
            folder,
            &[
                "train",
                "data",
                "--json",
                "--steps",
                "300",
                "--plan-steps",
                "1500",
                "--out",
                out,
            ],
            env,
        )
    };
    let free = done(&train("free", &[]));
    // This is enough memory to train and render the first 10 000 splats, but not 15 000.
    let full = train("full", &[("FIELDRIG_TEST_GPU_BYTES", "12000000")]);
    let text = stderr(&full);
    assert_eq!(
        text.matches("the model stops growing at").count(),
        1,
        "{text}"
    );
    let full = done(&full);
    assert_eq!(full["steps"], 300);
    assert!(
        full["primitives"].as_u64() < free["primitives"].as_u64(),
        "{full} {free}"
    );

    // There is not enough memory to start. The program prints one error message and does not panic.
    let none = train("none", &[("FIELDRIG_TEST_GPU_BYTES", "3000000")]);
    assert_eq!(none.status.code(), Some(1));
    assert!(
        stderr(&none).contains("the GPU ran out of memory: buffer"),
        "{}",
        stderr(&none)
    );
}

#[cfg(feature = "sim")]
#[test]
fn live_run_survives_gpu_loss_or_keeps_its_recording() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
    let run = |out: &str, env: &[(&str, &str)]| {
        let recording = format!("{out}.mcap");
        let args = [
            "run",
            rig.to_str().unwrap(),
            "--sim",
            "--lockstep",
            "--steps",
            "200",
            "--max-splats",
            "2000",
        ];
        let more = [
            "--json",
            "--listen",
            "127.0.0.1:0",
            "--checkpoint-secs",
            "0.5",
            "--record",
            &recording,
            "--out",
            out,
        ];
        fieldrig(folder, &[&args[..], &more[..]].concat(), env)
    };
    let lost = run("lost", &[("FIELDRIG_TEST_LOSE_GPU_AT_STEP", "120")]);
    let text = stderr(&lost);
    assert!(
        text.contains("reopened the GPU: training continues from"),
        "{text}"
    );
    assert_eq!(done(&lost)["steps"], 200);

    let unrecovered = run(
        "gone",
        &[
            ("FIELDRIG_TEST_LOSE_GPU_AT_STEP", "120"),
            ("FIELDRIG_TEST_OPEN_GPU_ONCE", "1"),
        ],
    );
    let text = stderr(&unrecovered);
    assert_eq!(unrecovered.status.code(), Some(1), "{text}");
    assert!(
        (text.contains(" run ") && text.contains(" --resume gone` continues from it"))
            || text.contains("no checkpoint was written yet"),
        "{text}"
    );
    let listed = std::fs::read_to_string(folder.join("gone/keyframes.txt")).unwrap();
    assert!(listed.lines().count() >= 12, "{listed}");
    // The recording is complete, so it can be used for training.
    let args = [
        "train",
        "gone.mcap",
        "--json",
        "--steps",
        "20",
        "--max-splats",
        "500",
        "--out",
        "again",
    ];
    let again = fieldrig(folder, &args, &[]);
    assert!(again.status.success(), "{}", stderr(&again));
    assert!(!stderr(&again).contains("truncated"), "{}", stderr(&again));
}
