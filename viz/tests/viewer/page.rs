//! Opens the bundled page in a real browser and compares it with the exact scene.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

mod moved_picture;

use crate::local_server::serve;
use crate::proxy::{Link, Proxy};
use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_bounds, canvas_shot, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{
    Hub, KeyframePose, LiveImage, LivePixels, ModelStatus, RunResult, SceneHint, Server,
    ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Sizes of the screenshots in `CARGO_TARGET_TMPDIR`.
const DESKTOP_PX: [u32; 2] = [1280, 800];
const PHONE_PX: [u32; 2] = [390, 844];
const TURNED_PHONE_PX: [u32; 2] = [844, 390];
/// The page shows a lost connection within this time.
const MAX_LOSS_DISPLAY_MILLIS: f64 = 1000.0;
/// Added to the render time of each picture. If pictures took less than 20 ms, the server would
/// skip the coarse stages.
const DRAWING: Duration = Duration::from_millis(25);
/// A wireless link: 20 Mbit/s, and one segment in a hundred is sent again.
const LINK: Link = Link {
    bytes_per_sec: 2.5e6,
    delay: Duration::from_millis(40),
    slow_period: 100,
    slow_delay: Duration::from_millis(200),
};
/// Maximum size of all files that the page loads before its first picture, compressed. They take
/// 0.1 s on this link.
const MAX_PAGE_BYTES: f64 = 250_000.0;
/// Size of all files that the page has loaded so far.
const LOADED_BYTES: &str =
    "['navigation', 'resource'].flatMap((kind) => performance.getEntriesByType(kind))
    .reduce((sum, entry) => sum + entry.transferSize, 0)";
/// Duration of the interruption.
const CUT: Duration = Duration::from_secs(25);
/// Whether a pixel contains some of the page's `--accent`, the color of live cameras. Nothing else
/// in this scene is blue-green.
fn is_accent([red, green, blue]: [u8; 3]) -> bool {
    green >= red.saturating_add(30) && blue >= red.saturating_add(18)
}

/// Color of the view where nothing is drawn.
const BACKGROUND: [u8; 3] = [11, 14, 19];

/// A request and its model.
type ReceivedRequest = (RenderRequest, Option<String>);

/// Renders requests on a separate thread, like a training thread, and records them.
struct RenderThread {
    received_requests: Arc<Mutex<Vec<ReceivedRequest>>>,
    /// Whether pictures wait.
    is_paused: Arc<AtomicBool>,
    _thread: RequestThread,
}

impl RenderThread {
    fn start(hub: Hub) -> Self {
        let received_requests: Arc<Mutex<Vec<ReceivedRequest>>> = Arc::default();
        let is_paused: Arc<AtomicBool> = Arc::default();
        let (received, paused) = (received_requests.clone(), is_paused.clone());
        let thread = RequestThread::start(hub, move |pending| {
            let order = (pending.request.clone(), pending.method().map(str::to_owned));
            received
                .lock()
                .expect("no thread panicked while holding the lock")
                .push(order);
            let picture = draw(&pending.request);
            std::thread::sleep(DRAWING);
            while paused.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(10));
            }
            pending.deliver(picture);
        });
        Self {
            received_requests,
            is_paused,
            _thread: thread,
        }
    }

    /// The requests of the main view. Panoramas are requested for its surroundings.
    fn requests(&self) -> Vec<RenderRequest> {
        self.received_requests
            .lock()
            .expect("no thread panicked while holding the lock")
            .iter()
            .map(|(request, _)| request.clone())
            .filter(|request| request.projection != Projection::Equirectangular)
            .collect()
    }

    fn methods(&self) -> Vec<Option<String>> {
        self.received_requests
            .lock()
            .expect("no thread panicked while holding the lock")
            .iter()
            .map(|(_, method)| method.clone())
            .collect()
    }
}

/// A camera next to the scene, so that its frustum is visible from the first view.
fn side_camera() -> KeyframePose {
    let eye = Point3::new(-0.8, -0.3, 0.6);
    let rotation =
        UnitQuaternion::face_towards(&(Point3::new(0.0, 0.2, 0.1) - eye), &-Vector3::z());
    KeyframePose {
        camera: "wrist".into(),
        stamp: Stamp(0),
        world_from_camera: Transform::from_parts(eye.into(), rotation),
        size_px: [640, 480],
        focal_px: [560.0, 560.0],
        principal_px: [320.0, 240.0],
    }
}

/// An image of the camera next to the scene, captured now.
fn live_image(rgba: Arc<[u8]>) -> LiveImage {
    let camera = side_camera();
    LiveImage {
        camera: Arc::clone(&camera.camera),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: camera.size_px,
        pixels: LivePixels::Rgba(rgba),
        world_from_camera: Some(camera.world_from_camera),
        focal_px: camera.focal_px,
        principal_px: camera.principal_px,
    }
}

fn publish_updates(hub: &Hub) {
    let live = side_camera();
    let request = RenderRequest {
        world_from_camera: live.world_from_camera,
        size_px: live.size_px,
        projection: Projection::Pinhole {
            focal_px: live.focal_px,
            principal_px: live.principal_px,
        },
        shutter: None,
        near_m: 0.01,
        far_m: 50.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.1; 3],
        appearance_of: None,
        depth: true,
    };
    hub.set_live_image(live_image(draw(&request).rgba_srgb.into()));
    let turned =
        |angle: f64| Transform::rotation(Vector3::new(0.0, 0.0, angle)) * live.world_from_camera;
    let keyframes = (1..12).map(|ix| KeyframePose {
        world_from_camera: turned(0.15 * f64::from(ix)),
        ..live.clone()
    });
    hub.keyframes().set(keyframes.collect());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
    });
    let curve = |ix: u32| {
        (
            f64::from(ix) * 2.0,
            27.0 - 14.0 * (-f64::from(ix) / 12.0).exp(),
        )
    };
    hub.set_status(Status {
        state: "training".to_owned(),
        seconds: 98.4,
        keyframes: 143,
        rejected: BTreeMap::from([
            ("too little motion".to_owned(), 812),
            ("blurred".to_owned(), 31),
        ]),
        model: ModelStatus {
            method: "splat".to_owned(),
            step: 1520,
            step_millis: Some(41.7),
            primitives: 84_512,
            primitives_label: "Splats".to_owned(),
            bytes: 61_210_112,
            has_chunks: true,
            edits: 2,
            psnr: Some(26.76),
            psnr_history: (0..50).map(curve).collect(),
            ..ModelStatus::default()
        },
        others: vec![ModelStatus {
            method: "tsdf".to_owned(),
            step: 143,
            primitives_label: "Voxel blocks".to_owned(),
            ..ModelStatus::default()
        }],
        notes: Vec::new(),
        ..Status::default()
    });
}

#[test]
fn page_renders_scene_and_overlays_correctly() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    publish_updates(&hub);
    let server = serve(&hub);
    let render_thread = RenderThread::start(hub.clone());
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);

    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    std::fs::write(scratch.join("page.png"), browser.screenshot()).expect("written");
    assert_eq!(browser.text("psnr"), "26.76");
    assert_eq!(browser.text("primitives"), "84,512");
    assert_eq!(browser.text("rejected-total"), "843");
    let at_rest = render_thread.requests();
    let full = at_rest.last().expect("drawn").clone();
    let widths: Vec<_> = at_rest.iter().map(|request| request.size_px[0]).collect();
    let is_tenth = widths
        .iter()
        .any(|width| (width * 10).abs_diff(full.size_px[0]) < 10);
    // On a busy machine, the page may request the full picture again.
    let before_full = widths.split(|width| *width == full.size_px[0]).next();
    let is_half = before_full
        .and_then(<[u32]>::last)
        .is_some_and(|width| (width * 2).abs_diff(full.size_px[0]) < 2);
    assert!(
        is_tenth && is_half,
        "stages of 10, 50 and 100 %: {widths:?}"
    );
    let first_view = Translation3::new(0.0, 0.0, 0.3) * looking_along_y();
    assert!(
        (full.world_from_camera.inverse() * first_view)
            .translation
            .vector
            .norm()
            < 1e-6,
        "starts at the hint"
    );

    check_switch(&mut browser, &render_thread);
    check_live_frustum(&mut browser, &hub, &full);
    check_picture(&mut browser, &full);
    let turned = check_drag(&mut browser, &render_thread, &full);
    check_picture(&mut browser, &turned);
    std::fs::write(scratch.join("page-dragged.png"), browser.screenshot()).expect("written");
    reset_view(&mut browser, &render_thread, &full);
    moved_picture::check(&mut browser, &render_thread, &full);
    check_distance(&mut browser, &full);
    check_images(&mut browser);
    check_settings(&mut browser, &render_thread, &full);
    check_refresh(&mut browser, &render_thread, &hub);
    check_camera_path(&mut browser, &full);
    check_reconnect(&mut browser, server, &hub);

    drop(browser);
    drop(render_thread);
}

/// Returns to the first view, and waits for its full picture.
fn reset_view(browser: &mut Browser, render_thread: &RenderThread, full: &RenderRequest) {
    browser.click("reset-view");
    wait_for(browser, "the first view", |browser| {
        let last = render_thread.requests().last().expect("drawn").clone();
        let motion = full.world_from_camera.inverse() * last.world_from_camera;
        let is_full =
            last.size_px == full.size_px && browser.text("picture-text").contains("100 %");
        is_full && motion.translation.vector.norm() < 1e-6
    });
}

/// Clicking another model's button requests its pictures and shows its values.
fn check_switch(browser: &mut Browser, render_thread: &RenderThread) {
    let press = |browser: &mut Browser, method: &str| {
        browser.evaluate(&format!(
            "document.querySelector('#models button[data-method={method}]').click()"
        ));
    };
    assert!(
        render_thread.methods().iter().all(Option::is_none),
        "no model was chosen"
    );
    press(browser, "tsdf");
    wait_for(browser, "the other model's values", |browser| {
        browser.text("primitives-label") == "Voxel blocks"
    });
    wait_for(browser, "its picture", |_| {
        render_thread.methods().last() == Some(&Some("tsdf".to_owned()))
    });
    press(browser, "splat");
    wait_for(browser, "the first model's picture", |_| {
        render_thread.methods().last() == Some(&Some("splat".to_owned()))
    });
    wait_for(browser, "a full picture of it", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    assert_eq!(browser.text("primitives-label"), "Splats before edits");
}

/// The view without the camera images and texts that cover its lower part.
fn shot_without_bottom(browser: &mut Browser) -> image::RgbImage {
    let show_bottom = |browser: &mut Browser, visibility: &str| {
        browser.evaluate(&format!(
            "document.querySelector('.bottom').style.visibility = '{visibility}'"
        ));
    };
    show_bottom(browser, "hidden");
    let shot = canvas_shot(browser);
    show_bottom(browser, "");
    shot
}

/// The live camera's frustum is drawn according to the request's projection.
fn check_live_frustum(browser: &mut Browser, hub: &Hub, request: &RenderRequest) {
    const REACH_PX: i64 = 2; // Rounding to pixels, and lines one pixel wide.
    // The frustum fades if no images arrive.
    let images = Camera::start(hub.clone());
    wait_for(browser, "a live image", |browser| label(browser) == "live");
    let shot = shot_without_bottom(browser);
    images.stop();
    let camera = side_camera();
    let depth = 1.6 * 0.12 * 0.8; // Depth of the drawn frustum: see web/src/layers/overlays.ts.
    let corner = |u: f64, v: f64| {
        let at = |pixel: f64, focal: f64, principal: f64| (pixel - principal) / focal * depth;
        camera.world_from_camera
            * Point3::new(
                at(u, camera.focal_px[0], camera.principal_px[0]),
                at(v, camera.focal_px[1], camera.principal_px[1]),
                depth,
            )
    };
    let eye = Point3::from(camera.world_from_camera.translation.vector);
    for (u, v) in [(0.0, 0.0), (640.0, 0.0), (640.0, 480.0), (0.0, 480.0)] {
        for share in [0.3, 0.6, 0.9] {
            let center_px = pixel_of(request, eye + (corner(u, v) - eye) * share);
            let is_near = (-REACH_PX..=REACH_PX)
                .flat_map(|dy| {
                    (-REACH_PX..=REACH_PX).map(move |dx| (center_px.0 + dx, center_px.1 + dy))
                })
                .any(|(x, y)| is_accent(pixel(&shot, x, y)));
            assert!(is_near, "no line of the frustum near {center_px:?}");
        }
    }
}

/// With the lines off, the view equals the requested picture pixel for pixel, except for JPEG
/// compression.
fn check_picture(browser: &mut Browser, request: &RenderRequest) {
    browser.click("toggle-grid");
    let shot = canvas_shot(browser);
    let expected = draw(request);
    assert_eq!([shot.width(), shot.height()], expected.size_px);
    let off_by = |dx: i64| {
        let (mut sum, mut n) = (0.0, 0.0);
        let [columns, rows] = uncovered(expected.size_px);
        for y in rows {
            for x in columns.clone().step_by(3) {
                let ix = usize::try_from(y * i64::from(shot.width()) + x).expect("inside") * 4;
                let expected_pixel = &expected.rgba_srgb[ix..ix + 3];
                sum += pixel(&shot, x + dx, y)
                    .iter()
                    .zip(expected_pixel)
                    .map(|(a, b)| f64::from(a.abs_diff(*b)))
                    .sum::<f64>();
                n += 3.0;
            }
        }
        sum / n
    };
    let (there, left, right) = (off_by(0), off_by(-2), off_by(2));
    assert!(
        there < 3.0,
        "the view differs from the scene by {there} of 255 on average"
    );
    assert!(
        there < 0.7 * left && there < 0.7 * right,
        "a shift by 2 pixels must be detected: {there}, {left}, {right}"
    );
    browser.click("toggle-grid");
}

/// Presses and releases the mouse at a point of the scene.
fn click_on(browser: &mut Browser, request: &RenderRequest, point: Point3<f64>) {
    let [left, top, ..] = canvas_bounds(browser);
    let (x, y) = pixel_of(request, point);
    let at = [x + i64::from(left), y + i64::from(top)]
        .map(|value| i32::try_from(value).expect("inside the window"));
    browser.mouse("mouseMoved", at);
    browser.mouse("mousePressed", at);
    browser.mouse("mouseReleased", at);
}

/// Two clicks on the floor measure the distance between the points.
fn check_distance(browser: &mut Browser, request: &RenderRequest) {
    browser.click("toggle-measure");
    click_on(browser, request, Point3::new(-0.45, 0.2, 0.0));
    click_on(browser, request, Point3::new(0.25, 0.1, 0.0));
    wait_for(browser, "a distance", |browser| {
        distance_text(browser).contains("vertical")
    });
    let text = distance_text(browser);
    let millimeters: Vec<f64> = text
        .split(|c: char| !c.is_ascii_digit())
        .filter_map(|n| n.parse().ok())
        .collect();
    let expected = 707.0; // hypot(700, 100)
    assert!(
        (millimeters[0] - expected).abs() < 0.02 * expected,
        "{text}"
    );
    assert!(
        (millimeters[1] - expected).abs() < 0.02 * expected && millimeters[2] < 15.0,
        "{text}"
    );
    save_and_restore(browser, "distance");
    click_on(browser, request, Point3::new(0.0, 50.0, 12.0));
    assert!(browser.text("measure-hint").starts_with("No surface"));
    browser.evaluate("document.querySelector('.distance button')?.click()");
    assert_eq!(distance_text(browser), "");
    browser.click("toggle-measure");
}

/// Text of the last measurement.
fn distance_text(browser: &mut Browser) -> String {
    let text =
        browser.evaluate("document.querySelector('.distance:last-child span')?.textContent ?? ''");
    text.as_str().unwrap_or_default().to_owned()
}

/// A click on a camera image enlarges it, and its images arrive in a larger size.
fn check_images(browser: &mut Browser) {
    let height = "document.querySelector('#live canvas').height";
    let small = browser.evaluate(height).as_u64().expect("a height");
    browser.evaluate("document.querySelector('#live figure').click()");
    wait_for(browser, "a larger image", |browser| {
        browser.evaluate(height).as_u64() == Some(480)
    });
    assert!(small < 300, "a thumbnail of {small} rows");
    save_and_restore(browser, "enlarged");
    browser.evaluate("document.querySelector('#live figure').click()");
    wait_for(browser, "a small image", |browser| {
        browser.evaluate(height).as_u64() == Some(small)
    });
    // The keyboard enlarges it, too. Images in the side panel are small.
    browser.evaluate(
        "document.querySelector('#live canvas')?.dispatchEvent(new KeyboardEvent('keydown', { key: 'Enter', bubbles: true }))",
    );
    wait_for(browser, "a larger image", |browser| {
        browser.evaluate(height).as_u64() == Some(480)
    });
    let docked = "document.querySelectorAll('#docked canvas').length";
    let dock = "document.querySelector('figure[data-camera] button').click()";
    browser.evaluate(dock);
    assert_eq!(
        browser.evaluate(docked),
        1,
        "the image is in the side panel"
    );
    wait_for(browser, "a small image in the side panel", |browser| {
        browser
            .evaluate("document.querySelector('#docked canvas').height")
            .as_u64()
            == Some(small)
    });
    save_and_restore(browser, "docked");
    browser.evaluate("window.isBeforeReload = true; void setTimeout(() => location.reload(), 0)");
    wait_for(browser, "the reload", |browser| {
        browser.evaluate("window.isBeforeReload ?? false") == false
    });
    wait_for(
        browser,
        "the image in the side panel after a reload",
        |browser| browser.evaluate(docked) == 1,
    );
    wait_for(browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-images");
    assert_eq!(
        browser.evaluate("document.getElementById('docked-card').hidden"),
        true,
        "images are hidden there, too"
    );
    browser.click("toggle-images");
    assert_eq!(
        browser.evaluate("document.getElementById('docked-card').hidden"),
        false
    );
    browser.evaluate(dock);
    assert_eq!(browser.evaluate(docked), 0, "the image is back in the view");
}

/// Changes a control of the settings as a user would.
fn set(browser: &mut Browser, id: &str, value: &str) {
    browser.evaluate(&format!(
        "(() => {{ const control = document.getElementById('{id}'); control.value = '{value}'; \
         for (const kind of ['input', 'change']) control.dispatchEvent(new Event(kind)); }})()"
    ));
}

/// Field of view and picture width change the requests; opacity changes the view.
fn check_settings(browser: &mut Browser, render_thread: &RenderThread, before: &RenderRequest) {
    let last = || render_thread.requests().last().expect("drawn").clone();
    browser.click("toggle-settings");
    set(browser, "fov", "30");
    let focal_px = 0.5 * f64::from(before.size_px[1]) / 15_f64.to_radians().tan();
    wait_for(browser, "a narrower view", |_| match last().projection {
        Projection::Pinhole {
            focal_px: [_, y], ..
        } => last().size_px == before.size_px && (y - focal_px).abs() < 1.0,
        Projection::Equirectangular => false,
    });
    set(browser, "fov", "50");
    set(browser, "picture-width", "640");
    wait_for(browser, "a smaller picture", |_| last().size_px[0] == 640);
    save_and_restore(browser, "settings");
    set(browser, "picture-width", "1280");
    wait_for(browser, "the picture of before", |_| {
        last().size_px == before.size_px
    });
    browser.click("toggle-grid");
    set(browser, "opacity", "0");
    let shot = canvas_shot(browser);
    let (x, y) = pixel_of(before, Point3::new(0.1, 0.1, 0.0));
    assert_eq!(pixel(&shot, x, y), BACKGROUND);
    set(browser, "opacity", "100");
    browser.click("toggle-grid");
    browser.click("toggle-settings");
}

/// While the model changes, the view at rest is refreshed: with pauses, or continuously.
fn check_refresh(browser: &mut Browser, render_thread: &RenderThread, hub: &Hub) {
    let mut step = 2000;
    for refresh in ["pauses", "continuous", "pauses"] {
        set(browser, "refresh", refresh);
        let n_before = render_thread.requests().len();
        wait_for(browser, refresh, |_| {
            step += 1;
            hub.set_status(Status {
                state: "training".to_owned(),
                model: ModelStatus {
                    method: "splat".to_owned(),
                    step,
                    ..ModelStatus::default()
                },
                ..Status::default()
            });
            render_thread.requests().len() >= n_before + 2
        });
    }
    publish_updates(hub);
}

/// A camera path begins and ends at the added views, in the axes of nerfstudio.
fn check_camera_path(browser: &mut Browser, request: &RenderRequest) {
    browser.evaluate(
        "URL.createObjectURL = (blob) => { blob.text().then((text) => (window.savedPath = text)); return '#'; }; 0",
    );
    browser.click("path-add");
    browser.click("look-top");
    browser.click("path-add");
    browser.click("path-save");
    wait_for(browser, "a file", |browser| {
        browser.evaluate("window.savedPath !== undefined") == true
    });
    let text = browser.evaluate("window.savedPath");
    let file: serde_json::Value = serde_json::from_str(text.as_str().expect("text")).expect("JSON");
    let frames = file["camera_path"].as_array().expect("frames");
    assert_eq!((frames.len(), &file["fps"]), (61, &serde_json::json!(30)));
    let pose = |frame: &serde_json::Value| {
        let numbers: Vec<f64> =
            serde_json::from_value(frame["camera_to_world"].clone()).expect("a matrix, row by row");
        nalgebra::Matrix4::from_row_slice(&numbers)
    };
    let opengl_from_camera =
        nalgebra::Matrix4::from_diagonal(&nalgebra::Vector4::new(1.0, -1.0, -1.0, 1.0));
    let expected = request.world_from_camera.to_homogeneous();
    assert!(
        (pose(&frames[0]) * opengl_from_camera - expected).norm() < 1e-5,
        "starts at the first view"
    );
    let forward = -pose(&frames[60]).column(2).xyz();
    assert!(
        (forward + Vector3::z()).norm() < 0.01,
        "ends with the view from above: {forward}"
    );
    browser.click("path-play");
    assert_eq!(browser.text("path-play"), "Stop");
    wait_for(browser, "the end of the path", |browser| {
        browser.text("path-play") == "Play"
    });
    browser.click("path-clear");
    browser.click("reset-view");
    wait_for(browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
}

/// Drags the view to the right and down.
fn drag(browser: &mut Browser) {
    browser.mouse("mousePressed", [300, 300]);
    for ix in 0..12 {
        browser.mouse("mouseMoved", [300 + 12 * ix, 300 + 5 * ix]);
        std::thread::sleep(Duration::from_millis(30));
    }
    browser.mouse("mouseReleased", [432, 355]);
}

/// Columns and rows of a view away from its edges, which the toolbar and the inset cover.
fn uncovered([width, height]: [u32; 2]) -> [std::ops::Range<i64>; 2] {
    [4..i64::from(width) - 4, 80..i64::from(height) - 260]
}

/// While dragging, the page requests small pictures; at rest, full ones. The camera rotates around
/// the center.
fn check_drag(
    browser: &mut Browser,
    render_thread: &RenderThread,
    before: &RenderRequest,
) -> RenderRequest {
    let n_before = render_thread.requests().len();
    drag(browser);
    wait_for(browser, "a small picture", |browser| {
        !browser.text("picture-text").contains("100 %")
    });
    wait_for(browser, "a full picture after the drag", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    let requests = render_thread.requests();
    let first = &requests[n_before];
    assert!(
        first.size_px[0] * 2 <= before.size_px[0] + 1,
        "a moving view is drawn small: {:?}",
        first.size_px
    );
    let after = requests.last().expect("drawn");
    let center = Point3::new(0.0, 0.0, 0.2);
    let distance = |request: &RenderRequest| {
        (request.world_from_camera.translation.vector - center.coords).norm()
    };
    let moved = (after.world_from_camera.translation.vector
        - before.world_from_camera.translation.vector)
        .norm();
    assert!(moved > 0.2, "the camera moved only {moved} m");
    assert!((distance(after) - distance(before)).abs() < 0.3 && distance(after) > 1.0);
    let right = after.world_from_camera.rotation * Vector3::x();
    assert!(right.z.abs() < 1e-6, "the view stays upright");
    after.clone()
}

/// The page shows that the server has stopped, and reconnects automatically.
fn check_reconnect(browser: &mut Browser, server: Server, hub: &Hub) {
    let listen = server.address();
    drop(server);
    wait_for(browser, "the loss", |browser| {
        browser
            .text("connection")
            .contains("the server has stopped")
    });
    let server =
        Server::start(ServerConfig { listen }, hub.clone()).expect("the port is free again");
    wait_for(browser, "the return", |browser| {
        browser.text("connection").contains("connected")
    });
    drop(server);
}

/// Runs the page through a proxy that interrupts the connection, like a wireless link, up to the
/// end of the run.
#[test]
fn page_shows_connection_loss_and_run_result() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    publish_updates(&hub);
    let server = serve(&hub);
    let render_thread = RenderThread::start(hub.clone());
    let proxy = Proxy::start(server.address(), LINK);
    let mut browser = Browser::open(
        &program,
        &format!("http://{}/", proxy.address()),
        DESKTOP_PX,
    );
    wait_for(&mut browser, "a picture", |browser| {
        browser.text("picture-text").contains(" ms")
    });
    let first_millis = browser
        .evaluate("performance.now()")
        .as_f64()
        .expect("a time");
    let n_bytes = browser
        .evaluate(LOADED_BYTES)
        .as_f64()
        .expect("a number of bytes");
    eprintln!("first picture after {first_millis:.0} ms and files of {n_bytes} bytes");
    assert!(
        (50_000.0..MAX_PAGE_BYTES).contains(&n_bytes),
        "the page loads {n_bytes} bytes before the first picture"
    );
    let camera = Camera::start(hub.clone());
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    wait_for(&mut browser, "a live image", |browser| {
        label(browser) == "live"
    });
    browser.evaluate(RECORDER);
    assert_eq!(browser.text("banner"), "");
    save_screenshot(&mut browser, "connected");
    let bounds = canvas_bounds(&mut browser);

    browser.evaluate("record.cutAt = performance.now()");
    proxy.cut();
    let cut_at = Instant::now();
    std::thread::sleep(Duration::from_millis(1500));
    assert!(
        browser
            .text("banner")
            .starts_with("No data from the server for "),
        "{}",
        browser.text("banner")
    );
    wait_for(&mut browser, "attempts to reconnect", |browser| {
        browser.text("banner").contains("reconnecting")
    });
    assert_eq!(
        canvas_bounds(&mut browser),
        bounds,
        "the view keeps its size during an outage"
    );
    save_screenshot(&mut browser, "lost");
    std::thread::sleep(CUT.saturating_sub(cut_at.elapsed()));
    camera.stop();
    std::thread::sleep(Duration::from_millis(600)); // From here on, every image is too old to be live.
    browser.evaluate("record.isLive = false");
    proxy.restore();
    wait_for(&mut browser, "the return", |browser| {
        browser.text("connection").contains("connected")
    });
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(browser.text("banner"), "");
    let shown_after = browser
        .evaluate("record.shownAfter")
        .as_f64()
        .expect("the loss was shown");
    assert!(
        shown_after < MAX_LOSS_DISPLAY_MILLIS,
        "the lost connection was shown after {shown_after} ms"
    );
    assert_eq!(
        browser.evaluate("record.isLive"),
        false,
        "an image from before the cut was labeled live"
    );
    assert!(
        label(&mut browser).contains("old"),
        "{}",
        label(&mut browser)
    );
    let camera = Camera::start(hub.clone());
    wait_for(&mut browser, "a live image", |browser| {
        label(browser) == "live"
    });
    camera.stop();

    hub.set_run_result(RunResult {
        folder: Some("runs/2026-03-01-kitchen".to_owned()),
        scores: "PSNR 26.76 dB".to_owned(),
        seconds: 98.4,
        ..RunResult::default()
    });
    drop(server);
    wait_for(&mut browser, "the stopped server", |browser| {
        browser
            .text("connection")
            .contains("the server has stopped")
    });
    assert_eq!(browser.text("banner"), "", "the result has a panel");
    let result = browser.text("run-end");
    assert!(
        result.contains("PSNR 26.76 dB") && result.contains("runs/2026-03-01-kitchen"),
        "{result}"
    );
    assert_eq!(browser.text("psnr"), "26.76", "the scores stay");
    save_screenshot(&mut browser, "finished");
    drop(browser);
    drop(render_thread);
}

/// Records, at every change of the page, when the banner appears and whether a label says `live`.
const RECORDER: &str = "
    window.record = { cutAt: Infinity, shownAfter: null, isLive: false };
    setInterval(() => {
        if (record.shownAfter === null && document.getElementById('banner').textContent !== '')
            record.shownAfter = performance.now() - record.cutAt;
        for (const label of document.querySelectorAll('#live figcaption span'))
            record.isLive ||= label.textContent === 'live';
    }, 20)";

/// The label of the live image, which shows its age.
fn label(browser: &mut Browser) -> String {
    let label =
        browser.evaluate("document.querySelector('#live figcaption span')?.textContent ?? ''");
    label.as_str().unwrap_or_default().to_owned()
}

/// Panels that, if they are opened, are not in the view and next to the toolbar, which is a bar at
/// the bottom on phones, each with its edges. All panels, if there are not nine.
fn misplaced_panels(browser: &mut Browser) -> serde_json::Value {
    browser.evaluate(
        "(() => {
            const bounds = (id) => document.getElementById(id).getBoundingClientRect();
            const panels = [...document.querySelectorAll('.panel')];
            const isRight = ({ top, bottom, height }) => {
                const isApart = top > bounds('toolbar').bottom || bottom < bounds('toolbar').top;
                return isApart && top > bounds('view').top && bottom < bounds('view').bottom && height > 40;
            };
            const wereHidden = panels.map(({ hidden }) => hidden);
            const opened = panels.map((panel) => {
                for (const other of panels) other.hidden = other !== panel;
                return { id: panel.id, ...bounds(panel.id).toJSON() };
            });
            panels.forEach((panel, ix) => panel.hidden = wereHidden[ix]);
            return opened.length !== 9 ? opened : opened.filter((panel) => !isRight(panel));
        })()",
    )
}

/// Checks the layout at every window size and saves screenshots.
fn save_screenshot(browser: &mut Browser, name: &str) {
    for (window, size_px) in [
        ("turned-phone", TURNED_PHONE_PX),
        ("phone", PHONE_PX),
        ("desktop", DESKTOP_PX),
    ] {
        browser.resize(size_px);
        std::thread::sleep(Duration::from_millis(400));
        assert_eq!(
            misplaced_panels(browser),
            serde_json::json!([]),
            "{name}, {window}"
        );
        let file =
            PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("page-{name}-{window}.png"));
        std::fs::write(file, browser.screenshot()).expect("written");
    }
}

/// Sends live images ten times a second.
pub(crate) struct Camera {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<()>,
}

impl Camera {
    fn start(hub: Hub) -> Self {
        let gray: Arc<[u8]> = vec![120; 640 * 480 * 4].into();
        Self::sending(hub, move || live_image(Arc::clone(&gray)))
    }

    /// A camera that sends these images.
    pub(crate) fn sending(hub: Hub, image: impl Fn() -> LiveImage + Send + 'static) -> Self {
        let stop: Arc<AtomicBool> = Arc::default();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                hub.set_live_image(image());
                std::thread::sleep(Duration::from_millis(100));
            }
        });
        Self { stop, thread }
    }

    pub(crate) fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("no panic");
    }
}

/// Saves screenshots in all sizes, and returns to the size of the test.
fn save_and_restore(browser: &mut Browser, name: &str) {
    let bounds = canvas_bounds(browser);
    save_screenshot(browser, name);
    browser.resize(WINDOW_PX);
    wait_for(browser, "the size of before", |browser| {
        canvas_bounds(browser) == bounds
    });
    std::thread::sleep(Duration::from_millis(400)); // The view no longer moves.
    wait_for(browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
}

#[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
fn pixel_of(request: &RenderRequest, point: Point3<f64>) -> (i64, i64) {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        panic!("the page requests a pinhole projection")
    };
    let point_in_camera = request.world_from_camera.inverse_transform_point(&point);
    let u = focal_px[0] * point_in_camera.x / point_in_camera.z + principal_px[0];
    let v = focal_px[1] * point_in_camera.y / point_in_camera.z + principal_px[1];
    (u.floor() as i64, v.floor() as i64)
}

fn pixel(image: &image::RgbImage, x: i64, y: i64) -> [u8; 3] {
    let clamp = |at: i64, n: u32| u32::try_from(at.clamp(0, i64::from(n) - 1)).expect("inside");
    image
        .get_pixel(clamp(x, image.width()), clamp(y, image.height()))
        .0
}
