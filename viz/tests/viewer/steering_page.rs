//! Steers a scripted arm through the bundled page in a real browser: control, the dead-man switch,
//! everything that opens it, the stop key, refusals at their places, and previews over a long link.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::request_thread::RequestThread;
use crate::robot;
use analytic_scene::{draw, looking_along_y};
use kinematics::{Chain, transform};
use nalgebra::{Point3, Translation3};
use parking_lot::Mutex;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_bounds, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{
    AppliedLimit, ArmDescription, Certificate, Hub, LimitEffect, LimitLink, Preview, PreviewGoal,
    PreviewVerdict, RefusedRequest, SceneHint, Server, ServerConfig, Sharing, Status, SteeredJoint,
    SteeredPart, SteeringCommand, SteeringIntent, SteeringRequest, SteeringServer, SteeringState,
    Tokens, publish_steering,
};

const WINDOW_PX: [u32; 2] = [1280, 760];
const PHONE_PX: [u32; 2] = [390, 844];
/// Positions of the joints in the order of the robot's description: slide, rotate.
pub(crate) const POSITION: [f64; 2] = [0.2, 0.0];
/// Every round trip is shorter, so that the arm follows the hand.
pub(crate) const FOLLOWS_MILLIS: f64 = 1e6;
/// Every round trip is longer, so that the page previews.
pub(crate) const PREVIEWS_MILLIS: f64 = 1e-6;
/// The page of a busy computer draws slowly. This test is not about pauses between samples.
const EXPIRY_SECS: f64 = 1e4;
/// Where the scripted arm is refused, in the frame of its base.
const PLACE: [f64; 3] = [0.3, 0.0, 0.3];
/// Number of samples after which a released switch is regarded as open.
pub(crate) const N_OPEN: usize = 10;

/// What the scripted arm has received, and what it reports.
#[derive(Default)]
pub(crate) struct Script {
    holder: Option<u64>,
    stop: Option<String>,
    limits: Vec<AppliedLimit>,
    verdict: Option<PreviewVerdict>,
    pub(crate) commands: Vec<SteeringCommand>,
    pub(crate) previews: Vec<PreviewGoal>,
    /// Clients that have stopped the arm.
    pub(crate) stops: Vec<u64>,
    n_renewed: usize,
    n_rearmed: usize,
}

/// An arm that decides as its script says, on a thread, like the loop of a run.
pub(crate) struct ScriptedArm {
    pub(crate) server: Arc<SteeringServer>,
    pub(crate) script: Arc<Mutex<Script>>,
    is_over: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl ScriptedArm {
    pub(crate) fn start(servo_round_trip_millis: f64) -> Self {
        let joint = |name: &str, range: [f64; 2], is_prismatic| SteeredJoint {
            name: name.to_owned(),
            lower: Some(range[0]),
            upper: Some(range[1]),
            is_prismatic,
            velocity: 1.0,
        };
        let server = SteeringServer::new(ArmDescription {
            base_link: "pedestal".to_owned(),
            tip_link: "tip".to_owned(),
            joints: vec![
                joint("slide", [0.0, 0.3], true),
                joint("rotate", [-3.0, 3.0], false),
            ],
            expiry_secs: EXPIRY_SECS,
            lease_secs: 1e3,
            servo_round_trip_millis,
            base: None,
        });
        let script: Arc<Mutex<Script>> = Arc::default();
        let is_over: Arc<AtomicBool> = Arc::default();
        let thread = {
            let (server, script) = (Arc::clone(&server), Arc::clone(&script));
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                while !is_over.load(Ordering::Relaxed) {
                    server.wait_for_requests(Duration::from_millis(10));
                    let mut script = script.lock();
                    for received in server.take_requests() {
                        obey(&server, &mut script, received.client, received.request);
                    }
                    server.publish(state(&script));
                }
            })
        };
        Self {
            server,
            script,
            is_over,
            thread: Some(thread),
        }
    }

    fn change(&self, change: impl FnOnce(&mut Script)) {
        change(&mut self.script.lock());
    }

    pub(crate) fn last_command(&self) -> Option<SteeringCommand> {
        self.script.lock().commands.last().cloned()
    }

    pub(crate) fn n_commands(&self) -> usize {
        self.script.lock().commands.len()
    }
}

impl Drop for ScriptedArm {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            assert!(
                thread.join().is_ok() || std::thread::panicking(),
                "the scripted arm panicked"
            );
        }
    }
}

fn obey(server: &SteeringServer, script: &mut Script, client: u64, request: SteeringRequest) {
    match request {
        SteeringRequest::TakeLease if script.holder.is_none_or(|holder| holder == client) => {
            script.holder = Some(client);
        }
        SteeringRequest::TakeLease => {
            let text = "another operator has control: ask for it".to_owned();
            server.refuse(client, RefusedRequest::Lease, text);
        }
        SteeringRequest::RenewLease => script.n_renewed += 1,
        SteeringRequest::ReleaseLease | SteeringRequest::Disconnected => {
            script.holder = script.holder.filter(|holder| *holder != client);
        }
        SteeringRequest::OfferLease { .. } | SteeringRequest::View { .. } => {}
        SteeringRequest::Stop => {
            script.stops.push(client);
            script.stop = Some(format!("stopped by operator {client}"));
        }
        SteeringRequest::Rearm { stop } => {
            assert_eq!(stop, script.stops.len() as u64, "the newest stop");
            script.n_rearmed += 1;
            script.stop = None;
        }
        SteeringRequest::Command(command) => script.commands.push(command),
        SteeringRequest::Preview(request) => {
            let verdict = script.verdict.unwrap_or(PreviewVerdict::Reachable);
            script.previews.push(request.goal);
            let preview = Preview {
                verdict,
                text: "as the script says".to_owned(),
                position: Some(vec![0.05, 0.8]),
                place: (verdict != PreviewVerdict::Reachable).then_some(PLACE),
            };
            server.answer_preview(client, request.id, preview);
        }
    }
}

/// Pose of the tip in the base at [`POSITION`].
pub(crate) fn base_from_tip() -> kinematics::Transform {
    let chain = Chain::from_urdf(robot::URDF, "pedestal", "tip").expect("a chain");
    let [slide, rotate] = POSITION;
    chain.forward(&[rotate, slide]).expect("a pose")
}

fn state(script: &Script) -> SteeringState {
    SteeringState {
        at: Instant::now(),
        holder: script.holder,
        lease_left_secs: script.holder.map(|_| 5.0),
        offered_to: None,
        stop: script.stop.clone(),
        stop_number: script.stop.as_ref().map(|_| script.stops.len() as u64),
        is_recovering: false,
        is_moving: false,
        moved_part: None,
        position: POSITION.to_vec(),
        target: None,
        base_from_tip: transform::to_xyz_xyzw(&base_from_tip()),
        base_from_target: None,
        limits: script.limits.clone(),
        applied: None,
        contacts: None,
        base: None,
    }
}

/// The page, and the last full request of its main view.
struct Page {
    browser: Browser,
    last: Arc<Mutex<Option<RenderRequest>>>,
}

impl Page {
    fn wait(&mut self, what: &str, is_there: impl FnMut(&mut Browser) -> bool) {
        wait_for(&mut self.browser, what, is_there);
    }

    fn wait_for_text(&mut self, id: &str, text: &str) {
        self.wait(&format!("{id}: {text}"), |browser| {
            browser.text(id).contains(text)
        });
    }

    fn wait_until(&mut self, what: &str, expression: &str) {
        self.wait(what, |browser| browser.evaluate(expression) == json!(true));
    }

    fn is_visible(&mut self, id: &str) -> bool {
        let expression = format!("document.getElementById('{id}')?.checkVisibility() === true");
        self.browser.evaluate(&expression) == json!(true)
    }

    fn wait_until_visible(&mut self, id: &str, is_visible: bool) {
        let expression =
            format!("document.getElementById('{id}')?.checkVisibility() === {is_visible}");
        self.wait_until(&format!("{id} visible: {is_visible}"), &expression);
    }

    /// The request of the full picture that the page shows, once it is one of this kind.
    fn shown_view(&mut self, is_expected: impl Fn(&RenderRequest) -> bool) -> RenderRequest {
        let last = Arc::clone(&self.last);
        let mut shown = None;
        self.wait("the full picture", |browser| {
            let [.., width, height] = canvas_bounds(browser);
            let text = browser.text("picture-text");
            let is_shown = text.starts_with(&format!("{width} × {height} (100 %)"));
            shown = last
                .lock()
                .clone()
                .filter(|request| is_shown && request.size_px == [width, height])
                .filter(&is_expected);
            shown.is_some()
        });
        shown.expect("the condition holds")
    }

    /// A point in the frame of the arm's base, in pixels of the window.
    fn in_window(&mut self, view: &RenderRequest, point_in_base: Point3<f64>) -> [i32; 2] {
        let point = robot::state(POSITION[1]).world_from_base * point_in_base;
        let [x, y] = pixel_of(view, point);
        let [left, top, ..] = canvas_bounds(&mut self.browser);
        #[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
        let at = [x.round() as i32, y.round() as i32];
        [at[0] + left.cast_signed(), at[1] + top.cast_signed()]
    }

    /// The middle of an element, in pixels of the window.
    fn center_of(&mut self, id: &str) -> [i32; 2] {
        let center = self.browser.evaluate(&format!(
            "(() => {{ const element = document.getElementById('{id}'); \
             element.scrollIntoView({{ block: 'nearest' }}); \
             const b = element.getBoundingClientRect(); \
             return [Math.round(b.x + b.width / 2), Math.round(b.y + b.height / 2)]; }})()"
        ));
        serde_json::from_value(center).expect("a point")
    }

    /// Presses and releases the space bar, as a person does.
    fn press_space(&mut self) {
        let mut event = json!({"type": "keyDown", "key": " ", "code": "Space", "text": " ",
                               "windowsVirtualKeyCode": 32});
        self.browser.call("Input.dispatchKeyEvent", event.clone());
        event["type"] = json!("keyUp");
        self.browser.call("Input.dispatchKeyEvent", event);
    }

    fn save(&mut self, name: &str) {
        self.browser.next_frame();
        let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::write(path, self.browser.screenshot()).expect("written");
    }
}

fn pixel_of(request: &RenderRequest, point: Point3<f64>) -> [f64; 2] {
    let (focal_px, principal_px) = pinhole(request);
    let in_camera = request.world_from_camera.inverse_transform_point(&point);
    [0, 1].map(|axis| focal_px[axis] * in_camera[axis] / in_camera.z + principal_px[axis])
}

fn pinhole(request: &RenderRequest) -> ([f64; 2], [f64; 2]) {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        panic!("the page requests a pinhole projection")
    };
    (focal_px, principal_px)
}

/// The view of the button "First view".
fn first_view() -> kinematics::Transform {
    Translation3::new(0.0, 0.0, 0.3) * looking_along_y()
}

/// A scene with a robot, and the thread that draws it.
pub(crate) fn hub_with_robot(last: &Arc<Mutex<Option<RenderRequest>>>) -> (Hub, RequestThread) {
    let hub = Hub::new();
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: first_view(),
    });
    hub.set_status(Status {
        state: "training".to_owned(),
        ..Status::default()
    });
    hub.set_robot(robot::description());
    hub.set_robot_state(robot::state(POSITION[1]));
    let seen = Arc::clone(last);
    let thread = RequestThread::start(hub.clone(), move |pending| {
        // Panoramas are requested for the surroundings of the view.
        if pending.request.projection != Projection::Equirectangular {
            *seen.lock() = Some(pending.request.clone());
        }
        let picture = draw(&pending.request);
        pending.deliver(picture);
    });
    (hub, thread)
}

#[test]
fn operators_steer_with_a_held_switch_and_preview_over_long_links() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let last: Arc<Mutex<Option<RenderRequest>>> = Arc::default();
    let (hub, thread) = hub_with_robot(&last);
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let server = Server::start(config, hub.clone()).expect("a free port");
    let mut page = Page {
        browser: Browser::open(&program, &server.url(), WINDOW_PX),
        last,
    };
    page.shown_view(|_| true);
    assert!(!page.is_visible("toggle-steer"), "nothing can be steered");

    let arm = ScriptedArm::start(FOLLOWS_MILLIS);
    publish_steering(&hub, Some(Arc::clone(&arm.server)));
    check_control(&mut page, &arm);
    page.browser.click("reset-view");
    let view = page.shown_view(|request| {
        let eye = first_view().translation.vector;
        (request.world_from_camera.translation.vector - eye).norm() < 1e-3
    });
    check_drag(&mut page, &arm, &view);
    check_lost_events(&mut page, &arm, &view);
    check_jogging(&mut page, &arm);
    check_refusal(&mut page, &arm, &view);
    check_stop(&mut page, &arm);
    check_lost_control(&mut page, &arm);

    // Another arm behind a long link: the page connects again, and has no control of it.
    let far = ScriptedArm::start(PREVIEWS_MILLIS);
    publish_steering(&hub, Some(Arc::clone(&far.server)));
    drop(arm);
    page.wait_for_text("steer-mode", "limit 0 ms");
    page.wait_for_text("steer-lease", "Nobody has control");
    assert!(
        far.script.lock().commands.is_empty(),
        "nothing continues without a new press"
    );
    page.browser.click("steer-take");
    page.wait_for_text("steer-lease", "You have control");
    check_preview(&mut page, &far, &view);
    check_stored_pose(&mut page, &far);
    page.browser.resize(PHONE_PX);
    page.save("steering-phone.png");
    check_targets(&mut page);

    publish_steering(&hub, None);
    page.wait_until_visible("toggle-steer", false);
    drop((page, far, thread, server));
}

/// Taking control moves nothing, and shows the stop button.
fn check_control(page: &mut Page, arm: &ScriptedArm) {
    page.wait_until_visible("toggle-steer", true);
    page.browser.click("toggle-steer");
    page.wait_for_text("steer-lease", "Nobody has control");
    assert!(!page.is_visible("steer-stop"), "nobody can move the arm");
    page.browser.click("steer-take");
    page.wait_for_text("steer-lease", "You have control");
    page.wait_until_visible("steer-stop", true);
    page.wait_for_text("steer-mode", "Servo");
    page.wait("open samples", |_| arm.n_commands() > N_OPEN);
    let script = arm.script.lock();
    assert!(
        script.commands.iter().all(|command| command.grip.is_none()),
        "nothing is held"
    );
    let sequences = script.commands.iter().map(|command| command.sequence);
    assert!(sequences.is_sorted_by(|a, b| a < b), "numbers increase");
}

/// Presses the mouse on the ball in the middle of the gizmo, until the arm has a new grip.
fn grab(page: &mut Page, arm: &ScriptedArm, view: &RenderRequest) -> ([i32; 2], u64) {
    let tip = Point3::from(base_from_tip().translation.vector);
    let at = page.in_window(view, tip);
    page.browser.mouse("mouseMoved", at);
    page.browser.mouse("mousePressed", at);
    let mut grip = 0;
    page.wait("a grip", |_| {
        grip = arm
            .last_command()
            .and_then(|command| command.grip)
            .unwrap_or(0);
        grip > 0
    });
    (at, grip)
}

/// Waits for open samples, and checks that they stay open.
fn wait_for_release(page: &mut Page, arm: &ScriptedArm, why: &str) {
    page.wait(why, |_| {
        arm.last_command()
            .is_some_and(|command| command.grip.is_none())
    });
    let n_before = arm.n_commands();
    page.wait("further samples", |_| arm.n_commands() > n_before + N_OPEN);
    let script = arm.script.lock();
    let is_open = |command: &SteeringCommand| command.grip.is_none();
    assert!(script.commands[n_before..].iter().all(is_open), "{why}");
}

/// The hand follows the pointer while the button is down: to the right by as much as the pointer.
fn check_drag(page: &mut Page, arm: &ScriptedArm, view: &RenderRequest) {
    const BY_PX: i32 = 60;
    const TOLERANCE_M: f64 = 0.01;
    let ([x, y], grip) = grab(page, arm, view);
    for step in 1..=5 {
        page.browser.mouse("mouseMoved", [x + BY_PX * step / 5, y]);
    }
    let world_from_base = robot::state(POSITION[1]).world_from_base;
    let tip = base_from_tip();
    let depth_m = view
        .world_from_camera
        .inverse_transform_point(&(world_from_base * Point3::from(tip.translation.vector)))
        .z;
    let dragged_m = f64::from(BY_PX) * depth_m / pinhole(view).0[0];
    let right = view.world_from_camera.rotation * nalgebra::Vector3::x();
    let expected =
        tip.translation.vector + world_from_base.inverse_transform_vector(&right) * dragged_m;
    page.wait("the dragged hand", |_| {
        let Some(SteeringCommand {
            intent: Some(SteeringIntent::Hand { base_from_hand }),
            grip: Some(held),
            ..
        }) = arm.last_command()
        else {
            return false;
        };
        let hand = nalgebra::Vector3::new(base_from_hand[0], base_from_hand[1], base_from_hand[2]);
        held == grip && (hand - expected).norm() < TOLERANCE_M
    });
    page.save("steering-drag.png");
    page.browser.mouse("mouseReleased", [x + BY_PX, y]);
    wait_for_release(page, arm, "the release of the button");
}

/// A lost focus and a hidden page open the switch although the button stays down.
fn check_lost_events(page: &mut Page, arm: &ScriptedArm, view: &RenderRequest) {
    const SHOW: &str =
        "delete document.hidden; document.dispatchEvent(new Event('visibilitychange')); 0";
    const HIDE: &str = "Object.defineProperty(document, 'hidden', { configurable: true, get: () => true }); \
                        document.dispatchEvent(new Event('visibilitychange')); 0";
    let (at, first) = grab(page, arm, view);
    page.browser
        .evaluate("window.dispatchEvent(new Event('blur')); 0");
    page.browser.mouse("mouseMoved", [at[0] + 20, at[1]]);
    wait_for_release(page, arm, "the lost focus");
    page.wait_for_text("steer-note", "another window has the focus");
    page.browser.mouse("mouseReleased", [at[0] + 20, at[1]]);

    let (at, second) = grab(page, arm, view);
    assert!(second > first, "each press is a new grip");
    page.browser.evaluate(HIDE);
    page.wait("the release of the hidden page", |_| {
        arm.last_command()
            .is_some_and(|command| command.grip.is_none())
    });
    page.wait("a renewed lease", |_| arm.script.lock().n_renewed > 0);
    page.browser.evaluate(SHOW);
    page.browser.mouse("mouseMoved", [at[0] + 20, at[1]]);
    wait_for_release(page, arm, "the page is visible again, with the button down");
    page.browser.mouse("mouseReleased", [at[0] + 20, at[1]]);
}

/// A button jogs a joint while it is held.
fn check_jogging(page: &mut Page, arm: &ScriptedArm) {
    page.browser
        .evaluate("document.getElementById('steer-jog-joints').open = true; 0");
    page.wait_until(
        "the joints",
        "document.querySelectorAll('#steer-joints button').length === 4",
    );
    page.browser.evaluate(
        "document.querySelector('[aria-label=\"rotate forward\"]').id = 'test-rotate'; 0",
    );
    let at = page.center_of("test-rotate");
    page.browser.mouse("mouseMoved", at);
    page.browser.mouse("mousePressed", at);
    page.wait("a jogged joint", |_| {
        let Some(SteeringCommand {
            intent: Some(SteeringIntent::JointVelocity { velocity }),
            grip: Some(_),
            ..
        }) = arm.last_command()
        else {
            return false;
        };
        velocity[0] == 0.0 && velocity[1] > 0.0
    });
    page.browser.mouse("mouseReleased", at);
    wait_for_release(page, arm, "the release of the jog button");
    page.browser
        .evaluate("document.getElementById('steer-jog-joints').open = false; 0");
}

/// A refusal is shown as a text, and as a label at its place.
fn check_refusal(page: &mut Page, arm: &ScriptedArm, view: &RenderRequest) {
    const TOLERANCE_PX: f64 = 3.0;
    arm.change(|script| {
        script.limits = vec![AppliedLimit {
            part: SteeredPart::Arm,
            link: LimitLink::Clearance,
            effect: LimitEffect::Refused,
            speed_scale: 0.0,
            text: "the tip would touch the ball".to_owned(),
            place: Some(PLACE),
        }];
    });
    page.wait_for_text("steer-limits", "Refused: the tip would touch the ball");
    page.wait_for_text("steer-marks", "the tip would touch the ball");
    let [x, y] = page.in_window(view, Point3::from(PLACE)).map(f64::from);
    page.wait("the label at its place", |browser| {
        // The lower left corner of the label is at the place.
        let corner = browser.evaluate(
            "(() => { const b = document.querySelector('#steer-marks span')?.getBoundingClientRect(); \
             return b ? [b.left, b.bottom] : [0, 0]; })()",
        );
        let [left, bottom]: [f64; 2] = serde_json::from_value(corner).expect("a point");
        (left - x).abs() < TOLERANCE_PX && (bottom - y).abs() < TOLERANCE_PX
    });
    page.save("steering-refused.png");
    arm.change(|script| script.limits.clear());
    page.wait_until_visible("steer-limits", false);
}

/// Space stops the arm also while a slider has the focus; motion is permitted by two presses.
fn check_stop(page: &mut Page, arm: &ScriptedArm) {
    page.browser
        .evaluate("document.getElementById('steer-speed').focus(); 0");
    page.press_space();
    page.wait("a stop", |_| !arm.script.lock().stops.is_empty());
    page.wait_for_text("steer-stop-text", "stopped by operator");
    page.wait_until_visible("steer-stop", false);
    page.save("steering-stopped.png");
    page.browser.click("steer-rearm");
    page.wait_for_text("steer-rearm", "Press again");
    assert_eq!(arm.script.lock().n_rearmed, 0, "one press is not enough");
    page.wait("the permission", |browser| {
        // Quick presses do not count, and the page forgets the first press after some seconds.
        std::thread::sleep(Duration::from_millis(500));
        browser.click("steer-rearm");
        arm.script.lock().n_rearmed > 0
    });
    page.wait_until_visible("steer-stop", true);
    // The button does the same as the key.
    let n_before = arm.script.lock().stops.len();
    page.browser.click("steer-stop");
    page.wait("another stop", |_| arm.script.lock().stops.len() > n_before);
    arm.change(|script| script.stop = None);
    page.wait_until_visible("steer-stop", true);
}

/// Control that ends, for example because it expired, is shown, and its handles disappear.
fn check_lost_control(page: &mut Page, arm: &ScriptedArm) {
    arm.change(|script| script.holder = None);
    page.wait_for_text("steer-lease", "Nobody has control");
    page.wait_until_visible("steer-controls", false);
    page.save("steering-lost.png");
    let n_before = arm.n_commands();
    std::thread::sleep(Duration::from_millis(300));
    // A sample may have been on its way.
    assert!(
        arm.n_commands() <= n_before + 2,
        "no samples without control"
    );
}

/// Over a long link, a drag moves the ghost; the arm moves while "go" is held, and only if the goal
/// can be reached.
fn check_preview(page: &mut Page, arm: &ScriptedArm, view: &RenderRequest) {
    page.wait_for_text("steer-mode", "Preview, then go");
    arm.change(|script| script.verdict = Some(PreviewVerdict::SelfCollision));
    let tip = Point3::from(base_from_tip().translation.vector);
    let [x, y] = page.in_window(view, tip);
    page.browser.mouse("mouseMoved", [x, y]);
    page.browser.mouse("mousePressed", [x, y]);
    page.browser.mouse("mouseMoved", [x + 20, y]);
    page.browser.mouse("mouseMoved", [x + 40, y]);
    page.browser.mouse("mouseReleased", [x + 40, y]);
    page.wait("a preview", |_| {
        let script = arm.script.lock();
        matches!(script.previews.last(), Some(PreviewGoal::Pose { .. }))
    });
    page.wait_for_text("steer-verdict", "The robot would touch itself");
    page.wait_for_text("steer-marks", "The robot would touch itself");
    page.wait_until(
        "no way to go",
        "document.getElementById('steer-go').disabled === true",
    );
    page.save("steering-collision.png");
    arm.change(|script| script.verdict = Some(PreviewVerdict::Reachable));
    // The goal has its place now, so the ball is there.
    page.browser.mouse("mouseMoved", [x + 40, y]);
    page.browser.mouse("mousePressed", [x + 40, y]);
    page.browser.mouse("mouseMoved", [x + 50, y]);
    page.browser.mouse("mouseReleased", [x + 50, y]);
    page.wait_for_text("steer-verdict", "The goal can be reached");
    {
        let script = arm.script.lock();
        let is_open = |command: &SteeringCommand| command.grip.is_none();
        assert!(
            script.commands.iter().all(is_open),
            "a preview moves nothing"
        );
    }
    page.save("steering-ghost.png");
    hold_go(page, arm);
}

/// Holds "go": the arm moves to the previewed joint positions until the release.
fn hold_go(page: &mut Page, arm: &ScriptedArm) {
    page.wait_until(
        "a way to go",
        "document.getElementById('steer-go').disabled === false",
    );
    let at = page.center_of("steer-go");
    page.browser.mouse("mouseMoved", at);
    page.browser.mouse("mousePressed", at);
    page.wait("the motion to the goal", |_| {
        let Some(SteeringCommand {
            intent: Some(SteeringIntent::Joints { position }),
            grip: Some(_),
            ..
        }) = arm.last_command()
        else {
            return false;
        };
        position == [0.05, 0.8]
    });
    page.browser.mouse("mouseReleased", at);
    wait_for_release(page, arm, "the release of go");
}

/// A stored pose becomes the goal.
fn check_stored_pose(page: &mut Page, arm: &ScriptedArm) {
    page.browser.evaluate(
        "document.getElementById('steer-stored').open = true; \
         document.getElementById('steer-name').value = 'home'; \
         document.getElementById('steer-save').requestSubmit(); 0",
    );
    let stored = "localStorage.getItem('steer-poses') ?? ''";
    page.wait("the stored pose", |browser| {
        let text = browser.evaluate(stored);
        text.as_str().is_some_and(|text| text.contains("\"home\""))
    });
    page.browser
        .evaluate("document.querySelector('#steer-poses .name').click(); 0");
    page.wait("a preview of its joints", |_| {
        let script = arm.script.lock();
        matches!(script.previews.last(), Some(PreviewGoal::Joints { position }) if *position == POSITION)
    });
    page.browser.click("steer-discard");
    page.wait_until_visible("steer-goal", false);
}

/// On phones, everything that fingers press is at least 44 pixels high.
fn check_targets(page: &mut Page) {
    let small = page.browser.evaluate(
        "[...document.querySelectorAll('#steer button, #steer select, #steer-stop')] \
         .filter((one) => one.checkVisibility() && one.getBoundingClientRect().height < 43.9) \
         .map(({ id, textContent }) => id || textContent)",
    );
    assert_eq!(small, json!([]));
    assert!(page.is_visible("steer-stop"));
    let inside = "(() => { const b = document.getElementById('steer-stop').getBoundingClientRect(); \
                  return b.left >= 0 && b.right <= innerWidth && b.top >= 0 && b.bottom <= innerHeight; })()";
    assert_eq!(page.browser.evaluate(inside), Value::Bool(true));
}

#[test]
fn viewers_watch_and_stop() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let certificate = Certificate::kept_in(folder.path()).expect("a certificate");
    let tokens = Tokens::random().expect("random numbers");
    let viewer = tokens.viewer.text().to_owned();
    let last: Arc<Mutex<Option<RenderRequest>>> = Arc::default();
    let (hub, thread) = hub_with_robot(&last);
    let arm = ScriptedArm::start(FOLLOWS_MILLIS);
    publish_steering(&hub, Some(Arc::clone(&arm.server)));
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    let sharing = Sharing {
        certificate,
        tokens,
    };
    let server = Server::start_shared(config, sharing, hub).expect("a free port");
    let mut page = Page {
        browser: Browser::open(&program, &server.url(), WINDOW_PX),
        last,
    };
    page.wait_for_text("banner", "This server requires a token");
    page.browser
        .load_by(&format!("location.hash = '#token={viewer}'"));
    page.wait_until_visible("toggle-steer", true);
    page.browser.click("toggle-steer");
    page.wait_until(
        "the reason",
        "document.getElementById('steer-take').disabled === true \
         && document.getElementById('steer-take').title.includes('connected as viewer')",
    );
    assert!(!page.is_visible("steer-controls"));
    // Somebody else moves the arm.
    arm.change(|script| script.holder = Some(u64::MAX >> 12));
    page.wait_until_visible("steer-stop", true);
    page.save("steering-viewer.png");
    page.press_space();
    page.wait("a stop by the viewer", |_| {
        !arm.script.lock().stops.is_empty()
    });
    page.wait_for_text("steer-stop-text", "stopped by operator");
    page.wait_until(
        "no permission",
        "document.getElementById('steer-rearm').disabled === true",
    );
    assert!(arm.script.lock().commands.is_empty());
    drop((page, arm, thread, server));
}
