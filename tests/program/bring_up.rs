//! A robot that is set up piece by piece: first its arm, then a camera, then the calibration.

use crate::command::{fieldrig, stderr};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

const ARM: &str = "[arm]\ndriver = \"udp\"\naddress = \"127.0.0.1:0\"\nurdf = \"builtin:panda\"\n";
/// A camera that is not connected.
const CAMERA: &str = "[camera.wrist]\ndriver = \"v4l2\"\ndevice = \"no such camera\"\nsize_px = [640, 480]\n\
                      rate_hz = 30\nparent = \"flange\"\n";

fn write(folder: &Path, text: &str) {
    std::fs::write(folder.join("rig.toml"), text).expect("the disk has space");
}

fn printed(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &stderr(output)
}

#[test]
fn an_arm_is_checked_before_there_is_a_camera() {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), ARM);
    let output = fieldrig(folder.path(), &["doctor", "rig.toml", "--listen", "1"]);
    let text = printed(&output);
    for words in [
        "The flange (link \"panda_link8\") is moved by 7 joints",
        "camera is missing: it is not needed for `doctor` and `record`",
        // Nothing sends joint states.
        "start its sender",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let output = fieldrig(folder.path(), &["run", "rig.toml"]);
    let text = printed(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("camera is missing") && text.contains("fieldrig devices"),
        "{text}"
    );
}

#[test]
fn commands_name_the_calibration_that_they_need_and_how_to_find_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write(folder, &format!("{ARM}{CAMERA}"));
    for (args, expected) in [
        (
            &["run", "rig.toml"][..],
            &[
                "camera.wrist.intrinsics is missing: `fieldrig calibrate intrinsics rig.toml --camera wrist --target charuco:",
                "camera.wrist.parent_from_camera is missing: `fieldrig calibrate hand-eye rig.toml --camera wrist --target charuco:",
            ][..],
        ),
        (
            &[
                "calibrate",
                "hand-eye",
                "rig.toml",
                "--target",
                "charuco:5x7:24mm:18mm:5X5_100",
            ],
            &["camera.wrist.intrinsics is missing: `fieldrig calibrate intrinsics"],
        ),
    ] {
        let output = fieldrig(folder, args);
        let text = printed(&output);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
        for words in expected {
            assert!(text.contains(words), "{args:?}: {words}: {text}");
        }
    }
    // These commands need no calibration, and fail only because the camera is not connected.
    for args in [
        &["record", "rig.toml", "--out", "scan.mcap"][..],
        &[
            "calibrate",
            "intrinsics",
            "rig.toml",
            "--target",
            "charuco:5x7:24mm:18mm:5X5_100",
        ],
    ] {
        let output = fieldrig(folder, args);
        let text = printed(&output);
        assert!(
            !output.status.success()
                && text.contains("no such camera")
                && !text.contains("is missing"),
            "{args:?}: {text}"
        );
    }
}

#[test]
fn other_devices_are_listened_to_although_the_camera_is_not_connected() {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), &format!("{ARM}{CAMERA}"));
    let output = fieldrig(folder.path(), &["doctor", "rig.toml", "--listen", "1"]);
    let text = printed(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(
        text.contains("camera \"wrist\" cannot be opened") && text.contains("start its sender"),
        "{text}"
    );
    assert!(
        !text.contains("replaces every device"),
        "doctor has no --sim: {text}"
    );
}

#[test]
fn the_picture_of_a_rig_is_written() {
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/static-arm.toml");
    let rig = rig.to_str().expect("a path in UTF-8");
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    // Other checks may fail on this computer.
    fieldrig(folder, &["doctor", rig, "--picture", "rig.svg"]);
    let picture = std::fs::read_to_string(folder.join("rig.svg")).expect("a picture");
    assert!(picture.contains("side view") && picture.contains(">wrist<"));
    let output = fieldrig(folder, &["doctor", rig, "--picture", "rig.png"]);
    assert_eq!(output.status.code(), Some(2), "{}", printed(&output));
    assert!(stderr(&output).contains(".svg") && !folder.join("rig.png").exists());
}

#[test]
fn devices_are_watched_until_an_interrupt() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["devices", "--watch", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("fieldrig starts");
    let lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
    let list = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>());
    // The list comes first. From this message on, signals are handled.
    let mut log = BufReader::new(child.stderr.take().expect("a pipe"));
    let mut text = String::new();
    while !text.contains("watching for devices") {
        let n_bytes = log.read_line(&mut text).expect("text");
        assert!(n_bytes > 0, "it ended early: {text}");
    }
    let id = child.id().to_string();
    let killed = Command::new("kill").args(["-INT", &id]).status();
    assert!(killed.expect("kill is installed").success());
    let status = child.wait().expect("the program ends");
    let list = list.join().expect("the reader ends");
    let kinds: Vec<String> = list
        .iter()
        .filter_map(|line| {
            let device: serde_json::Value = serde_json::from_str(line).ok()?;
            Some(device["kind"].as_str()?.to_owned())
        })
        .collect();
    assert!(
        kinds.first().is_some_and(|kind| kind == "gpu") && kinds.contains(&"simulation".to_owned()),
        "{list:?}"
    );
    assert_eq!(status.code(), Some(0), "{status:?}");
}
