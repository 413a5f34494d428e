//! Opens the bundled page in a real browser, and compares photographs of keyframes, each with
//! another fault, with the model. Then looks where to look next, and saves the picture.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use keyframe::{Keyframe, Split};
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Instant;
use test_support::browser::{Browser, browser_for_page, canvas_bounds, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{
    Hub, KeyframePose, LiveImage, LivePixels, ModelStatus, ObservationMap, ObservedCell, SceneHint,
    Server, ServerConfig, Status,
};

const WINDOW_PX: [u32; 2] = [1280, 900];
const PHONE_PX: [u32; 2] = [390, 844];
const SIZE_PX: [u32; 2] = [320, 240];
const FOCAL_PX: f64 = 280.0;
const RADIUS_M: f64 = 0.8;
/// The color of the page's background, which the pictures of its requests have, too.
const BACKGROUND_SRGB: [f32; 3] = [11.0 / 255.0, 14.0 / 255.0, 19.0 / 255.0];
/// A rectangle that only the photograph shows: left, top, right and bottom, pixels.
const MOVED_PX: [u32; 4] = [10, 10, 90, 70];
/// Correction of the pose of one keyframe.
const CORRECTION_M: f64 = 0.008;
const SECOND: i64 = 1_000_000_000;

/// A keyframe and what the page should say about it.
struct Case {
    x_m: f64,
    stamp: Stamp,
    fault: &'static str,
    change: fn(&mut [u8]),
}

/// In the order of time. The first one is four minutes older than the last.
const CASES: [Case; 5] = [
    Case {
        x_m: -0.3,
        stamp: Stamp(0),
        fault: "old: 4 min",
        change: |_| {},
    },
    Case {
        x_m: -0.15,
        stamp: Stamp(236 * SECOND),
        fault: "exposure differs by 0.5 EV: the photograph is darker",
        change: darken,
    },
    Case {
        x_m: 0.0,
        stamp: Stamp(237 * SECOND),
        fault: "large error in the upper left: did something move there?",
        change: add_object,
    },
    Case {
        x_m: 0.15,
        stamp: Stamp(238 * SECOND),
        fault: "blurred",
        change: blur,
    },
    Case {
        x_m: 0.3,
        stamp: Stamp(240 * SECOND),
        fault: "pose corrected by 8.0 mm",
        change: |_| {},
    },
];

/// A camera above the floor that looks down, and a little along y.
fn corrected_pose(x_m: f64) -> Transform {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI + 0.15);
    Transform::from_parts(Translation3::new(x_m, -0.15, 0.95), rotation)
}

fn request_from(world_from_camera: Transform) -> RenderRequest {
    RenderRequest {
        world_from_camera,
        size_px: SIZE_PX,
        projection: Projection::Pinhole {
            focal_px: [FOCAL_PX; 2],
            principal_px: SIZE_PX.map(|side| 0.5 * f64::from(side)),
        },
        shutter: None,
        near_m: 0.01,
        far_m: 50.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: BACKGROUND_SRGB,
        appearance_of: None,
        depth: true,
    }
}

/// The keyframe with the pose that the robot reports, and the photograph from the corrected pose.
fn keyframe(case: &Case) -> Arc<Keyframe> {
    let mut rgba_srgb = draw(&request_from(corrected_pose(case.x_m))).rgba_srgb;
    (case.change)(&mut rgba_srgb);
    let is_corrected = case.fault.starts_with("pose corrected");
    let corrected_from_reported = if is_corrected { CORRECTION_M } else { 0.0 };
    let mut world_from_camera = corrected_pose(case.x_m);
    world_from_camera.translation.z += corrected_from_reported;
    Arc::new(Keyframe {
        camera: "wrist".into(),
        stamp: case.stamp,
        size_px: SIZE_PX,
        focal_px: [FOCAL_PX; 2],
        principal_px: SIZE_PX.map(|side| 0.5 * f64::from(side)),
        rgba_srgb: rgba_srgb.into(),
        depth: None,
        world_from_camera,
        twist: None,
        readout_secs: 0.0,
        joint_twists: [].into(),
        base: None,
        split: Split::Train,
        truth: None,
        robot: None,
    })
}

fn listed(case: &Case) -> KeyframePose {
    KeyframePose {
        camera: "wrist".into(),
        stamp: case.stamp,
        world_from_camera: corrected_pose(case.x_m),
        size_px: SIZE_PX,
        focal_px: [FOCAL_PX; 2],
        principal_px: SIZE_PX.map(|side| 0.5 * f64::from(side)),
    }
}

/// Half a step of exposure less.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "sRGB codes between 0 and 255"
)]
fn darken(rgba: &mut [u8]) {
    // sRGB is close to a power of 2.2, but not exactly.
    let linear = |code: u8| match f64::from(code) / 255.0 {
        value if value <= 0.04045 => value / 12.92,
        value => ((value + 0.055) / 1.055).powf(2.4),
    };
    let code = |linear: f64| 255.0 * (1.055 * linear.powf(1.0 / 2.4) - 0.055);
    for pixel in rgba.chunks_exact_mut(4) {
        for value in &mut pixel[..3] {
            *value = code(linear(*value) * 0.5_f64.sqrt())
                .clamp(0.0, 255.0)
                .round() as u8;
        }
    }
}

fn add_object(rgba: &mut [u8]) {
    let [left, top, right, bottom] = MOVED_PX;
    for (x, y) in (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y))) {
        let at = 4 * (y * SIZE_PX[0] + x) as usize;
        rgba[at..at + 3].fill(8);
    }
}

/// The mean over squares of 9 pixels.
fn blur(rgba: &mut [u8]) {
    const REACH: usize = 4;
    let [width, height] = SIZE_PX.map(|side| side as usize);
    let sharp = rgba.to_vec();
    for y in 0..height {
        for x in 0..width {
            for channel in 0..3 {
                let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
                let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
                let n = rows.len() * columns.len();
                let row_sum = |row: usize| -> usize {
                    let value = |column| usize::from(sharp[4 * (row * width + column) + channel]);
                    columns.clone().map(value).sum()
                };
                let mean = rows.map(row_sum).sum::<usize>() / n;
                rgba[4 * (y * width + x) + channel] = u8::try_from(mean).expect("a mean of bytes");
            }
        }
    }
}

/// Publishes the keyframes, and a model that is the scene itself.
fn publish(hub: &Hub, keyframes: &[Arc<Keyframe>]) {
    hub.keyframes().set_sources(keyframes);
    hub.keyframes().set(CASES.iter().map(listed).collect());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: RADIUS_M,
        world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
    });
    hub.set_status(Status {
        state: "viewing".to_owned(),
        keyframes: CASES.len() as u64,
        model: ModelStatus {
            method: "splat".to_owned(),
            step: 100,
            ..ModelStatus::default()
        },
        ..Status::default()
    });
}

#[test]
fn the_keyframe_browser_says_what_is_wrong_with_each_keyframe() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    let keyframes: Vec<_> = CASES.iter().map(keyframe).collect();
    publish(&hub, &keyframes);
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
    let received = Arc::clone(&requests);
    let renderer = RequestThread::start(hub.clone(), move |pending| {
        let request = pending.request.clone();
        let picture = draw(&request);
        received.lock().expect("no panic").push(request);
        pending.deliver(picture);
    });
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });

    check_faults(&mut browser, &scratch);
    check_wiper(&mut browser);
    check_order(&mut browser);
    check_look(&mut browser, &requests);
    check_click(&mut browser, &requests);
    check_newest(&mut browser);
    check_live(&mut browser, &hub, &scratch);
    check_missing_photograph(&mut browser, &hub);
    check_coverage(&mut browser, &hub, &requests);
    check_saved_picture(&mut browser);

    drop(browser);
    drop(renderer);
}

/// Presses a key while the panel has the focus.
fn press(browser: &mut Browser, key: &str) {
    browser.evaluate(&format!(
        "void document.getElementById('keyframe-browser')?.dispatchEvent(\
         new KeyboardEvent('keydown', {{key: '{key}', bubbles: true, cancelable: true}}))"
    ));
}

fn is_open(browser: &mut Browser) -> bool {
    browser.evaluate("document.getElementById('keyframe-browser')?.hidden === false") == true
}

/// Waits until the images of this keyframe of the order are compared.
fn wait_for_keyframe(browser: &mut Browser, place: usize) {
    let title = format!("Keyframe {place} of {}", CASES.len());
    wait_for(browser, &title, |browser| {
        browser.text("keyframe-title") == title
            && browser.evaluate("document.getElementById('keyframe-browser')?.dataset.state")
                == "shown"
            && !fact(browser, "PSNR").is_empty()
    });
}

/// A fact on the shown keyframe; empty if the page does not show it.
fn fact(browser: &mut Browser, name: &str) -> String {
    let value = browser.evaluate(&format!(
        "[...document.querySelectorAll('#keyframe-facts dt')]\
         .find((dt) => dt.textContent === '{name}')?.nextElementSibling?.textContent ?? ''"
    ));
    value.as_str().unwrap_or_default().to_owned()
}

/// Goes to the first keyframe of the order.
fn go_to_first(browser: &mut Browser) {
    for _ in 0..CASES.len() {
        press(browser, "ArrowLeft");
    }
    wait_for_keyframe(browser, 1);
}

fn check_faults(browser: &mut Browser, scratch: &Path) {
    assert_eq!(browser.text("look-nearest"), "Compare");
    browser.evaluate(
        "void document.body.dispatchEvent(new KeyboardEvent('keydown', {key: 'n', bubbles: true}))",
    );
    wait_for(browser, "the keyframe browser", is_open);
    // The view is at x = 0, and all keyframes look in the same direction.
    wait_for_keyframe(browser, 3);
    go_to_first(browser);
    for (ix, case) in CASES.iter().enumerate() {
        wait_for_keyframe(browser, ix + 1);
        let faults = browser.text("keyframe-faults");
        assert!(faults.contains(case.fault), "{}: {faults:?}", case.fault);
        // The faults of the other keyframes are not found in this one.
        for other in CASES.iter().filter(|other| other.fault != case.fault) {
            assert!(!faults.contains(other.fault), "{}: {faults:?}", case.fault);
        }
        assert_eq!(fact(browser, "Camera"), "wrist");
        assert_eq!(fact(browser, "Used for"), "training");
        let name = format!("page-keyframe-{}.png", ix + 1);
        std::fs::write(scratch.join(name), browser.screenshot()).expect("written");
        press(browser, "ArrowRight");
    }
    // At the end, the last one stays.
    wait_for_keyframe(browser, CASES.len());
}

/// Brightness of a pixel of a canvas, 0 to 765.
fn brightness(browser: &mut Browser, canvas: &str, [x, y]: [u32; 2]) -> f64 {
    let sum = browser.evaluate(&format!(
        "(() => {{ const context = document.getElementById('{canvas}')?.getContext('2d'); \
         const data = context?.getImageData({x}, {y}, 1, 1).data ?? [0, 0, 0]; \
         return data[0] + data[1] + data[2]; }})()"
    ));
    sum.as_f64().expect("a number")
}

/// The wiper uncovers the model, and the map of the error shows the object.
fn check_wiper(browser: &mut Browser) {
    for _ in 0..2 {
        press(browser, "ArrowLeft");
    }
    wait_for_keyframe(browser, 3);
    let wiper = "getComputedStyle(document.querySelector('#keyframe-render')).clipPath";
    assert_eq!(browser.evaluate(wiper), "inset(0px 0px 0px 50%)");
    browser.evaluate(
        "(() => { const wiper = document.getElementById('keyframe-wiper'); wiper.value = '20'; \
         wiper.dispatchEvent(new Event('input')); })()",
    );
    assert_eq!(browser.evaluate(wiper), "inset(0px 0px 0px 20%)");
    let on_object = [MOVED_PX[0] + 20, MOVED_PX[1] + 20];
    let beside = [MOVED_PX[2] + 40, MOVED_PX[3] + 60];
    assert!(brightness(browser, "keyframe-photo", on_object) < 60.0);
    assert!(brightness(browser, "keyframe-render", on_object) > 200.0);
    let [on_object, beside] =
        [on_object, beside].map(|at| brightness(browser, "keyframe-error", at));
    assert!(on_object > beside + 200.0, "{on_object}, {beside}");
}

/// All keyframes are measured, and the worst one is the first.
fn check_order(browser: &mut Browser) {
    /// The order is that of small pictures, in which the errors of compression differ.
    const MAX_DISORDER_DB: f64 = 4.0;
    browser.evaluate(
        "(() => { const order = document.getElementById('keyframe-order'); order.value = 'error'; \
         order.dispatchEvent(new Event('change')); })()",
    );
    wait_for(browser, "all keyframes to be measured", |browser| {
        browser.evaluate("document.getElementById('keyframe-progress')?.textContent === ''") == true
    });
    go_to_first(browser);
    let mut psnrs = Vec::new();
    for place in 1..=CASES.len() {
        wait_for_keyframe(browser, place);
        let psnr = fact(browser, "PSNR");
        let number = psnr.trim_end_matches(" dB").parse::<f64>();
        psnrs.push(number.unwrap_or_else(|error| panic!("{psnr:?}: {error}")));
        press(browser, "ArrowRight");
    }
    let is_ordered = |pair: &[f64]| pair[0] <= pair[1] + MAX_DISORDER_DB;
    assert!(psnrs.windows(2).all(is_ordered), "{psnrs:?}");
    assert!(psnrs[0] + 5.0 < psnrs[CASES.len() - 1], "{psnrs:?}");
    browser.evaluate(
        "(() => { const order = document.getElementById('keyframe-order'); order.value = 'time'; \
         order.dispatchEvent(new Event('change')); })()",
    );
}

/// The eye of the newest request of the main view, whose pictures are wider than those of the
/// browser.
fn main_request(requests: &Mutex<Vec<RenderRequest>>, width_px: u32) -> Option<RenderRequest> {
    let requests = requests.lock().expect("no panic");
    let is_main = |request: &&RenderRequest| request.size_px[0] == width_px;
    requests.iter().rev().find(is_main).cloned()
}

fn check_look(browser: &mut Browser, requests: &Mutex<Vec<RenderRequest>>) {
    go_to_first(browser);
    let width_px = canvas_bounds(browser)[2];
    browser.click("keyframe-look");
    let eye = corrected_pose(CASES[0].x_m).translation.vector;
    wait_for(browser, "the view from the keyframe", |_| {
        main_request(requests, width_px).is_some_and(|request| {
            (request.world_from_camera.translation.vector - eye).norm() < 1e-6
        })
    });
    press(browser, "Escape");
    assert!(!is_open(browser), "the panel is closed");
    assert_eq!(
        browser.evaluate("document.activeElement?.id"),
        "look-nearest",
        "the focus returns to the button"
    );
    browser.click("reset-view");
}

/// A click on a frustum opens its keyframe.
fn check_click(browser: &mut Browser, requests: &Mutex<Vec<RenderRequest>>) {
    browser.click("toggle-keyframes");
    let [left, top, width_px, height_px] = canvas_bounds(browser);
    let first_eye = (Translation3::new(0.0, 0.0, 0.3) * looking_along_y())
        .translation
        .vector;
    wait_for(browser, "the first view", |_| {
        main_request(requests, width_px).is_some_and(|request| {
            (request.world_from_camera.translation.vector - first_eye).norm() < 1e-6
        })
    });
    let request = main_request(requests, width_px).expect("it was there");
    assert_eq!(
        request.size_px,
        [width_px, height_px],
        "the picture fills the view"
    );
    // The middle of the line from the eye to the right lower corner of the last frustum, whose
    // depth is 0.12 of the radius.
    let depth = 0.06 * RADIUS_M;
    let corner = SIZE_PX.map(|side| 0.5 * f64::from(side) / FOCAL_PX * depth);
    let point = corrected_pose(CASES[4].x_m) * Point3::new(corner[0], corner[1], depth);
    let [x, y] = pixel_of(&request, &point);
    let at = [x + f64::from(left), y + f64::from(top)].map(rounded);
    let click = |browser: &mut Browser| {
        for kind in ["mouseMoved", "mousePressed", "mouseReleased"] {
            browser.mouse(kind, at);
        }
    };
    // A tool that takes clicks comes first.
    browser.click("toggle-measure");
    let hint = browser.text("measure-hint");
    click(browser);
    wait_for(browser, "an answer of the tool", |browser| {
        browser.text("measure-hint") != hint
    });
    browser.next_frame();
    assert!(!is_open(browser), "the tool takes the click");
    browser.click("toggle-measure");
    click(browser);
    wait_for_keyframe(browser, CASES.len());
    browser.click("toggle-keyframes");
}

#[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
fn rounded(px: f64) -> i32 {
    px.round() as i32
}

/// The pixel that shows a point, from the left upper corner of the picture.
fn pixel_of(request: &RenderRequest, point: &Point3<f64>) -> [f64; 2] {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        panic!("a pinhole")
    };
    let in_camera = request.world_from_camera.inverse_transform_point(point);
    [0, 1].map(|axis| focal_px[axis] * in_camera[axis] / in_camera.z + principal_px[axis])
}

/// Chooses what is compared with the model.
fn choose_source(browser: &mut Browser, value: &str) {
    browser.evaluate(&format!(
        "(() => {{ const source = document.getElementById('compare-source'); source.value = '{value}'; \
         source.dispatchEvent(new Event('change')); }})()"
    ));
}

/// Whether the buttons for other keyframes are shown.
fn can_step(browser: &mut Browser) -> bool {
    browser.evaluate("document.getElementById('keyframe-next').hidden") == false
}

fn check_newest(browser: &mut Browser) {
    assert!(can_step(browser));
    choose_source(browser, "newest");
    wait_for(browser, "the newest keyframe", |browser| {
        browser.text("keyframe-title") == "Newest keyframe"
            && browser.text("keyframe-faults").contains(CASES[4].fault)
    });
    assert!(!can_step(browser), "there is only one");
}

/// Shows a live image from the pose of a keyframe.
fn show_live(hub: &Hub, secs: i64, change: fn(&mut [u8])) {
    let pose = corrected_pose(CASES[2].x_m);
    let mut rgba_srgb = draw(&request_from(pose)).rgba_srgb;
    change(&mut rgba_srgb);
    hub.set_live_image(LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(secs * SECOND),
        captured_at: Instant::now(),
        size_px: SIZE_PX,
        pixels: LivePixels::Rgba(rgba_srgb.into()),
        world_from_camera: Some(pose),
        focal_px: [FOCAL_PX; 2],
        principal_px: SIZE_PX.map(|side| 0.5 * f64::from(side)),
    });
}

/// The live image is compared with the model from its pose, and each further image again. The panel
/// fits a phone.
fn check_live(browser: &mut Browser, hub: &Hub, scratch: &Path) {
    /// A picture of the scene itself, of which two encodings as JPEG differ.
    const MIN_PSNR: f64 = 25.0;
    let psnr = |browser: &mut Browser| {
        let text = fact(browser, "PSNR");
        text.trim_end_matches(" dB").parse::<f64>().unwrap_or(0.0)
    };
    show_live(hub, 242, add_object);
    wait_for(browser, "the camera in the list", |browser| {
        browser.evaluate("[...document.getElementById('compare-source').options].some(({value}) => value === 'live:wrist')") == true
    });
    choose_source(browser, "live:wrist");
    let stamp =
        |expected: &'static str| move |browser: &mut Browser| fact(browser, "Stamp") == expected;
    // The image may be sent again at the size of the comparison only when the next one arrives.
    show_live(hub, 243, add_object);
    wait_for(browser, "the live image", stamp("243.000 s"));
    assert_eq!(browser.text("keyframe-title"), "Live image of wrist");
    assert!(!can_step(browser));
    assert!(
        browser
            .text("keyframe-faults")
            .contains("large error in the upper left")
    );
    let with_object = psnr(browser);
    assert!((5.0..MIN_PSNR).contains(&with_object), "{with_object}");
    let on_object = [MOVED_PX[0] + 20, MOVED_PX[1] + 20];
    let beside = [MOVED_PX[2] + 40, MOVED_PX[3] + 60];
    let [on_object, beside] =
        [on_object, beside].map(|at| brightness(browser, "keyframe-error", at));
    assert!(on_object > beside + 200.0, "{on_object}, {beside}");

    show_live(hub, 244, |_| {});
    wait_for(browser, "the next live image", stamp("244.000 s"));
    assert!(psnr(browser) > MIN_PSNR, "{}", psnr(browser));
    assert!(
        browser
            .text("keyframe-faults")
            .contains("the image and the model agree")
    );

    std::fs::write(scratch.join("page-compare-live.png"), browser.screenshot()).expect("written");
    browser.resize(PHONE_PX);
    browser.next_frame();
    let bounds = browser.evaluate(
        "(() => { const b = document.getElementById('keyframe-browser').getBoundingClientRect(); \
         return [b.left, b.top, innerWidth - b.right, innerHeight - b.bottom]; })()",
    );
    let margins: Vec<f64> = bounds
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(Value::as_f64)
        .collect();
    assert!(
        margins.len() == 4 && margins.iter().all(|margin| *margin >= 0.0),
        "{margins:?}"
    );
    std::fs::write(scratch.join("page-compare-phone.png"), browser.screenshot()).expect("written");
    browser.resize(WINDOW_PX);
    choose_source(browser, "stored");
    wait_for(browser, "stored keyframes", can_step);
    for _ in 0..CASES.len() {
        press(browser, "ArrowRight");
    }
    wait_for_keyframe(browser, CASES.len());
}

/// Keyframes whose photographs are not stored are shown with the model only.
fn check_missing_photograph(browser: &mut Browser, hub: &Hub) {
    hub.keyframes().set_sources([]);
    press(browser, "ArrowLeft");
    wait_for(browser, "the reason", |browser| {
        let problem = browser.text("keyframe-problem");
        problem.contains("No photograph: the photograph of this keyframe is not stored")
    });
    wait_for(browser, "the model's picture", |browser| {
        browser.evaluate("document.getElementById('keyframe-render')?.width") == SIZE_PX[0]
    });
    let errors: Value = browser.evaluate("document.getElementById('keyframe-error')?.width");
    assert_eq!(errors, 0, "there is nothing to compare");
    browser.click("keyframe-close");
    assert!(!is_open(browser));
}

/// The page says where to look next, in world and relative to the live camera, and moves the eye to
/// this camera, because no keyframe shows the place.
fn check_coverage(browser: &mut Browser, hub: &Hub, requests: &Mutex<Vec<RenderRequest>>) {
    const N_CELLS: u32 = 20;
    const PLACE_M: [f64; 3] = [0.55, -0.45, 0.05];
    wait_for(browser, "the button", |browser| {
        browser.evaluate("document.getElementById('toggle-coverage').hidden") == false
    });
    browser.click("toggle-coverage");
    wait_for(browser, "a subscription", |_| hub.needs_observations());
    // A floor of which a corner was seen by one keyframe only.
    let cells = (0..N_CELLS).flat_map(|y| (0..N_CELLS).map(move |x| [x, y]));
    let observed = cells.map(|[x, y]| ObservedCell {
        ix: (x + N_CELLS * y) as usize,
        age_secs: 1.0,
        sigma_m: if (14..17).contains(&x) && (4..7).contains(&y) {
            f64::INFINITY
        } else {
            5e-4
        },
    });
    hub.set_observations(&ObservationMap {
        min_m: [-1.0, -1.0, 0.0],
        cell_m: 0.1,
        n_cells: [N_CELLS, N_CELLS, 1],
        observed: observed.collect(),
        n_keyframes: CASES.len(),
        newest_at: Some(Instant::now()),
    });
    wait_for(browser, "the place", |browser| {
        browser.text("coverage-text").contains("too few directions")
    });
    assert!(browser.text("coverage-text").contains("place 1 at x 0."));
    let camera = Translation3::new(0.05, 1.05, 0.0) * looking_along_y();
    hub.set_live_image(LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(245 * SECOND),
        captured_at: Instant::now(),
        size_px: SIZE_PX,
        pixels: LivePixels::Rgba(draw(&request_from(camera)).rgba_srgb.into()),
        world_from_camera: Some(camera),
        focal_px: [FOCAL_PX; 2],
        principal_px: SIZE_PX.map(|side| 0.5 * f64::from(side)),
    });
    wait_for(browser, "the direction", |browser| {
        let text = browser.text("coverage-text");
        text.contains("from wrist: turn right 45 degrees") && text.contains("m lower")
    });
    browser.click("coverage-look");
    let [_, _, width_px, _] = canvas_bounds(browser);
    wait_for(browser, "the view of the place", |_| {
        main_request(requests, width_px).is_some_and(|request| {
            let moved = request.world_from_camera.translation.vector - camera.translation.vector;
            let [x, y] = pixel_of(&request, &Point3::from(PLACE_M));
            let [width, height] = request.size_px.map(f64::from);
            // The place is known to about a cell.
            moved.norm() < 1e-4 && (x / width - 0.5).abs() < 0.2 && (y / height - 0.5).abs() < 0.2
        })
    });
    browser.click("toggle-coverage");
    assert_eq!(
        browser.evaluate("document.getElementById('coverage').hidden"),
        true
    );
    wait_for(browser, "no subscription", |_| !hub.needs_observations());
}

/// The saved file is a picture of the size of the view, and the page says its name.
fn check_saved_picture(browser: &mut Browser) {
    browser.evaluate(
        "(() => { HTMLAnchorElement.prototype.click = function () { window.savedName = this.download; }; \
         URL.createObjectURL = (file) => { void createImageBitmap(file).then(({width, height}) => \
         (window.savedPicture = [file.type, width, height].join())); return 'about:blank'; }; })()",
    );
    let expected = "(() => { const {width, height} = document.getElementById('canvas'); \
                    return ['image/png', width, height].join(); })()";
    let expected = browser.evaluate(expected);
    browser.click("save-picture");
    wait_for(browser, "the saved picture", |browser| {
        browser.evaluate("window.savedPicture ?? ''") == expected
    });
    let name = browser.evaluate("window.savedName");
    let name = name.as_str().expect("a name");
    assert!(
        // The pictures of this server name no run and no model; see `picture_caption.test.ts`.
        name.starts_with("fieldrig-20") && name.ends_with(".png") && !name.contains(' '),
        "{name}"
    );
    let note = format!("Saved {name}");
    wait_for(browser, "the name of the file", |browser| {
        browser.text("toast") == note
    });
}
