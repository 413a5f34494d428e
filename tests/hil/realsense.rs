//! Tests of RealSense cameras without hardware: files that the library records from a software device are played back
//! through the production driver, and our depth alignment is compared with that of the library.

use drivers::align::DepthAlignment;
use drivers::realsense::emulated::{BagWriter, EmulatedCamera, EmulatedDepth};
use drivers::realsense::{Config, Filter, Pace, RealsenseCamera, Settings, Stream};
use drivers::{Camera, Devices, Error, Image, Live, PixelFormat, Sample, Source};
use kinematics::{Intrinsics, Lens, Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use realsense_rust::config::Config as PipelineConfig;
use realsense_rust::context::Context;
use realsense_rust::frame::{DepthFrame, FrameEx, PixelKind};
use realsense_rust::kind::Rs2StreamKind;
use realsense_rust::pipeline::InactivePipeline;
use realsense_rust::processing_blocks::align::Align;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Timeout for steps that are slow on a busy machine.
const TEST_TIMEOUT: Duration = Duration::from_secs(20);
const RATE_HZ: u16 = 30;
/// Whole microseconds, like the camera clock. After a few hours, they exceed 32 bits.
const BEGIN_NANOS: i64 = 11_000_000_123_000;
const PERIOD_NANOS: i64 = 33_333_000;
/// Color and depth have different stamps.
const DEPTH_LATER_NANOS: i64 = 4_567_000;
const N_IMAGES: i64 = 12;

/// A D435i: depth from two infrared cameras, and a color camera next to them.
fn d435i(color_px: [u32; 2], lens: Lens) -> EmulatedCamera {
    let focal_px = f64::from(color_px[1]) * 1.2625;
    EmulatedCamera {
        name: "Intel RealSense D435I".into(),
        serial: "817612070000".into(),
        rate_hz: RATE_HZ,
        intrinsics: Intrinsics {
            size_px: color_px,
            focal_px: [focal_px, focal_px + 0.75],
            principal_px: [f64::from(color_px[0]) * 0.5 + 3.25, f64::from(color_px[1]) * 0.5 - 2.125],
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

fn depth_of(camera: &EmulatedCamera) -> &EmulatedDepth {
    camera.depth.as_ref().expect("the camera has depth")
}

/// Depth in meters along a ray of the plane `z` = 1: a slanted wall, a floor, and a box with a slanted front.
fn scene_m(ray: &Vector3<f64>) -> f64 {
    // normal * point = offset
    let planes = [(Vector3::new(0.25, 0.05, 1.0), 1.6), (Vector3::new(0.0, 1.0, 0.1), 0.7)];
    let distance_along_ray = |(normal, offset): &(Vector3<f64>, f64)| {
        let along = normal.dot(ray);
        if along > 0.0 { offset / along } else { f64::INFINITY }
    };
    let background = planes.iter().map(distance_along_ray).fold(f64::INFINITY, f64::min);
    let front = distance_along_ray(&(Vector3::new(-0.3, 0.2, 1.0), 0.65));
    let hit = ray * front;
    if hit.x.abs() < 0.12 && (hit.y - 0.03).abs() < 0.1 { front.min(background) } else { background }
}

/// Depth counts of the scene, with some holes.
fn counts_of(depth: &EmulatedDepth) -> Vec<u16> {
    let [width, height] = depth.intrinsics.size_px;
    let pixels = (0..height).flat_map(|row| (0..width).map(move |column| [column, row]));
    let count = |[column, row]: [u32; 2]| {
        if (column * 7 + row * 13) % 97 == 0 {
            return 0;
        }
        let ray = depth.intrinsics.unproject([f64::from(column) + 0.5, f64::from(row) + 0.5]).expect("a pinhole");
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

fn image(camera: &EmulatedCamera, number: i64) -> Image {
    let [width, height] = camera.intrinsics.size_px;
    let bytes = (0..width * height * 3).map(|ix| (i64::from(ix) * 31 + number * 7).to_le_bytes()[0]);
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

fn depth_image(camera: &EmulatedCamera, number: i64) -> Image {
    let depth = depth_of(camera);
    // Each image has a different value near the corner.
    let mut counts = counts_of(depth);
    counts[1] = 1000 + u16::try_from(number).expect("few images");
    Image {
        stamp: Stamp(BEGIN_NANOS + number * PERIOD_NANOS + DEPTH_LATER_NANOS),
        size_px: depth.intrinsics.size_px,
        format: PixelFormat::DepthU16 { meters_per_count: depth.meters_per_count },
        data: counts.iter().flat_map(|count| count.to_le_bytes()).collect(),
        exposure_secs: Some(0.007_123),
        ..image(camera, number)
    }
}

/// Writes a file with this number of images.
fn record(path: &Path, camera: &EmulatedCamera, n_images: i64) {
    let mut writer = BagWriter::create(path, camera).expect("a file to write");
    for number in 0..n_images {
        writer.write(&image(camera, number)).expect("writing an image");
        writer.write(&depth_image(camera, number)).expect("writing an image");
    }
    writer.finish().expect("completing the file");
}

fn config(path: PathBuf, camera: &EmulatedCamera, pace: Pace) -> Config {
    Config {
        name: "wrist".into(),
        serial: String::new(),
        file: Some(path),
        pace,
        clock_offset_nanos: 0,
        stream: Stream::Color,
        size_px: camera.intrinsics.size_px,
        rate_hz: RATE_HZ.into(),
        depth_size_px: Some(depth_of(camera).intrinsics.size_px),
        settings: Settings::default(),
        filters: Vec::new(),
        reconnect_for: Duration::ZERO,
    }
}

/// Reads all images until the end of the file.
fn play(config: Config) -> (RealsenseCamera, Vec<Image>) {
    let mut camera = RealsenseCamera::open(config).unwrap_or_else(|error| panic!("{error}"));
    let mut images = Vec::new();
    loop {
        match camera.next_image(TEST_TIMEOUT) {
            Ok(image) => images.push(image),
            Err(Error::NotDue { .. }) => {}
            Err(Error::Ended { .. }) => return (camera, images),
            Err(error) => panic!("{error}"),
        }
    }
}

/// Compares lens parameters within single precision.
fn assert_same_lens(got: &Intrinsics, expected: &Intrinsics) {
    const REL: f64 = 1e-7;
    let close = |got: f64, expected: f64| (got - expected).abs() <= REL * expected.abs().max(1.0);
    assert_eq!(got.size_px, expected.size_px);
    for axis in 0..2 {
        assert!(close(got.focal_px[axis], expected.focal_px[axis]), "{got:?}, expected {expected:?}");
        assert!(close(got.principal_px[axis], expected.principal_px[axis]), "{got:?}, expected {expected:?}");
    }
    match (got.lens, expected.lens) {
        (Lens::BrownConrady(got), Lens::BrownConrady(expected)) => {
            assert!(
                got.iter().zip(expected).all(|(got, expected)| close(*got, expected)),
                "{got:?}, expected {expected:?}"
            );
        }
        (got, expected) => assert_eq!(got, expected),
    }
}

#[test]
fn emulated_camera_round_trips_through_driver() {
    let folder = tempfile::tempdir().unwrap();
    let d455 = Lens::BrownConrady([-0.0555, 0.0657, -0.0006, 0.0004, -0.0213]);
    let l515 = EmulatedCamera {
        name: "Intel RealSense L515".into(),
        depth: Some(EmulatedDepth {
            meters_per_count: 0.000_25,
            ..depth_of(&d435i([640, 480], Lens::Pinhole)).clone()
        }),
        ..d435i([1280, 720], Lens::BrownConrady([0.155, -0.456, -0.0007, 0.0003, 0.41]))
    };
    for (camera, n_images) in [(d435i([640, 480], d455), N_IMAGES), (l515, 4)] {
        let path = folder.path().join("camera.bag");
        record(&path, &camera, n_images);
        let (driver, images) = play(config(path, &camera, Pace::Fast));
        // The calibration stored in the camera is preserved.
        let (calibration, depth) = (driver.calibration(), depth_of(&camera));
        let reported_depth = calibration.depth.as_ref().unwrap();
        assert_same_lens(&calibration.intrinsics, &camera.intrinsics);
        assert_same_lens(&reported_depth.intrinsics, &depth.intrinsics);
        let error = reported_depth.camera_from_depth.inverse() * depth.camera_from_depth;
        assert!(error.translation.vector.norm() < 1e-8 && error.rotation.angle() < 1e-6, "{error}");
        assert_eq!(reported_depth.meters_per_count, depth.meters_per_count);
        // Every image is delivered once, with unchanged bytes and stamp.
        let (depths, colors): (Vec<_>, Vec<_>) = images.into_iter().partition(Image::is_depth);
        for (got, expected) in [(&colors, image as fn(_, _) -> _), (&depths, depth_image)] {
            assert_eq!(
                got.len(),
                usize::try_from(n_images).unwrap(),
                "number of images, first stamp {:?}",
                got.first().map(|i| i.stamp)
            );
            for (got, number) in got.iter().zip(0..) {
                let expected: Image = expected(&camera, number);
                assert_eq!((got.stamp, got.size_px, got.format), (expected.stamp, expected.size_px, expected.format));
                assert!(got.data == expected.data, "the bytes of image {number} differ");
                let (got_secs, expected_secs) = (got.exposure_secs.unwrap(), expected.exposure_secs.unwrap());
                assert!((got_secs - expected_secs).abs() < 1e-9, "{got_secs}, expected {expected_secs}");
                assert_eq!(got.n_skipped, 0);
            }
        }
        // Depth in meters is accurate to one count.
        let meters = depths[0].decode_depth_m().unwrap();
        for (ix, meters) in meters.iter().enumerate().filter(|(ix, meters)| *ix > 1 && **meters > 0.0) {
            let (column, row) = (ix % 640, ix / 640);
            let ray = depth.intrinsics.unproject([column as f64 + 0.5, row as f64 + 0.5]).unwrap();
            let error_m = (f64::from(*meters) - scene_m(&ray)).abs();
            assert!(error_m <= depth.meters_per_count * 0.501, "column {column} row {row}: {error_m} m");
        }
        assert!(meters.iter().filter(|meters| **meters > 0.0).count() > 300_000);
        assert_eq!(driver.counts().n_images, 2 * u64::try_from(n_images).unwrap());
    }
}

#[test]
fn file_plays_in_real_time_and_fast_file_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let camera = d435i([640, 480], Lens::Pinhole);
    let path = folder.path().join("camera.bag");
    record(&path, &camera, N_IMAGES);
    let start_time = Instant::now();
    let (_, images) = play(config(path.clone(), &camera, Pace::RealTime));
    let duration = Duration::from_nanos(((N_IMAGES - 1) * PERIOD_NANOS + DEPTH_LATER_NANOS).unsigned_abs());
    assert!(start_time.elapsed() >= duration, "{:?}", start_time.elapsed());
    let first = images[0].stamp.0;
    let since: Vec<i64> = images.iter().filter(|image| !image.is_depth()).map(|image| image.stamp.0 - first).collect();
    assert_eq!(since, (0..N_IMAGES).map(|number| number * PERIOD_NANOS).collect::<Vec<_>>());
    // The file has more images than the queue of a live rig can hold.
    let open = RealsenseCamera::open(config(path, &camera, Pace::Fast)).unwrap();
    let mut live = Live::new(Devices { cameras: vec![Box::new(open)], ..Devices::default() }).unwrap();
    let mut n_images = 0;
    while let Some(Sample::Image(image)) = live.next_sample().unwrap() {
        assert_eq!(image.n_skipped, 0);
        n_images += 1;
        std::thread::sleep(Duration::from_millis(10));
    }
    assert_eq!(n_images, 2 * N_IMAGES);
}

#[test]
fn file_on_the_clock_starts_at_its_stamps() {
    const LATER_SECS: f64 = 6.0; // Longer than the silence limit of a device.
    let folder = tempfile::tempdir().unwrap();
    let camera = d435i([640, 480], Lens::Pinhole);
    let path = folder.path().join("camera.bag");
    let starts_at = drivers::clock::now().plus_secs(LATER_SECS);
    let mut writer = BagWriter::create(&path, &camera).unwrap();
    for number in 0..3 {
        writer.write(&image(&camera, number)).unwrap();
    }
    writer.finish().unwrap();
    // Only color was written.
    let clock_config = Config { depth_size_px: None, ..config(path, &camera, Pace::Clock) };
    let open = RealsenseCamera::open(Config { clock_offset_nanos: starts_at.0 - BEGIN_NANOS, ..clock_config }).unwrap();
    let mut live = Live::new(Devices { cameras: vec![Box::new(open)], ..Devices::default() }).unwrap();
    for number in 0..3 {
        let sample = live.next_sample().unwrap().unwrap();
        assert_eq!(sample.stamp(), Stamp(starts_at.0 + number * PERIOD_NANOS));
        assert!(drivers::clock::now() >= sample.stamp(), "the image was delivered too early");
    }
    assert_eq!(live.next_sample().unwrap(), None);
}

#[test]
fn file_opened_late_starts_at_current_time_without_loss() {
    let folder = tempfile::tempdir().unwrap();
    let (path, camera) = (folder.path().join("camera.bag"), d435i([640, 480], Lens::Pinhole));
    let n_before = 30;
    let mut writer = BagWriter::create(&path, &camera).unwrap();
    (0..3 * n_before).for_each(|number| writer.write(&image(&camera, number)).unwrap());
    writer.finish().unwrap();
    let starts_at = drivers::clock::now() - Duration::from_nanos((n_before * PERIOD_NANOS).unsigned_abs());
    let clock_config = Config { depth_size_px: None, ..config(path, &camera, Pace::Clock) };
    let open = RealsenseCamera::open(Config { clock_offset_nanos: starts_at.0 - BEGIN_NANOS, ..clock_config }).unwrap();
    let mut live = Live::new(Devices { cameras: vec![Box::new(open)], ..Devices::default() }).unwrap();
    let mut images = Vec::new();
    while let Some(Sample::Image(image)) = live.next_sample().unwrap() {
        images.push(image);
    }
    let first = (images[0].stamp.0 - starts_at.0) / PERIOD_NANOS;
    assert!((n_before..2 * n_before).contains(&first), "{first}");
    for (ix, image) in (first..).zip(&images) {
        assert_eq!((image.stamp.0, image.n_skipped), (starts_at.0 + ix * PERIOD_NANOS, 0));
    }
    assert_eq!(first + i64::try_from(images.len()).unwrap(), 3 * n_before);
}

#[test]
fn file_not_read_to_its_end_is_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let (path, camera) = (folder.path().join("long.bag"), d435i([640, 480], Lens::Pinhole));
    // More images than all queues together can hold.
    record(&path, &camera, 10 * N_IMAGES);
    let mut open = RealsenseCamera::open(config(path, &camera, Pace::Fast)).expect("opening the file");
    open.next_image(TEST_TIMEOUT).expect("the first image");
    std::thread::sleep(Duration::from_millis(500));
    let start_time = Instant::now();
    drop(open);
    assert!(start_time.elapsed() < TEST_TIMEOUT, "{:?}", start_time.elapsed());
}

#[test]
fn missing_streams_are_errors_and_filters_fill_holes() {
    let folder = tempfile::tempdir().unwrap();
    let camera = d435i([640, 480], Lens::Pinhole);
    let path = folder.path().join("camera.bag");
    record(&path, &camera, 2);
    let open_error = |config: Config| RealsenseCamera::open(config).unwrap_err().to_string();
    let plain_config = config(path.clone(), &camera, Pace::Fast);
    let message = open_error(Config { size_px: [848, 480], ..plain_config.clone() });
    assert!(message.contains("color 848x480") && message.contains("rgb 640x480 at 30 Hz"), "{message}");
    let message = open_error(Config { stream: Stream::Infrared, ..plain_config.clone() });
    assert!(message.contains("no infrared"), "{message}");
    let message = open_error(Config { file: Some(folder.path().join("absent.bag")), ..plain_config.clone() });
    assert!(message.contains("absent.bag") && message.contains("No such file"), "{message}");
    let truncated = folder.path().join("cut.bag");
    std::fs::write(&truncated, &std::fs::read(&path).unwrap()[..5000]).unwrap();
    let message = open_error(Config { file: Some(truncated), ..plain_config.clone() });
    assert!(message.contains("cut.bag"), "{message}");
    let n_holes = |images: &[Image]| {
        let depth = images.iter().find(|image| image.is_depth()).unwrap();
        depth.data.as_chunks::<2>().0.iter().filter(|count| **count == [0; 2]).count()
    };
    let (_, images) = play(plain_config.clone());
    assert!(n_holes(&images) > 1000);
    let filters = vec![Filter::Spatial, Filter::Temporal, Filter::HoleFilling];
    let (_, filtered) = play(Config { filters, ..plain_config });
    assert_eq!(filtered.len(), images.len());
    assert!(n_holes(&filtered) * 10 < n_holes(&images), "{} holes left", n_holes(&filtered));
    let stamps = |images: &[Image]| images.iter().map(|image| image.stamp).collect::<Vec<_>>();
    assert_eq!(stamps(&filtered), stamps(&images));
}

/// Aligns the depth of a file to color with the library. Returns the index of each image, the counts, and the time it
/// took.
fn aligned_by_library(path: &Path, n_images: usize) -> Vec<(i64, Vec<u16>, Duration)> {
    let mut config = PipelineConfig::new();
    config.enable_device_from_file(path, true).expect("the file is valid");
    let mut pipeline = InactivePipeline::try_from(&Context::new().expect("the library starts"))
        .expect("a pipeline")
        .start(Some(config))
        .expect("the file is valid");
    let mut align = Align::new(Rs2StreamKind::Color, 1).expect("a block");
    let mut aligned = Vec::new();
    while aligned.len() < n_images {
        let frames = pipeline.wait(Some(TEST_TIMEOUT)).expect("images arrive");
        if frames.count() < 2 {
            continue;
        }
        let start_time = Instant::now();
        align.queue(frames).expect("depth and color");
        let frames = align.wait(TEST_TIMEOUT).expect("the library aligns the images");
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

fn counts(image: &Image) -> Vec<u16> {
    image.data.as_chunks::<2>().0.iter().map(|bytes| u16::from_le_bytes(*bytes)).collect()
}

fn equal_frac(a: &[u16], b: &[u16]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).filter(|(a, b)| a == b).count() as f64 / a.len() as f64
}

/// The fast path of the library rounds the corners of a depth pixel to the nearest integer after adding half a pixel,
/// where it should truncate. This shifts the result by half a pixel to the right and down
/// (`src/proc/sse/sse-align.cpp`; the scalar path is correct). With a principal point shifted by half a pixel, our
/// result is the same.
fn with_library_rounding(color: &Intrinsics) -> Intrinsics {
    Intrinsics { principal_px: color.principal_px.map(|center| center + 0.5), ..color.clone() }
}

#[test]
fn alignment_matches_library_except_half_pixel() {
    // Both use single precision, so a corner occasionally falls on the other side of a pixel edge.
    const EQUAL_FRAC: f64 = 0.999;
    let folder = tempfile::tempdir().unwrap();
    for color_px in [[640, 480], [1280, 720]] {
        let camera = d435i(color_px, Lens::Pinhole);
        let path = folder.path().join("camera.bag");
        record(&path, &camera, 4);
        let depth = depth_of(&camera);
        let align = |color: &Intrinsics, image: &Image| {
            counts(&DepthAlignment::new(&depth.intrinsics, color, &depth.camera_from_depth).align(image).unwrap())
        };
        for (number, library, _) in aligned_by_library(&path, 3) {
            let image = depth_image(&camera, number);
            let equal_with_rounding = equal_frac(&align(&with_library_rounding(&camera.intrinsics), &image), &library);
            let equal_without_rounding = equal_frac(&align(&camera.intrinsics, &image), &library);
            eprintln!(
                "{color_px:?}: equal {equal_with_rounding:.5}; without the half-pixel shift {equal_without_rounding:.5}"
            );
            assert!(
                equal_with_rounding >= EQUAL_FRAC && equal_without_rounding < equal_with_rounding,
                "{color_px:?}: {equal_with_rounding}, {equal_without_rounding}"
            );
            assert!(library.iter().filter(|count| **count > 0).count() > library.len() / 2, "the scene is not visible");
        }
    }
}

#[test]
#[ignore = "benchmark: prints milliseconds; run it in release mode on one core (taskset -c 0)"]
fn alignment_is_faster_than_library() {
    let folder = tempfile::tempdir().unwrap();
    for color_px in [[640, 480], [1280, 720]] {
        let camera = d435i(color_px, Lens::Pinhole);
        let path = folder.path().join("camera.bag");
        record(&path, &camera, N_IMAGES);
        let mut library: Vec<_> = aligned_by_library(&path, 60).into_iter().map(|(.., elapsed)| elapsed).collect();
        let image = depth_image(&camera, 0);
        let align = DepthAlignment::new(
            &depth_of(&camera).intrinsics,
            &camera.intrinsics,
            &depth_of(&camera).camera_from_depth,
        );
        let mut own: Vec<_> = (0..60)
            .map(|_| {
                let start_time = Instant::now();
                std::hint::black_box(align.align(std::hint::black_box(&image)).unwrap());
                start_time.elapsed()
            })
            .collect();
        library.sort();
        own.sort();
        let ratio = |at: usize| library[at].as_secs_f64() / own[at].as_secs_f64();
        eprintln!(
            "depth 640x480 to {color_px:?}: ours: minimum {:.2?}, median {:.2?}; library: {:.2?}, {:.2?}; ratio {:.1} and {:.1}",
            own[0],
            own[30],
            library[0],
            library[30],
            ratio(0),
            ratio(30)
        );
    }
}
