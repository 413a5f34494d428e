//! Uses the bundled page in a real browser as people do: with the keyboard alone, with a mouse, and
//! with a finger on a phone.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use crate::request_thread::RequestThread;
use crate::robot;
use analytic_scene::{draw, looking_along_y};
use nalgebra::{Translation3, Vector3};
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{Hub, ModelStatus, SceneHint, Server, Status};

const DESKTOP_PX: [u32; 2] = [1440, 900];
const PHONE_PX: [u32; 2] = [390, 844];
const TURNED_PHONE_PX: [u32; 2] = [844, 390];
/// A view without requests for this long is at rest.
const REST: Duration = Duration::from_millis(300);
/// Undoes what the support of tests does, so that this is the first visit of the page.
const FIRST_VISIT: &str = "try { localStorage.removeItem('gestures-seen'); } catch {}";
/// A device with a touch screen and without mouse, as phones are.
const TOUCH_ONLY: &str = "
    const answer = window.matchMedia.bind(window);
    window.matchMedia = (query) => !query.includes('pointer') ? answer(query) : {
        matches: query.includes('coarse'), addEventListener() {}, removeEventListener() {},
    };";
/// Everything on the page that assistive technology could not use. As in common checkers: names,
/// unique ids, valid references, landmarks, headings in order, lists, reachable controls.
const PROBLEMS: &str = r#"(() => {
    const found = [];
    const all = (selector) => [...document.querySelectorAll(selector)];
    const text = (element) => element?.textContent.trim() ?? '';
    const described = (element) => `${element.tagName.toLowerCase()}#${element.id} ${text(element).slice(0, 20)}`;
    const referenced = (element, attribute) =>
        (element.getAttribute(attribute) ?? '').split(' ').filter(Boolean).map((id) => document.getElementById(id));
    const name = (element) => [
        element.getAttribute('aria-label') ?? '',
        ...referenced(element, 'aria-labelledby').map(text),
        ...[...(element.labels ?? [])].map(text),
        element.matches('button, summary, a, [role=button]') ? text(element) : '',
        element.getAttribute('title') ?? '',
    ].join('').trim();
    const ids = all('[id]').map(({ id }) => id);
    for (const id of new Set(ids)) if (ids.filter((other) => other === id).length > 1) found.push(`two ids ${id}`);
    for (const element of all('button, input, select, textarea, a[href], summary, dialog, aside, main, [tabindex], '
        + '[role=application], [role=button], [role=group], [role=img], [role=slider], [role=switch], [role=toolbar]'))
        if (name(element) === '') found.push(`no name: ${described(element)}`);
    for (const attribute of ['aria-controls', 'aria-labelledby', 'aria-describedby'])
        for (const element of all(`[${attribute}]`))
            if (referenced(element, attribute).includes(null)) found.push(`${attribute}: ${described(element)}`);
    for (const element of all('button:enabled, input:enabled, select:enabled'))
        if (element.tabIndex < 0 || element.closest('[aria-hidden=true]')) found.push(`unreachable: ${described(element)}`);
    for (const element of all('[tabindex]')) if (element.tabIndex > 0) found.push(`order: ${described(element)}`);
    const shown = all('h1, h2, h3, h4').filter((heading) => heading.checkVisibility() && !heading.closest('dialog'));
    const levels = shown.map((heading) => Number(heading.tagName[1]));
    if (levels[0] !== 1 || levels.filter((level) => level === 1).length !== 1) found.push(`headings ${levels}`);
    levels.forEach((level, ix) => { if (level > (levels[ix - 1] ?? 0) + 1) found.push(`a level is left out: ${levels}`); });
    if (all('main').length !== 1 || all('body > header').length !== 1) found.push('landmarks');
    if (all('main aside, main main, aside main').length > 0) found.push('landmarks in landmarks');
    if (all('ul > :not(li), ol > :not(li), dl > :not(dt, dd, div)').length > 0) found.push('lists');
    if (all('button button, button a, button [tabindex], [role=button] button').length > 0) found.push('nested controls');
    if (!document.documentElement.lang || !document.title) found.push('language or title');
    return found;
})()"#;

struct Page {
    browser: Browser,
    hub: Hub,
    requests: Arc<Mutex<Vec<RenderRequest>>>,
    renderer: RequestThread,
    server: Server,
}

impl Page {
    /// `None` without Chromium.
    fn open(size_px: [u32; 2], script: &str) -> Option<Self> {
        let program = browser_for_page()?;
        let hub = Hub::new();
        hub.set_scene_hint(SceneHint {
            center_m: [0.0, 0.0, 0.2],
            radius_m: 0.8,
            world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
        });
        let server = serve(&hub);
        let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
        let received = Arc::clone(&requests);
        let renderer = RequestThread::start(hub.clone(), move |pending| {
            // Panoramas are requested for the surroundings of the view.
            if pending.request.projection != Projection::Equirectangular {
                let mut received = received.lock().expect("no panic");
                received.push(pending.request.clone());
            }
            let picture = draw(&pending.request);
            pending.deliver(picture);
        });
        let script = format!("{NO_DRAWING}{script}");
        let browser = Browser::open_with(&program, &server.url(), size_px, &script);
        let mut page = Self {
            browser,
            hub,
            requests,
            renderer,
            server,
        };
        page.wait("a full picture", |browser| {
            browser.text("picture-text").contains("100 %")
        });
        Some(page)
    }

    fn close(self) {
        drop(self.browser);
        drop((self.renderer, self.server));
    }

    fn wait(&mut self, what: &str, is_there: impl FnMut(&mut Browser) -> bool) {
        wait_for(&mut self.browser, what, is_there);
    }

    /// Waits until an expression is true.
    fn wait_until(&mut self, what: &str, expression: &str) {
        self.wait(what, |browser| browser.evaluate(expression) == true);
    }

    fn is(&mut self, expression: &str) -> bool {
        self.browser.evaluate(expression) == true
    }

    fn strings(&mut self, expression: &str) -> Vec<String> {
        serde_json::from_value(self.browser.evaluate(expression)).expect("strings")
    }

    /// Presses and releases a key. `code` is its place; `modifiers` are 2 for Control, 8 for Shift.
    fn key(&mut self, key: &str, code: &str, modifiers: u32) {
        let virtual_key = match code {
            "Tab" => 9,
            "Escape" => 27,
            "ArrowLeft" => 37,
            "ArrowRight" => 39,
            _ => u32::from(code.as_bytes()[code.len() - 1]),
        };
        let mut event = json!({"type": "keyDown", "key": key, "code": code, "modifiers": modifiers,
                               "windowsVirtualKeyCode": virtual_key});
        if key.len() == 1 && modifiers & 2 == 0 {
            event["text"] = json!(key);
        }
        self.browser.call("Input.dispatchKeyEvent", event.clone());
        event["type"] = json!("keyUp");
        self.browser.call("Input.dispatchKeyEvent", event);
    }

    fn letter(&mut self, letter: char) {
        let code = format!("Key{}", letter.to_ascii_uppercase());
        self.key(&letter.to_string(), &code, 0);
    }

    fn focus(&mut self, id: &str) {
        self.browser
            .evaluate(&format!("document.getElementById('{id}').focus()"));
    }

    fn is_pressed(&mut self, id: &str) -> bool {
        self.is(&format!(
            "document.getElementById('{id}')?.getAttribute('aria-pressed') === 'true'"
        ))
    }

    /// Whether an element is drawn.
    fn is_visible(&mut self, id: &str) -> bool {
        self.is(&format!(
            "document.getElementById('{id}')?.checkVisibility() === true"
        ))
    }

    /// Waits until the view is at rest and shown in full.
    fn rest(&mut self) {
        self.browser.next_frame();
        let requests = Arc::clone(&self.requests);
        let mut n_requests = usize::MAX;
        self.wait("a full picture at rest", |browser| {
            let n = requests.lock().expect("no panic").len();
            let before = std::mem::replace(&mut n_requests, n);
            std::thread::sleep(REST);
            before == n && browser.text("picture-text").contains("100 %")
        });
    }

    fn last_request(&self) -> RenderRequest {
        let requests = self.requests.lock().expect("no panic");
        requests.last().expect("a picture was requested").clone()
    }

    /// Waits for a request from another viewpoint; returns the motion in the frame of the camera
    /// before: its translation in meters, and its rotation in radians.
    fn motion_since(&mut self, before: &RenderRequest) -> (Vector3<f64>, f64) {
        let requests = Arc::clone(&self.requests);
        let mut motion = (Vector3::zeros(), 0.0);
        self.wait("another viewpoint", |_| {
            let last = requests.lock().expect("no panic").last().cloned();
            let Some(last) = last else { return false };
            let relative = before.world_from_camera.inverse() * last.world_from_camera;
            motion = (relative.translation.vector, relative.rotation.angle());
            motion.0.norm() > 1e-3
        });
        motion
    }

    fn check_accessibility(&mut self, when: &str) {
        assert_eq!(self.strings(PROBLEMS), [""; 0], "{when}");
    }
}

/// Presses (`touchStart`) or releases (`touchEnd`) a finger at the center of an element.
fn touch(browser: &mut Browser, kind: &str, id: &str) {
    let center = browser.evaluate(&format!(
        "(() => {{ const b = document.getElementById('{id}').getBoundingClientRect(); \
             return {{ x: b.x + b.width / 2, y: b.y + b.height / 2 }}; }})()"
    ));
    let points = if kind == "touchEnd" {
        json!([])
    } else {
        json!([center])
    };
    browser.call(
        "Input.dispatchTouchEvent",
        json!({"type": kind, "touchPoints": points}),
    );
}

/// The status of a run with a model that can be edited.
fn status() -> Status {
    Status {
        state: "training".to_owned(),
        model: ModelStatus {
            method: "splat".to_owned(),
            step: 7,
            ..ModelStatus::default()
        },
        ..Status::default()
    }
}

#[test]
fn the_page_can_be_used_with_keys_alone() {
    let Some(mut page) = Page::open(DESKTOP_PX, FIRST_VISIT) else {
        return;
    };
    check_gesture_hint(&mut page);
    check_buttons_stay(&mut page);
    page.check_accessibility("at the start");
    check_keys_after_controls(&mut page);
    check_view_keys(&mut page);
    check_escape(&mut page);
    check_titles(&mut page);
    check_tooltip_of_focus(&mut page);
    check_help(&mut page);
    check_ring(&mut page);
    check_switches(&mut page);
    check_full_screen(&mut page);
    check_announcements(&mut page);
    page.close();
}

/// The first visit shows the three gestures of the mouse, until they are used.
fn check_gesture_hint(page: &mut Page) {
    assert!(page.is_visible("gesture-hint"), "a hint at the first visit");
    let gestures = page.strings(
        "[...document.querySelectorAll('#gesture-hint b')].map((what) => what.textContent)",
    );
    assert_eq!(gestures, ["orbit", "pan", "zoom"]);
    assert!(!page.browser.text("gesture-hint").contains("finger"));
    page.browser.mouse("mousePressed", [400, 400]);
    page.browser.mouse("mouseMoved", [420, 400]);
    page.browser.mouse("mouseReleased", [420, 400]);
    page.wait_until(
        "the end of the hint",
        "document.getElementById('gesture-hint')?.hidden === true",
    );
    assert_eq!(
        page.browser
            .evaluate("localStorage.getItem('gestures-seen')"),
        "1",
        "the next visit does not show it"
    );
}

/// Buttons that appear with the model and the robot do not move others.
fn check_buttons_stay(page: &mut Page) {
    const PLACES: &str = "window.places = () => Object.fromEntries(
        [...document.querySelectorAll('#toolbar button')].filter((button) => button.checkVisibility())
            .map((button) => [button.id, [button.offsetLeft, button.offsetTop].join()])), 0";
    page.browser.evaluate(PLACES);
    let before = page.browser.evaluate("places()");
    page.hub.set_status(status());
    page.hub.set_robot(robot::description());
    page.hub.set_robot_state(robot::state(0.0));
    page.wait_until(
        "another button",
        &format!(
            "Object.keys(places()).length > {}",
            before.as_object().map_or(0, serde_json::Map::len)
        ),
    );
    page.wait_until(
        "the robot",
        "document.getElementById('toggle-robot')?.hidden === false",
    );
    let after = page.browser.evaluate("places()");
    for (id, place) in before.as_object().expect("places") {
        assert_eq!(&after[id], place, "the button {id} has moved");
    }
    // Their order does not depend on which of them appears first.
    assert_eq!(
        page.strings("[...document.querySelectorAll('#late-tools button')].map(({ id }) => id)"),
        [
            "toggle-edit",
            "toggle-steer",
            "toggle-incidents",
            "toggle-follow",
            "toggle-history"
        ]
    );
}

/// Keys work after a slider, a list or a button was used; text fields and sliders keep their own.
fn check_keys_after_controls(page: &mut Page) {
    page.browser.click("toggle-settings");
    for control in ["opacity", "refresh", "path-add"] {
        let before = page.is_pressed("toggle-grid");
        page.focus(control);
        page.letter('g');
        assert_eq!(
            page.is_pressed("toggle-grid"),
            !before,
            "G after {control} was used"
        );
        let expected = if before { "Grid off" } else { "Grid on" };
        assert_eq!(page.browser.text("announcer"), expected);
    }
    assert_eq!(
        page.browser
            .evaluate("document.getElementById('refresh').value"),
        "pauses",
        "the list has not changed"
    );
    page.rest();
    let request = page.last_request();
    let opacity = "document.getElementById('opacity').value";
    let before = page.browser.evaluate(opacity);
    page.focus("opacity");
    page.key("ArrowLeft", "ArrowLeft", 0);
    assert_ne!(
        page.browser.evaluate(opacity),
        before,
        "arrow keys stay with a slider"
    );
    page.key("ArrowRight", "ArrowRight", 0);
    page.rest();
    assert_eq!(
        page.last_request().world_from_camera,
        request.world_from_camera
    );
    page.browser.click("toggle-settings");
    // Keys of the movement have no other meaning while flying.
    page.browser.click("toggle-fly");
    page.letter('d');
    assert!(!page.is_pressed("toggle-measure"), "D moves the eye");
    page.browser.click("toggle-fly");
    page.letter('d');
    assert!(page.is_pressed("toggle-measure"), "D measures");
    page.letter('d');
    page.browser.click("reset-view");
}

/// The focused view orbits, pans and zooms with keys.
fn check_view_keys(page: &mut Page) {
    page.focus("canvas");
    page.rest();
    let before = page.last_request();
    page.key("ArrowRight", "ArrowRight", 0);
    let (shift, angle) = page.motion_since(&before);
    assert!(
        shift.x > 0.0 && angle > 0.05,
        "an orbit to the right: {shift}, {angle} rad"
    );
    page.rest();
    let before = page.last_request();
    page.key("ArrowLeft", "ArrowLeft", 8);
    let (shift, angle) = page.motion_since(&before);
    assert!(
        shift.x < 0.0 && angle < 1e-6,
        "a shift to the left: {shift}, {angle} rad"
    );
    page.rest();
    let before = page.last_request();
    page.key("+", "Equal", 0);
    let (shift, angle) = page.motion_since(&before);
    assert!(
        shift.z > 0.0 && angle < 1e-6,
        "a step closer: {shift}, {angle} rad"
    );
}

/// Escape closes the topmost panel first, then modes; also from a control in the panel.
fn check_escape(page: &mut Page) {
    page.browser.click("toggle-measure");
    page.browser.click("toggle-settings");
    page.focus("opacity");
    page.key("Escape", "Escape", 0);
    assert!(!page.is_visible("settings") && page.is_pressed("toggle-measure"));
    assert_eq!(
        page.browser.evaluate("document.activeElement.id"),
        "toggle-settings",
        "the focus returns"
    );
    page.key("Escape", "Escape", 0);
    assert!(!page.is_pressed("toggle-measure"), "the mode has ended");
    assert!(page.is_visible("run"), "the side panel is no layer");
}

/// The title of a button is shown when the keyboard reaches it.
fn check_tooltip_of_focus(page: &mut Page) {
    page.focus("canvas");
    page.key("Tab", "Tab", 0);
    assert!(page.is("document.activeElement.closest('#toolbar') !== null"));
    page.wait_until(
        "a tooltip",
        "document.getElementById('tooltip')?.hidden === false",
    );
    assert!(page.is("document.activeElement.getAttribute('aria-describedby') === 'tooltip'"));
    let first = page.browser.evaluate("document.activeElement.id");
    page.key("ArrowRight", "ArrowRight", 0);
    assert!(page.is("document.activeElement.closest('#toolbar') !== null"));
    assert_ne!(page.browser.evaluate("document.activeElement.id"), first);
    page.key("ArrowLeft", "ArrowLeft", 0);
    assert_eq!(page.browser.evaluate("document.activeElement.id"), first);
    let text = page.browser.text("tooltip");
    assert!(
        text.contains('(') && text.ends_with(')'),
        "explanation and key: {text}"
    );
    assert!(
        page.is("document.activeElement.title === ''"),
        "the browser shows no second one"
    );
    page.key("Escape", "Escape", 0);
    assert!(!page.is_visible("tooltip"));
    assert_eq!(
        page.browser.evaluate("document.activeElement.title"),
        json!(text)
    );
}

/// The title of every button with keys ends with them, and shows no others.
fn check_titles(page: &mut Page) {
    let wrong = page.strings(
        r#"[...document.querySelectorAll('[aria-keyshortcuts]:not([aria-keyshortcuts=""])')]
            .filter(({ title }) => !title.endsWith(')') || title.match(/\((.|[A-Z][A-Za-z+]+)\)/g)?.length > 1)
            .map(({ id, title }) => `${id}: ${title}`)"#,
    );
    assert_eq!(wrong, [""; 0]);
}

/// The help has gestures of the mouse and all keys, each with one meaning, and can be searched.
fn check_help(page: &mut Page) {
    page.key("?", "Slash", 8);
    page.wait_until("the help", "document.getElementById('help')?.open === true");
    page.check_accessibility("in the help");
    let titles = page
        .strings("[...document.querySelectorAll('#keys h3')].map((title) => title.textContent)");
    assert!(titles.contains(&"Mouse".to_owned()), "{titles:?}");
    assert!(!titles.contains(&"Touch screen".to_owned()), "{titles:?}");
    let keys = page.strings(
        "[...document.querySelectorAll('#keys section')]
            .filter((group) => group.querySelector('h3').textContent.startsWith('Keys: '))
            .filter((group) => !/flying|view, after/.test(group.querySelector('h3').textContent))
            .flatMap((group) => [...group.querySelectorAll('dt')].flatMap((key) => key.textContent.split(' or ')))",
    );
    assert!(keys.len() > 20, "{keys:?}");
    let mut unique = keys.clone();
    unique.sort();
    unique.dedup();
    assert_eq!(unique.len(), keys.len(), "keys with two meanings: {keys:?}");
    assert!(page.is(
        "(() => { const { scrollHeight, clientHeight } = document.getElementById('help'); \
         return scrollHeight <= clientHeight + 1; })()"
    ));
    // Keys of the page have no effect under the help, and none while a text is typed.
    let before = page.is_pressed("toggle-grid");
    page.letter('g');
    page.focus("help-filter");
    for letter in "grid".chars() {
        page.letter(letter);
    }
    assert_eq!(page.is_pressed("toggle-grid"), before);
    let shown = page.strings(
        "[...document.querySelectorAll('#keys dd')].filter((text) => text.checkVisibility())
            .map((text) => text.textContent.toLowerCase())",
    );
    assert!(
        !shown.is_empty() && shown.iter().all(|text| text.contains("grid")),
        "{shown:?}"
    );
    // In a field with a text, browsers only clear the text.
    page.key("Escape", "Escape", 0);
    page.wait_until(
        "the end of the help",
        "document.getElementById('help')?.open === false",
    );
    page.key("?", "Slash", 8);
    page.wait_until("the help", "document.getElementById('help')?.open === true");
    page.browser.click("close-help");
    assert!(!page.is_visible("help"));
}

/// A button that was clicked has no ring when a key of another button is pressed.
fn check_ring(page: &mut Page) {
    let center = page.browser.evaluate(
        "(() => { const b = document.getElementById('look-overview').getBoundingClientRect(); \
         return [Math.round(b.x + b.width / 2), Math.round(b.y + b.height / 2)]; })()",
    );
    let center: [i32; 2] = serde_json::from_value(center).expect("a point");
    for kind in ["mousePressed", "mouseReleased"] {
        page.browser.mouse(kind, center);
    }
    page.wait_until(
        "the focus",
        "document.activeElement?.id === 'look-overview'",
    );
    page.letter('t');
    let ring = "getComputedStyle(document.activeElement).outlineStyle";
    assert_eq!(page.browser.evaluate(ring), "none");
    page.key("ArrowRight", "ArrowRight", 0);
    assert_eq!(
        page.browser.evaluate(ring),
        "solid",
        "the focus was moved by a key"
    );
}

/// The state of a switch is visible by a contrast of 3:1 between its knob positions and tracks.
fn check_switches(page: &mut Page) {
    page.browser.click("toggle-layers");
    let marks = "['toggle-grid', 'toggle-keyframes'].map((id) => {
        const { backgroundImage, borderColor } = getComputedStyle(document.getElementById(id), '::before');
        return backgroundImage + borderColor;
    })";
    // One is on, and the other one is off.
    if page.is_pressed("toggle-grid") == page.is_pressed("toggle-keyframes") {
        page.browser.click("toggle-grid");
    }
    let marks = page.strings(marks);
    assert_ne!(marks[0], marks[1]);
    assert!(
        marks.iter().all(|mark| mark.contains("gradient")),
        "{marks:?}"
    );
    page.browser.click("toggle-layers");
}

/// Full screen shows nothing but the view and its controls.
fn check_full_screen(page: &mut Page) {
    let center = page.browser.evaluate(
        "(() => { const b = document.getElementById('full-screen').getBoundingClientRect(); \
         return [b.x + b.width / 2, b.y + b.height / 2].map(Math.round); })()",
    );
    let at = [0, 1].map(|ix| {
        let pixel = center[ix].as_i64().expect("a pixel");
        i32::try_from(pixel).expect("inside the window")
    });
    for kind in ["mousePressed", "mouseReleased"] {
        page.browser.mouse(kind, at);
    }
    page.wait_until("full screen", "document.fullscreenElement !== null");
    let hidden =
        "['header', 'aside'].every((name) => !document.querySelector(name).checkVisibility())";
    page.wait_until("a view without header and side panel", hidden);
    assert!(page.is_visible("toolbar"));
    page.browser.evaluate("void document.exitFullscreen()");
    page.wait_until(
        "the side panel",
        "document.querySelector('aside').checkVisibility()",
    );
}

/// Changes of the run are announced to screen readers.
fn check_announcements(page: &mut Page) {
    page.hub
        .change_status(|status| "paused".clone_into(&mut status.state));
    page.wait("the announcement", |browser| {
        browser.text("announcer") == "Run: paused"
    });
}

#[test]
fn the_page_can_be_used_with_a_thumb() {
    let script = format!("{FIRST_VISIT}{TOUCH_ONLY}");
    let Some(mut page) = Page::open(PHONE_PX, &script) else {
        return;
    };
    page.browser.call(
        "Emulation.setTouchEmulationEnabled",
        json!({"enabled": true, "maxTouchPoints": 2}),
    );
    assert!(page.browser.text("gesture-hint").contains("finger"));
    page.hub.set_status(status());
    page.hub.set_robot(robot::description());
    page.hub.set_robot_state(robot::state(0.0));
    page.wait_until(
        "the robot",
        "document.getElementById('toggle-robot')?.hidden === false",
    );
    for size_px in [PHONE_PX, TURNED_PHONE_PX] {
        page.browser.resize(size_px);
        page.wait_until(
            "the size",
            &format!(
                "innerWidth === {} && innerHeight === {}",
                size_px[0], size_px[1]
            ),
        );
        check_bar(&mut page, size_px);
        check_sheets(&mut page);
        check_legend(&mut page, size_px);
        check_touch_help(&mut page, size_px);
        check_hold(&mut page);
        check_touch_words(&mut page);
        check_keyframe_sheet(&mut page, size_px);
        page.check_accessibility("on a phone");
    }
    check_follow(&mut page);
    check_overview_after_top(&mut page);
    page.browser.resize(DESKTOP_PX);
    page.wait_until(
        "the side panel",
        "document.querySelector('aside').checkVisibility()",
    );
    check_legend(&mut page, DESKTOP_PX);
    page.close();
}

/// Left, top, right and bottom of all visible elements of a selector, and whether their texts fit.
fn boxes(page: &mut Page, selector: &str) -> Vec<([f64; 4], bool)> {
    let expression = format!(
        "[...document.querySelectorAll('{selector}')].filter((one) => one.checkVisibility()).map((one) => {{ \
         const b = one.getBoundingClientRect(); \
         return [[b.left, b.top, b.right, b.bottom], one.scrollWidth <= one.clientWidth + 1]; }})"
    );
    serde_json::from_value(page.browser.evaluate(&expression)).expect("boxes")
}

/// Five entries and "More" at the bottom, 44 pixels high; "More" shows all other buttons.
fn check_bar(page: &mut Page, [width, height]: [u32; 2]) {
    let check = |page: &mut Page| {
        let buttons = boxes(page, "#toolbar button");
        for ([left, top, right, bottom], fits) in &buttons {
            assert!(
                *left >= 0.0 && *right <= f64::from(width) && bottom - top >= 43.9 && *fits,
                "{buttons:?}"
            );
        }
        buttons
    };
    let bar = check(page);
    assert_eq!(bar.len(), 6, "{bar:?}");
    let is_low = bar.iter().all(|([_, top, _, bottom], _)| {
        *top > f64::from(height) - 60.0 && *bottom <= f64::from(height)
    });
    assert!(is_low, "one row at the bottom: {bar:?}");
    page.browser.click("show-more");
    let all = check(page);
    assert!(all.len() > 10, "{all:?}");
    page.key("Escape", "Escape", 0);
    assert_eq!(boxes(page, "#toolbar button").len(), 6);
    assert!(page.is("document.scrollingElement.scrollHeight <= innerHeight"));
}

/// The values of the run, with the chart, are a sheet that is closed at first.
fn check_sheets(page: &mut Page) {
    assert!(!page.is_visible("run") && !page.is_visible("chart"));
    page.browser.click("toggle-layers");
    page.browser.click("toggle-run");
    assert!(page.is_visible("run") && !page.is_visible("layers"));
    let [(run, _)] = boxes(page, "#run")[..] else {
        panic!("one sheet")
    };
    let [(bar, _)] = boxes(page, "#toolbar")[..] else {
        panic!("one bar")
    };
    assert!(run[3] <= bar[1] + 0.5, "the sheet is above the bar");
    page.browser.click("toggle-layers");
    assert!(!page.is_visible("run") && page.is_visible("layers"));
    let switches = boxes(page, "#layers button");
    assert!(
        switches
            .iter()
            .all(|([_, top, _, bottom], fits)| bottom - top >= 43.9 && *fits),
        "{switches:?}"
    );
    page.browser.click("toggle-layers");
}

/// The legend of the colors is beside the view, not on top of the object.
fn check_legend(page: &mut Page, size_px: [u32; 2]) {
    page.browser.click("toggle-age");
    page.wait_until(
        "a legend",
        "document.getElementById('legend')?.checkVisibility() === true",
    );
    let [(legend, _)] = boxes(page, "#legend")[..] else {
        panic!("one legend")
    };
    let [(view, _)] = boxes(page, "#canvas")[..] else {
        panic!("one view")
    };
    let is_beside = legend[0] >= view[2] - 0.5 || legend[1] >= view[3] - 0.5;
    assert!(is_beside, "{size_px:?}: legend {legend:?}, view {view:?}");
    if size_px != DESKTOP_PX {
        let labels = "document.getElementById('legend-labels')?.offsetHeight";
        assert_eq!(page.browser.evaluate(labels), 0, "one line");
        page.browser.click("legend");
        assert!(page.is(&format!("{labels} > 0")), "a tap shows the labels");
        page.browser.click("legend");
    }
    page.browser.click("toggle-age");
}

/// The help fits on the screen, and is about touch screens only.
fn check_touch_help(page: &mut Page, [width, height]: [u32; 2]) {
    page.browser.click("show-help");
    // A key was pressed before, so that a keyboard is known.
    let titles = page
        .strings("[...document.querySelectorAll('#keys h3')].map((title) => title.textContent)");
    assert_eq!(titles[0], "Touch screen", "{titles:?}");
    assert!(!titles.contains(&"Mouse".to_owned()), "{titles:?}");
    for selector in ["#help", "#close-help"] {
        let [([left, top, right, bottom], fits)] = boxes(page, selector)[..] else {
            panic!("one {selector}")
        };
        let is_inside =
            left >= 0.0 && top >= 0.0 && right <= f64::from(width) && bottom <= f64::from(height);
        assert!(
            is_inside && fits,
            "{selector}: {left} {top} {right} {bottom}"
        );
    }
    page.browser.click("close-help");
    assert!(!page.is_visible("help"));
}

/// A finger that holds a button reads what it does, and does not press it.
fn check_hold(page: &mut Page) {
    let is_open = "document.getElementById('toggle-layers').getAttribute('aria-expanded')";
    touch(&mut page.browser, "touchStart", "toggle-layers");
    page.wait_until(
        "a tooltip",
        "document.getElementById('tooltip')?.hidden === false",
    );
    assert!(
        page.browser
            .text("tooltip")
            .contains("Choose what is drawn")
    );
    touch(&mut page.browser, "touchEnd", "toggle-layers");
    page.browser.next_frame();
    assert_eq!(page.browser.evaluate(is_open), Value::from("false"));
    page.wait("the layers", |browser| {
        // On a busy machine, a touch can last so long that it is held.
        let is_open = browser.evaluate(is_open) == "true";
        if !is_open {
            touch(browser, "touchStart", "toggle-layers");
            touch(browser, "touchEnd", "toggle-layers");
        }
        is_open
    });
    page.browser.click("toggle-layers");
}

/// Hints name gestures of fingers, and what is at the bottom covers at most a third of the view.
fn check_touch_words(page: &mut Page) {
    page.browser.click("toggle-measure");
    page.wait("the hint", |browser| {
        browser
            .text("measure-hint")
            .starts_with("Tap on two points")
    });
    assert!(!page.browser.text("gesture-hint").contains("Scroll"));
    let share = "document.getElementById('view-bottom')?.offsetHeight \
                 / document.getElementById('view')?.offsetHeight";
    assert!(page.is(&format!("{share} < 0.34")));
    page.browser.click("toggle-measure");
}

/// The sheet of the keyframes fits on the screen, scrolls, and closes when another sheet is opened.
fn check_keyframe_sheet(page: &mut Page, [width, _]: [u32; 2]) {
    page.browser.click("show-more");
    page.browser.click("look-nearest");
    assert!(page.is_visible("keyframe-browser"));
    assert_eq!(boxes(page, "#toolbar button").len(), 6, "one sheet");
    let [([left, top, right, _], fits)] = boxes(page, "#keyframe-browser")[..] else {
        panic!("one sheet")
    };
    let [([_, _, _, header], _)] = boxes(page, "body > header")[..] else {
        panic!("one header")
    };
    assert!(
        left >= 0.0 && right <= f64::from(width) && top >= header && fits,
        "{left} {right}, {top} below {header}"
    );
    let scrolls = "getComputedStyle(document.getElementById('keyframe-browser')).overflowY === 'auto' \
                   && getComputedStyle(document.querySelector('.wiped')).touchAction === 'pan-y'";
    assert!(page.is(scrolls));
    page.browser.click("show-more");
    page.wait_until(
        "the closed sheet",
        "document.getElementById('keyframe-browser')?.hidden === true",
    );
    assert!(boxes(page, "#toolbar button").len() > 6, "the list is open");
    page.browser.click("show-more");
}

/// A view that follows the robot says so, also while its button is in the list of "More".
fn check_follow(page: &mut Page) {
    page.browser.click("toggle-follow");
    page.wait("what is followed", |browser| {
        browser.text("follow-text") == "following base"
    });
    assert!(page.is_pressed("toggle-follow"));
    page.browser.click("toggle-follow");
    page.wait("the end", |browser| browser.text("follow-text").is_empty());
}

/// The overview replaces the view from above.
fn check_overview_after_top(page: &mut Page) {
    for button in ["look-top", "look-overview"] {
        page.rest();
        let before = page.last_request();
        page.browser.click(button);
        page.motion_since(&before);
    }
}
