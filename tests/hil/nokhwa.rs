//! Tests of nokhwa cameras against vivid, inside the virtual kernel.

use crate::cameras::{self, DROP_PERCENT, WEBCAM, node, write_driver_action};
use drivers::nokhwa::{Config, NokhwaCamera};
use drivers::v4l2::{self, Delivery, V4l2Camera, V4l2Format};
use drivers::{Camera, Error, Image, PixelFormat};
use kinematics::{Intrinsics, Lens};
use std::time::{Duration, Instant};

const RATE_HZ: f64 = 25.0;
/// Limit for the detection of an outage and for recovery.
const MAX_REACTION: Duration = Duration::from_secs(2);

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

/// Opens a camera after setting a format that nokhwa supports. nokhwa cannot open a camera that is
/// set to another format. After the V4L2 tests, the camera may be set to such a format.
fn open(config: Config) -> NokhwaCamera {
    let known_format = v4l2::Config {
        format: Some(V4l2Format::Yuyv),
        ..cameras::config(WEBCAM, [640, 360], RATE_HZ)
    };
    drop(V4l2Camera::open(known_format).expect("vivid opens"));
    NokhwaCamera::open(config).expect("vivid opens")
}

/// Waits for an image after a fault and returns it with the elapsed time.
fn time_to_recover(camera: &mut NokhwaCamera) -> (Image, Duration) {
    let start_time = Instant::now();
    loop {
        match camera.next_image(Duration::from_millis(100)) {
            Ok(image) => return (image, start_time.elapsed()),
            Err(Error::NoImage { .. } | Error::Reconnecting { .. }) => {
                assert!(
                    start_time.elapsed() < Duration::from_secs(10),
                    "no more images"
                )
            }
            Err(other) => panic!("{other}"),
        }
    }
}

/// Waits until the camera reports that it is reconnecting.
fn time_to_disconnect(camera: &mut NokhwaCamera) -> Duration {
    let start_time = Instant::now();
    while !matches!(
        camera.next_image(Duration::from_millis(50)),
        Err(Error::Reconnecting { .. })
    ) {
        assert!(
            start_time.elapsed() < Duration::from_secs(10),
            "the driver did not detect the outage"
        );
    }
    start_time.elapsed()
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn nokhwa_streams_ten_seconds() {
    for format in [None, Some(V4l2Format::Nv12)] {
        let mut camera = open(Config { format, ..config() });
        let first = camera
            .next_image(Duration::from_secs(2))
            .expect("vivid streams");
        assert_eq!(first.decode_rgb().expect("raw pixels").len(), 640 * 360 * 3);
        assert!(matches!(first.format, PixelFormat::Yuv { .. }));
        let start_time = Instant::now();
        let mut last = first.stamp;
        while start_time.elapsed() < Duration::from_secs(if format.is_none() { 10 } else { 2 }) {
            let image = camera
                .next_image(Duration::from_secs(2))
                .expect("vivid streams");
            assert!(image.stamp > last, "stamps decrease");
            last = image.stamp;
        }
        let by_time = last.secs_since(first.stamp) * RATE_HZ;
        let counts = camera.counts();
        println!(
            "nokhwa, {:?}: {counts:?} in {:.2?}, {by_time:.1} by time",
            first.format,
            start_time.elapsed()
        );
        assert_eq!((counts.n_reconnections, camera.n_abandoned()), (0, 0));
        let n_counted = (counts.n_images - 1 + counts.n_skipped) as f64;
        assert!(
            (n_counted - by_time).abs() < 3.0,
            "{n_counted} images including gaps, expected {by_time} from the stamps"
        );
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn hanging_nokhwa_call_is_abandoned() {
    let mut camera = open(config());
    camera
        .next_image(Duration::from_secs(2))
        .expect("vivid streams");
    // vivid stops sending images, and the call of nokhwa never returns.
    v4l2::set_control(&node(WEBCAM), DROP_PERCENT, 100).expect("vivid injects faults");
    let detected_after = time_to_disconnect(&mut camera);
    println!("nokhwa: a hanging call was abandoned after {detected_after:.2?}");
    assert!(detected_after < MAX_REACTION, "{detected_after:?}");
    assert_eq!(camera.n_abandoned(), 1);
    write_driver_action("unbind");
    let unplugged_at = Instant::now();
    while unplugged_at.elapsed() < Duration::from_secs(1) {
        assert!(matches!(
            camera.next_image(Duration::from_millis(50)),
            Err(Error::Reconnecting { .. })
        ));
    }
    write_driver_action("bind");
    let (image, elapsed) = time_to_recover(&mut camera);
    assert!(elapsed < MAX_REACTION, "{elapsed:?}");
    println!(
        "nokhwa: reconnected, recovered after {elapsed:.2?}; about {} images were lost; {:?}",
        image.n_skipped,
        camera.counts()
    );
    assert_eq!(camera.counts().n_reconnections, 1);
    for _ in 0..25 {
        camera
            .next_image(Duration::from_secs(2))
            .expect("streaming continues");
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn nokhwa_camera_survives_unplugging() {
    let mut camera = open(config());
    camera
        .next_image(Duration::from_secs(2))
        .expect("vivid streams");
    write_driver_action("unbind");
    let unplugged_at = Instant::now();
    let detected_after = time_to_disconnect(&mut camera);
    std::thread::sleep(Duration::from_secs(1).saturating_sub(detected_after));
    write_driver_action("bind");
    let (image, elapsed) = time_to_recover(&mut camera);
    assert!(
        detected_after.max(elapsed) < MAX_REACTION,
        "detected after {detected_after:?}, recovered after {elapsed:?}"
    );
    println!(
        "nokhwa: disconnected, detected after {detected_after:.2?}, recovered after {elapsed:.2?}, about {} images lost",
        image.n_skipped
    );
    // The camera is missing for at least one second, plus the times to bind it and to open it
    // again.
    let lost_range = 20.0..=unplugged_at.elapsed().as_secs_f64() * RATE_HZ + 10.0;
    assert!(
        lost_range.contains(&(image.n_skipped as f64)),
        "{} images lost, expected {lost_range:?}",
        image.n_skipped
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn unsupported_nokhwa_settings_are_errors() {
    let open_error = |config| {
        NokhwaCamera::open(config)
            .expect_err("the settings are unsupported")
            .to_string()
    };
    let absent = open_error(Config {
        device: "no such camera".into(),
        ..config()
    });
    println!("{absent}");
    assert!(
        absent.contains("\"no such camera\"") && absent.contains("vivid-000"),
        "{absent}"
    );
    let mut large = config();
    large.intrinsics.size_px = [800, 600];
    let large = open_error(large);
    println!("{large}");
    assert!(large.contains("cannot start 800x600 at 25 Hz"), "{large}");
    assert!(
        open_error(Config {
            rate_hz: 29.97,
            ..config()
        })
        .contains("expected an integer")
    );
    assert!(
        open_error(Config {
            format: Some(V4l2Format::Grey),
            ..config()
        })
        .contains("grey")
    );
}
