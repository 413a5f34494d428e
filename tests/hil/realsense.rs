//! Tests of RealSense cameras without hardware. Files that the library records from a software
//! device are played back through the production driver, and our depth alignment is compared with
//! the library's.

mod realsense_scene;

use drivers::align::DepthAlignment;
use drivers::realsense::emulated::{BagWriter, EmulatedCamera, EmulatedDepth};
use drivers::realsense::{Config, Filter, Pace, RealsenseCamera, Settings, Stream};
use drivers::{Camera, Devices, Error, Image, LiveDevices, Sample, Source};
use kinematics::{Intrinsics, Lens, Stamp};
use realsense_scene::{
    BEGIN_NANOS, DEPTH_LATER_NANOS, PERIOD_NANOS, RATE_HZ, aligned_by_library, d435i, depth_image,
    depth_of, image, record, scene_m,
};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Timeout for steps that are slow on a busy machine.
const TEST_TIMEOUT: Duration = Duration::from_secs(20);
const N_IMAGES: i64 = 12;

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

/// Opens a file and reads all its images.
fn play(config: Config) -> (RealsenseCamera, Vec<Image>) {
    read_all(RealsenseCamera::open(config).unwrap_or_else(|error| panic!("{error}")))
}

/// Reads all remaining images of a file.
fn read_all(mut camera: RealsenseCamera) -> (RealsenseCamera, Vec<Image>) {
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
        assert!(
            close(got.focal_px[axis], expected.focal_px[axis]),
            "{got:?}, expected {expected:?}"
        );
        assert!(
            close(got.principal_px[axis], expected.principal_px[axis]),
            "{got:?}, expected {expected:?}"
        );
    }
    match (got.lens, expected.lens) {
        (Lens::BrownConrady(got), Lens::BrownConrady(expected)) => {
            assert!(
                got.iter()
                    .zip(expected)
                    .all(|(got, expected)| close(*got, expected)),
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
        ..d435i(
            [1280, 720],
            Lens::BrownConrady([0.155, -0.456, -0.0007, 0.0003, 0.41]),
        )
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
        assert!(
            error.translation.vector.norm() < 1e-8 && error.rotation.angle() < 1e-6,
            "{error}"
        );
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
                assert_eq!(
                    (got.stamp, got.size_px, got.format),
                    (expected.stamp, expected.size_px, expected.format)
                );
                assert!(
                    got.data == expected.data,
                    "the bytes of image {number} differ"
                );
                let (got_secs, expected_secs) =
                    (got.exposure_secs.unwrap(), expected.exposure_secs.unwrap());
                assert!(
                    (got_secs - expected_secs).abs() < 1e-9,
                    "{got_secs}, expected {expected_secs}"
                );
                assert_eq!(got.n_skipped, 0);
            }
        }
        // Depth in meters is accurate to one count.
        let meters = depths[0].decode_depth_m().unwrap();
        for (ix, meters) in meters
            .iter()
            .enumerate()
            .filter(|(ix, meters)| *ix > 1 && **meters > 0.0)
        {
            let (column, row) = (ix % 640, ix / 640);
            let ray = depth
                .intrinsics
                .unproject([column as f64 + 0.5, row as f64 + 0.5])
                .unwrap();
            let error_m = (f64::from(*meters) - scene_m(&ray)).abs();
            assert!(
                error_m <= depth.meters_per_count * 0.501,
                "column {column} row {row}: {error_m} m"
            );
        }
        assert!(meters.iter().filter(|meters| **meters > 0.0).count() > 300_000);
        assert_eq!(
            driver.counts().n_images,
            2 * u64::try_from(n_images).unwrap()
        );
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
    let duration =
        Duration::from_nanos(((N_IMAGES - 1) * PERIOD_NANOS + DEPTH_LATER_NANOS).unsigned_abs());
    assert!(
        start_time.elapsed() >= duration,
        "{:?}",
        start_time.elapsed()
    );
    let first = images[0].stamp.0;
    let since: Vec<i64> = images
        .iter()
        .filter(|image| !image.is_depth())
        .map(|image| image.stamp.0 - first)
        .collect();
    assert_eq!(
        since,
        (0..N_IMAGES)
            .map(|number| number * PERIOD_NANOS)
            .collect::<Vec<_>>()
    );
    // The file has more images than the queue of a live rig can hold.
    let open = RealsenseCamera::open(config(path, &camera, Pace::Fast)).unwrap();
    let mut live = LiveDevices::new(Devices {
        cameras: vec![Box::new(open)],
        ..Devices::default()
    })
    .unwrap();
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
    const LATER_SECS: f64 = 6.0; // This delay is longer than the silence limit of a device.
    let folder = tempfile::tempdir().unwrap();
    let camera = d435i([640, 480], Lens::Pinhole);
    let path = folder.path().join("camera.bag");
    let mut writer = BagWriter::create(&path, &camera).unwrap();
    for number in 0..3 {
        writer.write(&image(&camera, number)).unwrap();
    }
    writer.finish().unwrap();
    let starts_at = drivers::clock::now().plus_secs(LATER_SECS);
    // The file contains only color.
    let clock_config = Config {
        depth_size_px: None,
        ..config(path, &camera, Pace::Clock)
    };
    let open = RealsenseCamera::open(Config {
        clock_offset_nanos: starts_at.0 - BEGIN_NANOS,
        ..clock_config
    })
    .unwrap();
    let mut live = LiveDevices::new(Devices {
        cameras: vec![Box::new(open)],
        ..Devices::default()
    })
    .unwrap();
    for number in 0..3 {
        let sample = live.next_sample().unwrap().unwrap();
        assert_eq!(sample.stamp(), Stamp(starts_at.0 + number * PERIOD_NANOS));
        assert!(
            drivers::clock::now() >= sample.stamp(),
            "the image was delivered too early"
        );
    }
    assert_eq!(live.next_sample().unwrap(), None);
}

/// Plays a file that began a second ago. Returns its images that are due after it was opened, when
/// the file began, and the times before and after it was opened. If the machine stalls until the
/// file is over, repeats it.
fn play_late(
    config: &Config,
    read: impl Fn(RealsenseCamera) -> Vec<Image>,
) -> (Vec<Image>, Stamp, [Stamp; 2]) {
    let deadline = Instant::now() + TEST_TIMEOUT;
    loop {
        let before = drivers::clock::now();
        let starts_at = before - Duration::from_secs(1);
        let camera = RealsenseCamera::open(Config {
            clock_offset_nanos: starts_at.0 - BEGIN_NANOS,
            ..config.clone()
        })
        .expect("a readable file");
        let opened = [before, drivers::clock::now()];
        let images = read(camera);
        if !images.is_empty() {
            return (images, starts_at, opened);
        }
        assert!(Instant::now() < deadline, "the file is over when it opens");
    }
}

#[test]
fn file_opened_late_starts_at_current_time_without_loss() {
    const N_IN_FILE: i64 = 90;
    let folder = tempfile::tempdir().unwrap();
    let (path, camera) = (
        folder.path().join("camera.bag"),
        d435i([640, 480], Lens::Pinhole),
    );
    let mut writer = BagWriter::create(&path, &camera).unwrap();
    (0..N_IN_FILE).for_each(|number| writer.write(&image(&camera, number)).unwrap());
    writer.finish().unwrap();
    let clock_config = Config {
        depth_size_px: None,
        ..config(path, &camera, Pace::Clock)
    };
    // The first image is the first one that is due after the file was opened.
    let check_first = |first: i64, starts_at: Stamp, opened: [Stamp; 2]| {
        let [earliest, latest] = opened.map(|opened| (opened.0 - starts_at.0) / PERIOD_NANOS);
        assert!((earliest..=latest + 1).contains(&first), "{first}");
    };
    // The file waits for its reader, however slow that is.
    let (images, starts_at, opened) = play_late(&clock_config, |camera| read_all(camera).1);
    let first = (images[0].stamp.0 - starts_at.0) / PERIOD_NANOS;
    check_first(first, starts_at, opened);
    for (ix, image) in (first..).zip(&images) {
        assert_eq!(
            (image.stamp.0, image.n_skipped),
            (starts_at.0 + ix * PERIOD_NANOS, 0)
        );
    }
    assert_eq!(first + i64::try_from(images.len()).unwrap(), N_IN_FILE);
    // The queue of a live rig drops images if this thread stalls, and counts them.
    let (images, starts_at, opened) = play_late(&clock_config, |camera| {
        let mut live = LiveDevices::new(Devices {
            cameras: vec![Box::new(camera)],
            ..Devices::default()
        })
        .unwrap();
        let mut images = Vec::new();
        while let Some(Sample::Image(image)) = live.next_sample().unwrap() {
            images.push(image);
        }
        images
    });
    let n_skipped = |image: &Image| i64::try_from(image.n_skipped).unwrap();
    let mut next = (images[0].stamp.0 - starts_at.0) / PERIOD_NANOS - n_skipped(&images[0]);
    check_first(next, starts_at, opened);
    for image in &images {
        next += n_skipped(image);
        assert_eq!(image.stamp.0, starts_at.0 + next * PERIOD_NANOS);
        next += 1;
    }
    assert_eq!(next, N_IN_FILE);
}

#[test]
fn file_not_read_to_its_end_is_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let (path, camera) = (
        folder.path().join("long.bag"),
        d435i([640, 480], Lens::Pinhole),
    );
    // More images than all queues together can hold.
    record(&path, &camera, 10 * N_IMAGES);
    let mut open =
        RealsenseCamera::open(config(path, &camera, Pace::Fast)).expect("opening the file");
    open.next_image(TEST_TIMEOUT).expect("the first image");
    std::thread::sleep(Duration::from_millis(500));
    let start_time = Instant::now();
    drop(open);
    assert!(
        start_time.elapsed() < TEST_TIMEOUT,
        "{:?}",
        start_time.elapsed()
    );
}

#[test]
fn missing_streams_are_errors_and_filters_fill_holes() {
    let folder = tempfile::tempdir().unwrap();
    let camera = d435i([640, 480], Lens::Pinhole);
    let path = folder.path().join("camera.bag");
    record(&path, &camera, 2);
    let open_error = |config: Config| RealsenseCamera::open(config).unwrap_err().to_string();
    let plain_config = config(path.clone(), &camera, Pace::Fast);
    let message = open_error(Config {
        size_px: [848, 480],
        ..plain_config.clone()
    });
    assert!(
        message.contains("color 848x480") && message.contains("rgb 640x480 at 30 Hz"),
        "{message}"
    );
    let message = open_error(Config {
        stream: Stream::Infrared,
        ..plain_config.clone()
    });
    assert!(message.contains("no infrared"), "{message}");
    let message = open_error(Config {
        file: Some(folder.path().join("absent.bag")),
        ..plain_config.clone()
    });
    assert!(
        message.contains("absent.bag") && message.contains("No such file"),
        "{message}"
    );
    let truncated = folder.path().join("cut.bag");
    std::fs::write(&truncated, &std::fs::read(&path).unwrap()[..5000]).unwrap();
    let message = open_error(Config {
        file: Some(truncated),
        ..plain_config.clone()
    });
    assert!(message.contains("cut.bag"), "{message}");
    let n_holes = |images: &[Image]| {
        let depth = images.iter().find(|image| image.is_depth()).unwrap();
        depth
            .data
            .as_chunks::<2>()
            .0
            .iter()
            .filter(|count| **count == [0; 2])
            .count()
    };
    let (_, images) = play(plain_config.clone());
    assert!(n_holes(&images) > 1000);
    let filters = vec![Filter::Spatial, Filter::Temporal, Filter::HoleFilling];
    let (_, filtered) = play(Config {
        filters,
        ..plain_config
    });
    assert_eq!(filtered.len(), images.len());
    assert!(
        n_holes(&filtered) * 10 < n_holes(&images),
        "{} holes left",
        n_holes(&filtered)
    );
    let stamps = |images: &[Image]| images.iter().map(|image| image.stamp).collect::<Vec<_>>();
    assert_eq!(stamps(&filtered), stamps(&images));
}

fn counts(image: &Image) -> Vec<u16> {
    image
        .data
        .as_chunks::<2>()
        .0
        .iter()
        .map(|bytes| u16::from_le_bytes(*bytes))
        .collect()
}

fn equal_frac(a: &[u16], b: &[u16]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).filter(|(a, b)| a == b).count() as f64 / a.len() as f64
}

/// The library's fast path adds half a pixel to the corners of a depth pixel and then rounds, where
/// it should truncate. This shifts the result by half a pixel to the right and down
/// (`src/proc/sse/sse-align.cpp`; the scalar path is correct). With a principal point shifted by
/// half a pixel, our result is the same.
fn with_library_rounding(color: &Intrinsics) -> Intrinsics {
    Intrinsics {
        principal_px: color.principal_px.map(|center| center + 0.5),
        ..color.clone()
    }
}

#[test]
fn alignment_matches_library_except_half_pixel() {
    // Both computations use single precision, so a corner occasionally falls on the other side of a
    // pixel edge.
    const EQUAL_FRAC: f64 = 0.999;
    let folder = tempfile::tempdir().unwrap();
    for color_px in [[640, 480], [1280, 720]] {
        let camera = d435i(color_px, Lens::Pinhole);
        let path = folder.path().join("camera.bag");
        record(&path, &camera, 4);
        let depth = depth_of(&camera);
        let align = |color: &Intrinsics, image: &Image| {
            counts(
                &DepthAlignment::new(&depth.intrinsics, color, &depth.camera_from_depth)
                    .align(image)
                    .unwrap(),
            )
        };
        for (number, library, _) in aligned_by_library(&path, 3) {
            let image = depth_image(&camera, number);
            let equal_with_rounding = equal_frac(
                &align(&with_library_rounding(&camera.intrinsics), &image),
                &library,
            );
            let equal_without_rounding = equal_frac(&align(&camera.intrinsics, &image), &library);
            eprintln!(
                "{color_px:?}: equal {equal_with_rounding:.5}; without the half-pixel shift {equal_without_rounding:.5}"
            );
            assert!(
                equal_with_rounding >= EQUAL_FRAC && equal_without_rounding < equal_with_rounding,
                "{color_px:?}: {equal_with_rounding}, {equal_without_rounding}"
            );
            assert!(
                library.iter().filter(|count| **count > 0).count() > library.len() / 2,
                "the scene is not visible"
            );
        }
    }
}
