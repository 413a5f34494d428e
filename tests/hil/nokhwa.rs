//! Inside the virtual kernel: cameras by way of nokhwa, against vivid.

use crate::cameras::{self, DROP_PERCENT, WEBCAM, drive, node};
use drivers::nokhwa::{Config, NokhwaCamera};
use drivers::v4l2::{self, Delivery, V4l2Camera, V4l2Format};
use drivers::{Camera, Error, Image, PixelFormat};
use kinematics::{Intrinsics, Lens};
use std::time::{Duration, Instant};

const RATE_HZ: f64 = 25.0;

fn config() -> Config {
    Config {
        name: "front".into(),
        device: "vivid-000".into(),
        format: None,
        intrinsics: Intrinsics {
            size_px: [640, 360],
            focal_px: [500.0; 2],
            principal_px: [320.0, 180.0],
            lens: Lens::Pinhole,
            rectified: true,
        },
        rate_hz: RATE_HZ,
        exposure_micros: None,
        delivery: Delivery::Every,
        reconnect_for: Duration::from_secs(20),
    }
}

/// Leaves the camera in a format that nokhwa knows: it opens none whose present one it does not, as after the tests of V4L2.
fn open(config: Config) -> NokhwaCamera {
    let known = v4l2::Config { format: Some(V4l2Format::Yuyv), ..cameras::config(WEBCAM, [640, 360], RATE_HZ) };
    drop(V4l2Camera::open(known).expect("vivid opens"));
    NokhwaCamera::open(config).expect("vivid opens")
}

/// The next image after a fault, and how long it took.
fn back_after(camera: &mut NokhwaCamera) -> (Image, Duration) {
    let began = Instant::now();
    loop {
        match camera.next_image(Duration::from_millis(100)) {
            Ok(image) => return (image, began.elapsed()),
            Err(Error::NoImage { .. } | Error::Reconnecting { .. }) => {
                assert!(began.elapsed() < Duration::from_secs(10), "no image any more")
            }
            Err(other) => panic!("{other}"),
        }
    }
}

/// Until the camera says that it is looked for.
fn lost_after(camera: &mut NokhwaCamera) -> Duration {
    let began = Instant::now();
    while !matches!(camera.next_image(Duration::from_millis(50)), Err(Error::Reconnecting { .. })) {
        assert!(began.elapsed() < Duration::from_secs(10), "the driver does not notice");
    }
    began.elapsed()
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn nokhwa_streams_ten_seconds() {
    for format in [None, Some(V4l2Format::Nv12)] {
        let mut camera = open(Config { format, ..config() });
        let first = camera.next_image(Duration::from_secs(2)).expect("vivid streams");
        assert_eq!(first.decode_rgb().expect("raw pixels").len(), 640 * 360 * 3);
        assert!(matches!(first.format, PixelFormat::Yuv { .. }));
        let began = Instant::now();
        let mut last = first.stamp;
        while began.elapsed() < Duration::from_secs(if format.is_none() { 10 } else { 2 }) {
            let image = camera.next_image(Duration::from_secs(2)).expect("vivid streams");
            assert!(image.stamp > last, "stamps go back");
            last = image.stamp;
        }
        let by_time = last.secs_since(first.stamp) * RATE_HZ;
        let counts = camera.counts();
        println!("nokhwa, {:?}: {counts:?} in {:.2?}, {by_time:.1} by time", first.format, began.elapsed());
        assert_eq!((counts.n_reconnections, counts.n_left_behind), (0, 0));
        let counted = (counts.n_images - 1 + counts.n_skipped) as f64;
        assert!((counted - by_time).abs() < 3.0, "{counted} images and gaps, {by_time} by time");
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn a_call_to_nokhwa_that_hangs_is_left_behind() {
    let mut camera = open(config());
    camera.next_image(Duration::from_secs(2)).expect("vivid streams");
    // Vivid sends nothing any more: nokhwa waits for ever.
    v4l2::set_control(&node(WEBCAM), DROP_PERCENT, 100).expect("vivid injects faults");
    let noticed = lost_after(&mut camera);
    println!("nokhwa: a call that hangs was left behind after {noticed:.2?}");
    assert!(noticed < Duration::from_secs(2), "{noticed:?}");
    assert_eq!(camera.counts().n_left_behind, 1);
    drive("unbind");
    let pulled = Instant::now();
    while pulled.elapsed() < Duration::from_secs(1) {
        assert!(matches!(camera.next_image(Duration::from_millis(50)), Err(Error::Reconnecting { .. })));
    }
    drive("bind");
    let (image, took) = back_after(&mut camera);
    println!(
        "nokhwa: plugged in again, images after {took:.2?}; about {} were lost; {:?}",
        image.n_skipped,
        camera.counts()
    );
    assert!(took < Duration::from_secs(2), "{took:?}");
    assert_eq!(camera.counts().n_reconnections, 1);
    for _ in 0..25 {
        camera.next_image(Duration::from_secs(2)).expect("it streams on");
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn a_camera_of_nokhwa_survives_a_pulled_cable() {
    let mut camera = open(config());
    camera.next_image(Duration::from_secs(2)).expect("vivid streams");
    drive("unbind");
    let noticed = lost_after(&mut camera);
    std::thread::sleep(Duration::from_secs(1).saturating_sub(noticed));
    drive("bind");
    let (image, took) = back_after(&mut camera);
    println!(
        "nokhwa: pulled, noticed after {noticed:.2?}, images again after {took:.2?}, about {} lost",
        image.n_skipped
    );
    assert!(noticed < Duration::from_secs(2) && took < Duration::from_secs(2), "{noticed:?}, {took:?}");
    assert!((20..=60).contains(&image.n_skipped), "{} images for a second without a camera", image.n_skipped);
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn what_nokhwa_cannot_do_is_told() {
    let refused = |config| NokhwaCamera::open(config).expect_err("not to be had").to_string();
    let absent = refused(Config { device: "no such camera".into(), ..config() });
    println!("{absent}");
    assert!(absent.contains("\"no such camera\"") && absent.contains("vivid-000"), "{absent}");
    let mut large = config();
    large.intrinsics.size_px = [800, 600];
    let large = refused(large);
    println!("{large}");
    assert!(large.contains("800x600 at 25 Hz cannot be had"), "{large}");
    assert!(refused(Config { rate_hz: 29.97, ..config() }).contains("whole numbers"));
    assert!(refused(Config { format: Some(V4l2Format::Grey), ..config() }).contains("grey"));
}
