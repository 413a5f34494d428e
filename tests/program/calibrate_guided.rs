//! `fieldrig calibrate intrinsics` takes photographs of a target that a simulated hand moves, until
//! they cover everything, and writes the rig file.
#![cfg(feature = "sim")]

use crate::command::{fieldrig, json_of, stderr};
use std::path::Path;

const TARGET: &str = "charuco:7x5:17mm:13mm:5X5_100";
/// True lens of the simulated webcam, pixels; see `rigs/webcam-lens.toml`.
const TRUE_FOCAL_PX: [f64; 2] = [604.2, 603.1];
const TRUE_PRINCIPAL_PX: [f64; 2] = [326.4, 234.8];
/// Maximum error of the focal length and of the principal point, pixels.
const MAX_ERROR_PX: f64 = 1.5;

/// Rate of the simulated cameras, images per second. Searching an image takes most of the computing
/// time. The simulated hand holds the target still for six images.
const RATE_HZ: u32 = 5;

/// Writes `rigs/webcam-lens.toml` with a lower rate of images.
fn write_rig(folder: &Path) {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs/webcam-lens.toml");
    std::fs::copy(shipped, folder.join("rig.toml")).expect("a shipped rig file");
    reduce_rate(&folder.join("rig.toml"), 10);
}

/// Replaces the rate of images in a rig file.
fn reduce_rate(rig: &Path, from_hz: u32) {
    let text = std::fs::read_to_string(rig).expect("a rig file");
    let [from, to] = [from_hz, RATE_HZ].map(|hz| format!("rate_hz = {hz}\n"));
    assert!(text.contains(&from), "{text}");
    std::fs::write(rig, text.replace(&from, &to)).expect("the disk has space");
}

fn number(value: &serde_json::Value) -> f64 {
    value.as_f64().expect("a number")
}

#[test]
fn a_webcam_lens_is_calibrated_from_guided_photographs() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    write_rig(folder);
    let args = [
        "calibrate",
        "intrinsics",
        "rig.toml",
        "--sim",
        "--target",
        TARGET,
        "--listen",
        "127.0.0.1:0",
        "--save-images",
        "photographs",
        "--report",
        "lens.html",
        "--write-rig",
        "webcam.toml",
        "--json",
    ];
    let output = fieldrig(folder, &args);
    let log = stderr(&output);
    assert!(output.status.success(), "{log}");
    // It has ended because everything is covered, and said on the way what was missing.
    for words in [
        "show the whole target to the camera",
        "next: tilt the target by 20 to 45 degrees",
        "next: move the target to the ",
        "of the image covered; the images cover everything",
    ] {
        assert!(log.contains(words), "{words} is not in {log}");
    }
    assert!(!log.contains("do not cover everything"), "{log}");

    let lens = json_of(&output);
    for axis in 0..2 {
        let focal_px = number(&lens["focal_px"][axis]);
        let principal_px = number(&lens["principal_px"][axis]);
        assert!(
            (focal_px - TRUE_FOCAL_PX[axis]).abs() < MAX_ERROR_PX
                && (principal_px - TRUE_PRINCIPAL_PX[axis]).abs() < MAX_ERROR_PX,
            "{lens}"
        );
    }
    let text = std::fs::read_to_string(folder.join("webcam.toml")).expect("a rig file");
    let written: toml::Table = text.parse().expect("TOML");
    let focal_px = written["camera"]["webcam"]["intrinsics"]["focal_px"][0]
        .as_float()
        .expect("a number");
    assert!((focal_px - TRUE_FOCAL_PX[0]).abs() < MAX_ERROR_PX, "{text}");
    assert!(folder.join("lens.html").is_file());

    // The saved photographs give the same lens.
    let n_images = lens["images"].as_array().expect("images").len();
    let saved = std::fs::read_dir(folder.join("photographs")).expect("a folder");
    assert!(saved.count() >= n_images && n_images >= 15, "{n_images}");
    let args = [
        "calibrate",
        "intrinsics",
        "photographs",
        "--target",
        TARGET,
        "--json",
    ];
    let again = json_of(&fieldrig(folder, &args));
    assert_eq!(again["focal_px"], lens["focal_px"]);
}

#[test]
fn the_lens_of_any_simulated_camera_is_calibrated() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    // The rig file has no target, and its camera is on an arm that a base carries.
    let init = "init rig.toml --robot panda --moving-base --camera flange --yes";
    let output = fieldrig(folder, &init.split(' ').collect::<Vec<_>>());
    assert!(output.status.success(), "{}", stderr(&output));
    reduce_rate(&folder.join("rig.toml"), 30);
    let lens = [
        "calibrate",
        "intrinsics",
        "rig.toml",
        "--sim",
        "--target",
        TARGET,
        "--json",
    ];
    let output = fieldrig(folder, &lens);
    let log = stderr(&output);
    assert!(output.status.success(), "{log}");
    assert!(log.contains("the images cover everything"), "{log}");
    let file = std::fs::read_to_string(folder.join("rig.toml")).expect("a rig file");
    let rig: toml::Table = file.parse().expect("TOML");
    let true_px = rig["camera"]["wrist"]["intrinsics"]["focal_px"][0]
        .as_float()
        .expect("a number");
    let focal_px = number(&json_of(&output)["focal_px"][0]);
    assert!((focal_px - true_px).abs() < MAX_ERROR_PX, "{focal_px}");
}

#[test]
fn photographs_are_not_mixed_with_others() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    std::fs::create_dir(folder.join("photographs")).expect("a new folder");
    std::fs::write(folder.join("photographs/old.png"), "old").expect("written");
    write_rig(folder);
    let args = [
        "calibrate",
        "intrinsics",
        "rig.toml",
        "--sim",
        "--target",
        TARGET,
    ];
    let save = ["--save-images", "photographs"];
    let output = fieldrig(folder, &[&args[..], &save].concat());
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(stderr(&output).contains("not empty"), "{}", stderr(&output));
    // A fixed time uses all images instead of chosen ones.
    let output = fieldrig(folder, &[&args[..], &save, &["--seconds", "5"]].concat());
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(stderr(&output).contains("--seconds"), "{}", stderr(&output));
}
