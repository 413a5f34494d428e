//! Measures the tasks of the page's main thread while it receives the data of a run.
//!
//! WebGL calls draw nothing, because drawing on the CPU would dominate the tasks. Skipped, with
//! a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use crate::robot;
use kinematics::{Stamp, Transform};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use trainer::Picture;
use viz::{Hub, KeyframePose, LiveImage, LivePixels, ModelStatus, SceneHint, Status};

const WINDOW_PX: [u32; 2] = [1280, 720];
const N_KEYFRAMES: i64 = 400;
const DURATION: Duration = Duration::from_secs(8);
/// Limit of the 99th percentile of the CPU time of tasks, relative to fixed work on the same page.
/// The ratio does not depend on the speed of the computer.
const MAX_P99: f64 = 1.2;

fn keyframe(stamp: i64) -> KeyframePose {
    KeyframePose {
        camera: "wrist".into(),
        stamp: Stamp(stamp),
        world_from_camera: Transform::translation(
            f64::from(i32::try_from(stamp).expect("small")) * 1e-3,
            0.0,
            0.5,
        ),
        size_px: [640, 480],
        focal_px: [600.0; 2],
        principal_px: [320.0, 240.0],
    }
}

/// Publishes robot states at 60 Hz, images at 15 Hz, and a keyframe and a status per second.
fn publish(hub: &Hub, is_over: &AtomicBool) {
    let rgb: std::sync::Arc<[u8]> = (0..640 * 480 * 3_u32)
        .map(|ix| (ix.wrapping_mul(2_654_435_761) >> 29) as u8)
        .collect();
    let started = Instant::now();
    for tick in 0.. {
        if is_over.load(Ordering::Relaxed) {
            return;
        }
        hub.set_robot_state(robot::state(started.elapsed().as_secs_f64()));
        if tick % 4 == 0 {
            hub.set_live_image(LiveImage {
                camera: "wrist".into(),
                stamp: Stamp(tick),
                captured_at: Instant::now(),
                size_px: [640, 480],
                pixels: LivePixels::Rgb(rgb.clone()),
                world_from_camera: Some(keyframe(tick).world_from_camera),
                focal_px: [600.0; 2],
                principal_px: [320.0, 240.0],
            });
        }
        if tick % 60 == 0 {
            hub.keyframes()
                .set((0..=N_KEYFRAMES + tick / 60).map(keyframe).collect());
            let psnr_history = (0..512)
                .map(|n| (f64::from(n) * 1.37, 20.0 + f64::from(n) * 0.0123))
                .collect();
            let model = ModelStatus {
                step: tick.unsigned_abs(),
                psnr_history,
                ..ModelStatus::default()
            };
            hub.set_status(Status {
                state: "training".to_owned(),
                model,
                ..Status::default()
            });
        }
        std::thread::sleep(Duration::from_millis(16));
    }
}

/// Delivers pictures; those of the same size are equal, because the view does not move.
fn deliver(hub: &Hub, is_over: &AtomicBool) {
    let mut drawn: BTreeMap<[u32; 2], Picture> = BTreeMap::new();
    while !is_over.load(Ordering::Relaxed) {
        hub.pictures().wait_for_request(Duration::from_millis(50));
        if let Some(pending) = hub.pictures().next_request() {
            let picture = drawn
                .entry(pending.request.size_px)
                .or_insert_with(|| analytic_scene::draw(&pending.request));
            pending.deliver(picture.clone());
        }
    }
}

/// Sets a flag when it is dropped, also after a failure.
struct SetAtEnd<'a>(&'a AtomicBool);

impl Drop for SetAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn tasks_of_the_main_thread_are_short() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_robot(robot::description());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: analytic_scene::looking_along_y(),
    });
    let server = serve(&hub);
    let is_over = AtomicBool::new(false);
    let tasks = std::thread::scope(|scope| {
        let _at_end = SetAtEnd(&is_over);
        scope.spawn(|| publish(&hub, &is_over));
        scope.spawn(|| deliver(&hub, &is_over));
        let mut browser = Browser::open_with(&program, &server.url(), WINDOW_PX, NO_DRAWING);
        wait_for(&mut browser, "a full picture", |browser| {
            browser.text("picture-text").contains("100 %")
        });
        let tasks = browser.trace_tasks(DURATION);
        assert!(
            browser.text("picture-text").contains("100 %"),
            "pictures still arrive"
        );
        assert!(
            browser.evaluate("document.querySelectorAll('#live canvas').length") == 1,
            "images arrive"
        );
        tasks
    });
    let p99 = tasks.relative_p99();
    assert!(
        p99 < MAX_P99,
        "the 99th percentile is {p99:.2} times the fixed work"
    );
}
