//! Enters an emulated headset (IWER) from the bundled page, and checks what both eyes see, what the
//! hands do, and that leaving returns everything.
//!
//! Skipped, with a message, if Chromium, the bundle (`make web`) or IWER (`scripts/check-web.sh`)
//! is missing. The emulation grants a session without a click, and draws without the layers of a
//! real headset; a stub stands in for these layers in one of the tests.

use crate::models::{self, ModelThread, splat_model, tsdf_model, wall};
use kinematics::Transform;
use nalgebra::{Matrix4, Point3, UnitQuaternion, Vector3};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, wait_for};
use trainer::eval::{PixelPair, psnr};
use trainer::{Method, Projection, RenderRequest};
use viz::{Hub, ModelStatus, SceneHint, Server, ServerConfig, Status};

/// Two eyes side by side.
const WINDOW_PX: [u32; 2] = [640, 320];
const EYE_PX: u32 = WINDOW_PX[1];
/// Required PSNR of each eye against the trainer's picture at the same pose, dB.
const MIN_DB: f64 = 30.0;
/// The background of the page.
const BACKGROUND: [f32; 3] = [11.0 / 255.0, 14.0 / 255.0, 19.0 / 255.0];
/// Largest difference of a place that the hands move, meters: half a millimeter of rounding.
const MAX_PLACE_ERROR_M: f64 = 5e-4;
const HEADSET: &str = include_str!("headset_script.js");
/// Layers as on a real headset, drawn into the canvas of the emulation after each frame.
const LAYERS: &str = include_str!("headset_layers.js");

/// Runs these tests if it is "demand". Without a GPU, they draw two eyes for many minutes.
const DEMAND_VARIABLE: &str = "FIELDRIG_HEADSET_TESTS";

/// IWER as one script; `None` if it is not installed, or if these tests are not demanded.
pub(crate) fn iwer() -> Option<String> {
    if std::env::var(DEMAND_VARIABLE).as_deref() != Ok("demand") {
        test_support::skip(format!("{DEMAND_VARIABLE} is not set to demand"));
        return None;
    }
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("web/node_modules/iwer/build/iwer.min.js");
    let script = std::fs::read_to_string(path).ok();
    if script.is_none() {
        let reason = "IWER is missing (scripts/install-web.sh check)";
        assert!(!test_support::is_demanded(), "{reason}");
        test_support::skip(reason);
    }
    script
}

/// The page in a browser with a headset.
pub(crate) struct Headset {
    pub(crate) browser: Browser,
}

impl Headset {
    pub(crate) fn open(program: &Path, url: &str, script: &str) -> Option<Self> {
        let script = format!("{}\n{HEADSET}\n{script}", iwer()?);
        let browser = Browser::open_with(program, url, WINDOW_PX, &script);
        Some(Self { browser })
    }

    pub(crate) fn wait_until(&mut self, what: &str, expression: &str) {
        wait_for(&mut self.browser, what, |browser| {
            browser.evaluate(expression) == true
        });
    }

    /// Enters with a button, and waits until both eyes are drawn.
    pub(crate) fn enter(&mut self, button: &str) {
        self.wait_until(
            "the button",
            &format!("document.getElementById('{button}')?.hidden === false"),
        );
        self.browser.click(button);
        self.wait_until(
            "the session",
            "document.documentElement.dataset.headset !== undefined && fieldrigHeadset().nFrames > 2",
        );
    }

    pub(crate) fn wait_until_left(&mut self) {
        self.wait_until(
            "the end of the session",
            "document.documentElement.dataset.headset === undefined",
        );
    }

    pub(crate) fn report(&mut self) -> Value {
        self.browser.evaluate("fieldrigHeadset()")
    }

    /// Waits until the hands have been read again.
    pub(crate) fn next_frames(&mut self) {
        let n = self.report()["nFrames"].as_u64().expect("a number");
        self.wait_until("frames", &format!("fieldrigHeadset().nFrames > {}", n + 2));
    }

    /// Presses a button of the palm menu.
    pub(crate) fn press(&mut self, label: &str) {
        self.point_at(label);
        self.hold("right", "trigger", true);
        self.hold("right", "trigger", false);
    }

    /// Points at a button of the palm menu.
    pub(crate) fn point_at(&mut self, label: &str) {
        self.browser.evaluate("showPalm()");
        self.wait_until(label, &format!("aimAt({label:?})"));
        self.next_frames();
    }

    pub(crate) fn hold(&mut self, side: &str, button: &str, is_held: bool) {
        let value = u8::from(is_held);
        self.browser
            .evaluate(&format!("hold('{side}', '{button}', {value})"));
        self.next_frames();
    }

    /// Puts the menu and the controllers away, so that they cover nothing.
    fn put_away(&mut self, is_away: bool) {
        self.browser.evaluate(&format!(
            "for (const side of ['left', 'right']) device.controllers[side].connected = {}",
            !is_away
        ));
        self.next_frames();
    }

    fn shot(&mut self) -> image::RgbImage {
        self.browser.next_frame();
        let png = self.browser.screenshot();
        image::load_from_memory_with_format(&png, image::ImageFormat::Png)
            .expect("a PNG")
            .to_rgb8()
    }
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let all: Vec<f64> = serde_json::from_value(value.clone()).expect("numbers");
    all.try_into().expect("as many")
}

/// What the trainer draws for an eye.
fn request_of(eye: &Value) -> RenderRequest {
    let rows: [f64; 16] = numbers(&eye["world_from_camera"]);
    let matrix = Matrix4::from_row_slice(&rows);
    RenderRequest {
        world_from_camera: nalgebra::try_convert(matrix).expect("a pose"),
        size_px: [EYE_PX, EYE_PX],
        projection: Projection::Pinhole {
            focal_px: numbers(&eye["projection"]["focalPx"]),
            principal_px: numbers(&eye["projection"]["principalPx"]),
        },
        shutter: None,
        near_m: 0.04,
        far_m: 400.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: BACKGROUND,
        appearance_of: None,
        depth: false,
    }
}

/// PSNR of each eye against the trainer.
fn eyes_psnr(headset: &mut Headset, model: &mut dyn Method, name: &str) -> [f64; 2] {
    let (report, shot) = (headset.report(), headset.shot());
    let scratch = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    shot.save(scratch.join(format!("headset-{name}.png")))
        .expect("written");
    [0, 1].map(|eye| {
        let request = request_of(&report["eyes"][eye]);
        let [x, y, width, height]: [f64; 4] = numbers(&report["eyes"][eye]["viewport"]);
        assert_eq!([width, height], [f64::from(EYE_PX); 2]);
        assert!(y == 0.0 && x == f64::from(EYE_PX) * if eye == 0 { 0.0 } else { 1.0 });
        let mut expected = model.render(&request).expect("drawn").rgba_srgb;
        expected
            .chunks_exact_mut(4)
            .for_each(|pixel| pixel[3] = 255);
        let left = if eye == 0 { 0 } else { EYE_PX };
        let half = image::imageops::crop_imm(&shot, left, 0, EYE_PX, EYE_PX).to_image();
        let shown: Vec<u8> = half
            .pixels()
            .flat_map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2], 255])
            .collect();
        psnr(&PixelPair::new([EYE_PX; 2], &shown, &expected).expect("sizes")).expect("a score")
    })
}

/// Waits until both eyes show the model as the trainer draws it.
fn check_eyes(headset: &mut Headset, model: &mut dyn Method, name: &str) {
    const TIMEOUT: Duration = Duration::from_secs(300);
    let began = Instant::now();
    loop {
        let db = eyes_psnr(headset, model, name);
        if db.iter().all(|db| *db >= MIN_DB) {
            eprintln!("{name}: {:.1} and {:.1} dB", db[0], db[1]);
            return;
        }
        assert!(began.elapsed() < TIMEOUT, "{name}: {db:?} dB");
        std::thread::sleep(Duration::from_millis(300));
    }
}

/// A hub with a wall of splats and a mesh, seen from a place that is not along an axis.
fn hub_with_models() -> Hub {
    let hub = Hub::new();
    let eye = Point3::new(0.4, -2.4, 0.3);
    let upright = UnitQuaternion::face_towards(&(Point3::new(0.0, 0.0, 0.2) - eye), &-Vector3::z());
    hub.set_scene_hint(SceneHint {
        center_m: [0.0, 0.0, 0.1],
        radius_m: 1.5,
        world_from_camera: Transform::from_parts(eye.into(), upright),
    });
    let status = |method: &str| ModelStatus {
        method: method.to_owned(),
        has_chunks: true,
        ..ModelStatus::default()
    };
    hub.set_status(Status {
        model: status("splat"),
        others: vec![status("tsdf")],
        ..Status::default()
    });
    hub
}

fn serve(hub: &Hub, port: u16) -> Server {
    let listen = ([127, 0, 0, 1], port).into();
    let began = Instant::now();
    loop {
        // The port of a server that has just stopped may still be in use.
        match Server::start(ServerConfig { listen }, hub.clone()) {
            Ok(server) => return server,
            Err(error) => assert!(began.elapsed() < Duration::from_secs(20), "{error}"),
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}

fn port_of(server: &Server) -> u16 {
    let url = server.url();
    let port = url.trim_end_matches('/').rsplit(':').next();
    port.and_then(|port| port.parse().ok()).expect("a port")
}

#[test]
fn both_eyes_see_the_model_that_the_trainer_draws() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = hub_with_models();
    let splats = wall(40_000);
    let models: models::Models = vec![
        ("splat", Box::new(splat_model(&splats))),
        ("tsdf", Box::new(tsdf_model(12))),
    ];
    let (mut reference_splats, mut reference_tsdf) = (splat_model(&splats), tsdf_model(12));
    let thread = ModelThread::start(hub.clone(), models);
    let server = serve(&hub, 0);
    let port = port_of(&server);
    let Some(mut headset) = Headset::open(&program, &server.url(), "") else {
        return;
    };
    wait_for(&mut headset.browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    headset.browser.click("toggle-grid");
    headset.enter("enter-vr");
    headset.press("Full");
    headset.put_away(true);
    check_eyes(&mut headset, &mut reference_splats, "splats");
    check_turned_head(&mut headset, &mut reference_splats);
    check_grab(&mut headset);
    check_table(&mut headset, &mut reference_splats);
    check_crop(&mut headset, &hub);
    headset.press("tsdf");
    wait_for(&mut headset.browser, "the mesh", |_| {
        hub.model_chunks().period("tsdf").is_some()
    });
    check_lost_tracking(&mut headset);
    let server = check_restart(&mut headset, &hub, server, port);
    check_own_host(&mut headset, &server);

    // Leaving by the menu returns the page, which can enter again.
    headset.point_at("Leave");
    headset.browser.evaluate("hold('right', 'trigger', 1)");
    headset.wait_until_left();
    headset.browser.evaluate("hold('right', 'trigger', 0)");
    wait_for(&mut headset.browser, "a picture of the page", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    headset
        .browser
        .evaluate("device.position.set(0.1, 1.5, 0.2)");
    headset.enter("enter-vr");
    headset.put_away(true);
    check_eyes(&mut headset, &mut reference_tsdf, "mesh-again");
    headset.browser.evaluate("device.activeSession.end()");
    headset.wait_until_left();
    drop(thread.finish());
    drop(server);
}

/// Real headsets draw into layers of the browser. The pictures must be the same.
#[test]
fn the_layers_of_a_headset_show_the_same_pictures() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let hub = hub_with_models();
    let splats = wall(20_000);
    let models: models::Models = vec![("splat", Box::new(splat_model(&splats)))];
    let mut reference = splat_model(&splats);
    let thread = ModelThread::start(hub.clone(), models);
    let server = serve(&hub, 0);
    let Some(mut headset) = Headset::open(&program, &server.url(), LAYERS) else {
        return;
    };
    wait_for(&mut headset.browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    headset.browser.click("toggle-grid");
    headset.enter("enter-vr");
    assert_eq!(headset.browser.evaluate("nProjectionLayers"), 1);
    headset.press("Full");
    headset.put_away(true);
    check_eyes(&mut headset, &mut reference, "layers");
    headset.browser.evaluate("device.activeSession.end()");
    headset.wait_until_left();

    // The resolution is chosen on the page.
    headset
        .browser
        .evaluate("document.getElementById('headset-scale').value = '0.5'");
    headset.enter("enter-vr");
    let viewport: [f64; 4] = numbers(&headset.report()["eyes"][1]["viewport"]);
    let half = f64::from(EYE_PX / 2);
    assert_eq!(viewport, [half, 0.0, half, half]);
    headset.browser.evaluate("device.activeSession.end()");
    headset.wait_until_left();
    drop((thread.finish(), server));
}

fn check_turned_head(headset: &mut Headset, model: &mut dyn Method) {
    // Turned to the left, leaned to the side and tilted.
    headset.browser.evaluate(
        "device.position.set(0.2, 1.45, 0.1); device.quaternion.set(-0.08, 0.16, 0.07, 0.98)",
    );
    headset.next_frames();
    check_eyes(headset, model, "splats-turned");
    headset
        .browser
        .evaluate("device.position.set(0, 1.6, 0); device.quaternion.set(0, 0, 0, 1)");
    headset.next_frames();
}

fn world_from_headset(headset: &mut Headset) -> Matrix4<f64> {
    let columns: [f64; 16] = numbers(&headset.report()["worldFromHeadset"]);
    Matrix4::from_column_slice(&columns)
}

/// Position of what a controller holds, in the space of the headset.
fn grip_of(headset: &mut Headset, side: &str) -> Point3<f64> {
    let at: [f64; 3] = numbers(&headset.report()["hands"][side]);
    Point3::from(at)
}

/// What the hands hold stays in them.
fn check_grab(headset: &mut Headset) {
    headset.put_away(false);
    headset.browser.evaluate("hidePalm()");
    headset
        .browser
        .evaluate("put('right', [0.3, 1.1, -0.4], [0, 0, -1], [0.3, 1.1, -3])");
    headset.next_frames();
    headset.hold("right", "squeeze", true);
    let held = world_from_headset(headset).transform_point(&grip_of(headset, "right"));
    headset
        .browser
        .evaluate("put('right', [0.1, 1.3, -0.6], [0, 0, -1], [0.1, 1.3, -3])");
    headset.next_frames();
    let now = world_from_headset(headset).transform_point(&grip_of(headset, "right"));
    assert!(
        (now - held).norm() < MAX_PLACE_ERROR_M,
        "{held} became {now}"
    );

    // Both hands: the distance between them halves the scale.
    headset.hold("left", "squeeze", true);
    let hands = ["left", "right"].map(|side| grip_of(headset, side));
    let before = world_from_headset(headset);
    let places = hands.map(|hand| before.transform_point(&hand));
    headset
        .browser
        .evaluate("put('left', [-0.7, 1.0, -0.7], [0, 0, -1], [-0.7, 1.0, -3])");
    headset.next_frames();
    let after = world_from_headset(headset);
    let moved = ["left", "right"].map(|side| grip_of(headset, side));
    let middle = |of: [Point3<f64>; 2]| nalgebra::center(&of[0], &of[1]);
    let error = after.transform_point(&middle(moved)) - middle(places);
    assert!(
        error.norm() < MAX_PLACE_ERROR_M,
        "the middle moved by {error}"
    );
    let scale = |matrix: &Matrix4<f64>| matrix.fixed_view::<3, 1>(0, 0).norm();
    let expected = (hands[0] - hands[1]).norm() / (moved[0] - moved[1]).norm();
    let ratio = scale(&after) / scale(&before);
    assert!(
        (ratio - expected).abs() < 1e-3,
        "{ratio} instead of {expected}"
    );
    headset.hold("left", "squeeze", false);
    headset.hold("right", "squeeze", false);
}

/// On a table, the same splats are smaller, and as exact.
fn check_table(headset: &mut Headset, model: &mut dyn Method) {
    headset.press("Table");
    let scale = headset.report()["placement"]["scale"].as_f64();
    // A scene with a radius of 1.5 m is 0.8 m wide.
    assert!(
        scale.is_some_and(|scale| (scale - 3.75).abs() < 1e-9),
        "{scale:?}"
    );
    let shot = headset.shot();
    shot.save(PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("headset-menu.png"))
        .expect("written");
    headset.put_away(true);
    check_eyes(headset, model, "table");
    headset.put_away(false);
}

fn check_crop(headset: &mut Headset, hub: &Hub) {
    headset.press("Layers");
    headset.press("Crop");
    headset.wait_until("the crop", "isOn('Crop') === true");
    headset.press("Crop");
    headset.wait_until("no crop", "isOn('Crop') === false");
    assert!(
        hub.model_chunks().period("splat").is_some(),
        "drawn locally"
    );
}

/// Without a pose of the head nothing is drawn, and the session goes on.
fn check_lost_tracking(headset: &mut Headset) {
    headset
        .browser
        .evaluate("device.updateVisibilityState('hidden')");
    headset.wait_until(
        "the hidden session",
        "device.activeSession.visibilityState === 'hidden'",
    );
    headset
        .browser
        .evaluate("device.updateVisibilityState('visible')");
    headset.wait_until(
        "the visible session",
        "device.activeSession.visibilityState === 'visible'",
    );
    headset.next_frames();
}

/// A cut is shown in the headset, and ends without any action of the operator.
fn check_restart(headset: &mut Headset, hub: &Hub, server: Server, port: u16) -> Server {
    assert_eq!(headset.report()["sign"], "");
    drop(server);
    headset.wait_until("the sign", "fieldrigHeadset().sign !== ''");
    let server = serve(hub, port);
    headset.wait_until("no sign", "fieldrigHeadset().sign === ''");
    headset.wait_until(
        "the model of the new server",
        "fieldrigHeadset().drawnBy === 'local'",
    );
    server
}

/// No file of another host was requested.
fn check_own_host(headset: &mut Headset, server: &Server) {
    let requested = headset
        .browser
        .evaluate("performance.getEntriesByType('resource').map(({ name }) => name)");
    let requested: Vec<String> = serde_json::from_value(requested).expect("addresses");
    assert!(requested.iter().any(|url| url.ends_with("/headset.js")));
    let foreign: Vec<_> = requested
        .iter()
        .filter(|url| !url.starts_with(&server.url()) && !url.starts_with("data:"))
        .collect();
    assert!(foreign.is_empty(), "{foreign:?}");
}
