//! `fieldrig calibrate`, from files to the printed result.

use crate::command::{fieldrig, json_of, stderr};
use kinematics::{Intrinsics, Lens, Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Stdio};
use targets::TargetSpec;
use targets::synthetic::{View, render};

const TARGET: &str = "charuco:5x7:34mm:26mm:5X5_100";
const SIZE_PX: [u32; 2] = [480, 360];
/// Exit codes.
const DONE: i32 = 0;
const BAD_ARGUMENTS: i32 = 2;
const INSUFFICIENT_DATA: i32 = 4;

fn camera() -> Intrinsics {
    Intrinsics {
        size_px: SIZE_PX,
        focal_px: [400.0, 398.0],
        principal_px: [243.0, 176.0],
        lens: Lens::BrownConrady([-0.12, 0.03, 0.0, 0.0, 0.0]),
        rectified: false,
    }
}

fn flange_from_camera() -> Transform {
    Transform::new(
        Vector3::new(0.04, -0.02, 0.06),
        Vector3::new(0.1, -0.05, 1.4),
    )
}

/// Poses of the camera relative to the board: around it, tilted, at different distances.
fn board_poses() -> Vec<Transform> {
    let center = Vector3::new(0.085, 0.119, 0.0);
    (0..12)
        .map(|ix| {
            let angle = f64::from(ix) * 0.53;
            let tilt = Vector3::new(
                0.45 * angle.sin(),
                0.45 * (1.7 * angle).cos(),
                0.4 * (0.9 * angle).sin(),
            );
            let rotation = UnitQuaternion::from_scaled_axis(tilt);
            let position = Vector3::new(
                0.03 * angle.cos(),
                0.02 * angle.sin(),
                0.34 + 0.02 * f64::from(ix % 4),
            );
            Transform::from_parts((position - rotation * center).into(), rotation)
        })
        .collect()
}

/// Writes images `0.png` to `11.png`, whose alphabetical order differs from their numerical order.
fn write_images(folder: &Path) {
    let target: TargetSpec = TARGET.parse().expect("a target");
    for (ix, camera_from_board) in board_poses().into_iter().enumerate() {
        let view = View {
            intrinsics: camera(),
            camera_from_board,
            blur_px: 0.7,
            noise: 2.0,
            seed: ix as u64,
            is_legacy: false,
        };
        let pixels = render(&target, &view);
        let [width, height] = SIZE_PX;
        let file = folder.join(format!("{ix}.png"));
        image::save_buffer(file, &pixels, width, height, image::ColorType::L8).expect("an image");
    }
}

fn rows(pose: &Transform) -> Value {
    let numbers = transform::to_rows(pose);
    json!(numbers.chunks(4).map(<[f64]>::to_vec).collect::<Vec<_>>())
}

fn transform_of(matrix: &Value) -> Transform {
    let numbers: Vec<f64> = matrix
        .as_array()
        .into_iter()
        .flatten()
        .flat_map(|row| row.as_array().cloned().unwrap_or_default())
        .filter_map(|value| value.as_f64())
        .collect();
    transform::from_rows(&numbers.try_into().expect("16 numbers")).expect("a rigid transform")
}

/// Robot poses for an arm with the board fixed to its base.
fn robot_poses() -> Vec<Transform> {
    let base_from_board = Transform::new(Vector3::new(0.5, 0.1, 0.02), Vector3::new(3.0, 0.1, 0.0));
    board_poses()
        .iter()
        .map(|camera_from_board| {
            base_from_board * camera_from_board.inverse() * flange_from_camera().inverse()
        })
        .collect()
}

#[test]
fn lens_and_hand_eye_are_found_from_images() {
    let folder = tempfile::tempdir().expect("a folder");
    let images = folder.path().join("images");
    std::fs::create_dir(&images).expect("a folder");
    write_images(&images);
    std::fs::write(images.join("broken.jpg"), b"not a picture").expect("a file");

    let output = fieldrig(
        folder.path(),
        &[
            "calibrate",
            "intrinsics",
            "images",
            "--target",
            TARGET,
            "--json",
        ],
    );
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    let lens = json_of(&output);
    assert_eq!(
        (lens["model"].as_str(), lens["size_px"] == json!(SIZE_PX)),
        (Some("brown_conrady"), true),
        "{lens}"
    );
    let truth = camera();
    for (axis, name) in ["fx", "fy"].into_iter().enumerate() {
        let error =
            (lens["focal_px"][axis].as_f64().expect("a number") - truth.focal_px[axis]).abs();
        let sigma = lens["sigma"][name].as_f64().expect("a number");
        assert!(
            error < 4.0 * sigma && sigma < 2.0,
            "{name}: {error} px, {sigma} px"
        );
    }
    assert!(
        lens["rms_px"].as_f64().is_some_and(|rms| rms < 0.1),
        "{lens}"
    );
    assert_eq!(
        lens["rejected"][0]["image"], "broken.jpg",
        "an unreadable image is named"
    );

    // The samples are in another order than the file names.
    let robot_poses = robot_poses();
    let sample = |ix: usize| json!({"base_from_flange": rows(&robot_poses[ix]), "image": format!("images/{ix}.png")});
    let samples: Vec<Value> = (0..robot_poses.len()).rev().map(sample).collect();
    let file = json!({"intrinsics": lens, "target": TARGET, "samples": samples});
    std::fs::write(folder.path().join("samples.json"), file.to_string()).expect("a file");
    let output = fieldrig(
        folder.path(),
        &["calibrate", "hand-eye", "samples.json", "--json"],
    );
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    let result = json_of(&output);
    let error = flange_from_camera().inverse() * transform_of(&result["flange_from_camera"]);
    let (mm, degrees) = (
        1e3 * error.translation.vector.norm(),
        error.rotation.angle().to_degrees(),
    );
    assert!(
        mm < 1.0 && degrees < 0.1,
        "{mm} mm, {degrees} degrees: {result}"
    );
    assert!(
        result["refused"].is_null()
            && result["sigma_mm"]
                .as_array()
                .is_some_and(|sigma| sigma.len() == 3)
    );

    // Reports are complete, and names from files are escaped.
    std::fs::rename(images.join("3.png"), images.join("<i>3.png")).expect("a file");
    let args = [
        "calibrate",
        "intrinsics",
        "images",
        "--target",
        TARGET,
        "--report",
        "lens.html",
    ];
    assert_eq!(fieldrig(folder.path(), &args).status.code(), Some(DONE));
    let page = report(folder.path(), "lens.html");
    for words in [
        "Accepted",
        "focal length x",
        "Projection uncertainty",
        "magnified",
        "&lt;i&gt;3.png",
        "broken.jpg",
    ] {
        assert!(page.contains(words), "{words} is missing");
    }
    assert_eq!(
        page.matches("data:image/jpeg;base64,").count(),
        2,
        "the worst and the median image"
    );
    std::fs::rename(images.join("<i>3.png"), images.join("3.png")).expect("a file");
    let args = [
        "calibrate",
        "hand-eye",
        "samples.json",
        "--report",
        "hand-eye.html",
    ];
    assert_eq!(fieldrig(folder.path(), &args).status.code(), Some(DONE));
    let page = report(folder.path(), "hand-eye.html");
    for words in [
        "Accepted",
        "position of the camera in the flange",
        "Rotations of the flange",
        "images/11.png",
    ] {
        assert!(page.contains(words), "{words} is missing");
    }

    // Intrinsics of another resolution are rejected.
    let mut other = file;
    other["intrinsics"]["size_px"] = json!([960, 720]);
    std::fs::write(folder.path().join("other.json"), other.to_string()).expect("a file");
    let output = fieldrig(folder.path(), &["calibrate", "hand-eye", "other.json"]);
    assert_eq!(output.status.code(), Some(BAD_ARGUMENTS));
    assert!(stderr(&output).contains("960x720"), "{}", stderr(&output));

    // Another target is named.
    let output = fieldrig(
        folder.path(),
        &[
            "calibrate",
            "intrinsics",
            "images",
            "--target",
            "charuco:5x7:34mm:26mm:4X4_50",
        ],
    );
    assert_eq!(output.status.code(), Some(INSUFFICIENT_DATA));
    assert!(stderr(&output).contains("5X5"), "{}", stderr(&output));

    // Markers of another size are measured.
    let output = fieldrig(
        folder.path(),
        &[
            "calibrate",
            "intrinsics",
            "images",
            "--target",
            "charuco:5x7:34mm:20mm:5X5_100",
        ],
    );
    assert_eq!(output.status.code(), Some(INSUFFICIENT_DATA));
    assert!(
        stderr(&output).contains("the markers are about 0.7"),
        "{}",
        stderr(&output)
    );
}

/// Returns a report, and checks that it does not load anything.
fn report(folder: &Path, name: &str) -> String {
    let page = std::fs::read_to_string(folder.join(name)).expect("a report");
    assert!(page.starts_with("<!doctype html>") && page.trim_end().ends_with("</html>"));
    for source in ["<script", "<link", "src=\"http", "href=\"http", "url("] {
        assert!(!page.contains(source), "{name} contains {source}");
    }
    // Encoded pictures may contain any letters, so they are removed before the search.
    let without_picture = |part: &str| {
        part.split_once('"')
            .map_or(String::new(), |(_, rest)| rest.to_owned())
    };
    let mut parts = page.split("base64,");
    let text = parts.next().unwrap_or_default().to_owned()
        + &parts.map(without_picture).collect::<String>();
    assert!(!text.contains("NaN") && !text.contains("<i>"), "{name}");
    page
}

#[test]
fn results_are_written_into_a_rig_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let images = folder.path().join("images");
    std::fs::create_dir(&images).expect("a folder");
    write_images(&images);
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    let text = std::fs::read_to_string(rigs.join("static-arm.toml")).expect("a rig file");
    let urdf = rigs.join("robots/panda.urdf").display().to_string();
    let rig = text.replace("robots/panda.urdf", &urdf);
    std::fs::write(folder.path().join("other-size.toml"), &rig).expect("a file");
    let rig = rig.replace("size_px = [640, 480]", "size_px = [480, 360]");
    std::fs::write(folder.path().join("rig.toml"), &rig).expect("a file");
    let run = |args: &[&str]| {
        let output = fieldrig(folder.path(), &[&["calibrate"], args].concat());
        (output.status.code(), stderr(&output))
    };
    let lens = ["intrinsics", "images", "--target", TARGET];
    let written = |name: &str| {
        let text = std::fs::read_to_string(folder.path().join(name)).expect("a rig file");
        text.parse::<toml::Table>().expect("a rig file")["camera"]["wrist"].clone()
    };

    let (code, error) = run(&[
        &lens[..],
        &[
            "--rig",
            "rig.toml",
            "--camera",
            "wrist",
            "--write-rig",
            "new.toml",
        ],
    ]
    .concat());
    assert_eq!(code, Some(DONE), "{error}");
    let focal_px = written("new.toml")["intrinsics"]["focal_px"][0]
        .as_float()
        .expect("a number");
    assert!((focal_px - camera().focal_px[0]).abs() < 2.0, "{focal_px}");

    let poses = robot_poses().into_iter().zip(board_poses());
    let pair = |(robot, board): (Transform, Transform)| json!({"base_from_flange": rows(&robot), "camera_from_board": rows(&board)});
    let samples: Vec<Value> = poses.map(pair).collect();
    std::fs::write(
        folder.path().join("samples.json"),
        json!({"samples": samples}).to_string(),
    )
    .expect("a file");
    let hand_eye = [
        "hand-eye",
        "samples.json",
        "--rig",
        "new.toml",
        "--camera",
        "wrist",
        "--write-rig",
        "new.toml",
    ];
    let (code, error) = run(&hand_eye);
    assert_eq!(code, Some(DONE), "{error}");
    let camera = written("new.toml");
    let x_m = camera["parent_from_camera"]["xyz_m"][0]
        .as_float()
        .expect("a number");
    assert!(
        (x_m - flange_from_camera().translation.x).abs() < 1e-6,
        "{x_m}"
    );
    assert_eq!(
        camera["intrinsics"]["focal_px"][0].as_float(),
        Some(focal_px),
        "the intrinsics are kept"
    );
    assert!(folder.path().join("new.toml.old").exists());

    // If two programs write the same file at once, no result disappears.
    let both = [
        "--rig",
        "new.toml",
        "--camera",
        "wrist",
        "--write-rig",
        "both.toml",
    ];
    let start = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fieldrig"));
        command
            .args(["calibrate", "hand-eye", "samples.json"])
            .args(both)
            .current_dir(folder.path());
        command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("it starts")
    };
    let outputs = [start(), start()].map(|child| child.wait_with_output().expect("it ends"));
    let (done, refused): (Vec<_>, Vec<_>) =
        outputs.iter().partition(|output| output.status.success());
    for output in refused {
        assert!(
            stderr(output).contains("both.toml: another program is writing it"),
            "{}",
            stderr(output)
        );
    }
    let entries = std::fs::read_dir(folder.path()).expect("a folder");
    let names = entries.map(|entry| {
        entry
            .expect("an entry")
            .file_name()
            .to_string_lossy()
            .into_owned()
    });
    let names: Vec<String> = names.filter(|name| name.contains("both.toml")).collect();
    assert!(
        !done.is_empty() && names.len() == done.len(),
        "{} wrote {names:?}",
        done.len()
    );

    // Nothing is written if something is wrong.
    let rejected = |args: &[&str], expected: i32, words: &str| {
        let (code, error) = run(args);
        assert!(
            code == Some(expected) && error.contains(words),
            "{code:?} {error}"
        );
        assert!(!folder.path().join("not.toml").exists());
    };
    let target = ["--write-rig", "not.toml"];
    rejected(
        &[
            &lens[..],
            &["--rig", "rig.toml", "--camera", "wirst"],
            &target,
        ]
        .concat(),
        BAD_ARGUMENTS,
        "it has wrist",
    );
    rejected(
        &[
            &lens[..],
            &["--rig", "other-size.toml", "--camera", "wrist"],
            &target,
        ]
        .concat(),
        BAD_ARGUMENTS,
        "640x480",
    );
    rejected(&[&lens[..], &target].concat(), BAD_ARGUMENTS, "--rig");
    std::fs::write(
        folder.path().join("few.json"),
        json!({"samples": samples[..2]}).to_string(),
    )
    .expect("a file");
    let few = [
        "hand-eye", "few.json", "--rig", "rig.toml", "--camera", "wrist",
    ];
    rejected(
        &[&few[..], &target].concat(),
        INSUFFICIENT_DATA,
        "at least 3",
    );
    let to_hand = json!({"samples": samples, "setup": "eye-to-hand"});
    std::fs::write(folder.path().join("to-hand.json"), to_hand.to_string()).expect("a file");
    let to_hand = [
        "hand-eye",
        "to-hand.json",
        "--rig",
        "rig.toml",
        "--camera",
        "wrist",
    ];
    rejected(
        &[&to_hand[..], &target].concat(),
        BAD_ARGUMENTS,
        "parent in the rig file is flange",
    );
}

#[test]
fn bad_input_is_named_and_has_its_own_exit_code() {
    let folder = tempfile::tempdir().expect("a folder");
    let write =
        |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a file");
    std::fs::create_dir(folder.path().join("empty")).expect("a folder");
    std::fs::create_dir(folder.path().join("unreadable")).expect("a folder");
    write("unreadable/a.png", "not an image");
    let sample = json!({"base_from_flange": rows(&Transform::identity()), "camera_from_board": rows(&Transform::identity())});
    let changed = |name: &str, key: &str, value: Value| {
        let mut bad = sample.clone();
        bad[key] = value;
        write(name, &json!({"samples": [sample, bad]}).to_string());
    };
    changed("matrix.json", "base_from_flange", json!([[1, 0, 0, 0]]));
    changed("missing.json", "base_from_flange", Value::Null);
    changed("key.json", "base_to_flange", json!(1));
    changed("both.json", "image", json!("a.png"));
    write("empty.json", "{\"samples\": []}");
    write("syntax.json", "{\"samples\": [");
    write("table.csv", "1,2,3\n");
    let images = |name| vec!["intrinsics", name, "--target", TARGET];
    let hand_eye = |name| vec!["hand-eye", name];
    for (args, words) in [
        (images("absent"), "absent"),
        (images("empty"), "no .jpg, .jpeg or .png image"),
        (images("unreadable"), "none of 1 images can be read; a.png"),
        (hand_eye("absent.json"), "absent.json"),
        (hand_eye("syntax.json"), "syntax.json"),
        (
            hand_eye("matrix.json"),
            "matrix.json: samples[1].base_from_flange: must be a matrix",
        ),
        (
            hand_eye("missing.json"),
            "samples[1].base_from_flange: missing",
        ),
        (
            hand_eye("key.json"),
            "samples[1]: unknown key \"base_to_flange\"; did you mean \"base_from_flange\"?",
        ),
        (hand_eye("both.json"), "samples[1].image: "),
        (
            hand_eye("empty.json"),
            "empty.json: samples: the list is empty",
        ),
        (vec!["time-offset", "absent.csv", "table.csv"], "absent.csv"),
        (
            vec!["time-offset", "table.csv", "table.csv"],
            "line 1: 3 numbers, expected 8",
        ),
        (vec!["scene", "absent"], "absent does not exist"),
        (
            vec!["hand-eye", "key.json", "--report", "page.pdf"],
            "extension .html",
        ),
    ] {
        let output = fieldrig(folder.path(), &[vec!["calibrate"], args.clone()].concat());
        let error = stderr(&output);
        assert!(
            output.status.code() == Some(BAD_ARGUMENTS) && error.contains(words),
            "{args:?}: {error}"
        );
    }
}

#[test]
fn weak_excitation_and_mistakes_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = |samples: Vec<Value>| {
        let file = json!({"samples": samples});
        std::fs::write(folder.path().join("samples.json"), file.to_string()).expect("a file");
        let args = [
            "calibrate",
            "hand-eye",
            "samples.json",
            "--json",
            "--report",
            "page.html",
        ];
        let output = fieldrig(folder.path(), &args);
        (output.status.code(), json_of(&output))
    };
    let both = || robot_poses().into_iter().zip(board_poses());
    let pair = |(robot, board): (Transform, Transform)| json!({"base_from_flange": rows(&robot), "camera_from_board": rows(&board)});
    let (code, result) = run(both().map(pair).collect());
    assert_eq!(
        (code, result["refused"].is_null()),
        (Some(DONE), true),
        "{result}"
    );

    let inverted = both()
        .map(|(robot, board)| (robot.inverse(), board.inverse()))
        .map(pair)
        .collect();
    let (code, result) = run(inverted);
    assert_eq!(code, Some(INSUFFICIENT_DATA), "{result}");
    assert!(
        result["refused"]
            .as_str()
            .is_some_and(|reason| reason.contains("behind the camera")),
        "{result}"
    );
    assert!(
        result["flange_from_camera"].is_null() && result.get("flange_from_camera").is_some(),
        "{result}"
    );

    let millimeters = both().map(|(mut robot, board)| {
        robot.translation.vector *= 1e3;
        pair((robot, board))
    });
    let (code, result) = run(millimeters.collect());
    assert_eq!(code, Some(INSUFFICIENT_DATA), "{result}");
    assert!(
        result["refused"]
            .as_str()
            .is_some_and(|reason| reason.contains("millimeters")),
        "{result}"
    );

    // All rotations are about the flange's z axis.
    let first = robot_poses()[0];
    let base_from_board = first * flange_from_camera() * board_poses()[0];
    let about_z = (0..8).map(|ix| {
        let turn = Transform::new(
            Vector3::new(0.01 * f64::from(ix), 0.0, 0.0),
            Vector3::z() * 0.15 * f64::from(ix),
        );
        let robot = first * turn;
        pair((
            robot,
            (robot * flange_from_camera()).inverse() * base_from_board,
        ))
    });
    let (code, result) = run(about_z.collect());
    assert_eq!(code, Some(INSUFFICIENT_DATA), "{result}");
    assert!(
        result["refused"]
            .as_str()
            .is_some_and(|reason| reason.contains("z axis")),
        "{result}"
    );
    let page = report(folder.path(), "page.html");
    for words in ["Refused", "hardly any rotation", "Rotations of the flange"] {
        assert!(page.contains(words), "{words} is missing");
    }

    // Each image is paired with the robot pose of the sample before it.
    let shifted = robot_poses()
        .into_iter()
        .zip(board_poses().into_iter().skip(1))
        .map(pair)
        .collect();
    let (code, result) = run(shifted);
    assert_eq!(code, Some(INSUFFICIENT_DATA), "{result}");
    assert!(
        result["refused"]
            .as_str()
            .is_some_and(|reason| reason.contains("off by one")),
        "{result}"
    );
}

#[test]
fn time_offset_of_two_streams_is_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, rate_hz: f64, clock_secs: f64, moves: bool| {
        let line = |ix: u32| {
            let secs = f64::from(ix) / rate_hz;
            let angle = if moves {
                0.5 * (1.3 * secs).sin() + 0.3 * (2.9 * secs).cos()
            } else {
                0.0
            };
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(
                angle,
                0.4 * (0.7 * secs).sin() * angle,
                0.2 * angle,
            ));
            let [x, y, z, w]: [f64; 4] = rotation.coords.into();
            format!(
                "{},0.1,0.2,{},{x},{y},{z},{w}\n",
                secs + clock_secs,
                0.1 * angle
            )
        };
        let n = 20.0 * rate_hz;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a number of rows"
        )]
        let rows: String = (0..n as u32).map(line).collect();
        std::fs::write(
            folder.path().join(name),
            format!("t,x,y,z,qx,qy,qz,qw\n{rows}"),
        )
        .expect("a file");
    };
    write("a.csv", 100.0, 50.0, true);
    write("b.csv", 30.0, 7.25, true);
    write("still.csv", 30.0, 7.25, false);
    let output = fieldrig(
        folder.path(),
        &["calibrate", "time-offset", "a.csv", "b.csv", "--json"],
    );
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    let offset_secs = json_of(&output)["offset_secs"].as_f64().expect("a number");
    assert!((offset_secs - 42.75).abs() < 1e-3, "{offset_secs}");
    let args = [
        "calibrate",
        "time-offset",
        "a.csv",
        "b.csv",
        "--report",
        "found.html",
    ];
    assert_eq!(fieldrig(folder.path(), &args).status.code(), Some(DONE));
    let page = report(folder.path(), "found.html");
    for words in [
        "Accepted",
        "Highest correlation",
        "After: both streams on the clock of A",
        "RMS ",
    ] {
        assert!(page.contains(words), "{words} is missing");
    }
    let args = [
        "calibrate",
        "time-offset",
        "a.csv",
        "still.csv",
        "--json",
        "--report",
        "refused.html",
    ];
    let output = fieldrig(folder.path(), &args);
    assert_eq!(
        output.status.code(),
        Some(INSUFFICIENT_DATA),
        "{}",
        stderr(&output)
    );
    assert!(json_of(&output)["refused"].is_string());
    assert!(report(folder.path(), "refused.html").contains("body B hardly rotates"));
    // Stamps in milliseconds.
    let text = std::fs::read_to_string(folder.path().join("b.csv")).expect("a file");
    let millis = text.lines().skip(1).map(|line| {
        let (secs, rest) = line.split_once(',').expect("columns");
        format!("{},{rest}\n", 1e3 * secs.parse::<f64>().expect("a number"))
    });
    std::fs::write(folder.path().join("millis.csv"), millis.collect::<String>()).expect("a file");
    let output = fieldrig(
        folder.path(),
        &["calibrate", "time-offset", "a.csv", "millis.csv"],
    );
    assert_eq!(
        output.status.code(),
        Some(INSUFFICIENT_DATA),
        "{}",
        stderr(&output)
    );
    assert!(
        stderr(&output).contains("stream B are probably in milliseconds"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn targets_are_printed_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let args = ["calibrate", "target", "--out", "board.pdf"];
    assert_eq!(fieldrig(folder.path(), &args).status.code(), Some(DONE));
    let pdf = std::fs::read(folder.path().join("board.pdf")).expect("a file");
    assert!(pdf.starts_with(b"%PDF"));
    assert_eq!(
        fieldrig(folder.path(), &args).status.code(),
        Some(BAD_ARGUMENTS),
        "the file exists"
    );
    let output = fieldrig(
        folder.path(),
        &[
            "calibrate",
            "target",
            "--target",
            "chessboard:9x6:25",
            "--out",
            "other.pdf",
        ],
    );
    assert!(
        output.status.code() == Some(BAD_ARGUMENTS) && stderr(&output).contains("no unit"),
        "{}",
        stderr(&output)
    );
}

#[cfg(feature = "sim")]
#[test]
fn rig_is_calibrated_from_a_simulated_scan() {
    let folder = tempfile::tempdir().expect("a folder");
    let rigs = Path::new(env!("CARGO_MANIFEST_DIR")).join("rigs");
    // The rig file has a quarter of the resolution.
    let text = std::fs::read_to_string(rigs.join("uncalibrated.toml")).expect("a rig file");
    let small = text
        .replace("[640, 480]", "[160, 120]")
        .replace("[614.6, 614.2]", "[153.65, 153.55]")
        .replace("[323.7, 236.4]", "[80.925, 59.1]");
    let urdf = rigs.join("robots/panda.urdf").display().to_string();
    let rig = small.replace("robots/panda.urdf", &urdf);
    std::fs::write(folder.path().join("rig.toml"), rig).expect("a file");
    let args = [
        "calibrate",
        "scene",
        "rig.toml",
        "--sim",
        "--seconds",
        "15",
        "--json",
        "--write-rig",
        "calibrated.toml",
    ];
    let output = fieldrig(folder.path(), &args);
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    let result = json_of(&output);
    let camera = &result["cameras"]["wrist"];
    let truth = Transform::from_parts(
        Vector3::new(0.06, 0.0, 0.045).into(),
        UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
            0.6408563820557885,
            0.29883623873011983,
            0.29883623873011983,
            0.6408563820557885,
        )),
    );
    let error = truth.inverse() * transform_of(&camera["parent_from_camera"]);
    let (mm, degrees) = (
        1e3 * error.translation.vector.norm(),
        error.rotation.angle().to_degrees(),
    );
    assert!(mm < 0.5 && degrees < 0.05, "{mm} mm, {degrees} degrees");
    let offset_millis = camera["stamp_to_mid_exposure_millis"]
        .as_f64()
        .expect("a number");
    assert!((offset_millis - 8.0).abs() < 0.5, "{offset_millis} ms");
    // The written file is calibrated, and has the same truth and the same drivers.
    let written =
        std::fs::read_to_string(folder.path().join("calibrated.toml")).expect("a rig file");
    assert!(
        written.contains("[camera.wrist.sim.truth") && !written.contains("lockstep = true"),
        "{written}"
    );
}

/// A limit of the file size simulates a full disk.
#[cfg(unix)]
#[test]
fn result_is_printed_if_the_report_cannot_be_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let pairs = robot_poses().into_iter().zip(board_poses());
    let sample = |(robot, board): (Transform, Transform)| json!({"base_from_flange": rows(&robot), "camera_from_board": rows(&board)});
    let samples: Vec<Value> = pairs.map(sample).collect();
    for (name, samples) in [("good.json", &samples[..]), ("few.json", &samples[..2])] {
        std::fs::write(
            folder.path().join(name),
            json!({"samples": samples}).to_string(),
        )
        .expect("a file");
    }
    let run = |input: &str| {
        let limited = "ulimit -f 1; exec \"$0\" \"$@\"";
        std::process::Command::new("sh")
            .args([
                "-c",
                limited,
                env!("CARGO_BIN_EXE_fieldrig"),
                "calibrate",
                "hand-eye",
                input,
            ])
            .args(["--json", "--report", "page.html"])
            .current_dir(folder.path())
            .output()
            .expect("sh starts")
    };
    let output = run("good.json");
    let problem = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{problem}");
    assert!(
        json_of(&output)["flange_from_camera"].is_array(),
        "{problem}"
    );
    assert_eq!(
        problem
            .lines()
            .filter(|line| line.contains("page.html"))
            .count(),
        1,
        "{problem}"
    );
    // A refusal keeps its reason and its exit code.
    let output = run("few.json");
    let problem = stderr(&output);
    assert_eq!(output.status.code(), Some(INSUFFICIENT_DATA), "{problem}");
    assert!(
        json_of(&output)["refused"].is_string() && problem.contains("page.html"),
        "{problem}"
    );
    let left: Vec<_> = std::fs::read_dir(folder.path())
        .expect("a folder")
        .flatten()
        .map(|file| file.file_name())
        .collect();
    assert_eq!(left.len(), 2, "no part of a report is left: {left:?}");
}
