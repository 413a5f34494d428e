//! Tests of the programs in `scripts/datasets`: the datasets that they write are read.
#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a failing test may panic")]

use drivers::dataset::{self, Dataset};
use image::RgbImage;
use kinematics::Transform;
use nalgebra::Point3;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// Rounding of decimal numbers in text files.
const CLOSE: f64 = 1e-9;

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Runs a program in Python. It writes no compiled files into the repository.
fn python(program: &Path, args: &[&str]) -> Output {
    Command::new("python3")
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .stdin(Stdio::null())
        .arg(program)
        .args(args)
        .output()
        .unwrap()
}

fn converter(name: &str, args: &[&str]) -> Output {
    python(&repository().join("scripts/datasets").join(name), args)
}

/// Whether `python3` can import these packages. If not, the calling test is skipped.
fn has_packages(packages: &str) -> bool {
    let status = Command::new("python3")
        .args(["-c", &format!("import {packages}")])
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .status();
    let has_packages = status.is_ok_and(|status| status.success());
    if !has_packages {
        test_support::skip(format!("python3 cannot import {packages}"));
    }
    has_packages
}

fn expect_success(output: &Output) {
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

/// The last line of the errors of a program that must fail.
fn error_of(output: &Output) -> String {
    assert!(!output.status.success(), "it must fail");
    let errors = String::from_utf8_lossy(&output.stderr);
    errors.lines().last().unwrap_or_default().to_owned()
}

fn assert_close(found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < CLOSE, "{found} vs. {expected}");
    }
}

/// Where a point in the frame of a camera is in the world.
fn in_world(world_from_camera: &Transform, point: [f64; 3]) -> [f64; 3] {
    (world_from_camera * Point3::from(point)).coords.into()
}

/// A COLMAP model with two cameras and two images, and the folder of its images.
fn colmap_model(folder: &Path, cameras: &str) -> [String; 2] {
    let [model, images] = ["sparse", "images"].map(|name| folder.join(name));
    std::fs::create_dir(&model).unwrap();
    std::fs::create_dir(&images).unwrap();
    std::fs::write(model.join("cameras.txt"), cameras).unwrap();
    // The second image has no features, so its second line is empty. Its camera is rotated by 90
    // degrees about the x axis: it looks along +y of the world (COLMAP's camera_from_world).
    let text = "# Image list\n1 1 0 0 0 -1 -2 3 1 a 1.png\n5 6 -1\n2 0.5 0.5 0 0 0 0 4 2 b.png\n\n";
    std::fs::write(model.join("images.txt"), text).unwrap();
    std::fs::write(
        model.join("points3D.txt"),
        "# Points\n7 1 2 3 10 20 30 0.5 1 0\n",
    )
    .unwrap();
    for name in ["a 1.png", "b.png"] {
        RgbImage::new(64, 48).save(images.join(name)).unwrap();
    }
    [model, images].map(|path| path.to_string_lossy().into_owned())
}

const CAMERAS: &str = "# Cameras\n1 OPENCV 64 48 50 51 32 24 0.1 -0.02 0.001 0.002\n2 SIMPLE_RADIAL 64 48 60 31 23 0.05\n";

#[test]
fn the_minimal_dataset_in_the_guide_is_read() {
    let guide = include_str!("../../docs/guide/data-from-elsewhere.md");
    let (_, rest) = guide.split_once("```json\n").unwrap();
    let (json, _) = rest.split_once("```").unwrap();
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("transforms.json"), json).unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    RgbImage::new(1280, 720)
        .save(folder.path().join("images/0.png"))
        .unwrap();
    let dataset: Dataset = dataset::read(folder.path()).unwrap();
    assert_eq!((dataset.images.len(), dataset.notes.len()), (1, 0));
}

#[test]
fn colmap_models_become_datasets_in_meters() {
    if !has_packages("json") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [model, images] = colmap_model(folder.path(), CAMERAS);
    let args = [&*model, &*images, "--meters-per-unit", "0.5"];
    expect_success(&converter("colmap_to_transforms.py", &args));
    let dataset: Dataset = dataset::read(folder.path()).unwrap();
    assert_eq!(dataset.notes, Vec::<String>::new());
    let [a, b] = &*dataset.images else {
        panic!("{:?}", dataset.images)
    };
    assert!(a.name.contains("a 1") && b.name.contains("b"));
    // Without rotation, the center of the camera is minus the translation, times the scale.
    assert_close(
        &in_world(&a.world_from_camera, [0.0, 0.0, 2.0]),
        &[0.5, 1.0, 0.5],
    );
    // A point 2 m in front of the second camera, 1 m to its right and 0.5 m below its axis:
    // world = R^T (camera - t), with y and z of the camera along -z and y of the world.
    assert_close(
        &in_world(&b.world_from_camera, [1.0, 0.5, 2.0]),
        &[1.0, 0.0, -0.5],
    );
    assert_close(&a.intrinsics.focal_px, &[50.0, 51.0]);
    assert_close(&a.intrinsics.principal_px, &[32.0, 24.0]);
    assert_close(&b.intrinsics.focal_px, &[60.0, 60.0]);
    assert_close(&b.intrinsics.principal_px, &[31.0, 23.0]);
    let points = std::fs::read_to_string(dataset.points_path.unwrap()).unwrap();
    assert!(
        points.ends_with("end_header\n0.5 1.0 1.5 10 20 30\n"),
        "{points}"
    );

    let again = error_of(&converter("colmap_to_transforms.py", &args));
    assert!(again.contains("transforms.json exists"), "{again}");
}

#[test]
fn colmap_models_that_cannot_be_converted_are_explained() {
    if !has_packages("json") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let [model, images] = colmap_model(folder.path(), "1 FOV 64 48 50 51 32 24 0.1\n");
    let run = |scale: &str| {
        let args = [&*model, &*images, "--meters-per-unit", scale];
        error_of(&converter("colmap_to_transforms.py", &args))
    };
    let lens = run("1");
    assert!(lens.contains("camera 1 has the model FOV") && lens.contains("image_undistorter"));
    let scale = run("0");
    assert!(scale.contains("expected a number above 0"), "{scale}");
    let cameras = Path::new(&model).join("cameras.txt");
    std::fs::rename(&cameras, cameras.with_extension("bin")).unwrap();
    let binary = run("1");
    assert!(binary.contains("colmap model_converter"), "{binary}");
}

#[test]
fn ros_bags_of_all_kinds_become_datasets() {
    if !has_packages("rosbags, numpy, PIL") {
        return;
    }
    for (kind, bag) in [
        ("ros1", "scan.bag"),
        ("sqlite3", "scan"),
        ("mcap", "scan"),
        ("mcap", "scan/scan.mcap"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
        let write_bag = repository().join("drivers/tests/converters/write_bag.py");
        expect_success(&python(
            &write_bag,
            &[&folder.path().to_string_lossy(), kind],
        ));
        let topics = "--image /image --depth /depth --pose /odom --camera-info /info";
        let camera_in_body = "--camera-in-body 0.5 0 0 0 0 0 1";
        let (bag, out) = (path(bag), path("out"));
        let flags = topics.split(' ').chain(camera_in_body.split(' '));
        let args: Vec<&str> = [&*bag, &*out].into_iter().chain(flags).collect();
        expect_success(&converter("ros_bag_to_tum.py", &args));
        let dataset: Dataset = dataset::read(Path::new(&out)).unwrap();
        assert_eq!(dataset.images.len(), 3, "{kind}: {:?}", dataset.notes);
        for (ix, image) in dataset.images.iter().enumerate() {
            assert_eq!(
                image.stamp.0,
                1_700_000_000_000_000_005 + 50_000_000 * ix as i64
            );
            // The body is rotated by 90 degrees about z, and the camera is 0.5 m along its x axis.
            let x_m = 1.0 + ix as f64;
            assert_close(
                &in_world(&image.world_from_camera, [1.0, 0.0, 0.0]),
                &[x_m, 3.5, 3.0],
            );
            assert_close(&image.intrinsics.focal_px, &[50.0, 51.0]);
            // ROS and TUM RGB-D count pixel centers from 0.
            assert_close(&image.intrinsics.principal_px, &[32.0, 24.0]);
            let photo = image::open(&image.image_path).unwrap().into_rgb8();
            assert_eq!(photo.get_pixel(63, 47).0, [0, 0, 200]);
            let depth = image.depth.as_ref().unwrap();
            let counts = image::open(&depth.path).unwrap().into_luma16();
            assert_eq!(counts.get_pixel(0, 0).0, [0]);
            let depth_m = f64::from(counts.get_pixel(63, 47).0[0]) * depth.meters_per_count;
            assert_close(&[depth_m], &[1.5]);
        }
        let unknown = [
            &*bag,
            &*path("out2"),
            "--image",
            "/images",
            "--pose",
            "/odom",
        ];
        let unknown: Vec<&str> = unknown
            .into_iter()
            .chain(["--camera-info", "/info"])
            .collect();
        let error = error_of(&converter("ros_bag_to_tum.py", &unknown));
        assert!(error.contains("no topic /images; it has /depth"), "{error}");
    }
}
