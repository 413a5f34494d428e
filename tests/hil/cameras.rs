//! Tests of the V4L2 driver against vivid, inside the virtual kernel. There are two devices:
//! `vivid-000` is a webcam, `vivid-001` a television grabber.
//!
//! vivid has no exposure control and no MJPEG; unit tests cover both.

use drivers::v4l2::{self, Config, Delivery, Settings, V4l2Camera, V4l2Format};
use drivers::{Camera, CameraCounts, Error, Image};
use kinematics::{Intrinsics, Lens};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

pub(crate) const WEBCAM: &str = "platform:vivid-000";
const GRABBER: &str = "platform:vivid-001";
/// Fault injection controls of vivid (`vivid-ctrls.c`): one drops a percentage of the images, the
/// other disconnects the device.
pub(crate) const DROP_PERCENT: u32 = 0x00f0_f040;
const DISCONNECT: u32 = 0x00f0_f041;
/// These fault injection controls damage the next image, reject the next stream, or break the
/// running stream.
const DAMAGE: u32 = 0x00f0_f042;
const REFUSE_STREAM: u32 = 0x00f0_f045;
const BREAK_STREAM: u32 = 0x00f0_f046;
/// Drift of the stamps relative to the sequence numbers, in periods, that may occur without a
/// miscount. A miscount changes the drift by a whole period. vivid stamps images up to one tick of
/// the kernel late, which is a quarter of a period.
const DRIFT_RANGE: std::ops::RangeInclusive<f64> = -0.3..=0.3;
/// V4L2 ids of gain and brightness, and values other than the defaults.
const GAIN: u32 = 0x0098_0913;
const BRIGHTNESS: u32 = 0x0098_0900;
const SETTINGS: Settings = Settings {
    exposure_micros: None,
    gain: Some(77),
    white_balance_kelvin: None,
    brightness: Some(99),
};

pub(crate) fn config(device: &str, size_px: [u32; 2], rate_hz: f64) -> Config {
    Config {
        name: "front".into(),
        device: device.into(),
        format: None,
        intrinsics: Intrinsics {
            size_px,
            focal_px: [500.0; 2],
            principal_px: size_px.map(|side| f64::from(side) / 2.0),
            lens: Lens::Pinhole,
            rectified: true,
        },
        rate_hz,
        meters_per_count: None,
        settings: Settings::default(),
        delivery: Delivery::Every,
        reconnect_for: Duration::from_secs(5),
    }
}

/// Current node of a device. Its number may change after reconnecting.
pub(crate) fn node(bus: &str) -> PathBuf {
    v4l2::cameras()
        .into_iter()
        .flatten()
        .find(|found| found.bus == bus)
        .expect("vivid is loaded")
        .node
}

/// Images captured in a period of time.
struct CapturedImages {
    images: Vec<Image>,
    elapsed: Duration,
}

impl CapturedImages {
    /// Captures images for `seconds`. Only the first keeps its pixels.
    fn capture(camera: &mut V4l2Camera, seconds: f64) -> Self {
        let start_time = Instant::now();
        let mut images = Vec::new();
        while start_time.elapsed().as_secs_f64() < seconds {
            let mut image = camera
                .next_image(Duration::from_secs(2))
                .expect("vivid streams");
            if !images.is_empty() {
                image.data = [].into();
            }
            images.push(image);
        }
        Self {
            images,
            elapsed: start_time.elapsed(),
        }
    }

    /// Returns the numbers of delivered and lost images after the first one. Checks them against
    /// the stamps, which are independent of the sequence numbers.
    fn report(&self, what: &str, rate_hz: f64) -> (u64, u64) {
        let first = self.images[0].stamp;
        let mut number = 0;
        // Delay of each image relative to its sequence number, in periods. A miscount shifts all
        // later images by one.
        let delays: Vec<f64> = (self.images.iter().enumerate())
            .map(|(ix, image)| {
                number += if ix == 0 { 0 } else { 1 + image.n_skipped };
                (image.stamp.0 - first.0) as f64 * 1e-9 * rate_hz - number as f64
            })
            .collect();
        let n_third = delays.len().div_ceil(3);
        let min = |delays: &[f64]| delays.iter().copied().fold(f64::INFINITY, f64::min);
        let drift = min(&delays[delays.len() - n_third..]) - min(&delays[..n_third]);
        let delivered = self.images.len() as u64 - 1;
        let n_lost = number - delivered;
        println!(
            "{what}: {delivered} images and {n_lost} lost ones in {:.2?}; drift of the stamps {drift:+.2} periods",
            self.elapsed
        );
        assert!(
            DRIFT_RANGE.contains(&drift),
            "{what}: the number of lost images does not match the stamps"
        );
        let in_order = self
            .images
            .windows(2)
            .all(|pair| pair[0].stamp < pair[1].stamp);
        assert!(in_order, "{what}: stamps decrease");
        (delivered, n_lost)
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn every_lost_image_is_counted() {
    // At 1080p, vivid is slow as a webcam, but not as a grabber.
    for (device, size_px) in [(WEBCAM, [640, 360]), (GRABBER, [1920, 1080])] {
        let rate_hz = 25.0;
        let mut camera = V4l2Camera::open(config(device, size_px, rate_hz)).expect("vivid opens");
        let what = format!("{device} {}x{} at {rate_hz} Hz", size_px[0], size_px[1]);
        let captured = CapturedImages::capture(&mut camera, 10.0);
        let (delivered, n_lost) = captured.report(&what, rate_hz);
        let CameraCounts {
            n_images,
            n_skipped,
            n_reconnections,
        } = camera.counts();
        assert_eq!(
            (n_images, n_lost, camera.n_damaged(), n_reconnections),
            (delivered + 1, 0, 0, 0)
        );
        assert_eq!(n_skipped, n_lost + captured.images[0].n_skipped);
        let first = &captured.images[0];
        assert_eq!(
            first.decode_rgb().expect("raw pixels").len(),
            size_px.map(|side| side as usize).iter().product::<usize>() * 3
        );
    }
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn injected_drops_are_counted_exactly() {
    let rate_hz = 25.0;
    let mut camera = V4l2Camera::open(config(WEBCAM, [640, 360], rate_hz)).expect("vivid opens");
    v4l2::set_control(&node(WEBCAM), DROP_PERCENT, 30).expect("vivid injects faults");
    let (delivered, n_lost) =
        CapturedImages::capture(&mut camera, 12.0).report("30 % dropped", rate_hz);
    v4l2::set_control(&node(WEBCAM), DROP_PERCENT, 0).expect("vivid injects faults");
    let share = n_lost as f64 / (delivered + n_lost) as f64;
    // The limits are four standard deviations of 300 Bernoulli trials at 30 %.
    assert!(
        (0.19..0.41).contains(&share),
        "lost a fraction of {share:.2}"
    );
}

/// Time since a fault, after which the camera delivers images again.
fn time_to_recover(what: &str, faulted_at: Instant) -> Duration {
    let duration = faulted_at.elapsed();
    println!("{what}: recovered after {duration:.0?}");
    assert!(duration < Duration::from_secs(1), "{what}: {duration:?}");
    duration
}

/// Waits for an image after a fault.
fn recovered_image(camera: &mut V4l2Camera, start_time: Instant) -> Image {
    loop {
        match camera.next_image(Duration::from_millis(100)) {
            Ok(image) => return image,
            Err(Error::NoImage { .. } | Error::Reconnecting { .. }) => {
                assert!(start_time.elapsed() < Duration::from_secs(30))
            }
            Err(other) => panic!("{other}"),
        }
    }
}

pub(crate) fn write_driver_action(action: &str) {
    fs::write(
        Path::new("/sys/bus/platform/drivers/vivid").join(action),
        "vivid.0",
    )
    .expect("vivid can be (un)bound");
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn unplugged_camera_reconnects_with_all_settings() {
    let rate_hz = 25.0;
    let mut camera = V4l2Camera::open(Config {
        settings: SETTINGS,
        ..config(WEBCAM, [640, 360], rate_hz)
    })
    .expect("vivid opens");
    let assert_settings = |camera: &V4l2Camera| {
        let read_back_values: BTreeMap<_, _> = camera.read_back().iter().copied().collect();
        assert_eq!(
            (
                read_back_values["v4l2.gain"],
                read_back_values["v4l2.brightness"]
            ),
            (77, 99),
            "values read back by the driver"
        );
        let node = node(WEBCAM);
        assert_eq!(v4l2::control(&node, GAIN).expect("vivid has gain"), 77);
        assert_eq!(
            v4l2::control(&node, BRIGHTNESS).expect("vivid has brightness"),
            99
        );
    };
    CapturedImages::capture(&mut camera, 0.5);
    assert_settings(&camera);

    for n_before in 0..3 {
        v4l2::set_control(&node(WEBCAM), DISCONNECT, 1).expect("vivid injects faults");
        // Images captured before the fault may still arrive.
        let start_time = Instant::now();
        let image = loop {
            let image = recovered_image(&mut camera, start_time);
            if camera.counts().n_reconnections > n_before {
                break image;
            }
        };
        let max_lost = time_to_recover("disconnected", start_time).as_secs_f64() * rate_hz + 1.0;
        assert!(
            image.n_skipped as f64 <= max_lost,
            "{} images counted as lost, at most {max_lost}",
            image.n_skipped
        );
        assert_settings(&camera);
    }

    write_driver_action("unbind");
    let unplugged_at = Instant::now();
    while !matches!(
        camera.next_image(Duration::from_millis(50)),
        Err(Error::Reconnecting { .. })
    ) {
        assert!(
            unplugged_at.elapsed() < Duration::from_secs(30),
            "the driver did not detect the outage"
        );
    }
    let detected_after = unplugged_at.elapsed();
    assert!(
        detected_after < Duration::from_secs(2),
        "{detected_after:?}"
    );
    std::thread::sleep(Duration::from_secs(1).saturating_sub(detected_after));
    write_driver_action("bind");
    let bound_at = Instant::now();
    let image = recovered_image(&mut camera, bound_at);
    time_to_recover("connected again", bound_at);
    // The camera is missing for at least one second, plus the time to bind it.
    let max_lost = unplugged_at.elapsed().as_secs_f64() * rate_hz + 10.0;
    let lost_range = 20.0..=max_lost;
    assert!(
        lost_range.contains(&(image.n_skipped as f64)),
        "{} images lost, expected {lost_range:?}",
        image.n_skipped
    );
    assert_settings(&camera);
    CapturedImages::capture(&mut camera, 2.0).report("after reconnecting", rate_hz);
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn missing_camera_is_an_error_after_timeout() {
    let wait = Duration::from_secs(1);
    let mut camera = V4l2Camera::open(Config {
        reconnect_for: wait,
        ..config(WEBCAM, [320, 180], 25.0)
    })
    .expect("vivid opens");
    CapturedImages::capture(&mut camera, 0.2);
    write_driver_action("unbind");
    let start_time = Instant::now();
    let error = loop {
        match camera.next_image(Duration::from_millis(100)) {
            Ok(_) | Err(Error::Reconnecting { .. }) => {
                assert!(
                    start_time.elapsed() < 30 * wait,
                    "the driver did not give up"
                )
            }
            Err(error) => break error.to_string(),
        }
    };
    let given_up_after = start_time.elapsed();
    write_driver_action("bind");
    println!("not reconnected: {error}");
    assert!(
        error.contains("\"front\"") && error.contains("did not reconnect within"),
        "{error}"
    );
    assert!(
        given_up_after >= wait && given_up_after < 2 * wait,
        "{given_up_after:?}"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn silent_camera_is_restarted_and_then_given_up() {
    let wait = Duration::from_secs(5);
    let mut camera = V4l2Camera::open(Config {
        reconnect_for: wait,
        ..config(WEBCAM, [320, 180], 25.0)
    })
    .expect("vivid opens");
    CapturedImages::capture(&mut camera, 0.2);
    let set_drop_percent = |percent| {
        v4l2::set_control(&node(WEBCAM), DROP_PERCENT, percent).expect("vivid injects faults")
    };
    // If the camera is silent for three seconds, the driver restarts it after two, and it recovers.
    set_drop_percent(100);
    let start_time = Instant::now();
    while start_time.elapsed() < Duration::from_secs(3) {
        let result = camera.next_image(Duration::from_millis(100));
        assert!(
            matches!(
                result,
                Ok(_) | Err(Error::NoImage { .. } | Error::Reconnecting { .. })
            ),
            "{result:?}"
        );
    }
    set_drop_percent(0);
    let image = recovered_image(&mut camera, Instant::now());
    let secs = start_time.elapsed().as_secs_f64();
    println!(
        "silent: restarted {} times, {} images lost in {secs:.2} s",
        camera.counts().n_reconnections,
        image.n_skipped
    );
    assert_eq!(camera.counts().n_reconnections, 1);
    let lost_range = 70.0..=25.0 * secs + 10.0;
    assert!(
        lost_range.contains(&(image.n_skipped as f64)),
        "{} lost, expected {lost_range:?}",
        image.n_skipped
    );
    // If the camera stays silent, the driver reopens it repeatedly and then gives up.
    set_drop_percent(100);
    let start_time = Instant::now();
    let error = loop {
        match camera.next_image(Duration::from_millis(100)) {
            Ok(_) | Err(Error::NoImage { .. } | Error::Reconnecting { .. }) => {
                assert!(start_time.elapsed() < 12 * wait)
            }
            Err(error) => break error.to_string(),
        }
    };
    set_drop_percent(0);
    println!("silent forever: {error}");
    assert!(
        error.contains("did not reconnect within")
            && error.contains("it sent no complete image for"),
        "{error}"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn damaged_images_and_broken_streams_are_counted_and_recovered() {
    let rate_hz = 25.0;
    let mut camera = V4l2Camera::open(config(WEBCAM, [640, 360], rate_hz)).expect("vivid opens");
    let mut captured = CapturedImages::capture(&mut camera, 0.3);
    for _ in 0..3 {
        v4l2::set_control(&node(WEBCAM), DAMAGE, 1).expect("vivid injects faults");
        captured
            .images
            .extend(CapturedImages::capture(&mut camera, 0.3).images);
    }
    let (_, n_lost) = captured.report("three damaged images", rate_hz);
    assert_eq!(camera.n_damaged(), 3);
    assert_eq!(n_lost, 3);
    assert_eq!(
        camera.counts().n_reconnections,
        0,
        "a damaged image does not restart the stream"
    );

    v4l2::set_control(&node(WEBCAM), BREAK_STREAM, 1).expect("vivid injects faults");
    let broken_at = Instant::now();
    recovered_image(&mut camera, broken_at);
    time_to_recover("failed stream", broken_at);
    assert_eq!(camera.counts().n_reconnections, 1);
    drop(camera);

    v4l2::set_control(&node(WEBCAM), REFUSE_STREAM, 1).expect("vivid injects faults");
    let open_error = V4l2Camera::open(config(WEBCAM, [640, 360], rate_hz))
        .expect_err("vivid rejects the stream")
        .to_string();
    println!("{open_error}");
    assert!(
        open_error.contains("\"front\": it rejected the start of its stream"),
        "{open_error}"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn all_formats_show_the_same_picture() {
    use V4l2Format::{Bgr, Grey, Nv12, Rgb, Uyvy, Yuyv};
    // vivid applies brightness differently in each format; this value has no effect.
    const PLAIN: Settings = Settings {
        brightness: Some(128),
        ..SETTINGS
    };
    let size_px = [640, 360];
    let picture = |format| {
        let config = Config {
            format: Some(format),
            settings: PLAIN,
            ..config(WEBCAM, size_px, 25.0)
        };
        let mut camera = V4l2Camera::open(config).expect("vivid has this format");
        camera
            .next_image(Duration::from_secs(2))
            .expect("vivid streams")
            .decode_rgb()
            .expect("raw pixels")
    };
    let rgb = picture(Rgb);
    // The image has eight bars with text above: sample one pixel from the center of each bar, low
    // in the image.
    let bars = |rgb: &[u8]| -> Vec<u8> {
        (0..8)
            .flat_map(|bar| rgb[(330 * 640 + bar * 80 + 40) * 3..][..3].to_vec())
            .collect()
    };
    let expected = bars(&rgb);
    assert_eq!(
        expected.chunks_exact(3).collect::<BTreeSet<_>>().len(),
        8,
        "{expected:?}"
    );
    for format in [Bgr, Yuyv, Uyvy, Nv12] {
        let got = bars(&picture(format));
        let max_difference = expected.iter().zip(&got).map(|(a, b)| a.abs_diff(*b)).max();
        println!(
            "{}: maximum difference {max_difference:?} of 255",
            format.name()
        );
        // Covers rounding errors of the conversion to limited range and back.
        assert!(
            max_difference <= Some(3),
            "{}: {expected:?}, got {got:?}",
            format.name()
        );
    }
    let gray = bars(&picture(Grey));
    let is_gray = gray
        .chunks_exact(3)
        .all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]);
    let falls = gray
        .chunks_exact(3)
        .collect::<Vec<_>>()
        .windows(2)
        .all(|pair| pair[0][0] > pair[1][0]);
    println!(
        "gray: {:?}",
        gray.chunks_exact(3)
            .map(|pixel| pixel[0])
            .collect::<Vec<_>>()
    );
    assert!(
        is_gray && falls,
        "the bars are not ordered from bright to dark: {gray:?}"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn newest_image_is_delivered_if_configured() {
    let rate_hz = 25.0;
    let deliver = |delivery| {
        let mut camera = V4l2Camera::open(Config {
            delivery,
            ..config(WEBCAM, [640, 360], rate_hz)
        })
        .expect("vivid opens");
        let (mut images, mut ages_secs) = (Vec::new(), Vec::new());
        for _ in 0..8 {
            std::thread::sleep(Duration::from_millis(200));
            let image = camera
                .next_image(Duration::from_secs(2))
                .expect("vivid streams");
            ages_secs.push((drivers::clock::now().0 - image.stamp.0) as f64 * 1e-9);
            images.push(image);
        }
        let captured = CapturedImages {
            images,
            elapsed: Duration::default(),
        };
        (
            captured.report(&format!("{delivery:?}, every 200 ms"), rate_hz),
            ages_secs,
        )
    };
    let ((_, n_lost), ages_secs) = deliver(Delivery::Newest);
    assert!(
        n_lost >= 20,
        "{n_lost} images lost at five images per 200 ms"
    );
    assert!(
        ages_secs.iter().all(|age_secs| *age_secs < 0.05),
        "the newest images are {ages_secs:?} s old"
    );
    let (_, ages_secs) = deliver(Delivery::Every);
    assert!(
        ages_secs[7] > 0.2,
        "the oldest queued images are only {ages_secs:?} s old"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn images_before_first_read_are_not_counted_as_lost() {
    let mut camera = V4l2Camera::open(config(WEBCAM, [640, 360], 25.0)).expect("vivid opens");
    // Simulates other devices that take time to open. Meanwhile, the eight buffers fill up and
    // later images are dropped.
    std::thread::sleep(Duration::from_secs(1));
    let asked_at = drivers::clock::now();
    let captured = CapturedImages::capture(&mut camera, 0.5);
    assert_eq!(captured.images[0].n_skipped, 0);
    assert!(
        captured.images[0].stamp > asked_at,
        "the image was captured before the first read"
    );
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn unsupported_mode_error_lists_supported_modes() {
    let open_error = |config| {
        V4l2Camera::open(config)
            .expect_err("vivid does not support this")
            .to_string()
    };
    let size = open_error(config(WEBCAM, [800, 600], 25.0));
    println!("{size}");
    assert!(
        size.contains("color 800x600 at 25 Hz") && size.contains("640x360 up to 40 Hz"),
        "{size}"
    );
    let fast = open_error(config(WEBCAM, [1920, 1080], 60.0));
    assert!(fast.contains("1920x1080 at 60 Hz"), "{fast}");
    let jpeg = open_error(Config {
        format: Some(V4l2Format::Mjpeg),
        ..config(WEBCAM, [640, 360], 25.0)
    });
    assert!(jpeg.contains("mjpeg 640x360"), "{jpeg}");
    let balance = Settings {
        white_balance_kelvin: Some(4600),
        ..Settings::default()
    };
    let balance = open_error(Config {
        settings: balance,
        ..config(WEBCAM, [640, 360], 25.0)
    });
    assert!(
        balance.contains("no control for v4l2.white_balance_kelvin"),
        "{balance}"
    );
    let gain = open_error(Config {
        settings: Settings {
            gain: Some(300),
            ..SETTINGS
        },
        ..config(WEBCAM, [640, 360], 25.0)
    });
    assert!(
        gain.contains("v4l2.gain is 300, allowed: 0 to 255"),
        "{gain}"
    );
    let _streams = V4l2Camera::open(config(WEBCAM, [640, 360], 25.0)).expect("vivid opens");
    let busy = open_error(config(WEBCAM, [640, 360], 25.0));
    println!("{busy}");
    assert!(busy.contains("another program uses it"), "{busy}");
}

#[test]
#[ignore = "runs in the virtual kernel"]
fn program_lists_and_records_camera() {
    let fieldrig = |args: &[&str]| {
        let output = Command::new("/bin/fieldrig")
            .args(args)
            .current_dir("/tmp")
            .output()
            .expect("fieldrig starts");
        let text = String::from_utf8_lossy(&output.stdout).into_owned()
            + &String::from_utf8_lossy(&output.stderr);
        println!("fieldrig {}:\n{text}", args.join(" "));
        (output.status.code(), text)
    };
    let (code, text) = fieldrig(&["devices"]);
    assert_eq!(code, Some(0));
    assert!(
        text.contains(WEBCAM) && text.contains(GRABBER),
        "both cameras are listed with a stable name"
    );
    assert!(
        text.contains("vcan0"),
        "the CAN bus created by the start script is listed"
    );
    let (_, text) = fieldrig(&["doctor"]);
    assert!(text.contains("cameras"), "{text}");
    let (code, text) = fieldrig(&[
        "record",
        "/rigs/vivid.toml",
        "--out",
        "/tmp/vivid.mcap",
        "--seconds",
        "4",
        "--json",
    ]);
    assert_eq!(code, Some(0));
    let summary = text
        .lines()
        .find(|line| line.contains("\"done\""))
        .expect("a summary");
    let summary: serde_json::Value = serde_json::from_str(summary).expect("JSON");
    let number = |key: &str| summary[key].as_u64().expect("a number");
    let (images, n_lost) = (number("images"), number("images_dropped_by_devices"));
    assert!(
        (98..=103).contains(&images) && n_lost == 0,
        "{images} images and {n_lost} lost in 4 s at 25 Hz"
    );
    let node = node(WEBCAM);
    assert_eq!(
        (
            v4l2::control(&node, GAIN).ok(),
            v4l2::control(&node, BRIGHTNESS).ok()
        ),
        (Some(77), Some(99))
    );
    let mut recording =
        drivers::recording::Recording::open(Path::new("/tmp/vivid.mcap")).expect("a recording");
    let mut n_read = 0;
    while let Some(sample) = drivers::Source::next_sample(&mut recording).expect("readable") {
        if let drivers::Sample::Image(image) = sample {
            n_read += 1;
            assert_eq!(
                image.exposure_secs,
                Some(0.004),
                "vivid has no exposure control, so the value of the rig file is used"
            );
            assert_eq!(image.decode_rgb().expect("uyvy").len(), 640 * 360 * 3);
        }
    }
    assert_eq!(n_read, images);
}
