//! Opens the bundled page in a real browser inside a room, and moves the view by wheel, drags, keys
//! and thumbs: the eye stops before walls. WebGL calls draw nothing, because the requests show
//! where the eye is.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use crate::request_thread::RequestThread;
use analytic_scene::draw_boxes;
use kinematics::Transform;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use serde_json::json;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, NO_DRAWING, browser_for_page, wait_for};
use trainer::{Picture, Projection, RenderRequest};
use viz::{Hub, ModelStatus, SceneHint, Server, Status};

const WINDOW_PX: [u32; 2] = [900, 440];
/// Inner sides of the walls, and a pillar in the room: corners, meters.
pub(crate) const ROOM: [[f64; 3]; 2] = [[-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]];
const PILLAR: [[f64; 3]; 2] = [[0.4, -0.3, 0.0], [0.8, 0.3, 2.4]];
pub(crate) const WALL_M: f64 = 0.2;
const RADIUS_M: f64 = 2.0;
/// Of the page: 0.005 times the radius.
const NEAR_M: f64 = 0.01;
/// Without requests for this long, the view is at rest.
const REST: Duration = Duration::from_millis(450);
const FIRST_EYE: Point3<f64> = Point3::new(-1.0, 0.6, 1.2);

/// Distance of a point in the room to the nearest surface; negative in and behind walls.
pub(crate) fn clearance(point: Vector3<f64>) -> f64 {
    let inside = |[min, max]: [[f64; 3]; 2]| {
        (0..3)
            .map(|axis| (point[axis] - min[axis]).min(max[axis] - point[axis]))
            .fold(f64::INFINITY, f64::min)
    };
    inside(ROOM).min(-inside(PILLAR))
}

/// The room, with or without its pillar.
fn draw(request: &RenderRequest, has_pillar: bool) -> Picture {
    let outside = [
        ROOM[0].map(|min| min - WALL_M),
        ROOM[1].map(|max| max + WALL_M),
    ];
    let boxes = [ROOM, outside, PILLAR];
    draw_boxes(request, &boxes[..if has_pillar { 3 } else { 2 }])
}

/// Draws the room on a thread, and records the requests for the main view.
pub(crate) struct Renderer {
    requests: Arc<Mutex<Vec<RenderRequest>>>,
    n_panoramas: Arc<AtomicUsize>,
    has_panoramas: Arc<AtomicBool>,
    has_pillar: Arc<AtomicBool>,
    _thread: RequestThread,
}

impl Renderer {
    fn start(hub: Hub) -> Self {
        let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
        let [has_panoramas, has_pillar] = [true; 2].map(|is_on| Arc::new(AtomicBool::new(is_on)));
        let n_panoramas: Arc<AtomicUsize> = Arc::default();
        let (received, n_received) = (Arc::clone(&requests), Arc::clone(&n_panoramas));
        let (panoramas, pillar) = (Arc::clone(&has_panoramas), Arc::clone(&has_pillar));
        let thread = RequestThread::start(hub, move |pending| {
            let is_panorama = pending.request.projection == Projection::Equirectangular;
            n_received.fetch_add(usize::from(is_panorama), Ordering::Relaxed);
            if !is_panorama {
                received
                    .lock()
                    .expect("no panic")
                    .push(pending.request.clone());
            } else if !panoramas.load(Ordering::Relaxed) {
                return pending.fail("no panoramas");
            }
            let picture = draw(&pending.request, pillar.load(Ordering::Relaxed));
            pending.deliver(picture);
        });
        Self {
            requests,
            n_panoramas,
            has_panoramas,
            has_pillar,
            _thread: thread,
        }
    }

    fn n_requests(&self) -> usize {
        self.requests.lock().expect("no panic").len()
    }

    /// Eyes of the requests after the first `n`.
    fn eyes_since(&self, n: usize) -> Vec<Vector3<f64>> {
        let requests = self.requests.lock().expect("no panic");
        requests[n..]
            .iter()
            .map(|request| request.world_from_camera.translation.vector)
            .collect()
    }

    pub(crate) fn last(&self) -> RenderRequest {
        self.requests
            .lock()
            .expect("no panic")
            .last()
            .expect("a picture was requested")
            .clone()
    }

    pub(crate) fn eye(&self) -> Vector3<f64> {
        self.last().world_from_camera.translation.vector
    }

    fn forward(&self) -> Vector3<f64> {
        self.last().world_from_camera.rotation * Vector3::z()
    }
}

/// One browser at a time: several would slow each other down.
static BROWSER: Mutex<()> = Mutex::new(());

/// The page in the room.
pub(crate) struct Page {
    _alone: MutexGuard<'static, ()>,
    pub(crate) browser: Browser,
    pub(crate) renderer: Renderer,
    pub(crate) hub: Hub,
    _server: Server,
}

impl Page {
    /// `None` without Chromium.
    pub(crate) fn open(has_panoramas: bool, radius_m: f64) -> Option<Self> {
        let program = browser_for_page()?;
        let alone = BROWSER.lock().unwrap_or_else(PoisonError::into_inner);
        let hub = Hub::new();
        let toward = Vector3::new(1.0, -0.25, -0.1);
        hub.set_scene_hint(SceneHint {
            center_m: [0.0, 0.0, 1.0],
            radius_m,
            world_from_camera: Transform::from_parts(
                FIRST_EYE.into(),
                UnitQuaternion::face_towards(&toward, &-Vector3::z()),
            ),
        });
        let server = serve(&hub);
        let renderer = Renderer::start(hub.clone());
        renderer
            .has_panoramas
            .store(has_panoramas, Ordering::Relaxed);
        let browser = Browser::open_with(&program, &server.url(), WINDOW_PX, NO_DRAWING);
        let mut page = Self {
            _alone: alone,
            browser,
            renderer,
            hub,
            _server: server,
        };
        page.rest();
        Some(page)
    }

    /// Waits until the view is at rest and shown in full.
    pub(crate) fn rest(&mut self) {
        self.browser.next_frame();
        let mut n_requests = usize::MAX;
        let renderer = &self.renderer;
        wait_for(&mut self.browser, "a full picture at rest", |browser| {
            let before = std::mem::replace(&mut n_requests, renderer.n_requests());
            std::thread::sleep(REST);
            before == renderer.n_requests() && browser.text("picture-text").contains("100 %")
        });
    }

    fn wheel(&mut self, pixels: i32) {
        let event =
            json!({"type": "mouseWheel", "x": 200, "y": 200, "deltaX": 0, "deltaY": pixels});
        self.browser.call("Input.dispatchMouseEvent", event);
        self.browser.next_frame();
    }

    /// Orbits around the surface at a pixel of the window from now on.
    fn pivot(&mut self, [x, y]: [i32; 2]) {
        self.browser.evaluate(&format!(
            "document.getElementById('canvas').dispatchEvent(new MouseEvent('dblclick', {{clientX: {x}, clientY: {y}}}))"
        ));
        self.browser.next_frame();
    }

    /// Drags from the middle of the view: the left button rotates, the right one shifts.
    fn drag(&mut self, button: &str, [x, y]: [i32; 2]) {
        let mut send = |kind: &str, share: i32| {
            let buttons = if button == "left" { 1 } else { 2 };
            let at = [200 + x * share / 4, 200 + y * share / 4];
            let event = json!({"type": kind, "x": at[0], "y": at[1], "button": button, "buttons": buttons, "clickCount": 1});
            self.browser.call("Input.dispatchMouseEvent", event);
        };
        send("mousePressed", 0);
        (1..=4).for_each(|share| send("mouseMoved", share));
        send("mouseReleased", 4);
        self.browser.next_frame();
    }

    /// Orbits, zooms and pans.
    fn move_at_random(&mut self, seed: u64) {
        let mut random = Random(seed);
        for round in 0..36 {
            match round % 4 {
                0 => self.pivot([290 + random.within(250), 220 + random.within(100)]),
                1 => (0..4).for_each(|_| self.wheel(if round % 3 == 0 { 300 } else { -300 })),
                2 => self.drag("left", [random.within(300), random.within(120)]),
                _ => self.drag("right", [random.within(200), random.within(150)]),
            }
        }
    }

    fn key(&mut self, kind: &str, code: &str) {
        let key = code.trim_start_matches("Key").to_lowercase();
        let key = if code.starts_with("Key") {
            key
        } else {
            "Shift".to_owned()
        };
        self.browser.call(
            "Input.dispatchKeyEvent",
            json!({"type": kind, "code": code, "key": key}),
        );
    }

    /// Holds keys down; returns how far the eye has moved.
    fn hold(&mut self, codes: &[&str], duration: Duration) -> Vector3<f64> {
        self.hold_timed(codes, duration).0
    }

    /// Holds keys down for at least this long; returns how far the eye has moved and how long they
    /// were down.
    fn hold_timed(&mut self, codes: &[&str], duration: Duration) -> (Vector3<f64>, Duration) {
        let before = self.renderer.eye();
        codes.iter().for_each(|code| self.key("keyDown", code));
        let began = Instant::now();
        std::thread::sleep(duration);
        self.browser.next_frame(); // On a busy computer, frames are rare.
        let held = began.elapsed();
        codes.iter().for_each(|code| self.key("keyUp", code));
        self.rest();
        (self.renderer.eye() - before, held)
    }

    fn n_panoramas(&self) -> usize {
        self.renderer.n_panoramas.load(Ordering::Relaxed)
    }

    fn set_model(&self, step: u64, edits: usize) {
        let model = ModelStatus {
            step,
            edits,
            ..ModelStatus::default()
        };
        self.hub.set_status(Status {
            state: "training".to_owned(),
            model,
            ..Status::default()
        });
    }

    pub(crate) fn close(self) {
        let Self {
            browser,
            renderer,
            hub: _,
            _server: server,
            _alone: alone,
        } = self;
        drop(browser);
        drop((renderer, server));
        drop(alone);
    }
}

/// A small generator of random numbers; the seed is fixed.
struct Random(u64);

impl Random {
    /// A number from `-most` to `most`.
    fn within(&mut self, most: i32) -> i32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        i32::try_from((self.0 >> 33) % (2 * most.unsigned_abs() + 1) as u64).expect("small") - most
    }
}

#[test]
fn the_eye_stays_in_front_of_walls() {
    let Some(mut page) = Page::open(true, RADIUS_M) else {
        return;
    };
    assert!((page.renderer.eye() - FIRST_EYE.coords).norm() < 1e-6);
    // Straight to a wall: the eye stops close to it, and can leave.
    page.pivot([200, 200]);
    for _ in 0..60 {
        page.wheel(-300);
    }
    page.rest();
    let stopped = clearance(page.renderer.eye());
    assert!(
        (NEAR_M..0.15).contains(&stopped),
        "the eye stopped {stopped} m before a wall"
    );
    let before = page.renderer.eye();
    for _ in 0..20 {
        page.wheel(300);
    }
    page.rest();
    assert!(
        (page.renderer.eye() - before).norm() > 0.3,
        "the eye can move away"
    );

    page.browser.click("reset-view");
    page.rest();
    let n_before = page.renderer.n_requests();
    page.move_at_random(7);
    page.rest();
    let eyes = page.renderer.eyes_since(n_before);
    let traveled: f64 = eyes.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    let closest = eyes
        .iter()
        .map(|eye| clearance(*eye))
        .fold(f64::INFINITY, f64::min);
    eprintln!(
        "{} pictures on a way of {traveled:.1} m, at least {closest:.3} m from the walls",
        eyes.len()
    );
    let cut = page
        .browser
        .evaluate("document.getElementById('toggle-cut').getAttribute('aria-pressed')");
    assert_eq!(cut, "false", "the walls are not cut away");
    assert!(traveled > 5.0, "the eye moved only {traveled} m");
    assert!(closest > NEAR_M, "an eye was {closest} m from a wall");
    page.close();
}

#[test]
fn an_eye_that_has_passed_an_unknown_wall_returns() {
    let Some(mut page) = Page::open(false, RADIUS_M) else {
        return;
    };
    // Backward, where no picture shows the wall.
    for _ in 0..12 {
        page.wheel(300);
    }
    wait_for(&mut page.browser, "an eye behind the wall", |_| {
        page.renderer
            .eyes_since(0)
            .iter()
            .any(|eye| clearance(*eye) < -WALL_M)
    });
    wait_for(&mut page.browser, "an eye in the room", |_| {
        clearance(page.renderer.eye()) > 0.0
    });
    page.rest();
    assert!(clearance(page.renderer.eye()) > 0.0, "it stays in the room");
    let before = page.renderer.eye();
    for _ in 0..5 {
        page.wheel(-300);
    }
    page.rest();
    assert!((page.renderer.eye() - before).norm() > 0.1, "it can move");
    page.close();
}

/// The eye flies through the place of a pillar once it is erased, or once training has removed it.
#[test]
fn the_eye_passes_a_surface_that_is_gone() {
    for (name, step, edits) in [("erased", 1, 1), ("trained", 2, 0)] {
        let Some(mut page) = Page::open(true, RADIUS_M) else {
            return;
        };
        page.set_model(1, 0);
        page.browser.click("toggle-fly");
        page.hold(&["ShiftLeft", "KeyW"], Duration::from_millis(2000));
        let before = page.renderer.eye();
        assert!(
            clearance(before) < 0.3 && before.x < PILLAR[0][0],
            "{name}: the pillar stops the eye at {before}"
        );
        page.renderer.has_pillar.store(false, Ordering::Relaxed);
        let n_panoramas = page.n_panoramas();
        page.set_model(step, edits);
        wait_for(&mut page.browser, "the new surroundings", |_| {
            page.renderer.n_panoramas.load(Ordering::Relaxed) > n_panoramas
        });
        page.rest();
        page.hold(&["ShiftLeft", "KeyW"], Duration::from_millis(2000));
        let after = page.renderer.eye();
        assert!(
            after.x > PILLAR[1][0] && after.x < ROOM[1][0],
            "{name}: the eye is at {after}"
        );
        page.close();
    }
}

/// The surroundings of an eye that orbits far from all surfaces are requested once.
#[test]
fn surroundings_are_requested_only_where_they_are_needed() {
    // Half of this radius is much less than the distance of the eye to the walls.
    let Some(mut page) = Page::open(true, 0.6) else {
        return;
    };
    wait_for(&mut page.browser, "the first surroundings", |_| {
        page.renderer.n_panoramas.load(Ordering::Relaxed) > 0
    });
    page.rest();
    let n_panoramas = page.n_panoramas();
    let before = page.renderer.eye();
    for _ in 0..6 {
        page.drag("left", [4, 0]);
        std::thread::sleep(Duration::from_millis(200));
    }
    page.rest();
    let moved_m = (page.renderer.eye() - before).norm();
    assert!((0.1..0.6).contains(&moved_m), "an orbit by {moved_m} m");
    assert_eq!(
        page.n_panoramas(),
        n_panoramas,
        "the eye has moved only through space that is known to be free"
    );
    page.browser.click("toggle-fly");
    page.hold(&["KeyW"], Duration::from_millis(250));
    assert!(page.n_panoramas() > n_panoramas, "a flying eye needs them");
    page.close();
}

#[test]
fn keys_and_thumbs_fly() {
    let Some(mut page) = Page::open(true, RADIUS_M) else {
        return;
    };
    const TIME: Duration = Duration::from_millis(250);
    page.browser.click("toggle-fly");
    let [right, up, forward] = [Vector3::x(), -Vector3::y(), Vector3::z()]
        .map(|axis| page.renderer.last().world_from_camera.rotation * axis);
    assert!(
        (page.renderer.eye() - FIRST_EYE.coords).norm() < 1e-6,
        "the mode does not move the view"
    );
    for (code, direction) in [
        ("KeyW", forward),
        ("KeyS", -forward),
        ("KeyD", right),
        ("KeyA", -right),
    ] {
        let motion = page.hold(&[code], TIME);
        assert!(
            motion.norm() > 0.05 && motion.normalize().dot(&direction) > 0.99,
            "{code}: {motion}"
        );
    }
    for (code, direction) in [("KeyE", Vector3::z()), ("KeyQ", -Vector3::z())] {
        let motion = page.hold(&[code], TIME);
        assert!(
            motion.normalize().dot(&direction) > 0.99 && direction.dot(&up).abs() > 0.9,
            "{code}: {motion}"
        );
    }
    for button in ["toggle-measure", "toggle-layers"] {
        let state = page.browser.evaluate(&format!(
            "['aria-pressed', 'aria-expanded'].map((name) => document.getElementById('{button}').getAttribute(name))"
        ));
        assert!(!state.to_string().contains("true"), "{button}: {state}");
    }
    // To the right, where there is most space.
    let [slow_m_s, fast_m_s] = [vec!["KeyD"], vec!["ShiftLeft", "KeyD"]].map(|codes| {
        let (motion, held) = page.hold_timed(&codes, TIME);
        page.browser.click("reset-view");
        page.rest();
        motion.norm() / held.as_secs_f64()
    });
    assert!(
        fast_m_s > 2.0 * slow_m_s,
        "{slow_m_s} m/s, with Shift {fast_m_s} m/s"
    );
    // The view turns to the left, because the scene follows the mouse to the right.
    let eye = page.renderer.eye();
    page.drag("left", [120, 0]);
    page.rest();
    assert!(
        page.renderer.forward().cross(&forward).z < -0.2
            && (page.renderer.eye() - eye).norm() < 1e-6
    );
    // Into the wall, and out of it.
    page.hold(&["ShiftLeft", "KeyW"], Duration::from_millis(2000));
    let stopped = clearance(page.renderer.eye());
    assert!(
        (NEAR_M..0.3).contains(&stopped),
        "{stopped} m from the wall"
    );
    assert!(
        page.hold(&["KeyS"], TIME).norm() > 0.05,
        "the eye can move away"
    );
    check_thumbs(&mut page);
    page.browser.click("toggle-fly");
    let still = page.hold(&["KeyW"], TIME);
    assert!(still.norm() < 1e-6, "the mode is off");
    page.key("keyDown", "KeyD");
    assert_eq!(
        page.browser
            .evaluate("document.getElementById('toggle-measure').ariaPressed"),
        "true"
    );
    page.close();
}

/// The left thumb moves the eye, the right one turns the view.
fn check_thumbs(page: &mut Page) {
    page.browser.call(
        "Emulation.setTouchEmulationEnabled",
        json!({"enabled": true, "maxTouchPoints": 2}),
    );
    let touch = |page: &mut Page, kind: &str, points: &[[i32; 2]]| {
        let points: Vec<_> = points
            .iter()
            .map(|[x, y]| json!({"x": x, "y": y}))
            .collect();
        page.browser.call(
            "Input.dispatchTouchEvent",
            json!({"type": kind, "touchPoints": points}),
        );
    };
    let (eye, forward) = (page.renderer.eye(), page.renderer.forward());
    touch(page, "touchStart", &[[60, 200]]);
    touch(page, "touchMove", &[[60, 260]]);
    assert_eq!(
        page.browser
            .evaluate("document.getElementById('stick').hidden"),
        false
    );
    std::thread::sleep(Duration::from_millis(250));
    touch(page, "touchEnd", &[]);
    assert_eq!(
        page.browser
            .evaluate("document.getElementById('stick').hidden"),
        true
    );
    page.rest();
    let motion = page.renderer.eye() - eye;
    assert!(
        motion.norm() > 0.05 && motion.normalize().dot(&-forward) > 0.99,
        "backward: {motion}"
    );
    let eye = page.renderer.eye();
    touch(page, "touchStart", &[[450, 200]]);
    touch(page, "touchMove", &[[380, 200]]);
    touch(page, "touchEnd", &[]);
    page.rest();
    assert!(
        page.renderer.forward().cross(&forward).z > 0.1
            && (page.renderer.eye() - eye).norm() < 1e-6
    );
}
