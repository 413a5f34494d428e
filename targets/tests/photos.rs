//! Detection in photos. Without the test data, these tests are skipped with a message.

#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use std::path::{Path, PathBuf};
use targets::{GrayImage, TargetSpec};

/// For every photo in a folder, the part of the target's corners that is detected.
fn detected_parts(spec: &str, folder: &Path) -> Vec<f64> {
    let target: TargetSpec = spec.parse().unwrap();
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "jpg"));
    files.sort();
    let part = |file: &PathBuf| {
        let photo = image::open(file).unwrap().to_luma8();
        let image = GrayImage {
            size_px: [photo.width(), photo.height()],
            pixels: photo.as_raw(),
        };
        match target.detect(image) {
            Ok(detection) => detection.corners.len() as f64 / detection.n_in_target as f64,
            Err(error) => {
                eprintln!("{}: {error}", file.display());
                0.0
            }
        }
    };
    files.iter().map(part).collect()
}

#[test]
fn chessboards_are_found_completely() {
    for (name, spec) in [
        ("chessboard", "chessboard:9x6:25mm"),
        ("handeye/koide_a", "chessboard:11x9:20.2mm"),
    ] {
        let Some(folder) = test_support::data_folder(name) else {
            return;
        };
        let parts = detected_parts(spec, &folder);
        assert!(
            parts.len() > 10 && parts.iter().all(|part| *part == 1.0),
            "{name}: {parts:?}"
        );
    }
}

#[test]
fn wrong_counts_are_named_in_photos() {
    let Some(folder) = test_support::data_folder("chessboard") else {
        return;
    };
    let photo = image::open(folder.join("left01.jpg")).unwrap().to_luma8();
    let target: TargetSpec = "chessboard:8x6:25mm".parse().unwrap();
    let image = GrayImage {
        size_px: [photo.width(), photo.height()],
        pixels: photo.as_raw(),
    };
    let message = target.detect(image).unwrap_err().to_string();
    assert!(
        message.starts_with("found a board with 9x6 inner corners, expected 8x6"),
        "{message}"
    );
}

#[test]
fn parts_of_larger_boards_are_not_accepted() {
    let Some(folder) = test_support::data_folder("chessboard") else {
        return;
    };
    for spec in [
        "chessboard:8x6:25mm",
        "chessboard:9x5:25mm",
        "chessboard:7x5:25mm",
    ] {
        let parts = detected_parts(spec, &folder);
        assert!(
            parts.len() > 10 && parts.iter().all(|part| *part == 0.0),
            "{spec}: {parts:?}"
        );
    }
}

#[test]
fn small_charuco_boards_are_found() {
    let Some(folder) = test_support::data_folder("arm_scan") else {
        return;
    };
    let parts = detected_parts("charuco:9x6:40mm:35mm:4X4_250", &folder.join("images"));
    let mean = parts.iter().sum::<f64>() / parts.len() as f64;
    assert!(
        parts.len() == 42 && parts.iter().all(|part| *part > 0.3) && mean > 0.95,
        "{parts:?}"
    );
}

#[test]
fn tags_in_a_photo_match_annotations() {
    /// The annotations were made by another detector.
    const NEAR_PX: f64 = 1.5;
    let Some(folder) = test_support::data_folder("apriltag") else {
        return;
    };
    let photo = image::open(folder.join("33369213973_9d9bb4cc96_c.jpg"))
        .unwrap()
        .to_luma8();
    let annotations = std::fs::read_to_string(folder.join("33369213973_9d9bb4cc96_c.txt")).unwrap();
    let corner = |text: &str| {
        let (x, y) = text.split_once(')')?.0.split_once(' ')?;
        Some([x.parse::<f64>().ok()?, y.parse::<f64>().ok()?])
    };
    let annotated: Vec<[f64; 2]> = annotations.split('(').filter_map(corner).collect();
    assert_eq!(annotated.len(), 48);
    // All tags have the id 0, and the largest tag is detected.
    let target: TargetSpec = "tag:36h11:0:100mm".parse().unwrap();
    let image = GrayImage {
        size_px: [photo.width(), photo.height()],
        pixels: photo.as_raw(),
    };
    let detection = target.detect(image).unwrap();
    assert!(detection.corners.len() >= 3);
    for corner in detection.corners {
        let is_near = |other: &[f64; 2]| {
            (other[0] - corner.pixel[0]).hypot(other[1] - corner.pixel[1]) < NEAR_PX
        };
        assert!(
            annotated.iter().any(is_near),
            "no annotation near {:?}",
            corner.pixel
        );
    }
}
