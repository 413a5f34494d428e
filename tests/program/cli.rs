//! Tests the command line: help, exit codes, and one clear error message for invalid input.

use crate::command::assert_one_error;
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// Commands that `fieldrig --help` must list, each with its own help.
const COMMANDS: [&str; 19] = [
    "run",
    "record",
    "train",
    "view",
    "preview",
    "runs",
    "render",
    "eval",
    "metrics",
    "bench",
    "calibrate",
    "export",
    "fk",
    "init",
    "devices",
    "doctor",
    "schema",
    "sim",
    "move",
];

/// Runs a command that should end at once; after two minutes it is killed, with exit code 124.
fn fieldrig(args: &[&str]) -> Output {
    let program = ["120", env!("CARGO_BIN_EXE_fieldrig")];
    Command::new("timeout")
        .args(program)
        .args(args)
        .output()
        .expect("fieldrig starts")
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).expect("stdout is UTF-8")
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).expect("stderr is UTF-8")
}

/// Asserts the exit code and one error message on stderr that contains all `words`.
fn assert_fails_with(args: &[&str], code: i32, words: &[&str]) {
    assert_one_error(args, &fieldrig(args), code, words);
}

#[test]
fn every_command_is_listed_and_has_help() {
    let all = fieldrig(&["--help"]);
    assert_eq!(all.status.code(), Some(0));
    for command in COMMANDS {
        assert!(
            stdout(&all).contains(&format!("\n  {command} ")),
            "{command} is not listed:\n{}",
            stdout(&all)
        );
        let one = fieldrig(&[command, "--help"]);
        assert_eq!(one.status.code(), Some(0), "{command} --help");
        assert!(stdout(&one).contains("Usage: fieldrig"), "{}", stdout(&one));
    }
    let listed = stdout(&all)
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.is_empty())
        .count();
    assert_eq!(
        listed,
        COMMANDS.len() + 1,
        "a command is missing in this test:\n{}",
        stdout(&all)
    );
}

#[test]
fn wrong_arguments_exit_with_2() {
    assert_eq!(fieldrig(&[]).status.code(), Some(2));
    assert_fails_with(&["walk"], 2, &["walk"]);
    assert_fails_with(&["doctor", "--colour"], 2, &["--colour"]);
}

#[test]
fn a_run_of_no_time_is_refused() {
    for secs in ["0", "0.0", "-0"] {
        let args = ["run", "absent.toml", "--seconds", secs];
        assert_fails_with(&args, 2, &["--seconds", "must be more than 0"]);
    }
}

#[test]
fn missing_file_exits_with_1_and_is_named() {
    assert_fails_with(
        &[
            "fk",
            "absent.urdf",
            "--tip",
            "tool",
            "--joints",
            "absent.json",
        ],
        1,
        &["absent.urdf", "No such file"],
    );
}

/// Writes a shipped rig file with one piece of text replaced, and the robot description that it
/// refers to.
fn changed_rig(folder: &Path, from: &str, to: &str) -> String {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let text = std::fs::read_to_string(rigs.join("static-arm.toml")).expect("a shipped rig file");
    assert!(text.contains(from), "the shipped rig file has no {from:?}");
    std::fs::create_dir_all(folder.join("robots")).expect("the disk has space");
    std::fs::copy(
        rigs.join("robots/panda.urdf"),
        folder.join("robots/panda.urdf"),
    )
    .expect("the robot");
    let file = folder.join("rig.toml");
    std::fs::write(&file, text.replacen(from, to, 1)).expect("the disk has space");
    file.into_os_string()
        .into_string()
        .expect("a temporary folder has a plain name")
}

#[test]
fn unknown_rig_key_error_names_the_nearest_key() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "rate_hz", "raet_hz");
    assert_fails_with(
        &["run", &rig, "--sim"],
        2,
        &["raet_hz", "rate_hz", "rig.toml"],
    );
    assert_fails_with(&["run", "absent.toml"], 2, &["absent.toml"]);
}

#[test]
fn missing_device_error_suggests_simulation() {
    let folder = tempfile::tempdir().expect("a folder");
    let from = "[camera.wrist]\ndriver = \"sim\"";
    for driver in ["v4l2", "realsense"] {
        let to = format!("[camera.wrist]\ndriver = {driver:?}\ndevice = \"/dev/video99\"");
        let rig = changed_rig(folder.path(), from, &to);
        assert_fails_with(
            &["run", &rig, "--listen", "127.0.0.1:0"],
            1,
            &["wrist", "--sim"],
        );
    }
}

#[test]
fn unencrypted_pages_are_served_only_on_loopback_addresses() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "seed = 1", "seed = 2");
    let command = format!("`fieldrig run {rig} --sim --listen 0.0.0.0:0 --share`");
    assert_fails_with(
        &["run", &rig, "--sim", "--listen", "0.0.0.0:0"],
        2,
        &["0.0.0.0", "token", &command],
    );
    assert_fails_with(
        &["view", "absent", "--listen", "[::]:0"],
        2,
        &["'[::]:0' --share"],
    );
    assert_fails_with(
        &["view", "absent", "--certificate", "chain.pem"],
        2,
        &["--share"],
    );
    if cfg!(not(feature = "foxglove")) {
        assert_fails_with(
            &["view", "absent", "--foxglove"],
            2,
            &["--features foxglove"],
        );
    }
}

#[test]
fn missing_or_invalid_data_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let empty = folder.path().to_str().expect("a plain name");
    assert_fails_with(&["train", "absent"], 1, &["absent does not exist"]);
    assert_fails_with(&["train", empty], 1, &[empty]);
    assert_fails_with(
        &["train", "absent.mcap"],
        1,
        &["absent.mcap does not exist"],
    );
    let recording = folder.path().join("torn.mcap");
    std::fs::write(&recording, b"\x89MCAP0\r\n").expect("the disk has space");
    assert_fails_with(
        &["train", recording.to_str().expect("a plain name")],
        1,
        &["torn.mcap"],
    );
    assert_fails_with(&["eval", empty, "absent"], 1, &["absent does not exist"]);
    let no_model = format!("{empty} contains no model");
    assert_fails_with(&["eval", empty, empty], 1, &[&no_model]);
    let pose = ["--pose", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"];
    assert_fails_with(&["render", empty, pose[0], pose[1]], 1, &[&no_model]);
    assert_fails_with(
        &["render", "absent", pose[0], pose[1]],
        1,
        &["absent does not exist"],
    );
    for part in ["torn.mcap", "mesh.ply", "report.json"] {
        let file = folder.path().join(part);
        std::fs::write(&file, "a part").expect("the disk has space");
        let file = file.to_str().expect("a plain name");
        assert_fails_with(
            &["render", file, pose[0], pose[1]],
            2,
            &[part, "give its folder"],
        );
        assert_fails_with(&["eval", file, empty], 2, &[part, "give its folder"]);
    }
    let mesh = folder.path().join("mesh.ply");
    let export = [
        "export",
        mesh.to_str().expect("a plain name"),
        "--to",
        "glb",
        "--out",
        "a.glb",
    ];
    assert_fails_with(&export, 2, &["give its folder"]);
}

#[test]
fn invalid_arguments_exit_with_2() {
    assert_fails_with(&["train", "absent", "--seconds", "NaN"], 2, &["--seconds"]);
    assert_fails_with(
        &["train", "absent", "--scale", "0.04"],
        2,
        &["--scale", "0.05 to 1"],
    );
    for (flag, value) in [
        ("--max-splats", "0"),
        ("--max-bytes", "999"),
        ("--seed", "9223372036854775808"),
        ("--method", "mesh"),
    ] {
        assert_fails_with(&["train", "absent", flag, value], 2, &[flag]);
        assert_fails_with(&["run", "absent.toml", flag, value], 2, &[flag]);
    }
    // The options are rejected before data are read, because this folder does not exist.
    let refine = |words| ["train", "absent", "--method", "tsdf", "--refine", words];
    assert_fails_with(
        &refine("extrinsics,image-gains"),
        2,
        &[
            "image-gains",
            "tsdf cannot",
            "extrinsics, time-offset, joints, depth-pose",
        ],
    );
    assert_fails_with(&refine("extrinsics,auto"), 2, &["cannot be combined"]);
    for (flag, value) in [
        ("--splats", "0"),
        ("--splats", "100000000000"),
        ("--repeats", "0"),
        ("--size", "0x9"),
    ] {
        assert_fails_with(&["bench", "kernels", flag, value], 2, &[flag]);
    }
    assert_fails_with(
        &["bench", "curve", "absent", "--seconds", "NaN"],
        2,
        &["--seconds"],
    );
    assert_fails_with(
        &["bench", "curve", "absent", "--seeds", "0"],
        2,
        &["--seeds"],
    );
    assert_fails_with(
        &["bench", "curve", "absent", "--peer", "absent.json"],
        2,
        &["absent.json"],
    );
    assert_fails_with(
        &["bench", "budget", "absent", "--splats", "0"],
        2,
        &["--splats"],
    );
    assert_fails_with(
        &["bench", "stability", "absent", "--disturb", "weather"],
        2,
        &["weather", "pose-noise"],
    );
    assert_fails_with(
        &["bench", "stability", "absent", "--rate-hz", "0"],
        2,
        &["--rate-hz"],
    );
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "seed = 1", "seed = 2");
    assert_fails_with(
        &["run", &rig, "--sim", "--steps-per-keyframe", "3"],
        2,
        &["--steps-per-keyframe", "--lockstep"],
    );
    assert_fails_with(
        &["run", "rig.toml", "--lockstep", "--from", "scan.mcap"],
        2,
        &["--from"],
    );
    let out = folder.path().join("endless.mcap");
    let record = [
        "record",
        &rig,
        "--sim",
        "--lockstep",
        "--out",
        out.to_str().expect("a plain name"),
    ];
    assert_fails_with(&record, 2, &["lockstep", "--seconds"]);
    assert!(!out.exists(), "a rejected command leaves no files behind");
    let out = folder.path().join("refused");
    let to = [
        "--listen",
        "127.0.0.1:0",
        "--out",
        out.to_str().expect("a plain name"),
    ];
    for (method, flag, value) in [
        ("nerf", "--max-splats", "9"),
        ("nerf", "--count", "to-cap"),
        ("tsdf", "--max-splats", "9"),
        ("tsdf", "--count", "to-cap"),
        ("tsdf", "--refine", "image-gains"),
    ] {
        let run = ["run", &rig, "--sim", "--method", method, flag, value];
        assert_fails_with(&[&run[..], &to].concat(), 2, &[flag, "method", method]);
    }
    let run = [
        "run",
        &rig,
        "--sim",
        "--method",
        "tsdf",
        "--max-bytes",
        "1000000",
    ];
    assert_fails_with(
        &[&run[..], &to].concat(),
        2,
        &["1000000", "the smallest distance field takes 2629632 bytes"],
    );
    assert!(!out.exists(), "a rejected command leaves no files behind");
    for address in ["7105", "computer:7105"] {
        assert_fails_with(
            &["run", "rig.toml", "--sim", "--listen", address],
            2,
            &["127.0.0.1:7007"],
        );
    }
    assert_fails_with(
        &["eval", "model", "absent", "--holdout", "0"],
        2,
        &["--holdout 0"],
    );
    for meters in ["0", "nan", "-1"] {
        assert_fails_with(
            &[
                "metrics",
                "a.png",
                "b.png",
                &format!("--meters-per-count={meters}"),
            ],
            2,
            &["above 0"],
        );
    }
    assert_fails_with(&["render", "model", "--pose", "1 2 3"], 2, &["16"]);
    let scaled = [
        "render",
        "model",
        "--pose",
        "2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
    ];
    assert_fails_with(
        &scaled,
        2,
        &["not rigid", "expected a rotation without scale and shear"],
    );
    assert_fails_with(&["render", "model"], 2, &["--camera-path"]);
    assert_fails_with(
        &["run", "rig.toml", "--sim", "--from", "scan.mcap"],
        2,
        &["--from"],
    );
}

#[test]
fn existing_model_is_not_overwritten() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("splats.ply"), "a model").expect("the disk has space");
    let model = folder.path().to_str().expect("a plain name");
    assert_fails_with(
        &["train", "absent", "--out", model],
        2,
        &[model, "splats.ply"],
    );
    assert_fails_with(
        &["run", "absent.toml", "--out", model],
        2,
        &[model, "splats.ply"],
    );
    assert_eq!(
        std::fs::read(folder.path().join("splats.ply")).expect("still there"),
        b"a model"
    );
}

#[test]
fn devices_are_printed_as_json() {
    let output = fieldrig(&["devices", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let kinds: Vec<String> = stdout(&output)
        .lines()
        .map(|line| {
            serde_json::from_str::<serde_json::Value>(line).expect("one JSON object per line")
        })
        .map(|device| device["kind"].as_str().expect("a kind").to_owned())
        .collect();
    assert!(
        kinds.contains(&"gpu".to_owned()) && kinds.contains(&"simulation".to_owned()),
        "{kinds:?}"
    );
}

#[test]
fn doctor_fails_exactly_when_a_check_fails() {
    let output = fieldrig(&["doctor", "--json"]);
    let findings: Vec<serde_json::Value> = stdout(&output)
        .lines()
        .map(|line| serde_json::from_str(line).expect("one JSON object per line"))
        .collect();
    assert!(findings.len() >= 7, "{findings:?}");
    let failed = findings.iter().any(|finding| finding["verdict"] == "fail");
    assert_eq!(output.status.code(), Some(i32::from(failed)));
    for finding in &findings {
        assert_eq!(
            finding["verdict"] != "ok",
            finding["remedy"].is_string(),
            "every problem has a remedy: {finding}"
        );
    }
}

#[test]
fn doctor_names_the_missing_vulkan_package() {
    let absent = Path::new(env!("CARGO_MANIFEST_DIR")).join("no-such-driver.json");
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .arg("doctor")
        .env("VK_DRIVER_FILES", &absent)
        .env("VK_ICD_FILENAMES", &absent)
        .output()
        .expect("fieldrig starts");
    assert_eq!(output.status.code(), Some(1), "{}", stdout(&output));
    assert!(
        stdout(&output).contains("mesa-vulkan-drivers"),
        "{}",
        stdout(&output)
    );
}

#[test]
fn closed_stdout_is_not_an_error() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["devices", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("fieldrig ends");
    assert_eq!(
        (output.status.code(), stderr(&output)),
        (Some(0), String::new())
    );
}
