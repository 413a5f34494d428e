//! Opens the bundled page in a real browser, and uses the views that depend on the scene and on the
//! robot: the overview, views along an axis, the chase, rides on cameras, and the cut.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::eye_page::{self, clearance};
use crate::local_server::serve;
use crate::robot;
use crate::scene_thread::{SceneThread, full_request};
use analytic_scene::looking_along_y;
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use serde_json::json;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_bounds, canvas_shot, wait_for};
use trainer::{Projection, RenderRequest};
use viz::{Hub, LiveImage, LivePixels, ModelStatus, RobotState, SceneBounds, SceneHint, Status};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Heading of the robot at the start, see [`robot::state`].
const HEADING_RAD: f64 = 0.2;
/// A view that has not moved for this long is at rest.
const REST: Duration = Duration::from_millis(450);
/// Tolerance of views that follow the robot.
const TOLERANCE: f64 = 2e-3;

/// The robot's base relative to where it starts, and the position of its arm.
#[derive(Clone, Copy)]
struct RobotPose {
    moved: Transform,
    arm_rad: f64,
}

impl RobotPose {
    fn state(&self) -> RobotState {
        let mut state = robot::state(self.arm_rad);
        state.world_from_base *= self.moved;
        state
    }

    fn base(&self) -> Transform {
        self.state().world_from_base
    }
}

/// Draws pictures and moves the robot on separate threads, like a run.
struct Run {
    pose: Arc<Mutex<RobotPose>>,
    pictures: SceneThread,
    stop: Arc<AtomicBool>,
    robot: Option<std::thread::JoinHandle<()>>,
}

impl Run {
    fn start(hub: &Hub) -> Self {
        let pose = Arc::new(Mutex::new(RobotPose {
            moved: Transform::identity(),
            arm_rad: 0.3,
        }));
        let stop: Arc<AtomicBool> = Arc::default();
        let robot = {
            let (hub, stop, pose) = (hub.clone(), Arc::clone(&stop), Arc::clone(&pose));
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    let state = pose.lock().expect("no panic").state();
                    hub.set_robot_state(state);
                    std::thread::sleep(Duration::from_millis(20));
                }
            })
        };
        Self {
            pose,
            pictures: SceneThread::start(hub.clone()),
            stop,
            robot: Some(robot),
        }
    }

    fn pose(&self) -> RobotPose {
        *self.pose.lock().expect("no panic")
    }

    fn set_pose(&self, pose: RobotPose) {
        *self.pose.lock().expect("no panic") = pose;
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(robot) = self.robot.take() {
            assert!(
                robot.join().is_ok() || std::thread::panicking(),
                "the robot panicked"
            );
        }
    }
}

/// A cube around the origin, on the floor.
fn cube(half_m: f64) -> SceneBounds {
    SceneBounds {
        min_m: [-half_m, -half_m, 0.0],
        max_m: [half_m, half_m, 2.0 * half_m],
    }
}

fn corners(bounds: &SceneBounds) -> Vec<Point3<f64>> {
    let side = |bit: usize, ix: usize| {
        if (ix >> bit) & 1 == 0 {
            bounds.min_m
        } else {
            bounds.max_m
        }
    };
    (0..8)
        .map(|ix| Point3::new(side(0, ix)[0], side(1, ix)[1], side(2, ix)[2]))
        .collect()
}

fn set_scene(hub: &Hub, bounds: SceneBounds) {
    let half_m = bounds.max_m[0];
    let hint = SceneHint {
        center_m: [0.0, 0.0, half_m],
        radius_m: half_m * 3.0_f64.sqrt(),
        world_from_camera: looking_along_y(),
    };
    hub.set_scene(hint, bounds);
}

/// Far plane of the page for a scene of these bounds.
fn far_m(bounds: &SceneBounds) -> f64 {
    let radius_m = bounds.max_m[0] * 3.0_f64.sqrt();
    400.0 * (0.005 * radius_m.min(2.0)).max(0.005) + 40.0 * radius_m
}

fn forward(request: &RenderRequest) -> Vector3<f64> {
    request.world_from_camera.rotation * Vector3::z()
}

fn eye(request: &RenderRequest) -> Point3<f64> {
    request.world_from_camera.translation.vector.into()
}

/// Whether a point is in the picture, not only at its edge.
fn shows(request: &RenderRequest, point: &Point3<f64>) -> bool {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        return false;
    };
    let in_camera = request.world_from_camera.inverse_transform_point(point);
    let is_within = |axis: usize| {
        let from_center_px = focal_px[axis] * in_camera[axis] / in_camera.z;
        from_center_px.abs() < 0.9 * principal_px[axis]
    };
    in_camera.z > 0.0 && is_within(0) && is_within(1)
}

/// Whether a picture shows these bounds and the robot, which is about half a meter high.
fn shows_all(request: &RenderRequest, bounds: &SceneBounds, base: &Transform) -> bool {
    let robot = [0.0, 0.4].map(|z| base * Point3::new(0.0, 0.0, z));
    corners(bounds)
        .iter()
        .chain(&robot)
        .all(|point| shows(request, point))
}

/// Waits until the view is at rest and shown in full, and returns its request.
fn settled(browser: &mut Browser, run: &Run) -> RenderRequest {
    browser.next_frame();
    let mut before = None;
    full_request(browser, &run.pictures, "a view at rest", |request| {
        let pose = Some(request.world_from_camera);
        let is_same = std::mem::replace(&mut before, pose) == pose;
        std::thread::sleep(REST);
        is_same
    })
}

fn press(browser: &mut Browser, key: &str, code: &str) {
    for kind in ["keyDown", "keyUp"] {
        browser.call(
            "Input.dispatchKeyEvent",
            json!({"type": kind, "key": key, "code": code}),
        );
    }
}

/// Rolls the wheel, so that the eye moves back.
fn roll(browser: &mut Browser) {
    let event = json!({"type": "mouseWheel", "x": 200, "y": 200, "deltaX": 0, "deltaY": 300});
    browser.call("Input.dispatchMouseEvent", event);
    browser.next_frame();
}

/// Drags from the middle of the view to the right.
fn drag(browser: &mut Browser) {
    let [left, top, width, height] =
        canvas_bounds(browser).map(|bound| i32::try_from(bound).expect("pixels of a window"));
    let [x, y] = [left + width / 2, top + height / 2];
    browser.mouse("mousePressed", [x, y]);
    for step in 1..=6 {
        browser.mouse("mouseMoved", [x + 15 * step, y]);
    }
    browser.mouse("mouseReleased", [x + 90, y]);
    browser.next_frame();
}

fn attribute(browser: &mut Browser, id: &str, name: &str) -> String {
    let value = browser.evaluate(&format!(
        "document.getElementById('{id}')?.getAttribute('{name}') ?? ''"
    ));
    value.as_str().unwrap_or_default().to_owned()
}

fn is_shown(browser: &mut Browser, id: &str) -> bool {
    browser.evaluate(&format!(
        "document.getElementById('{id}')?.hidden === false"
    )) == true
}

#[test]
fn views_follow_the_scene_and_the_robot() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    set_scene(&hub, cube(0.4));
    hub.set_robot(robot::description());
    let server = serve(&hub);
    let run = Run::start(&hub);
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);

    check_first_view(&mut browser, &run, &hub);
    check_axes(&mut browser, &run);
    check_chase(&mut browser, &run);
    check_rides(&mut browser, &run, &hub);
    check_near_links(&mut browser, &run, &hub);

    drop(browser);
    drop(run);
}

/// The first view shows everything from behind the robot, and follows the growing scene until the
/// user moves it.
fn check_first_view(browser: &mut Browser, run: &Run, hub: &Hub) {
    let heading = Vector3::new(HEADING_RAD.cos(), HEADING_RAD.sin(), 0.0);
    let is_overview = |request: &RenderRequest, bounds: &SceneBounds| {
        let forward = forward(request);
        forward.dot(&heading) > 0.5
            && forward.z < -0.3
            && shows_all(request, bounds, &run.pose().base())
    };
    let first = full_request(browser, &run.pictures, "an overview", |request| {
        is_overview(request, &cube(0.4))
    });
    set_scene(hub, cube(1.2));
    let grown = full_request(
        browser,
        &run.pictures,
        "an overview of the grown scene",
        |request| is_overview(request, &cube(1.2)),
    );
    assert!(
        (eye(&grown) - eye(&first)).norm() > 1.0,
        "it is farther away"
    );
    // The robot and its path belong to the overview.
    run.set_pose(RobotPose {
        moved: Transform::translation(3.0, 0.0, 0.0),
        ..run.pose()
    });
    full_request(
        browser,
        &run.pictures,
        "an overview with the robot",
        |request| is_overview(request, &cube(1.2)),
    );
    let there = run.pose();
    run.set_pose(RobotPose {
        moved: Transform::identity(),
        ..there
    });
    full_request(
        browser,
        &run.pictures,
        "an overview with the path",
        |request| {
            is_overview(request, &cube(1.2))
                && shows(request, &there.base().translation.vector.into())
        },
    );

    drag(browser);
    let dragged = settled(browser, run);
    assert!((forward(&dragged) - forward(&grown)).norm() > 0.1);
    let larger = cube(1.8);
    set_scene(hub, larger);
    let mut step = 0;
    wait_for(browser, "the larger scene", |_| {
        step += 1;
        hub.set_status(Status {
            model: ModelStatus {
                step,
                ..ModelStatus::default()
            },
            ..Status::default()
        });
        run.pictures
            .last_request()
            .is_some_and(|request| (request.far_m - far_m(&larger)).abs() < 1e-6)
    });
    let after = run.pictures.last_request().expect("a request");
    let motion = dragged.world_from_camera.inverse() * after.world_from_camera;
    assert!(
        motion.translation.vector.norm() < 1e-6 && motion.rotation.angle() < 1e-6,
        "the view of the user stays"
    );
    // The zoom would have ended at a distance of 8 m in the first scene, and ends at 37 m in this one.
    wait_for(browser, "a view from far away", |browser| {
        roll(browser);
        run.pictures
            .last_request()
            .is_some_and(|request| eye(&request).coords.norm() > 15.0)
    });
    press(browser, "0", "Digit0");
    full_request(browser, &run.pictures, "an overview of all", |request| {
        is_overview(request, &larger)
    });
}

/// Views from above and from the front of the robot show everything, too.
fn check_axes(browser: &mut Browser, run: &Run) {
    let front = -Vector3::new(HEADING_RAD.cos(), HEADING_RAD.sin(), 0.0);
    for (button, expected) in [("look-top", -Vector3::z()), ("look-front", front)] {
        browser.click(button);
        full_request(browser, &run.pictures, button, |request| {
            (forward(request) - expected).norm() < 0.01
                && shows_all(request, &cube(1.8), &run.pose().base())
        });
    }
}

/// The view moves and turns with the base, but not with the arm unless it follows the tool.
fn check_chase(browser: &mut Browser, run: &Run) {
    let before = settled(browser, run);
    let start = run.pose();
    press(browser, "l", "KeyL");
    wait_for(browser, "a chase", |browser| {
        attribute(browser, "toggle-follow", "aria-pressed") == "true"
    });
    browser.next_frame();
    // The arm moves, and the base moves within the dead band.
    run.set_pose(RobotPose {
        moved: Transform::translation(0.01, 0.0, 0.0),
        arm_rad: 0.8,
    });
    std::thread::sleep(Duration::from_millis(600));
    let resting = run.pictures.last_request().expect("a request");
    assert!(
        (eye(&resting) - eye(&before)).norm() < 1e-6,
        "pictures can become sharp"
    );
    let turned = RobotPose {
        moved: Transform::translation(0.6, -0.2, 0.0)
            * Transform::rotation(Vector3::new(0.0, 0.0, 0.7)),
        arm_rad: 0.8,
    };
    run.set_pose(turned);
    let motion = turned.base() * start.base().inverse();
    let expected = motion * before.world_from_camera;
    full_request(
        browser,
        &run.pictures,
        "a view that has turned with the base",
        |request| {
            let error = expected.inverse() * request.world_from_camera;
            // The chase began where the base was, and its dead band is not part of the motion.
            error.translation.vector.norm() < 10.0 * TOLERANCE
                && error.rotation.angle() < 10.0 * TOLERANCE
        },
    );

    browser.evaluate(
        "(() => { const list = document.getElementById('follow-frame'); list.value = '@tool'; \
         list.dispatchEvent(new Event('change')); return list.value; })()",
    );
    let before = settled(browser, run);
    // The last joint in the list moves the arm, which turns about the pedestal.
    run.set_pose(RobotPose {
        arm_rad: 1.4,
        ..turned
    });
    full_request(
        browser,
        &run.pictures,
        "a view that has turned with the tool",
        |request| {
            let angle_rad = forward(request).angle(&forward(&before));
            angle_rad > 0.2
        },
    );
    press(browser, "l", "KeyL");
    run.set_pose(start);
}

/// An image of a camera that looks in a direction, with its upper edge in another direction.
fn live_image(camera: &str, at: Point3<f64>, toward: Vector3<f64>, up: Vector3<f64>) -> LiveImage {
    LiveImage {
        camera: camera.into(),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: [48, 48],
        pixels: LivePixels::Rgba(vec![90; 48 * 48 * 4].into()),
        world_from_camera: Some(Transform::from_parts(
            at.into(),
            UnitQuaternion::face_towards(&toward, &-up),
        )),
        focal_px: [40.0; 2],
        principal_px: [24.0; 2],
    }
}

/// The thumbnail's button and the key attach the view to a camera, with its roll and its lens; a
/// drag detaches it. An arrow points to the robot that is not in the picture.
fn check_rides(browser: &mut Browser, run: &Run, hub: &Hub) {
    // The camera "front" lies on its side. The camera "rear" looks away from the robot.
    let sideways = Vector3::y();
    let front = live_image("front", Point3::new(1.0, 0.3, 0.4), -Vector3::x(), sideways);
    let rear = live_image(
        "rear",
        Point3::new(1.0, 0.3, 0.4),
        Vector3::x(),
        Vector3::z(),
    );
    let poses = [&front, &rear].map(|image| image.world_from_camera.expect("a pose"));
    let has_pose = |request: &RenderRequest, pose: &Transform| {
        let error = pose.inverse() * request.world_from_camera;
        error.translation.vector.norm() < TOLERANCE && error.rotation.angle() < TOLERANCE
    };
    hub.set_live_image(front);
    hub.set_live_image(rear);
    let button = "document.querySelector('figure[data-camera=front] button.ride')";
    wait_for(browser, "the camera images", |browser| {
        browser.evaluate(&format!("{button} !== null")) == true
            && browser.evaluate("document.querySelectorAll('#live figure').length") == 2
    });
    browser.evaluate(&format!("{button}?.click()"));
    let riding = full_request(
        browser,
        &run.pictures,
        "the view of the camera",
        |request| has_pose(request, &poses[0]),
    );
    let Projection::Pinhole { focal_px, .. } = riding.projection else {
        panic!("a pinhole")
    };
    // The view is wider than the square image, whose height therefore fills it.
    let expected_px = 40.0 / 48.0 * f64::from(riding.size_px[1]);
    assert!(
        (focal_px[1] - expected_px).abs() < 1.0,
        "{focal_px:?}, expected {expected_px}"
    );
    assert_eq!(
        browser.evaluate(&format!("{button}?.getAttribute('aria-pressed')")),
        "true"
    );
    // The view stays attached to the camera.
    let moved = Point3::new(1.1, 0.2, 0.4);
    let image = live_image("front", moved, -Vector3::x(), sideways);
    let pose = image.world_from_camera.expect("a pose");
    hub.set_live_image(image);
    full_request(
        browser,
        &run.pictures,
        "the view of the moved camera",
        |request| has_pose(request, &pose),
    );
    assert!(
        !is_shown(browser, "robot-arrow"),
        "the robot is in the picture"
    );

    press(browser, "c", "KeyC");
    full_request(
        browser,
        &run.pictures,
        "the view of the next camera",
        |request| has_pose(request, &poses[1]),
    );
    wait_for(browser, "an arrow to the robot", |browser| {
        is_shown(browser, "robot-arrow")
    });
    press(browser, "c", "KeyC");
    full_request(
        browser,
        &run.pictures,
        "the first camera again",
        |request| has_pose(request, &pose),
    );
    drag(browser);
    full_request(browser, &run.pictures, "an upright view", |request| {
        let right = request.world_from_camera.rotation * Vector3::x();
        right.z.abs() < 1e-6 && !has_pose(request, &pose)
    });
    wait_for(browser, "no ride", |browser| {
        attribute(browser, "look-live", "aria-pressed") == "false"
    });
    browser.evaluate("document.querySelector('figure[data-camera=rear] button.ride')?.click()");
    wait_for(browser, "the arrow again", |browser| {
        is_shown(browser, "robot-arrow")
    });
    browser.click("robot-arrow");
    full_request(browser, &run.pictures, "the overview", |request| {
        shows_all(request, &cube(1.8), &run.pose().base())
    });
    wait_for(browser, "no arrow", |browser| {
        !is_shown(browser, "robot-arrow")
    });
}

/// A link around the eye does not fill the view.
fn check_near_links(browser: &mut Browser, run: &Run, hub: &Hub) {
    /// Fraction of the picture, most of which the pedestal would fill.
    const MAX_FRAC: f64 = 0.01;
    let yellow_frac = |browser: &mut Browser| {
        let shot = canvas_shot(browser);
        let is_yellow = |pixel: &&image::Rgb<u8>| {
            let [red, green, blue] = pixel.0.map(f64::from);
            red > 40.0 && green > 0.6 * red && red > 0.7 * green && blue < 0.5 * green
        };
        shot.pixels().filter(is_yellow).count() as f64 / f64::from(shot.width() * shot.height())
    };
    browser.click("toggle-occlude");
    browser.click("toggle-model");
    let base = run.pose().base();
    let ahead = base.rotation * Vector3::new(1.0, 0.0, -0.6);
    // 0.5 m behind the middle of the pedestal, and in it.
    for (x, is_inside) in [(-0.5, false), (0.0, true)] {
        let at = base * Point3::new(x, 0.0, 0.2);
        let image = live_image("probe", at, ahead, Vector3::z());
        let pose = image.world_from_camera.expect("a pose");
        hub.set_live_image(image);
        wait_for(browser, "the probe", |browser| {
            browser.evaluate(
                "document.querySelector('figure[data-camera=probe] button.ride') !== null",
            ) == true
        });
        let is_riding = "document.querySelector('figure[data-camera=probe] button.ride')?.getAttribute('aria-pressed') === 'true'";
        if browser.evaluate(is_riding) != true {
            browser.evaluate(
                "document.querySelector('figure[data-camera=probe] button.ride')?.click()",
            );
        }
        wait_for(browser, "the pedestal as it should look", |browser| {
            let is_there = run.pictures.last_request().is_some_and(|request| {
                let error = pose.inverse() * request.world_from_camera;
                error.translation.vector.norm() < TOLERANCE
            });
            is_there && (yellow_frac(browser) < MAX_FRAC) == is_inside
        });
    }
}

/// The wheel stops at a wall behind the eye; the page says so, and can cut the wall away.
#[test]
fn a_wall_that_stops_the_eye_can_be_cut_away() {
    let Some(mut page) = eye_page::Page::open(true, 2.0) else {
        return;
    };
    wait_for(
        &mut page.browser,
        "the reason why the eye stops",
        |browser| {
            roll(browser);
            is_shown(browser, "blocked") && browser.text("blocked-text").contains("behind you")
        },
    );
    page.rest();
    assert!(
        clearance(page.renderer.eye()) > 0.0,
        "the eye is in the room"
    );
    assert!(page.renderer.last().near_m < 0.02, "nothing is cut away");

    page.browser.click("cut-away");
    wait_for(&mut page.browser, "an eye outside of the room", |browser| {
        roll(browser);
        page.renderer.eye().x < eye_page::ROOM[0][0] - 2.0 * eye_page::WALL_M
    });
    page.rest();
    let outside = page.renderer.last();
    let wall_depth_m = (eye_page::ROOM[0][0] - eye(&outside).x) / forward(&outside).x;
    assert!(
        outside.near_m > wall_depth_m,
        "the model begins at {} m, behind the wall at {wall_depth_m} m",
        outside.near_m
    );
    assert!(is_shown(&mut page.browser, "cut-chip"));
    assert!(!is_shown(&mut page.browser, "blocked"));
    assert_eq!(
        attribute(&mut page.browser, "toggle-cut", "aria-pressed"),
        "true"
    );

    page.browser.click("end-cut");
    wait_for(&mut page.browser, "the whole model", |_| {
        page.renderer.last().near_m < 0.02
    });
    assert!(!is_shown(&mut page.browser, "cut-chip"));
    press(&mut page.browser, "3", "Digit3");
    wait_for(&mut page.browser, "the cut again", |_| {
        page.renderer.last().near_m > 0.1
    });
    page.close();
}

/// In the overview, the room hides the robot, so its front is cut away until the user shows the
/// whole room.
#[test]
fn the_overview_cuts_away_what_hides_the_robot() {
    let Some(mut page) = eye_page::Page::open(true, 2.0) else {
        return;
    };
    page.hub.set_robot(robot::description());
    let state = robot::state(0.0);
    let base = state.world_from_base.translation.vector;
    page.hub.set_robot_state(state);
    let depth_m = |request: &RenderRequest, point: Vector3<f64>| {
        (point - eye(request).coords).dot(&forward(request))
    };
    let is_cut = |request: &RenderRequest| {
        let ceiling = Vector3::new(base.x, base.y, eye_page::ROOM[1][2]);
        request.near_m > depth_m(request, ceiling) && request.near_m < depth_m(request, base)
    };
    for _ in 0..2 {
        page.browser.click("look-overview");
        wait_for(&mut page.browser, "a view below the ceiling", |_| {
            is_cut(&page.renderer.last())
        });
        page.rest();
        let view = page.renderer.last();
        assert!(eye(&view).z > eye_page::ROOM[1][2], "from above the room");
        assert!(is_shown(&mut page.browser, "cut-chip"));
        assert!(!is_shown(&mut page.browser, "blocked"));

        page.browser.click("end-cut");
        wait_for(&mut page.browser, "a message", |browser| {
            is_shown(browser, "blocked")
                && browser.text("blocked-text") == "The model hides the robot"
        });
        page.rest();
        assert!(page.renderer.last().near_m < 0.02, "the user has ended it");
    }
    page.close();
}
