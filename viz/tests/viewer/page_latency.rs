//! The page shows and reports how long keyframes take from the camera to the screen.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use viz::{Hub, ModelStatus, NewestKeyframe, SceneHint, ShownPicture, Status, TrainedKeyframes};

const WINDOW_PX: [u32; 2] = [640, 400];
/// Age of a keyframe when it is added to the model.
const AGE: Duration = Duration::from_millis(250);

/// A model in training whose keyframes the test adds.
struct Model {
    hub: Hub,
    keyframes: Mutex<TrainedKeyframes>,
    n_drawn: AtomicU64,
    is_over: AtomicBool,
}

impl Model {
    /// Trains, and draws requested pictures.
    fn run(&self) {
        for step in 0.. {
            if self.is_over.load(Ordering::Relaxed) {
                return;
            }
            let model = ModelStatus {
                step,
                ..ModelStatus::default()
            };
            self.hub.set_status(Status {
                state: "training".to_owned(),
                model,
                ..Status::default()
            });
            self.hub
                .pictures()
                .wait_for_request(Duration::from_millis(20));
            if let Some(pending) = self.hub.pictures().next_request() {
                let keyframes = *self.keyframes.lock().expect("no panic");
                let picture = analytic_scene::draw(&pending.request);
                pending.of_keyframes(keyframes).deliver(picture);
                self.n_drawn.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    fn add_keyframe(&self) {
        let added_at = Instant::now();
        let captured_at = added_at
            .checked_sub(AGE)
            .expect("the machine has run for longer");
        let mut keyframes = self.keyframes.lock().expect("no panic");
        *keyframes = TrainedKeyframes {
            n: keyframes.n + 1,
            newest: Some(NewestKeyframe {
                captured_at,
                added_at,
            }),
        };
    }

    /// Waits until the page has shown another picture.
    fn wait_for_picture(&self, browser: &mut Browser) {
        let n_drawn = self.n_drawn.load(Ordering::Relaxed);
        // The second one was requested after the first one had arrived.
        wait_for(browser, "two pictures", |_| {
            self.n_drawn.load(Ordering::Relaxed) >= n_drawn + 2
        });
        browser.next_frame();
    }
}

/// The duration at the end of a line such as `sending 3 ms`.
fn millis(line: &str) -> f64 {
    let number = line
        .trim_end_matches('.')
        .trim_end_matches(" ms")
        .rsplit(' ')
        .next();
    number
        .and_then(|number| number.parse().ok())
        .unwrap_or_else(|| panic!("no duration in {line:?}"))
}

#[test]
fn time_from_the_camera_to_the_screen_is_shown_and_reported() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let world_from_camera = analytic_scene::looking_along_y();
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera,
    });
    let server = serve(&hub);
    let model = Model {
        hub: hub.clone(),
        keyframes: Mutex::new(TrainedKeyframes { n: 0, newest: None }),
        n_drawn: AtomicU64::new(0),
        is_over: AtomicBool::new(false),
    };
    // The keyframes before the page was opened.
    (0..5).for_each(|_| model.add_keyframe());
    std::thread::scope(|scope| {
        scope.spawn(|| model.run());
        let mut browser = Browser::open_with(&program, &server.url(), WINDOW_PX, NO_DRAWING);
        wait_for(&mut browser, "a full picture", |browser| {
            browser.text("picture-text").contains("100 %")
        });
        model.wait_for_picture(&mut browser);
        assert_eq!(
            browser.text("shown-text"),
            "",
            "the page has not waited for these keyframes"
        );

        wait_for(&mut browser, "a round-trip time", |browser| {
            browser.text("link-text").contains(" ms")
        });
        let link = browser.text("link-text");
        let round_trip = link.split_once(" ms").expect("waited").0;
        // The page's estimate of the server's clock is ahead by less than the round trip of any
        // ping; this one is rounded.
        let clock_error_millis = round_trip.parse::<f64>().expect("a duration") + 0.5;
        let began = Instant::now();
        model.add_keyframe();
        wait_for(&mut browser, "a duration", |browser| {
            browser.text("shown-text").starts_with("camera to screen ")
        });
        let waited_millis = began.elapsed().as_secs_f64() * 1e3;
        let total = millis(&browser.text("shown-text"));
        let age_millis = AGE.as_secs_f64() * 1e3;
        let max_millis = age_millis + waited_millis + clock_error_millis;
        assert!(
            (age_millis..=max_millis).contains(&total),
            "{total} ms, expected at most {max_millis} ms"
        );
        // While the camera stands still, the keyframe gets older, but the latency remains.
        for _ in 0..2 {
            model.wait_for_picture(&mut browser);
        }
        assert!((millis(&browser.text("shown-text")) - total).abs() < 1.0);
        let details = browser.evaluate("document.getElementById('shown-text').title");
        let details = details.as_str().expect("a text");
        let parts: Vec<f64> = details.lines().skip(3).map(millis).collect();
        assert!(
            parts.len() == 4 && (parts.iter().sum::<f64>() - total).abs() <= 2.5,
            "{total} ms: {details}"
        );
        assert!(
            (parts[0] - age_millis).abs() <= 1.0,
            "camera to model: {details}"
        );

        check_reports(&hub.pictures().take_shown(), total);
        model.is_over.store(true, Ordering::Relaxed);
    });
}

/// The run learns about the picture with the new keyframe.
fn check_reports(shown: &[ShownPicture], total_millis: f64) {
    let [picture] = shown else {
        panic!("expected one report: {shown:?}")
    };
    assert_eq!(picture.new_keyframes, 5..6);
    let showing = (picture.shown_at - picture.sent_at).as_secs_f64() * 1e3;
    assert!(
        0.0 < showing && showing < total_millis,
        "{showing} of {total_millis} ms"
    );
}
