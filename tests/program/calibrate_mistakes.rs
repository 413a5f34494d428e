//! Mistakes of users of `fieldrig calibrate`: messages name them.

use crate::command::{fieldrig, json_of, stderr};
use kinematics::{Intrinsics, Lens, Transform, transform};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::json;
use std::path::Path;
use targets::TargetSpec;
use targets::synthetic::{View, render};

const SIZE_PX: [u32; 2] = [480, 360];
const BOARD: &str = "chessboard:9x6:25mm";
/// Exit codes.
const DONE: i32 = 0;
const INSUFFICIENT_DATA: i32 = 4;

/// Writes images `0.png` and so on of a board that is tilted by the given rotations, at a distance
/// of 0.45 m.
fn write_images(folder: &Path, spec: &str, tilts_rad: &[[f64; 3]]) {
    std::fs::create_dir_all(folder).expect("a folder");
    let target: TargetSpec = spec.parse().expect("a target");
    let [low, high] = target.bounds_m();
    let center = Vector3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.0);
    for (ix, tilt) in tilts_rad.iter().enumerate() {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(*tilt));
        let position = Vector3::new(0.0, 0.0, 0.45);
        let view = View {
            intrinsics: Intrinsics {
                size_px: SIZE_PX,
                focal_px: [400.0, 398.0],
                principal_px: [243.0, 176.0],
                lens: Lens::Pinhole,
                rectified: false,
            },
            camera_from_board: Transform::from_parts(
                (position - rotation * center).into(),
                rotation,
            ),
            blur_px: 0.7,
            noise: 2.0,
            seed: ix as u64,
            is_legacy: false,
        };
        let file = folder.join(format!("{ix}.png"));
        let [width, height] = SIZE_PX;
        image::save_buffer(
            file,
            &render(&target, &view),
            width,
            height,
            image::ColorType::L8,
        )
        .expect("an image");
    }
}

const TILTS: [[f64; 3]; 5] = [
    [0.0; 3],
    [0.4, 0.0, 0.1],
    [-0.4, 0.1, 0.0],
    [0.0, 0.4, 0.0],
    [0.1, -0.4, 0.2],
];

#[test]
fn size_of_another_board_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    write_images(&folder.path().join("images"), BOARD, &TILTS);
    let run = |args: &[&str]| {
        fieldrig(
            folder.path(),
            &[&["calibrate", "intrinsics", "images"], args].concat(),
        )
    };
    let output = run(&["--target", BOARD, "--json"]);
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    for given in ["chessboard:8x6:25mm", "chessboard:10x7:25mm"] {
        let output = run(&["--target", given]);
        let error = stderr(&output);
        assert_eq!(
            output.status.code(),
            Some(INSUFFICIENT_DATA),
            "{given}: {error}"
        );
        let expected = format!(
            "5 of 5 images show a board with 9x6 inner corners, not {given}; use --target {BOARD}"
        );
        assert!(error.contains(&expected), "{given}: {error}");
    }
}

#[test]
fn unreadable_images_are_reported_once_and_counted_separately() {
    let folder = tempfile::tempdir().expect("a folder");
    let images = folder.path().join("images");
    write_images(&images, BOARD, &TILTS);
    std::fs::write(images.join("broken.jpg"), b"not a picture").expect("a file");
    let run = |target| {
        fieldrig(
            folder.path(),
            &["calibrate", "intrinsics", "images", "--target", target],
        )
    };
    let output = run(BOARD);
    assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
    let printed = String::from_utf8_lossy(&output.stdout).into_owned() + &stderr(&output);
    assert_eq!(printed.matches("broken.jpg").count(), 1, "{printed}");
    let output = run("charuco:5x7:34mm:26mm:5X5_100");
    assert_eq!(
        output.status.code(),
        Some(INSUFFICIENT_DATA),
        "{}",
        stderr(&output)
    );
    let error = stderr(&output);
    assert!(
        error.contains("was not detected in any of 5 images; 0.png"),
        "{error}"
    );
}

#[test]
fn symmetric_boards_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let print = |target: &str, out: &str| {
        let output = fieldrig(
            folder.path(),
            &["calibrate", "target", "--target", target, "--out", out],
        );
        assert_eq!(output.status.code(), Some(DONE), "{}", stderr(&output));
        stderr(&output)
    };
    assert!(print("chessboard:8x6:25mm", "a.pdf").contains("looks the same after half a turn"));
    assert!(print("chessboard:6x6:25mm", "b.pdf").contains("looks the same after a quarter turn"));
    assert!(!print(BOARD, "c.pdf").contains("looks the same"));
}

#[test]
fn refused_lens_has_a_report_with_coverage() {
    let folder = tempfile::tempdir().expect("a folder");
    // The board only faces the camera.
    write_images(
        &folder.path().join("images"),
        BOARD,
        &[[0.0; 3], [0.0, 0.0, 0.1], [0.0, 0.0, -0.1]],
    );
    let args = [
        "calibrate",
        "intrinsics",
        "images",
        "--target",
        BOARD,
        "--report",
        "page.html",
    ];
    let output = fieldrig(folder.path(), &args);
    assert_eq!(
        output.status.code(),
        Some(INSUFFICIENT_DATA),
        "{}",
        stderr(&output)
    );
    let page = std::fs::read_to_string(folder.path().join("page.html")).expect("a report");
    for words in [
        "Refused",
        "3 of 3",
        "162",
        "Coverage: corners per part of the image",
    ] {
        assert!(page.contains(words), "{words} is missing");
    }
}

#[test]
fn messages_contain_paths_from_the_current_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let images = folder.path().join("session");
    write_images(&images, BOARD, &TILTS);
    std::fs::write(images.join("1.png"), b"not a picture").expect("a file");
    image::save_buffer(
        images.join("2.png"),
        &vec![128; 480 * 360],
        480,
        360,
        image::ColorType::L8,
    )
    .expect("an image");
    let pose = transform::to_rows(&Transform::identity());
    let rows: Vec<_> = pose.chunks(4).collect();
    let sample = |ix: usize| json!({"base_from_flange": rows, "image": format!("{ix}.png")});
    let samples: Vec<_> = (0..5).map(sample).collect();
    let intrinsics = json!({"focal_px": [400, 398], "principal_px": [243, 176]});
    let file = json!({"intrinsics": intrinsics, "target": BOARD, "samples": samples});
    std::fs::write(images.join("samples.json"), file.to_string()).expect("a file");
    let output = fieldrig(
        folder.path(),
        &["calibrate", "hand-eye", "session/samples.json", "--json"],
    );
    assert_eq!(
        output.status.code(),
        Some(INSUFFICIENT_DATA),
        "the flange does not move: {}",
        stderr(&output)
    );
    assert!(
        stderr(&output).contains("session/1.png"),
        "{}",
        stderr(&output)
    );
    let refused = json_of(&output)["refused"]
        .as_str()
        .expect("a reason")
        .to_owned();
    assert!(
        refused.contains("1 of 4 images do not show the target: session/2.png"),
        "{refused}"
    );
}
