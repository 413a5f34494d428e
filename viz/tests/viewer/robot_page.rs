//! Opens the bundled page in a real browser, compares the silhouette of the robot with the exact
//! one, in front of the scene and partly behind it, and uses the controls of the view.
//!
//! Skipped, with a message, if Chromium or the bundle (`make web`) is missing.

use crate::local_server::serve;
use crate::robot;
use crate::scene_thread::{SceneThread, full_request};
use analytic_scene::{draw, looking_along_y, ray_in_world};
use kinematics::Chain;
use nalgebra::{Point3, Translation3, Vector3};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use test_support::browser::{Browser, browser_for_page, canvas_bounds, canvas_shot, wait_for};
use test_support::silhouette::iou;
use trainer::{Projection, RenderRequest};
use viz::{Hub, RobotState, RunResult, SceneHint};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Required overlap of the drawn silhouette with the exact one: intersection over union.
const MIN_IOU: f64 = 0.97;

/// Draws pictures and moves the robot on separate threads, like a run.
struct Run {
    angle: Arc<Mutex<f64>>,
    base_x: Arc<Mutex<f64>>,
    pictures: SceneThread,
    stop: Arc<AtomicBool>,
    arm: Option<std::thread::JoinHandle<()>>,
}

impl Run {
    fn start(hub: &Hub) -> Self {
        let angle: Arc<Mutex<f64>> = Arc::default();
        let stop: Arc<AtomicBool> = Arc::default();
        let base_x: Arc<Mutex<f64>> = Arc::default();
        let arm = {
            let (hub, stop) = (hub.clone(), Arc::clone(&stop));
            let (angle, base_x) = (Arc::clone(&angle), Arc::clone(&base_x));
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    let mut state = robot::state(*angle.lock().expect("no panic"));
                    let moved = Translation3::new(*base_x.lock().expect("no panic"), 0.0, 0.0);
                    state.world_from_base = moved * state.world_from_base;
                    hub.set_robot_state(state);
                    std::thread::sleep(Duration::from_millis(20));
                }
            })
        };
        Self {
            angle,
            base_x,
            pictures: SceneThread::start(hub.clone()),
            stop,
            arm: Some(arm),
        }
    }

    /// Moves the base along x.
    fn move_base(&self, x: f64) {
        *self.base_x.lock().expect("no panic") = x;
    }

    fn rotate_to(&self, angle: f64) {
        *self.angle.lock().expect("no panic") = angle;
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(arm) = self.arm.take() {
            assert!(
                arm.join().is_ok() || std::thread::panicking(),
                "the arm panicked"
            );
        }
    }
}

/// Where the robot is visible, by pixel.
fn exact_silhouette(request: &RenderRequest, state: &RobotState, is_occluded: bool) -> Vec<bool> {
    let (scene, shapes) = (draw(request), robot::PosedShapes::new(state));
    let [width, height] = request.size_px;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let depths = scene.depth_m.iter().map(|depth| {
        if *depth > 0.0 {
            f64::from(*depth)
        } else {
            f64::INFINITY
        }
    });
    pixels
        .zip(depths)
        .map(|((x, y), scene_depth)| {
            let (eye, direction) = ray_in_world(request, f64::from(x) + 0.5, f64::from(y) + 0.5);
            let depth = shapes.nearest_hit(eye, direction);
            depth.is_some_and(|depth| !is_occluded || depth < scene_depth)
        })
        .collect()
}

/// Where the screenshot has the robot's yellow, which nothing else in the scene has.
fn drawn_silhouette(shot: &image::RgbImage) -> Vec<bool> {
    let is_yellow = |pixel: &image::Rgb<u8>| {
        let [red, green, blue] = pixel.0.map(f64::from);
        red > 40.0 && green > 0.6 * red && red > 0.7 * green && blue < 0.5 * green
    };
    shot.pixels().map(is_yellow).collect()
}

#[test]
fn robot_silhouette_is_exact_in_front_and_behind() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = Hub::new();
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.2],
        radius_m: 0.8,
        world_from_camera: Translation3::new(0.0, 0.0, 0.3) * looking_along_y(),
    });
    hub.set_robot(robot::description());
    let server = serve(&hub);
    let run = Run::start(&hub);
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    wait_for(&mut browser, "a picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    let request = full_request(&mut browser, &run.pictures, "a full picture", |_| true);
    browser.click("toggle-grid");

    let mut masks = Vec::new();
    for angle in [0.0, 0.9] {
        run.rotate_to(angle);
        for is_occluded in [true, false] {
            let exact = exact_silhouette(&request, &robot::state(angle), is_occluded);
            let name = format!(
                "page-robot-{angle}-{}.png",
                if is_occluded { "occluded" } else { "in-front" }
            );
            wait_for(
                &mut browser,
                &format!("the silhouette in {name}"),
                |browser| {
                    let shot = canvas_shot(browser);
                    shot.save(scratch.join(&name)).expect("written");
                    assert_eq!([shot.width(), shot.height()], request.size_px);
                    let overlap = iou(request.size_px, &drawn_silhouette(&shot), &exact);
                    eprintln!("{name}: IoU {overlap:.4}");
                    overlap >= MIN_IOU
                },
            );
            masks.push(exact);
            browser.click("toggle-occlude");
        }
    }
    // The cases differ, so that a wrong case would have been detected.
    for (a, b) in [(0, 1), (0, 2), (2, 3)] {
        let similarity = iou(request.size_px, &masks[a], &masks[b]);
        assert!(
            similarity < MIN_IOU - 0.02,
            "cases {a} and {b} are too similar: {similarity}"
        );
    }
    assert_eq!(
        browser.evaluate("document.getElementById('robot-age').hidden"),
        true,
        "the pose is live"
    );
    check_pivot(&mut browser, &run);
    check_views(&mut browser, &run);
    check_frames(&mut browser, &run);
    check_titles(&mut browser);
    check_crop(&mut browser, &run);
    check_follow(&mut browser, &run);
    drop(run);
    wait_for(&mut browser, "an outdated pose", |browser| {
        browser.text("robot-age").contains("s old")
            && browser.evaluate("document.getElementById('robot-age').hidden") == false
    });
    hub.set_run_result(RunResult {
        folder: None,
        scores: String::new(),
        seconds: 1.0,
        ..RunResult::default()
    });
    wait_for(&mut browser, "no warning after the run", |browser| {
        browser.evaluate("document.getElementById('robot-age').hidden") == true
    });
    drop(browser);
}

/// A double click rotates the view toward the surface at that pixel.
fn check_pivot(browser: &mut Browser, run: &Run) {
    let before = full_request(browser, &run.pictures, "a full picture", |_| true);
    let [x, y] = [before.size_px[0] / 2 - 150, before.size_px[1] / 2 + 250];
    let ix = (y * before.size_px[0] + x) as usize;
    let depth = f64::from(draw(&before).depth_m[ix]);
    assert!(depth > 0.0, "there is a surface");
    let (eye, direction) = ray_in_world(&before, f64::from(x) + 0.5, f64::from(y) + 0.5);
    let surface = eye + direction * depth;
    let [left, top, ..] = canvas_bounds(browser);
    browser.evaluate(&format!(
        "document.getElementById('canvas').dispatchEvent(new MouseEvent('dblclick', {{clientX: {}, clientY: {}}}))",
        left + x,
        top + y
    ));
    wait_for(browser, "a view toward the surface", |_| {
        run.pictures.last_request().is_some_and(|request| {
            let in_camera = request.world_from_camera.inverse_transform_point(&surface);
            in_camera.z > 0.0 && in_camera.coords.xy().norm() < 0.02 * in_camera.z
        })
    });
}

/// The buttons for the views from above and from the front of the robot. Afterwards, the view is
/// along y again, from below the robot's arm.
fn check_views(browser: &mut Browser, run: &Run) {
    let base = robot::state(0.0).world_from_base;
    let front = -(base.rotation * Vector3::x());
    for (button, forward) in [("look-top", -Vector3::z()), ("look-front", front)] {
        browser.click(button);
        full_request(browser, &run.pictures, button, |request| {
            (request.world_from_camera.rotation * Vector3::z() - forward).norm() < 0.01
        });
    }
    browser.click("reset-view");
    let [left, top, width, height] = canvas_bounds(browser).map(u32::cast_signed);
    let [x, y] = [left + width / 2, top + height / 2];
    browser.mouse("mousePressed", [x, y]);
    (1..=3).for_each(|step| browser.mouse("mouseMoved", [x, y - 10 * step]));
    browser.mouse("mouseReleased", [x, y - 30]);
    full_request(browser, &run.pictures, "a lower view along y", |request| {
        let forward = request.world_from_camera.rotation * Vector3::z();
        forward.z > 0.1 && forward.x.abs() < 1e-6
    });
}

/// The axes of a link are drawn where it is, although they lie inside its body.
fn check_frames(browser: &mut Browser, run: &Run) {
    /// Colors of the x, y and z axes.
    const COLORS: [[u8; 3]; 3] = [[0xf0, 0x71, 0x6a], [0x7b, 0xd8, 0x8f], [0x6c, 0xb6, 0xff]];
    const MAX_DIFFERENCE: u8 = 60;
    let request = full_request(browser, &run.pictures, "a full picture", |_| true);
    let state = robot::state(0.9);
    let chain = Chain::from_urdf(robot::URDF, "pedestal", "tip").expect("a chain");
    let world_from_tip = state.world_from_base * chain.forward(&[0.9, 0.2]).expect("a pose");
    let half_length = 0.5 * 0.1 * 0.8; // Axes are 0.1 times as long as the radius of the scene.
    let middles: Vec<[i64; 2]> = [Vector3::x(), Vector3::y(), Vector3::z()]
        .map(|axis| {
            project(
                &request,
                &(world_from_tip * Point3::from(axis * half_length)),
            )
        })
        .into();
    let n_visible_axes = |shot: &image::RgbImage| {
        let has_color = |([x, y], color): (&[i64; 2], [u8; 3])| {
            let neighbors = (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| [x + dx, y + dy]));
            let pixels = neighbors.filter_map(|[x, y]| {
                shot.get_pixel_checked(x.try_into().ok()?, y.try_into().ok()?)
            });
            let mut differences =
                pixels.map(|pixel| (0..3).map(|ix| pixel.0[ix].abs_diff(color[ix])).max());
            differences.any(|difference| difference < Some(MAX_DIFFERENCE))
        };
        std::iter::zip(&middles, COLORS)
            .filter(|pair| has_color(*pair))
            .count()
    };
    assert_eq!(n_visible_axes(&canvas_shot(browser)), 0, "no axes");
    browser.click("toggle-frames");
    wait_for(browser, "axes", |browser| {
        n_visible_axes(&canvas_shot(browser)) == 3
    });
    let names = "[...document.querySelectorAll('#frame-names span')].map((name) => name.textContent).join(' ')";
    assert_eq!(browser.evaluate(names), "world_link pedestal arm tip");
    let places = "[...document.querySelectorAll('#frame-names span:not([hidden])')].map((name) => \
                  { const b = name.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })";
    let places: Vec<[f64; 4]> =
        serde_json::from_value(browser.evaluate(places)).expect("rectangles");
    assert_eq!(places.len(), 4);
    for (ix, a) in places.iter().enumerate() {
        for b in &places[..ix] {
            let overlaps =
                a[0] < b[2] - 1.0 && b[0] < a[2] - 1.0 && a[1] < b[3] - 1.0 && b[1] < a[3] - 1.0;
            assert!(!overlaps, "names cover each other: {places:?}");
        }
    }
    let shot = canvas_shot(browser);
    shot.save(PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("page-robot-frames.png"))
        .expect("written");
    browser.click("toggle-frames");
    wait_for(browser, "no axes", |browser| {
        n_visible_axes(&canvas_shot(browser)) == 0
    });
}

/// The pixel that shows a point.
#[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
fn project(request: &RenderRequest, point: &Point3<f64>) -> [i64; 2] {
    let Projection::Pinhole {
        focal_px,
        principal_px,
    } = request.projection
    else {
        panic!("a pinhole")
    };
    let in_camera = request.world_from_camera.inverse_transform_point(point);
    [0, 1].map(|axis| {
        (focal_px[axis] * in_camera[axis] / in_camera.z + principal_px[axis]).floor() as i64
    })
}

/// While flying, W, A, S, D, Q and E move the eye, so titles do not show them as keys of buttons.
fn check_titles(browser: &mut Browser) {
    let titles = "['toggle-measure', 'toggle-scans', 'look-top'] \
                  .map((id) => /\\((.)\\)/.exec(document.getElementById(id).title)?.[1]).join()";
    for expected in [",,T", "D,S,T"] {
        browser.click("toggle-fly");
        assert_eq!(browser.evaluate(titles), expected);
    }
}

/// The crop box encloses the scene; dragging a handle moves one side and not the view.
fn check_crop(browser: &mut Browser, run: &Run) {
    assert_eq!(
        full_request(browser, &run.pictures, "a full picture", |_| true).crop,
        None
    );
    browser.click("toggle-crop");
    let before = full_request(browser, &run.pictures, "a cropped picture", |request| {
        request.crop.is_some()
    });
    let crop = before.crop.expect("a crop");
    let expected = [[-0.48, -0.48, -0.28], [0.48, 0.48, 0.68]]; // 1.2 times the radius, around the center.
    for (corner, expected) in [crop.min_m, crop.max_m].iter().zip(expected) {
        assert!(
            corner
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-6),
            "{crop:?}"
        );
    }
    let Projection::Pinhole { focal_px, .. } = before.projection else {
        panic!("a pinhole")
    };
    let handle_m = Point3::new(0.48, 0.0, 0.2);
    let [x, y] = project(&before, &handle_m);
    let [left, top, ..] = canvas_bounds(browser);
    #[expect(clippy::cast_possible_truncation, reason = "pixels of a window")]
    let handle = [x as i32 + left.cast_signed(), y as i32 + top.cast_signed()];
    browser.mouse("mousePressed", handle);
    for step in 1..=8 {
        browser.mouse("mouseMoved", [handle[0] - 10 * step, handle[1]]);
    }
    browser.mouse("mouseReleased", [handle[0] - 80, handle[1]]);
    // 80 pixels at the depth of the handle.
    let expected_x = 0.48
        - 80.0
            * before
                .world_from_camera
                .inverse_transform_point(&handle_m)
                .z
            / focal_px[0];
    let after = full_request(browser, &run.pictures, "a smaller box", |request| {
        request
            .crop
            .is_some_and(|crop| (crop.max_m[0] - expected_x).abs() < 0.02)
    });
    assert_eq!(
        after.crop.map(|crop| (crop.min_m, crop.max_m[1])),
        Some((crop.min_m, crop.max_m[1]))
    );
    let motion = before.world_from_camera.inverse() * after.world_from_camera;
    assert!(
        motion.translation.vector.norm() < 1e-6,
        "the view has not moved"
    );
    browser.click("toggle-crop");
    full_request(browser, &run.pictures, "the whole scene", |request| {
        request.crop.is_none()
    });
}

/// The view follows the base, but not the arm.
fn check_follow(browser: &mut Browser, run: &Run) {
    let eye = |request: &RenderRequest| request.world_from_camera.translation.vector;
    let before = eye(&full_request(
        browser,
        &run.pictures,
        "a full picture",
        |_| true,
    ));
    browser.click("toggle-follow");
    // The view keeps its pose relative to the frame as it is in the next frame.
    browser.next_frame();
    browser.next_frame();
    run.rotate_to(0.2);
    std::thread::sleep(Duration::from_millis(300));
    let resting = eye(&full_request(
        browser,
        &run.pictures,
        "a full picture",
        |_| true,
    ));
    assert!((resting - before).norm() < 1e-6, "the arm moves alone");
    run.move_base(0.25);
    full_request(
        browser,
        &run.pictures,
        "a view that has moved with the base",
        |request| (eye(request) - before - Vector3::new(0.25, 0.0, 0.0)).norm() < 1e-3,
    );
}
