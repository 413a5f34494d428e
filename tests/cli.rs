//! The command line as a stranger meets it: help, exit codes, one clear sentence for wrong input.

use std::path::Path;
use std::process::{Command, Output, Stdio};

/// Commands that `fieldrig --help` must list, each with help of its own.
const COMMANDS: [&str; 14] = [
    "run", "record", "train", "view", "render", "eval", "metrics", "bench", "export", "fk", "devices", "doctor", "sim",
    "move",
];

fn fieldrig(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fieldrig")).args(args).output().expect("fieldrig starts")
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).expect("stdout is UTF-8")
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).expect("stderr is UTF-8")
}

/// Asserts the exit code and one sentence on stderr that holds every word of `words`.
fn assert_refused(args: &[&str], code: i32, words: &[&str]) {
    let output = fieldrig(args);
    let told = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{args:?}: {told}");
    assert!(!told.contains("panicked"), "{args:?}: {told}");
    for word in words {
        assert!(told.contains(word), "{args:?} does not speak of {word:?}: {told}");
    }
    let sentences: Vec<&str> = told.lines().filter(|line| line.starts_with("error: ")).collect();
    assert_eq!(sentences.len(), 1, "{args:?}: {told}");
}

#[test]
fn help_lists_every_command_and_each_has_its_own() {
    let all = fieldrig(&["--help"]);
    assert_eq!(all.status.code(), Some(0));
    for command in COMMANDS {
        assert!(stdout(&all).contains(&format!("\n  {command} ")), "{command} is not listed:\n{}", stdout(&all));
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
    assert_eq!(listed, COMMANDS.len() + 1, "a command is missing in this test:\n{}", stdout(&all));
}

#[test]
fn wrong_arguments_exit_with_2() {
    assert_eq!(fieldrig(&[]).status.code(), Some(2));
    assert_refused(&["walk"], 2, &["walk"]);
    assert_refused(&["doctor", "--colour"], 2, &["--colour"]);
}

#[test]
fn a_file_that_is_not_there_exits_with_1_and_is_named() {
    assert_refused(
        &["fk", "absent.urdf", "--tip", "tool", "--joints", "absent.json"],
        1,
        &["absent.urdf", "No such file"],
    );
}

/// A shipped rig file with one piece of text replaced, beside the robot that it names.
fn changed_rig(folder: &Path, from: &str, to: &str) -> String {
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let text = std::fs::read_to_string(rigs.join("static-arm.toml")).expect("a shipped rig file");
    assert!(text.contains(from), "the shipped rig file has no {from:?}");
    std::fs::create_dir_all(folder.join("robots")).expect("room on the disk");
    std::fs::copy(rigs.join("robots/panda.urdf"), folder.join("robots/panda.urdf")).expect("the robot");
    let file = folder.join("rig.toml");
    std::fs::write(&file, text.replacen(from, to, 1)).expect("room on the disk");
    file.into_os_string().into_string().expect("a temporary folder has a plain name")
}

#[test]
fn an_unknown_key_of_a_rig_file_is_named_with_the_nearest_known_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "rate_hz", "raet_hz");
    assert_refused(&["run", &rig, "--sim"], 2, &["raet_hz", "rate_hz", "rig.toml"]);
    assert_refused(&["run", "absent.toml"], 2, &["absent.toml"]);
}

#[test]
fn a_device_that_is_not_there_or_has_no_driver_names_the_simulation() {
    let folder = tempfile::tempdir().expect("a folder");
    let from = "[camera.wrist]\ndriver = \"sim\"";
    for driver in ["v4l2", "realsense"] {
        let to = format!("[camera.wrist]\ndriver = {driver:?}\ndevice = \"/dev/video99\"");
        let rig = changed_rig(folder.path(), from, &to);
        assert_refused(&["run", &rig, "--listen", "127.0.0.1:0"], 1, &["wrist", "--sim"]);
    }
}

#[test]
fn only_loopback_is_served() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "seed = 1", "seed = 2");
    assert_refused(&["run", &rig, "--sim", "--listen", "0.0.0.0:0"], 1, &["0.0.0.0"]);
}

#[test]
fn data_that_is_not_there_or_is_none_is_told() {
    let folder = tempfile::tempdir().expect("a folder");
    let empty = folder.path().to_str().expect("a plain name");
    assert_refused(&["train", "absent"], 1, &["absent does not exist"]);
    assert_refused(&["train", empty], 1, &[empty]);
    assert_refused(&["train", "absent.mcap"], 1, &["absent.mcap does not exist"]);
    let recording = folder.path().join("torn.mcap");
    std::fs::write(&recording, b"\x89MCAP0\r\n").expect("room on the disk");
    assert_refused(&["train", recording.to_str().expect("a plain name")], 1, &["torn.mcap"]);
    assert_refused(&["eval", empty, "absent"], 1, &["absent does not exist"]);
    let no_model = format!("{empty} holds no model");
    assert_refused(&["eval", empty, empty], 1, &[&no_model]);
    let pose = ["--pose", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"];
    assert_refused(&["render", empty, pose[0], pose[1]], 1, &[&no_model]);
    assert_refused(&["render", "absent", pose[0], pose[1]], 1, &["absent does not exist"]);
    for part in ["torn.mcap", "mesh.ply", "report.json"] {
        let file = folder.path().join(part);
        std::fs::write(&file, "a part").expect("room on the disk");
        let file = file.to_str().expect("a plain name");
        assert_refused(&["render", file, pose[0], pose[1]], 2, &[part, "name its folder"]);
        assert_refused(&["eval", file, empty], 2, &[part, "name its folder"]);
    }
    let mesh = folder.path().join("mesh.ply");
    let export = ["export", mesh.to_str().expect("a plain name"), "--to", "glb", "--out", "a.glb"];
    assert_refused(&export, 2, &["name its folder"]);
}

#[test]
fn arguments_that_make_no_sense_exit_with_2() {
    assert_refused(&["train", "absent", "--seconds", "NaN"], 2, &["--seconds"]);
    assert_refused(&["train", "absent", "--scale", "0.04"], 2, &["--scale", "0.05 to 1"]);
    for (flag, value) in
        [("--max-splats", "0"), ("--max-bytes", "999"), ("--seed", "9223372036854775808"), ("--method", "mesh")]
    {
        assert_refused(&["train", "absent", flag, value], 2, &[flag]);
        assert_refused(&["run", "absent.toml", flag, value], 2, &[flag]);
    }
    // Before data are read: there are none here.
    let refine = |words| ["train", "absent", "--method", "tsdf", "--refine", words];
    assert_refused(
        &refine("mount,image-gains"),
        2,
        &["image-gains", "tsdf does not", "mount, delay, joints, depth-pose"],
    );
    assert_refused(&refine("mount,auto"), 2, &["stand alone"]);
    for (flag, value) in [("--splats", "0"), ("--splats", "100000000000"), ("--repeats", "0"), ("--size", "0x9")] {
        assert_refused(&["bench", "kernels", flag, value], 2, &[flag]);
    }
    assert_refused(&["bench", "curve", "absent", "--seconds", "NaN"], 2, &["--seconds"]);
    assert_refused(&["bench", "curve", "absent", "--seeds", "0"], 2, &["--seeds"]);
    assert_refused(&["bench", "curve", "absent", "--peer", "absent.json"], 2, &["absent.json"]);
    assert_refused(&["bench", "budget", "absent", "--splats", "0"], 2, &["--splats"]);
    assert_refused(&["bench", "stability", "absent", "--disturb", "weather"], 2, &["weather", "pose-noise"]);
    assert_refused(&["bench", "stability", "absent", "--rate-hz", "0"], 2, &["--rate-hz"]);
    let folder = tempfile::tempdir().expect("a folder");
    let rig = changed_rig(folder.path(), "seed = 1", "seed = 2");
    assert_refused(&["run", &rig, "--sim", "--steps-per-keyframe", "3"], 2, &["--steps-per-keyframe", "--lockstep"]);
    assert_refused(&["run", "rig.toml", "--lockstep", "--from", "scan.mcap"], 2, &["--from"]);
    let out = folder.path().join("endless.mcap");
    let record = ["record", &rig, "--sim", "--lockstep", "--out", out.to_str().expect("a plain name")];
    assert_refused(&record, 2, &["lockstep", "--seconds"]);
    assert!(!out.exists(), "what is refused leaves nothing behind");
    let out = folder.path().join("refused");
    let to = ["--listen", "127.0.0.1:0", "--out", out.to_str().expect("a plain name")];
    for (flag, value) in [("--max-splats", "9"), ("--refine", "mount"), ("--count", "to-cap")] {
        for method in ["nerf", "tsdf"] {
            let run = ["run", &rig, "--sim", "--method", method, flag, value];
            assert_refused(&[&run[..], &to].concat(), 2, &[flag, "method", method]);
        }
    }
    let run = ["run", &rig, "--sim", "--method", "tsdf", "--max-bytes", "1000000"];
    assert_refused(&[&run[..], &to].concat(), 2, &["1000000", "the smallest distance field takes 2629632 bytes"]);
    assert!(!out.exists(), "what is refused leaves nothing behind");
    for address in ["7105", "localhost:7105"] {
        assert_refused(&["run", "rig.toml", "--sim", "--listen", address], 2, &["127.0.0.1:7007"]);
    }
    assert_refused(&["eval", "model", "absent", "--holdout", "0"], 2, &["--holdout 0"]);
    for metres in ["0", "nan", "-1"] {
        assert_refused(&["metrics", "a.png", "b.png", &format!("--metres-per-count={metres}")], 2, &["above 0"]);
    }
    assert_refused(&["render", "model", "--pose", "1 2 3"], 2, &["16"]);
    assert_refused(&["render", "model", "--pose", "2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"], 2, &["rotation"]);
    assert_refused(&["render", "model"], 2, &["--camera-path"]);
    assert_refused(&["run", "rig.toml", "--sim", "--from", "scan.mcap"], 2, &["--from"]);
}

#[test]
fn a_folder_that_holds_a_model_is_not_overwritten() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("splats.ply"), "a model").expect("room on the disk");
    let model = folder.path().to_str().expect("a plain name");
    assert_refused(&["train", "absent", "--out", model], 2, &[model, "splats.ply"]);
    assert_refused(&["run", "absent.toml", "--out", model], 2, &[model, "splats.ply"]);
    assert_eq!(std::fs::read(folder.path().join("splats.ply")).expect("still there"), b"a model");
}

#[test]
fn devices_are_told_as_json() {
    let output = fieldrig(&["devices", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let kinds: Vec<String> = stdout(&output)
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).expect("a JSON object a line"))
        .map(|device| device["kind"].as_str().expect("a kind").to_owned())
        .collect();
    assert!(kinds.contains(&"gpu".to_owned()) && kinds.contains(&"simulation".to_owned()), "{kinds:?}");
}

#[test]
fn the_doctor_fails_exactly_when_a_finding_does() {
    let output = fieldrig(&["doctor", "--json"]);
    let findings: Vec<serde_json::Value> =
        stdout(&output).lines().map(|line| serde_json::from_str(line).expect("a JSON object a line")).collect();
    assert!(findings.len() >= 7, "{findings:?}");
    let failed = findings.iter().any(|finding| finding["verdict"] == "fail");
    assert_eq!(output.status.code(), Some(i32::from(failed)));
    for finding in &findings {
        assert_eq!(
            finding["verdict"] != "ok",
            finding["mend"].is_string(),
            "a remedy for all that is amiss: {finding}"
        );
    }
}

#[test]
fn without_a_vulkan_driver_the_doctor_names_the_package() {
    let absent = Path::new(env!("CARGO_MANIFEST_DIR")).join("no-such-driver.json");
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .arg("doctor")
        .env("VK_DRIVER_FILES", &absent)
        .env("VK_ICD_FILENAMES", &absent)
        .output()
        .expect("fieldrig starts");
    assert_eq!(output.status.code(), Some(1), "{}", stdout(&output));
    assert!(stdout(&output).contains("mesa-vulkan-drivers"), "{}", stdout(&output));
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["devices", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("fieldrig ends");
    assert_eq!((output.status.code(), stderr(&output)), (Some(0), String::new()));
}
