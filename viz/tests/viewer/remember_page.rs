//! Opens the page in a real browser, and finds its view again: after a reload, by a link, and by
//! name. Then goes back in time.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use analytic_scene::{draw, looking_along_y};
use keyframe::{Keyframe, Split};
use kinematics::{Stamp, Transform};
use nalgebra::Translation3;
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{Hub, KeyframePose, SceneHint, Server, ServerConfig};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Links contain positions in micrometers.
const MAX_ERROR: f64 = 1e-4;
/// Times of the keyframes, seconds.
const KEYFRAME_SECS: [i64; 3] = [1000, 1065, 1130];
const KEYFRAME_PX: [u32; 2] = [64, 48];
/// Gray levels of their photographs, and how much JPEG may change them.
const GRAY_LEVELS: [u8; 3] = [40, 120, 200];
const MAX_GRAY_ERROR: u64 = 6;
/// Addresses that somebody may have written by hand: none of them changes the view.
const HOSTILE: [&str; 4] = [
    "#view=1~pNaN_0_0~t0_0_0",
    "#view=1~p1_2_3~t1_2_3~l<b>",
    "#view=%3Cscript%3E",
    "#view=2~p1_2_3~t0_0_0",
];

type Requests = Arc<Mutex<Vec<RenderRequest>>>;

#[test]
fn page_finds_its_view_again() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
    });
    let keyframes = keyframes();
    hub.keyframes().set_sources(&keyframes);
    hub.keyframes().set(keyframes.iter().map(listed).collect());
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let requests = Requests::default();
    let received = Arc::clone(&requests);
    let renderer = RequestThread::start(hub, move |pending| {
        if pending.request.projection != Projection::Equirectangular {
            received
                .lock()
                .expect("no panic")
                .push(pending.request.clone());
        }
        let picture = draw(&pending.request);
        pending.deliver(picture);
    });
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    let first = full_view(&mut browser, &requests);
    assert_eq!(
        browser.evaluate("location.hash"),
        json!(""),
        "an untouched view is not in the address"
    );

    let front = check_reload(&mut browser, &requests, &first);
    check_link(&mut browser, &requests, &server.url(), &front);
    check_named_views(&mut browser, &requests);
    for address in HOSTILE {
        open(&mut browser, &format!("{}{address}", server.url()));
        wait_for(
            &mut browser,
            &format!("the first view for {address}"),
            |browser| distance(&full_view(browser, &requests), &first) < MAX_ERROR,
        );
    }
    check_time(&mut browser, &requests);
    drop(browser);
    drop(renderer);
}

/// Keyframes of one camera that moves along x. Each photograph has one gray level.
fn keyframes() -> Vec<Arc<Keyframe>> {
    let at = |(ix, secs): (usize, i64)| {
        let gray = GRAY_LEVELS[ix];
        let n_pixels = (KEYFRAME_PX[0] * KEYFRAME_PX[1]) as usize;
        Arc::new(Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(secs * 1_000_000_000),
            size_px: KEYFRAME_PX,
            focal_px: [56.0; 2],
            principal_px: [32.0, 24.0],
            rgba_srgb: [gray, gray, gray, 255].repeat(n_pixels).into(),
            depth: None,
            world_from_camera: Transform::translation(0.3 * ix as f64 - 0.3, 0.4, 0.3)
                * looking_along_y(),
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        })
    };
    KEYFRAME_SECS.into_iter().enumerate().map(at).collect()
}

fn listed(keyframe: &Arc<Keyframe>) -> KeyframePose {
    KeyframePose {
        camera: Arc::clone(&keyframe.camera),
        stamp: keyframe.stamp,
        world_from_camera: keyframe.world_from_camera,
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
    }
}

/// Waits for the photograph with this gray level beside the slider.
fn wait_for_photograph(browser: &mut Browser, gray: u8) {
    let shown = "(() => { const photo = document.getElementById('history-photo'); return !photo || photo.hidden ? null : \
         photo.getContext('2d').getImageData(0, 0, 1, 1).data[0]; })()";
    wait_for(
        browser,
        &format!("the photograph of gray {gray}"),
        |browser| {
            let level = browser.evaluate(shown).as_u64();
            level.is_some_and(|level| level.abs_diff(u64::from(gray)) <= MAX_GRAY_ERROR)
        },
    );
}

/// Layers, camera path, field of view and camera return after a reload. Returns the view.
fn check_reload(browser: &mut Browser, requests: &Requests, first: &Transform) -> Transform {
    browser.click("toggle-grid");
    browser.click("path-add");
    browser.click("look-front");
    browser.click("path-add");
    browser.click("toggle-crop");
    wait_for(browser, "the view in the address", |browser| {
        let hash = browser.evaluate("location.hash");
        let hash = hash.as_str().unwrap_or_default();
        hash.starts_with("#view=1~") && hash.contains("~k2_") && hash.contains("crop")
    });
    wait_for(browser, "the front view", |browser| {
        distance(&full_view(browser, requests), first) > 0.1
    });
    let front = full_view(browser, requests);
    reload(browser);
    wait_for(browser, "the same view", |browser| {
        distance(&full_view(browser, requests), &front) < MAX_ERROR
    });
    // The panel beside the view changes the shape of the view, and thus its requests.
    for is_hidden in [true, false] {
        browser.click("toggle-run");
        reload(browser);
        wait_for(browser, "the panel as before", |browser| {
            browser.evaluate("document.getElementById('run')?.hidden") == json!(is_hidden)
        });
    }
    wait_for(browser, "the same view again", |browser| {
        distance(&full_view(browser, requests), &front) < MAX_ERROR
    });
    assert_eq!(pressed(browser, "toggle-grid"), json!("false"));
    assert_eq!(pressed(browser, "toggle-crop"), json!("true"));
    assert_eq!(pressed(browser, "toggle-robot"), json!("true"));
    assert_eq!(browser.text("path-count"), "2 views");
    let crop = requests.lock().expect("no panic").last().cloned();
    assert!(crop.is_some_and(|request| request.crop.is_some()));
    browser.click("toggle-crop");
    browser.click("toggle-grid");
    front
}

/// A copied link has the view, and nothing secret. It opens the view in a page that shows another.
fn check_link(browser: &mut Browser, requests: &Requests, url: &str, front: &Transform) {
    browser.evaluate(
        "Object.defineProperty(navigator, 'clipboard', { value: { writeText: (text) => { window.copied = text; \
         return Promise.resolve(); } } }); 0",
    );
    browser.click("toggle-views");
    browser.click("copy-link");
    wait_for(browser, "a link", |browser| {
        browser.text("views-note").starts_with("Copied")
    });
    let link = browser.evaluate("window.copied");
    let link = link.as_str().expect("a link").to_owned();
    assert!(link.starts_with(&format!("{url}#view=1~p")), "{link}");
    browser.click("look-top");
    wait_for(browser, "the view from above", |browser| {
        distance(&full_view(browser, requests), front) > 0.1
    });
    open(browser, &link);
    wait_for(browser, "the view of the link", |browser| {
        distance(&full_view(browser, requests), front) < MAX_ERROR
    });
}

/// Views can be saved, shown, renamed and deleted, and stay in the browser.
fn check_named_views(browser: &mut Browser, requests: &Requests) {
    let front = full_view(browser, requests);
    save_view(browser, "<b>front</b>");
    browser.click("look-top");
    wait_for(browser, "the view from above", |browser| {
        distance(&full_view(browser, requests), &front) > 0.1
    });
    save_view(browser, "");
    assert_eq!(names(browser), json!(["<b>front</b>", "View 2"]));
    reload(browser);
    wait_for(browser, "the saved views", |browser| {
        names(browser) == json!(["<b>front</b>", "View 2"])
    });
    click_in_row(browser, 0, 0);
    wait_for(browser, "the saved view", |browser| {
        distance(&full_view(browser, requests), &front) < MAX_ERROR
    });
    click_in_row(browser, 0, 1);
    browser.evaluate(
        "(() => { const input = document.querySelector('#named-views input'); input.value = 'door'; \
         input.dispatchEvent(new Event('blur')); })()",
    );
    wait_for(browser, "the new name", |browser| {
        names(browser) == json!(["door", "View 2"])
    });
    click_in_row(browser, 1, 2);
    assert_eq!(names(browser), json!(["door"]));
}

/// The slider leaves out the keyframes after its time, until it returns to the present.
fn check_time(browser: &mut Browser, requests: &Requests) {
    wait_for(browser, "the button", |browser| {
        browser.evaluate("document.getElementById('toggle-history')?.hidden") == json!(false)
    });
    for button in [
        "reset-view",
        "toggle-model",
        "toggle-grid",
        "toggle-history",
    ] {
        browser.click(button);
    }
    // Texts over the view change all the time. Only the frustums are compared.
    browser.evaluate(
        "for (const shown of document.querySelectorAll('#view > :not(canvas)')) shown.style.visibility = 'hidden'; 0",
    );
    let text =
        |text: &'static str| move |browser: &mut Browser| browser.text("history-text") == text;
    wait_for(
        browser,
        "the present",
        text("2:10 of 2:10, keyframe 3 of 3, camera wrist"),
    );
    let all = canvas_shot(browser);
    browser.evaluate(
        "(() => { const slider = document.getElementById('history-time'); slider.value = '1'; \
         slider.dispatchEvent(new Event('input')); })()",
    );
    wait_for(
        browser,
        "the time",
        text("1:05 of 2:10, keyframe 2 of 3, camera wrist"),
    );
    wait_for_photograph(browser, GRAY_LEVELS[1]);
    wait_for(browser, "fewer frustums", |browser| {
        canvas_shot(browser) != all
    });
    browser.click("history-before");
    wait_for(
        browser,
        "the first keyframe",
        text("0:00 of 2:10, keyframe 1 of 3, camera wrist"),
    );
    wait_for_photograph(browser, GRAY_LEVELS[0]);
    browser.click("history-now");
    wait_for(browser, "all frustums", |browser| {
        canvas_shot(browser) == all
    });
    browser.click("history-before");
    browser.click("history-look");
    let chosen = keyframes()[1].world_from_camera;
    wait_for(browser, "the view of the keyframe", |browser| {
        distance(&full_view(browser, requests), &chosen) < MAX_ERROR
    });
    browser.click("reset-view");
    browser.click("history-now");
    wait_for(browser, "all frustums from the same view", |browser| {
        canvas_shot(browser) == all
    });
    // A closed panel shows the layers as before.
    browser.click("toggle-history");
    wait_for(browser, "no frustums", |browser| {
        canvas_shot(browser) != all
    });
}

/// Waits for a picture in full resolution, and returns its view.
fn full_view(browser: &mut Browser, requests: &Requests) -> Transform {
    wait_for(browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    let requests = requests.lock().expect("no panic");
    requests.last().expect("drawn").world_from_camera
}

/// How much two views differ: the larger of the distance in meters and the angle in radians.
fn distance(a: &Transform, b: &Transform) -> f64 {
    let motion = a.inverse() * b;
    (motion.translation.vector.norm()).max(motion.rotation.angle())
}

fn save_view(browser: &mut Browser, name: &str) {
    browser.evaluate(&format!(
        "(() => {{ document.getElementById('view-name').value = {}; \
         document.getElementById('save-view').requestSubmit(); }})()",
        json!(name)
    ));
}

fn names(browser: &mut Browser) -> Value {
    browser.evaluate(
        "[...document.querySelectorAll('#named-views .name')].map((button) => button.textContent)",
    )
}

fn click_in_row(browser: &mut Browser, row: usize, button: usize) {
    browser.evaluate(&format!(
        "document.querySelectorAll('#named-views li')[{row}].querySelectorAll('button')[{button}].click()"
    ));
}

fn pressed(browser: &mut Browser, id: &str) -> Value {
    browser.evaluate(&format!(
        "document.getElementById('{id}')?.getAttribute('aria-pressed') ?? null"
    ))
}

fn reload(browser: &mut Browser) {
    browser.evaluate("window.isOld = true");
    browser.call("Page.reload", json!({}));
    wait_for_new_page(browser);
}

/// Opens an address as a new page, even if only its fragment differs.
fn open(browser: &mut Browser, address: &str) {
    browser.call("Page.navigate", json!({"url": "about:blank"}));
    browser.evaluate("window.isOld = true");
    browser.call("Page.navigate", json!({"url": address}));
    wait_for_new_page(browser);
}

fn wait_for_new_page(browser: &mut Browser) {
    wait_for(browser, "the new page", |browser| {
        browser.evaluate("window.isOld ?? false") == json!(false)
    });
}
