//! A rig whose camera is a file recorded by librealsense2: the binary reads lens and depth pose
//! from this file and records its images.

use drivers::realsense::emulated::{BagWriter, EmulatedCamera, EmulatedDepth};
use drivers::recording::{RIG_FILE, Recording};
use drivers::{Image, PixelFormat, Sample, Source};
use kinematics::{Intrinsics, Lens, Stamp, Transform};
use std::path::Path;
use std::process::Command;

const N_IMAGES: i64 = 10;
/// Exit code of `fieldrig` after a loss of data.
const DATA_LOSS: i32 = 3;
const RIG: &str = r#"
[arm]
driver = "none"

[camera.front]
driver = "realsense"
size_px = [320, 240]
rate_hz = 30
parent = "world"

[camera.front.realsense]
file = "front.bag"

[camera.front.depth]
"#;

/// A camera whose depth sensor is 15 mm next to its color sensor.
fn write_bag(path: &Path) {
    let lens = |focal_px| Intrinsics {
        size_px: [320, 240],
        focal_px: [focal_px, focal_px],
        principal_px: [161.5, 119.25],
        lens: Lens::Pinhole,
        rectified: false,
    };
    let depth = EmulatedDepth {
        intrinsics: lens(192.5),
        camera_from_depth: Transform::translation(0.015, 0.0, 0.0),
        meters_per_count: 0.001,
    };
    let camera = EmulatedCamera {
        name: "Intel RealSense D435I".into(),
        serial: "1".into(),
        rate_hz: 30,
        intrinsics: lens(303.25),
        format: PixelFormat::Rgb8,
        depth: Some(depth),
    };
    let mut writer = BagWriter::create(path, &camera).expect("a file to write");
    for number in 0..N_IMAGES {
        let color = Image {
            camera: "front".into(),
            stamp: Stamp(1_000_000_000 + number * 33_333_000),
            size_px: [320, 240],
            format: PixelFormat::Rgb8,
            data: vec![number.to_le_bytes()[0]; 320 * 240 * 3].into(),
            exposure_secs: None,
            n_skipped: 0,
        };
        writer.write(&color).expect("the disk has space");
        let format = PixelFormat::DepthU16 {
            meters_per_count: 0.001,
        };
        writer
            .write(&Image {
                format,
                data: [232, 3].repeat(320 * 240).into(),
                ..color
            })
            .expect("the disk has space");
    }
    writer.finish().expect("the disk has space");
}

#[test]
fn recording_stores_calibration_read_from_the_bag() {
    let folder = tempfile::tempdir().unwrap();
    let [rig, out] = ["rig.toml", "out.mcap"].map(|name| folder.path().join(name));
    write_bag(&folder.path().join("front.bag"));
    std::fs::write(&rig, RIG).unwrap();
    let record = || {
        let _ = std::fs::remove_file(&out);
        let program = env!("CARGO_BIN_EXE_fieldrig");
        let output = Command::new(program)
            .arg("record")
            .arg(&rig)
            .arg("--out")
            .arg(&out)
            .output()
            .unwrap();
        (
            output.status.code(),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        )
    };
    // The bag plays in real time, so a stalled machine loses images.
    let (mut code, mut printed) = record();
    for _ in 0..2 {
        if code == Some(DATA_LOSS) {
            (code, printed) = record();
        }
    }
    assert_eq!(code, Some(0), "{printed}");
    let mut recording = Recording::open(&out).unwrap();
    let resolved = String::from_utf8(recording.attachment(RIG_FILE).unwrap().to_vec()).unwrap();
    // 15 mm in single precision.
    let depth_translations = ["0.01499999", "0.015"];
    assert!(
        depth_translations
            .iter()
            .any(|translation| resolved.contains(translation)),
        "{resolved}"
    );
    assert!(
        resolved.contains("303.25") && resolved.contains("192.5"),
        "{resolved}"
    );
    let mut n_images = [0; 2];
    while let Some(sample) = recording.next_sample().unwrap() {
        let Sample::Image(image) = sample else {
            panic!("cameras deliver images")
        };
        match image.is_depth() {
            true => assert!(
                image
                    .decode_depth_m()
                    .unwrap()
                    .iter()
                    .all(|meters| (meters - 1.0).abs() < 1e-6)
            ),
            false => assert!(image.data.iter().all(|byte| *byte == image.data[0])),
        }
        n_images[usize::from(image.is_depth())] += 1;
    }
    assert_eq!(n_images, [N_IMAGES; 2], "{printed}");
}
