//! An emulated RealSense camera in front of a simple scene, and the depth alignment of
//! librealsense2; for tests and a benchmark.

use drivers::realsense::emulated::{BagWriter, EmulatedCamera, EmulatedDepth};
use drivers::{Image, PixelFormat};
use kinematics::{Intrinsics, Lens, Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use realsense_rust::config::Config as PipelineConfig;
use realsense_rust::context::Context;
use realsense_rust::frame::{DepthFrame, FrameEx, PixelKind};
use realsense_rust::kind::Rs2StreamKind;
use realsense_rust::pipeline::InactivePipeline;
use realsense_rust::processing_blocks::align::Align;
use std::path::Path;
use std::time::{Duration, Instant};

/// Timeout for images of a file.
const IMAGE_TIMEOUT: Duration = Duration::from_secs(20);
pub(crate) const RATE_HZ: u16 = 30;
/// A whole number of microseconds, like stamps of the camera clock; it exceeds 32 bits.
pub(crate) const BEGIN_NANOS: i64 = 11_000_000_123_000;
pub(crate) const PERIOD_NANOS: i64 = 33_333_000;
/// Color and depth have different stamps.
pub(crate) const DEPTH_LATER_NANOS: i64 = 4_567_000;

/// A D435i: depth from two infrared cameras, and a color camera next to them.
pub(crate) fn d435i(color_px: [u32; 2], lens: Lens) -> EmulatedCamera {
    let focal_px = f64::from(color_px[1]) * 1.2625;
    EmulatedCamera {
        name: "Intel RealSense D435I".into(),
        serial: "817612070000".into(),
        rate_hz: RATE_HZ,
        intrinsics: Intrinsics {
            size_px: color_px,
            focal_px: [focal_px, focal_px + 0.75],
            principal_px: [
                f64::from(color_px[0]) * 0.5 + 3.25,
                f64::from(color_px[1]) * 0.5 - 2.125,
            ],
            lens,
            rectified: false,
        },
        format: PixelFormat::Rgb8,
        depth: Some(EmulatedDepth {
            intrinsics: Intrinsics {
                size_px: [640, 480],
                focal_px: [385.375, 385.375],
                principal_px: [321.625, 238.875],
                lens: Lens::Pinhole,
                rectified: false,
            },
            camera_from_depth: Transform::from_parts(
                Translation3::new(0.014_8, 0.000_2, 0.000_3),
                UnitQuaternion::from_euler_angles(0.003, -0.006, 0.002),
            ),
            meters_per_count: 0.001,
        }),
    }
}

pub(crate) fn depth_of(camera: &EmulatedCamera) -> &EmulatedDepth {
    camera.depth.as_ref().expect("the camera has depth")
}

/// Depth in meters along a ray of the plane `z` = 1: a slanted wall, a floor, and a box with a
/// slanted front.
pub(crate) fn scene_m(ray: &Vector3<f64>) -> f64 {
    // normal * point = offset
    let planes = [
        (Vector3::new(0.25, 0.05, 1.0), 1.6),
        (Vector3::new(0.0, 1.0, 0.1), 0.7),
    ];
    let distance_along_ray = |(normal, offset): &(Vector3<f64>, f64)| {
        let along = normal.dot(ray);
        if along > 0.0 {
            offset / along
        } else {
            f64::INFINITY
        }
    };
    let background = planes
        .iter()
        .map(distance_along_ray)
        .fold(f64::INFINITY, f64::min);
    let front = distance_along_ray(&(Vector3::new(-0.3, 0.2, 1.0), 0.65));
    let hit = ray * front;
    if hit.x.abs() < 0.12 && (hit.y - 0.03).abs() < 0.1 {
        front.min(background)
    } else {
        background
    }
}

/// Depth counts of the scene, with some holes.
fn counts_of(depth: &EmulatedDepth) -> Vec<u16> {
    let [width, height] = depth.intrinsics.size_px;
    let pixels = (0..height).flat_map(|row| (0..width).map(move |column| [column, row]));
    let count = |[column, row]: [u32; 2]| {
        if (column * 7 + row * 13) % 97 == 0 {
            return 0;
        }
        let ray = depth
            .intrinsics
            .unproject([f64::from(column) + 0.5, f64::from(row) + 0.5])
            .expect("a pinhole");
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few meters are below 65535 counts"
        )]
        let count = (scene_m(&ray) / depth.meters_per_count).round() as u16;
        count
    };
    pixels.map(count).collect()
}

pub(crate) fn image(camera: &EmulatedCamera, number: i64) -> Image {
    let [width, height] = camera.intrinsics.size_px;
    let bytes =
        (0..width * height * 3).map(|ix| (i64::from(ix) * 31 + number * 7).to_le_bytes()[0]);
    Image {
        camera: "wrist".into(),
        stamp: Stamp(BEGIN_NANOS + number * PERIOD_NANOS),
        size_px: [width, height],
        format: camera.format,
        data: bytes.collect(),
        exposure_secs: Some(0.0083),
        n_skipped: 0,
    }
}

pub(crate) fn depth_image(camera: &EmulatedCamera, number: i64) -> Image {
    let depth = depth_of(camera);
    // Each image has a different value near the corner.
    let mut counts = counts_of(depth);
    counts[1] = 1000 + u16::try_from(number).expect("few images");
    Image {
        stamp: Stamp(BEGIN_NANOS + number * PERIOD_NANOS + DEPTH_LATER_NANOS),
        size_px: depth.intrinsics.size_px,
        format: PixelFormat::DepthU16 {
            meters_per_count: depth.meters_per_count,
        },
        data: counts
            .iter()
            .flat_map(|count| count.to_le_bytes())
            .collect(),
        exposure_secs: Some(0.007_123),
        ..image(camera, number)
    }
}

/// Writes a file with this number of images.
pub(crate) fn record(path: &Path, camera: &EmulatedCamera, n_images: i64) {
    let mut writer = BagWriter::create(path, camera).expect("a file to write");
    for number in 0..n_images {
        writer
            .write(&image(camera, number))
            .expect("writing an image");
        writer
            .write(&depth_image(camera, number))
            .expect("writing an image");
    }
    writer.finish().expect("completing the file");
}

/// Aligns the depth of a file to color with the library. Returns the index of each image, the
/// counts, and the time it took.
pub(crate) fn aligned_by_library(path: &Path, n_images: usize) -> Vec<(i64, Vec<u16>, Duration)> {
    let mut config = PipelineConfig::new();
    config
        .enable_device_from_file(path, true)
        .expect("the file is valid");
    let mut pipeline = InactivePipeline::try_from(&Context::new().expect("the library starts"))
        .expect("a pipeline")
        .start(Some(config))
        .expect("the file is valid");
    let mut align = Align::new(Rs2StreamKind::Color, 1).expect("a block");
    let mut aligned = Vec::new();
    while aligned.len() < n_images {
        let frames = pipeline.wait(Some(IMAGE_TIMEOUT)).expect("images arrive");
        if frames.count() < 2 {
            continue;
        }
        let start_time = Instant::now();
        align.queue(frames).expect("depth and color");
        let frames = align
            .wait(IMAGE_TIMEOUT)
            .expect("the library aligns the images");
        let elapsed = start_time.elapsed();
        for depth in frames.frames_of_type::<DepthFrame>() {
            let count = |pixel: PixelKind<'_>| match pixel {
                PixelKind::Z16 { depth } => *depth,
                other => panic!("{other:?} is not depth"),
            };
            aligned.push((
                i64::try_from(depth.frame_number()).expect("few images") - 1,
                depth.iter().map(count).collect(),
                elapsed,
            ));
        }
    }
    aligned
}
