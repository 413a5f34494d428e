//! Opens the bundled page in a real browser, and checks that every label describes what is drawn:
//! the picture at random moments, late pictures, old scans and cameras, and the operator's header.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use analytic_scene::looking_along_y;
use keyframe::RangePoints;
use kinematics::{Stamp, Transform};
use nalgebra::{Translation3, Vector3};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use trainer::{Picture, RenderRequest};
use viz::{
    Advice, CheckpointState, Hub, Identity, ImageCounts, KeyframePose, KeyframeStore, LiveImage,
    LivePixels, ModelStatus, OperatorStatus, RangeScan, RequestedCheckpoint, RunResult, SceneHint,
    Server, ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
const PHONE_PX: [u32; 2] = [390, 844];
/// Render time of a stage. Faster pictures would be answered in one stage only.
const DRAWING: Duration = Duration::from_millis(40);
/// The color of all pictures of a model.
const SPLAT_COLOR: [u8; 3] = [210, 60, 40];
const TSDF_COLOR: [u8; 3] = [40, 70, 210];
/// Number of moments at which the label is compared with the requests.
const N_MOMENTS: u32 = 1000;

/// Draws pictures of two models in different colors on a separate thread, like a run.
struct Models {
    /// Whether pictures wait.
    is_paused: Arc<AtomicBool>,
    _thread: RequestThread,
}

impl Models {
    fn start(hub: Hub) -> Self {
        let is_paused: Arc<AtomicBool> = Arc::default();
        let paused = Arc::clone(&is_paused);
        let thread = RequestThread::start(hub, move |pending| {
            std::thread::sleep(DRAWING);
            while paused.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(5));
            }
            let is_tsdf = pending.method() == Some("tsdf");
            let (method, color) = if is_tsdf {
                ("tsdf", TSDF_COLOR)
            } else {
                ("splat", SPLAT_COLOR)
            };
            let picture = colored(&pending.request, color);
            pending.of_model(method, 1520).deliver(picture);
        });
        Self {
            is_paused,
            _thread: thread,
        }
    }

    /// Holds back all pictures, or delivers them.
    fn pause(&self, is_paused: bool) {
        self.is_paused.store(is_paused, Ordering::Relaxed);
    }
}

impl Drop for Models {
    fn drop(&mut self) {
        self.pause(false); // Also in a panic, so that the thread can end.
    }
}

/// A wall of one color in front of the camera.
fn colored(request: &RenderRequest, [red, green, blue]: [u8; 3]) -> Picture {
    let [width, height] = request.size_px;
    let n_px = (width * height) as usize;
    Picture {
        size_px: request.size_px,
        rgba_srgb: [red, green, blue, 255].repeat(n_px),
        depth_m: vec![2.0; n_px],
    }
}

fn model(method: &str) -> ModelStatus {
    ModelStatus {
        method: method.to_owned(),
        step: 1520,
        step_millis: Some(1620.0),
        primitives: 84_512,
        primitives_label: "Splats".to_owned(),
        bytes: 16_649_000,
        psnr: Some(25.6),
        psnr_history: vec![(1.0, 20.0), (50.0, 25.6)],
        ..ModelStatus::default()
    }
}

/// The status of a run that loses most images, and whose store is full.
fn lossy_status() -> Status {
    Status {
        state: "training".to_owned(),
        seconds: 98.4,
        keyframes: 400,
        rejected: [("not_moved".to_owned(), 321), ("blur".to_owned(), 400)].into(),
        model: model("splat"),
        others: vec![model("tsdf")],
        notes: vec!["edited".to_owned(), "no GPU".to_owned()],
        operator: OperatorStatus {
            identity: Some(Identity {
                rig: Some("static-arm".to_owned()),
                robot: Some("panda".to_owned()),
                run: Some("2026-11-28-kitchen".to_owned()),
            }),
            advice: Some(Advice {
                text: "Scanning. 7 of 8 images are lost: lower rate_hz of the cameras".to_owned(),
                is_warning: true,
            }),
            images: Some(ImageCounts {
                received: 2653,
                dropped: 18_343,
                accepted: 1932,
                evicted: 1532,
            }),
            store: Some(KeyframeStore {
                keyframes: 400,
                max_keyframes: 400,
                bytes: 500_000_000,
                max_bytes: 8_000_000_000,
                is_full: true,
            }),
            infos: vec!["edited".to_owned()],
            ..OperatorStatus::default()
        },
        ..Status::default()
    }
}

/// A page of a new server, and what keeps both alive.
struct Page {
    browser: Browser,
    hub: Hub,
    models: Models,
    _server: Server,
}

impl Page {
    fn open(program: &Path) -> Self {
        let hub = Hub::new();
        hub.set_scene_hint(SceneHint {
            center_m: [0.0, 0.0, 0.2],
            radius_m: 0.8,
            world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
        });
        hub.set_status(lossy_status());
        let config = ServerConfig {
            listen: ([127, 0, 0, 1], 0).into(),
        };
        let server = Server::start(config, hub.clone()).expect("a free port");
        let models = Models::start(hub.clone());
        let mut browser = Browser::open(program, &server.url(), WINDOW_PX);
        wait_for(&mut browser, "a complete picture", is_current);
        Self {
            browser,
            hub,
            models,
            _server: server,
        }
    }

    fn close(self) {
        let Self {
            browser, models, ..
        } = self;
        drop(browser);
        drop(models);
    }
}

/// A data attribute of the label of the picture.
fn attribute(browser: &mut Browser, name: &str) -> String {
    let value = browser.evaluate(&format!(
        "document.getElementById('picture-info')?.dataset.{name} ?? ''"
    ));
    value.as_str().unwrap_or_default().to_owned()
}

/// Whether the picture is complete, and of the wanted view and model.
fn is_current(browser: &mut Browser) -> bool {
    attribute(browser, "state") == "current" && browser.text("picture-text").contains("100 %")
}

fn press_model(browser: &mut Browser, method: &str) {
    browser.evaluate(&format!(
        "document.querySelector('#models button[data-method={method}]').click()"
    ));
}

/// The color in the middle of the view.
fn middle(browser: &mut Browser) -> [u8; 3] {
    let shot = canvas_shot(browser);
    shot.get_pixel(shot.width() / 2, shot.height() / 2).0
}

/// Difference between the largest and the smallest channel.
fn colorfulness([red, green, blue]: [u8; 3]) -> u8 {
    red.max(green).max(blue) - red.min(green).min(blue)
}

#[test]
fn the_label_describes_the_drawn_picture_at_any_moment() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let mut page = Page::open(&program);
    check_random_moments(&mut page.browser);
    check_late_picture(&mut page);
    check_other_model(&mut page);
    page.close();
}

/// Changes view and model at random, and compares the label with the requests that the page has
/// sent.
fn check_random_moments(browser: &mut Browser) {
    // A current picture has the view and the model of the newest request. After a change of the
    // model, only answers to later requests are drawn.
    let script = format!(
        "(() => {{
            const asked = {{}};
            let seed = 7; // Constants of Numerical Recipes; products are below 2^53.
            const random = () => (seed = (seed * 1664525 + 1013904223) % 4294967296) / 4294967296;
            let newest = 0, atChange = null;
            const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (text) {{
                const message = JSON.parse(text);
                if (message.type === 'render' && !message.view) {{
                    newest = message.id;
                    asked[newest] = {{ method: message.method ?? 'splat', pose: message.world_from_camera.join() }};
                }}
                return send.call(this, text);
            }};
            const result = window.moments = {{ n: 0, wrong: [], states: {{}}, methods: {{}} }};
            const info = () => {{ const {{ state, method, request, shownRequest }} = document.getElementById('picture-info').dataset;
                return {{ state, method, request: +request, shown: +shownRequest }}; }};
            const check = () => {{
                const now = info(), shown = asked[now.shown], wanted = asked[now.request];
                result.states[now.state] = (result.states[now.state] ?? 0) + 1;
                result.methods[now.method] = (result.methods[now.method] ?? 0) + 1;
                const fail = (what) => result.wrong.push({{ what, ...now, ...shown }});
                if (shown && shown.method !== now.method) fail('method');
                if (now.request !== newest) fail('request');
                if (now.state === 'current' && shown && (shown.pose !== wanted.pose || shown.method !== wanted.method)) fail('current');
                if (atChange && now.shown !== atChange.shown && now.shown <= atChange.request) fail('late stage');
                if (now.state !== 'current' && !document.getElementById('picture-text').textContent.includes('waiting')) fail('text');
            }};
            const actions = ['look-top', 'look-front', 'reset-view'].map((id) => () => document.getElementById(id).click());
            for (const method of ['splat', 'tsdf']) actions.push(() => {{
                const button = document.querySelector(`#models button[data-method=${{method}}]`);
                atChange = info();
                button.click();
            }});
            const moment = () => {{
                if (random() < 0.06) {{
                    actions[Math.floor(random() * actions.length)]();
                    // A change is visible at once, before the next picture is requested.
                    check();
                }}
                check();
                result.n += 1;
                if (result.n < {N_MOMENTS}) setTimeout(moment, random() < 0.02 ? 400 : 12 * random());
                else WebSocket.prototype.send = send;
            }};
            // Earlier requests are unknown here.
            document.getElementById('look-top').click();
            const begin = setInterval(() => {{ if (asked[info().shown]) {{ clearInterval(begin); moment(); }} }}, 20);
            return 0;
        }})()"
    );
    browser.evaluate(&script);
    wait_for(browser, "all moments", |browser| {
        browser.evaluate("window.moments.n") == json!(N_MOMENTS)
    });
    let result = browser.evaluate("window.moments");
    eprintln!("{}, {}", result["states"], result["methods"]);
    assert_eq!(result["wrong"], json!([]), "labels that were wrong");
    let n_of = |group: &str, name: &str| result[group][name].as_u64().unwrap_or_default();
    assert!(
        n_of("states", "current") > 0 && n_of("states", "waiting") + n_of("states", "old") > 0,
        "{}",
        result["states"]
    );
    assert!(n_of("methods", "splat") > 0, "{}", result["methods"]);
    press_model(browser, "splat");
    wait_for(browser, "a complete picture", is_current);
}

/// A picture of another view is labeled as such at once. After a second, it loses its colors.
fn check_late_picture(page: &mut Page) {
    let Page {
        browser, models, ..
    } = page;
    browser.click("toggle-grid");
    browser.click("reset-view");
    wait_for(browser, "a complete picture", is_current);
    assert!(
        colorfulness(middle(browser)) > 120,
        "a current picture has its colors"
    );
    let text = browser.text("picture-text");
    assert!(text.starts_with("splat · "), "{text}");
    models.pause(true);
    let state = browser.evaluate(
        "(() => { document.getElementById('look-front').click(); return document.getElementById('picture-info').dataset.state; })()",
    );
    assert_eq!(state, "waiting", "at once");
    let n_filled = "document.querySelectorAll('.stages i.done').length";
    assert_eq!(browser.evaluate(n_filled), 0, "the marks are hollow");
    wait_for(browser, "an old picture", |browser| {
        attribute(browser, "state") == "old"
    });
    let text = browser.text("picture-text");
    assert!(
        text.starts_with("splat, ") && text.contains(" old · waiting "),
        "{text}"
    );
    browser.click("reset-view"); // The old picture fills the view again.
    let gray = middle(browser);
    assert!(colorfulness(gray) < 40, "{gray:?} of a picture that is old");
    models.pause(false);
    wait_for(browser, "a complete picture", is_current);
    wait_for(browser, "its colors", |browser| {
        colorfulness(middle(browser)) > 120
    });
}

/// A picture of another model is old at once, and keeps the name of its model.
fn check_other_model(page: &mut Page) {
    let Page {
        browser, models, ..
    } = page;
    models.pause(true);
    let shown = browser.evaluate(
        "(() => { document.querySelector('#models button[data-method=tsdf]').click();
        const { state, method } = document.getElementById('picture-info').dataset; return [state, method]; })()",
    );
    assert_eq!(shown, json!(["old", "splat"]));
    models.pause(false);
    wait_for(browser, "a picture of the other model", |browser| {
        is_current(browser) && attribute(browser, "method") == "tsdf"
    });
    assert_eq!(attribute(browser, "step"), "1520");
    wait_for(browser, "its color", |browser| {
        let [red, _, blue] = middle(browser);
        blue > red.saturating_add(100)
    });
    browser.click("toggle-grid");
}

#[test]
fn the_header_and_the_panels_answer_the_questions_of_an_operator() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let mut page = Page::open(&program);
    check_identity(&mut page.browser);
    check_counts(&mut page.browser);
    check_pause(&mut page);
    check_end(&mut page);
    check_ages(&mut page);
    check_stable_images(&mut page);
    check_new_run(&mut page);
    check_saved_model(&mut page);
    check_training_panel(&mut page.browser);
    page.close();
}

/// The page says which robot it shows, what to do, and who is connected.
fn check_identity(browser: &mut Browser) {
    assert_eq!(browser.text("rig"), "static-arm");
    assert_eq!(browser.text("run-name"), "panda · 2026-11-28-kitchen");
    assert_eq!(browser.text("badge"), "S");
    let title = browser.evaluate("document.title");
    assert_eq!(title, "static-arm · training · fieldrig");
    let icon = browser.evaluate("document.querySelector('link[rel=icon]').href");
    let icon = icon.as_str().expect("an address");
    assert!(
        icon.contains("%3ES%3C"),
        "the letter is in the icon: {icon}"
    );
    let advice = "Scanning. 7 of 8 images are lost: lower rate_hz of the cameras";
    assert_eq!(browser.text("advice"), advice);
    let lines = "(() => { const { webkitLineClamp, whiteSpace } = getComputedStyle(document.getElementById('advice')); \
                 return [webkitLineClamp, whiteSpace, document.getElementById('advice').title]; })()";
    assert_eq!(browser.evaluate(lines), json!(["2", "normal", advice]));
    let kind = "document.getElementById('advice').dataset.kind";
    assert_eq!(browser.evaluate(kind), "warning");
    assert_eq!(browser.text("n-clients"), "1 client");
    let clients = browser.text("client-list");
    assert!(
        clients.contains("operator") && clients.contains("(you)"),
        "{clients}"
    );
}

/// Accepted images are not the size of the store, and units are those of the terminal.
fn check_counts(browser: &mut Browser) {
    let shown = ["accepted", "evicted", "dropped-total", "rejected-total"];
    assert_eq!(
        shown.map(|id| browser.text(id)),
        ["1,932", "1,532", "18,343", "721"]
    );
    assert_eq!(browser.text("keyframes"), "400 of 400, 500.0 MB");
    assert_eq!(
        (browser.text("dropped"), browser.text("store")),
        ("18,343 dropped".to_owned(), "store full".to_owned())
    );
    assert_eq!(browser.text("step-millis"), "1.6 s");
    assert_eq!(browser.text("bytes"), "16.6 MB");
    let notes = "[...document.querySelectorAll('#notes li')].map((note) => [note.textContent, note.dataset.kind])";
    assert_eq!(
        browser.evaluate(notes),
        json!([["no GPU", "warning"], ["edited", "info"]])
    );
}

/// A paused run looks different, and says who has paused it. A checkpoint is reported when it is
/// written.
fn check_pause(page: &mut Page) {
    let Page { browser, hub, .. } = page;
    let color = |browser: &mut Browser| {
        browser.evaluate("getComputedStyle(document.getElementById('state')).backgroundColor")
    };
    let training = color(browser);
    let client = browser.evaluate("document.getElementById('client-list').textContent");
    let id = client.as_str().unwrap_or_default();
    let id: String = id.chars().filter(char::is_ascii_digit).collect();
    let id: u64 = id.parse().expect("the number of the only client");
    for (paused_by, by) in [(id, "you"), (id + 7, &*format!("client {}", id + 7))] {
        let mut status = lossy_status();
        "paused".clone_into(&mut status.state);
        status.operator.paused_by = Some(paused_by);
        status.operator.advice = Some(Advice {
            text: format!("Paused by client {paused_by}, keyframes are still taken"),
            is_warning: false,
        });
        status.operator.checkpoint = Some(RequestedCheckpoint {
            state: CheckpointState::Written,
            text: "checkpoint written after 98 s".to_owned(),
        });
        status
            .notes
            .push("checkpoint written after 98 s".to_owned());
        hub.set_status(status);
        let expected = format!("Paused by {by}, keyframes are still taken");
        wait_for(browser, "the pause", |browser| {
            browser.text("advice") == expected
        });
    }
    assert_ne!(color(browser), training);
    assert_eq!(browser.text("pause"), "Continue");
    assert_eq!(
        browser.text("checkpoint-note"),
        "checkpoint written after 98 s"
    );
    let notes = browser.text("notes");
    assert!(!notes.contains("checkpoint"), "it is shown once: {notes}");
}

/// After the run, the page shows one PSNR, and the advice of the run is gone.
fn check_end(page: &mut Page) {
    let Page { browser, hub, .. } = page;
    hub.change_status(|status| status.model.psnr = Some(26.6));
    hub.set_run_result(RunResult {
        folder: Some("runs/2026-11-28-kitchen".to_owned()),
        scores: "PSNR 26.60 dB".to_owned(),
        seconds: 98.4,
        ..RunResult::default()
    });
    wait_for(browser, "the end of the run", |browser| {
        browser.text("state") == "finished" && browser.text("advice").is_empty()
    });
    assert_eq!(browser.text("psnr"), "26.60");
    hub.set_status(lossy_status());
}

/// Cameras and scans that send nothing any more fade, and say so.
fn check_ages(page: &mut Page) {
    let Page { browser, hub, .. } = page;
    wait_for(browser, "the run", |browser| {
        browser.text("state") == "training"
    });
    hub.set_range_scan(RangeScan {
        scan: Arc::new(RangePoints {
            scanner: "lidar".into(),
            stamp: Stamp(1),
            world_from_scanner: Transform::identity(),
            points_in_world_m: [[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]].into(),
        }),
        map_from_odom: Transform::identity(),
        captured_at: Instant::now(),
    });
    wait_for(browser, "the age of the scan", |browser| {
        let is_shown = browser.evaluate("document.getElementById('scan-age').hidden") == false;
        let text = browser.text("scan-age");
        is_shown && text.starts_with("lidar ") && text.ends_with(" s old")
    });
    browser.click("toggle-model"); // Thin lines are easier to find in front of the background.
    wait_for(browser, "the frustum of a live camera", |browser| {
        hub.set_live_image(live_image());
        n_live(browser) > 100
    });
    wait_for(browser, "a frustum that has faded", |browser| {
        n_live(browser) < 10
    });
    // The newest keyframe at the same pose has another color.
    let image = live_image();
    hub.keyframes().set(vec![KeyframePose {
        camera: image.camera,
        stamp: image.stamp,
        world_from_camera: image.world_from_camera.expect("a pose"),
        size_px: image.size_px,
        focal_px: image.focal_px,
        principal_px: image.principal_px,
    }]);
    let n_before = n_violet(browser);
    browser.click("toggle-keyframes");
    wait_for(browser, "the frustum of a keyframe", |browser| {
        n_violet(browser) > n_before + 50
    });
    assert!(n_live(browser) < 10, "a keyframe looks like a live camera");
    browser.click("toggle-keyframes");
    browser.click("toggle-model");
}

/// Longer texts at the bottom do not move the camera images, and the button that is pressed is
/// legible.
fn check_stable_images(page: &mut Page) {
    let Page { browser, hub, .. } = page;
    wait_for(browser, "a camera image", |browser| {
        hub.set_live_image(live_image());
        browser.evaluate("document.querySelector('#live figure button.ride') !== null")
            == json!(true)
    });
    let moved_px = browser.evaluate(
        "(() => {
            const bottom = () => document.getElementById('live').getBoundingClientRect().bottom;
            const before = bottom();
            const age = document.getElementById('robot-age');
            const { hidden, textContent } = age;
            age.hidden = false;
            age.textContent = 'robot 12 min old';
            const moved = bottom() - before;
            Object.assign(age, { hidden, textContent });
            return moved;
        })()",
    );
    assert_eq!(moved_px.as_f64(), Some(0.0));
    let colors = browser.evaluate(
        "(() => {
            const button = document.querySelector('#live figure button.ride');
            const { ariaPressed } = button;
            button.ariaPressed = 'true';
            const { color, backgroundColor } = getComputedStyle(button);
            button.ariaPressed = ariaPressed;
            return [color, backgroundColor];
        })()",
    );
    assert_ne!(colors[0], colors[1], "the icon is visible");
}

/// Another run on the server is announced, and the picture of the old run disappears until there is
/// a new one.
fn check_new_run(page: &mut Page) {
    let Page {
        browser,
        hub,
        models,
        ..
    } = page;
    hub.set_status(lossy_status());
    wait_for(browser, "a complete picture", is_current);
    models.pause(true);
    let mut status = lossy_status();
    if let Some(identity) = &mut status.operator.identity {
        identity.run = Some("20261129-151503".to_owned());
    }
    hub.set_status(status);
    wait_for(browser, "the news", |browser| {
        browser.text("toast") == "A new run has started: 20261129-151503"
    });
    wait_for(browser, "no picture of the old run", |browser| {
        browser.text("picture-text").starts_with("no picture yet")
    });
    models.pause(false);
    wait_for(browser, "a picture of the new run", is_current);
}

/// Number of pixels in the color of live cameras.
fn n_live(browser: &mut Browser) -> usize {
    n_pixels(browser, |[red, green, blue]| {
        // Unlike the z axis, it is more green than blue.
        green >= red.saturating_add(60) && blue >= red.saturating_add(40) && blue <= green
    })
}

/// Number of pixels in the color of new keyframes, whose lines are translucent.
fn n_violet(browser: &mut Browser) -> usize {
    n_pixels(browser, |[red, green, blue]| {
        red >= green.saturating_add(10) && blue >= green.saturating_add(20)
    })
}

/// Number of pixels of a color, away from the toolbar and the images.
fn n_pixels(browser: &mut Browser, is_color: impl Fn([u8; 3]) -> bool) -> usize {
    let shot = canvas_shot(browser);
    let rows = 80..shot.height().saturating_sub(260);
    let pixels = shot.enumerate_pixels();
    pixels
        .filter(|(_, row, pixel)| rows.contains(row) && is_color(pixel.0))
        .count()
}

/// An image of a camera in front of the first view, captured now.
fn live_image() -> LiveImage {
    LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: [64, 48],
        pixels: LivePixels::Rgb(vec![90; 64 * 48 * 3].into()),
        world_from_camera: Some(
            Translation3::new(0.1, 0.8, 0.2)
                * (looking_along_y() * Transform::rotation(Vector3::new(0.0, 0.6, 0.0))),
        ),
        focal_px: [56.0, 56.0],
        principal_px: [32.0, 24.0],
    }
}

/// A saved model has no training panel, but a name and a size.
fn check_saved_model(page: &mut Page) {
    let Page { browser, hub, .. } = page;
    hub.set_status(Status {
        state: "viewing".to_owned(),
        model: ModelStatus {
            psnr: None,
            psnr_history: Vec::new(),
            ..model("splat")
        },
        operator: OperatorStatus {
            identity: Some(Identity {
                run: Some("guitar.ply".to_owned()),
                ..Identity::default()
            }),
            ..OperatorStatus::default()
        },
        ..Status::default()
    });
    wait_for(browser, "the saved model", |browser| {
        browser.text("rig") == "guitar.ply"
    });
    for panel in ["training", "keyframes-card"] {
        let is_hidden = browser.evaluate(&format!("document.getElementById('{panel}').hidden"));
        assert_eq!(is_hidden, true, "{panel}");
    }
    assert_eq!(browser.text("primitives"), "84,512");
    assert_eq!(browser.text("badge"), "G");
    hub.set_status(lossy_status());
    wait_for(browser, "the run", |browser| {
        browser.text("state") == "training"
    });
}

/// The training panel is open in large windows and closed on phones, and remembers a click.
fn check_training_panel(browser: &mut Browser) {
    let is_open = |browser: &mut Browser| -> Value {
        browser.evaluate("document.getElementById('training')?.open ?? null")
    };
    let reload = |browser: &mut Browser| {
        browser.evaluate("window.isOld = true");
        browser.load_by("location.reload()");
        wait_for(browser, "the status", |browser| {
            browser.evaluate("window.isOld") != true && browser.text("psnr") == "25.60"
        });
    };
    assert_eq!(is_open(browser), true);
    browser.resize(PHONE_PX);
    reload(browser);
    assert_eq!(is_open(browser), false);
    browser.click("training-summary");
    assert_eq!(is_open(browser), true);
    reload(browser);
    assert_eq!(is_open(browser), true, "the choice is remembered");
}
