//! Opens the bundled page in a real browser during a preview: live images, the robot and the list of
//! devices are shown, and nothing about models.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::robot;
use kinematics::{Stamp, Transform};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use viz::{
    Advice, DeviceState, DeviceStatus, Hub, Identity, LiveImage, LivePixels, ModelStatus,
    OperatorStatus, PreviewStatus, SceneBounds, SceneHint, Server, ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
const IMAGE_PX: [u32; 2] = [64, 48];
/// Minimum number of pixels in which the robot's yellow is visible, of about 300,000 of the view.
const MIN_ROBOT_PX: usize = 200;

fn device(name: &str, state: DeviceState) -> DeviceStatus {
    DeviceStatus {
        name: name.to_owned(),
        state,
        ..DeviceStatus::default()
    }
}

fn preview(devices: Vec<DeviceStatus>) -> Status {
    Status {
        state: "preview".to_owned(),
        preview: Some(PreviewStatus { devices }),
        operator: OperatorStatus {
            identity: Some(Identity {
                rig: Some("desk".to_owned()),
                robot: Some("bench".to_owned()),
                run: None,
            }),
            advice: Some(Advice {
                text: "Preview: nothing is trained, and nothing is written.".to_owned(),
                is_warning: false,
            }),
            ..OperatorStatus::default()
        },
        ..Status::default()
    }
}

/// Sends images of two cameras and states of the robot until it is dropped.
struct Devices {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Devices {
    fn start(hub: &Hub) -> Self {
        let stop: Arc<AtomicBool> = Arc::default();
        let is_stopped = Arc::clone(&stop);
        let hub = hub.clone();
        let thread = std::thread::spawn(move || {
            let mut ix: i64 = 0;
            while !is_stopped.load(Ordering::Relaxed) {
                // The pose of only one of the cameras is known.
                for (camera, pose) in [("front", Some(Transform::identity())), ("side", None)] {
                    hub.set_live_image(image(camera, ix, pose));
                }
                hub.set_robot_state(robot::state(0.3));
                ix += 1;
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        Self {
            stop,
            thread: Some(thread),
        }
    }
}

impl Drop for Devices {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            assert!(thread.join().is_ok() || std::thread::panicking());
        }
    }
}

fn image(camera: &str, ix: i64, world_from_camera: Option<Transform>) -> LiveImage {
    let n = IMAGE_PX[0] as usize * IMAGE_PX[1] as usize;
    LiveImage {
        camera: camera.into(),
        stamp: Stamp(ix),
        captured_at: Instant::now(),
        size_px: IMAGE_PX,
        pixels: LivePixels::Rgb(vec![180; 3 * n].into()),
        world_from_camera,
        focal_px: [64.0; 2],
        principal_px: [32.0, 24.0],
    }
}

/// Whether an element is visible; false while the page loads.
fn is_visible(browser: &mut Browser, selector: &str) -> bool {
    browser.evaluate(&format!(
        "document.querySelector('{selector}')?.checkVisibility() ?? false"
    )) == true
}

fn n_robot_px(browser: &mut Browser) -> usize {
    let is_yellow = |pixel: &image::Rgb<u8>| {
        let [red, green, blue] = pixel.0.map(f64::from);
        red > 40.0 && green > 0.6 * red && red > 0.7 * green && blue < 0.5 * green
    };
    let shot = canvas_shot(browser);
    shot.pixels().filter(|pixel| is_yellow(pixel)).count()
}

#[test]
fn a_preview_shows_images_the_robot_and_devices_but_no_model() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_robot(robot::description());
    let hint = SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.6,
        world_from_camera: Transform::identity(),
    };
    let bounds = SceneBounds {
        min_m: [-0.3; 3],
        max_m: [0.3; 3],
    };
    hub.set_scene(hint, bounds);
    let camera = DeviceStatus {
        rate_hz: Some(30.0),
        expected_hz: Some(30.0),
        age_millis: Some(33.0),
        ..device("camera \"front\"", DeviceState::Delivering)
    };
    let missing = DeviceStatus {
        reason: "no V4L2 camera named \"0x3\" is connected".to_owned(),
        ..device("camera \"top\"", DeviceState::Failed)
    };
    hub.set_status(preview(vec![
        camera.clone(),
        missing,
        device("arm", DeviceState::Opening),
    ]));
    let listen = ([127, 0, 0, 1], 0).into();
    let server = Server::start(ServerConfig { listen }, hub.clone()).expect("a free port");
    let devices = Devices::start(&hub);
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);

    wait_for(&mut browser, "the state of each device", |browser| {
        let text = browser.text("devices-card");
        [
            "1 of 3 deliver",
            "30.0 Hz, 33 ms old",
            "trying again",
            "\"0x3\" is connected",
            "opening",
        ]
        .iter()
        .all(|words| text.contains(words))
    });
    wait_for(&mut browser, "the header of a preview", |browser| {
        browser.text("state") == "preview"
            && browser.text("advice").contains("nothing is trained")
            && browser.text("rig").contains("desk")
    });
    wait_for(&mut browser, "images of both cameras", |browser| {
        browser.evaluate("document.querySelectorAll('#live figure canvas[width=\"64\"]').length")
            == 2
    });
    // The robot is drawn although there is no picture of a model, and nothing covers it.
    wait_for(&mut browser, "the robot", |browser| {
        n_robot_px(browser) > MIN_ROBOT_PX
    });
    for hidden in [
        "#model-card",
        "#training",
        "#keyframes-card",
        "#skeleton",
        "#toggle-measure",
        "#toggle-crop",
        "#look-nearest",
        "#picture-text",
    ] {
        assert!(!is_visible(&mut browser, hidden), "{hidden} is visible");
    }
    // Before the first status, the page may have requested pictures. The server takes the next
    // request of a client when the one before is answered.
    let mut n_quiet = 0;
    while n_quiet < 10 {
        browser.next_frame();
        n_quiet += 1;
        while let Some(pending) = hub.pictures().next_request() {
            pending.fail("there is no model");
            n_quiet = 0;
        }
    }
    browser.click("look-top");
    browser.next_frame();
    wait_for(&mut browser, "the view from above", |browser| {
        n_robot_px(browser) > MIN_ROBOT_PX
    });
    let requested = hub.pictures().next_request();
    assert!(
        requested.is_none(),
        "a preview has no model, but the page requests {:?}",
        requested.as_ref().map(|pending| &pending.request)
    );

    // The missing camera was plugged in, and is slow.
    let slow = DeviceStatus {
        rate_hz: Some(12.0),
        ..camera.clone()
    };
    let top = DeviceStatus {
        name: "camera \"top\"".to_owned(),
        ..slow
    };
    hub.set_status(preview(vec![camera, top]));
    wait_for(&mut browser, "the camera that was plugged in", |browser| {
        let text = browser.text("devices-card");
        text.contains("12.0 of 30.0 Hz") && !text.contains("trying again")
    });

    // A run with the same hub has a model again.
    hub.set_status(Status {
        state: "training".to_owned(),
        model: ModelStatus {
            method: "splat".to_owned(),
            ..ModelStatus::default()
        },
        ..Status::default()
    });
    wait_for(&mut browser, "the cards of a model", |browser| {
        is_visible(browser, "#model-card")
            && is_visible(browser, "#toggle-measure")
            && !is_visible(browser, "#devices-card")
    });
    wait_for(&mut browser, "a request for a picture", |_| {
        hub.pictures().next_request().is_some()
    });
    drop(devices);
    drop(browser);
}
