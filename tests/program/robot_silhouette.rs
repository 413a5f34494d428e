//! The robot that the page draws from the messages of a simulated run, compared with MuJoCo's
//! segmentation.
//!
//! The page gets the robot and its states as the run has sent them. The pictures have the exact
//! depth of the scene, so that only the robot is tested. Skipped, with a message, if Chromium or
//! the bundle (`make web`) is missing.
#![cfg(feature = "sim")]

use crate::page_server::PageServer;
use crate::small_rig;
use kinematics::Transform;
use nalgebra::{Matrix4, Point3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use sim::{PinholeView, RobotMasks, Scene};
use std::io::{BufRead, BufReader, ErrorKind};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use test_support::browser::{Browser, browser_for_page, canvas_shot, wait_for};
use test_support::silhouette::iou;
use tungstenite::{Message, WebSocket};

const WINDOW_PX: [u32; 2] = [1280, 760];
/// Required overlap of the drawn silhouette with MuJoCo's: intersection over union.
const MIN_IOU: f64 = 0.97;
/// Color of everything but the robot.
const BACKGROUND: [u8; 3] = [220, 0, 220];
/// Difference of a color channel between a pixel with and without the robot.
const MIN_CONTRAST: u8 = 24;
/// Positions of the robot differ by at least this much, radians.
const MIN_MOTION_RAD: f64 = 0.3;
/// Maximum time until the robot has moved by this much.
const TIMEOUT: Duration = Duration::from_secs(120);

/// The robot and some of its states, as sent by a run.
struct Robot {
    description: Value,
    states: Vec<Value>,
}

/// A run that is killed at the end of the test, or if it fails.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill(); // Fails if the process has already ended.
        let _ = self.0.wait();
    }
}

/// Receives the robot from a run of a simulated rig, until it has moved noticeably.
fn robot_of_run() -> Robot {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), small_rig::Pace::RealTime);
    let run = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args([
            "run",
            "rig.toml",
            "--sim",
            "--max-splats",
            "1000",
            "--out",
            "out",
            "--listen",
            "127.0.0.1:0",
            "--json",
        ])
        .current_dir(folder.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("it is built");
    let mut run = Running(run);
    let mut lines = BufReader::new(run.0.stdout.take().expect("piped"))
        .lines()
        .map_while(Result::ok);
    let serving: Value = serde_json::from_str(&lines.next().expect("an event")).expect("JSON");
    let address = serving["url"]
        .as_str()
        .and_then(|url| url.strip_prefix("http://"))
        .expect("a URL");
    let address = address.trim_end_matches('/');
    let stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let (mut socket, _) =
        tungstenite::client(format!("ws://{address}/ws"), stream).expect("a WebSocket");
    for message in [
        json!({"type": "hello", "protocols": [3, 4], "capabilities": ["subscribe", "robot"]}),
        json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 20}),
    ] {
        socket
            .send(Message::text(message.to_string()))
            .expect("the server reads");
    }
    let (mut description, mut states) = (None, Vec::<Value>::new());
    let began = Instant::now();
    while states.len() < 2 {
        assert!(
            began.elapsed() < TIMEOUT,
            "the robot has not moved within {TIMEOUT:?}"
        );
        let Message::Text(text) = socket.read().expect("the server sends") else {
            continue;
        };
        let message: Value = serde_json::from_str(&text).expect("JSON");
        match message["type"].as_str() {
            Some("robot") => description = Some(message),
            Some("robot_state")
                if states
                    .first()
                    .is_none_or(|first| motion_rad(first, &message) > MIN_MOTION_RAD) =>
            {
                states.push(message);
            }
            _ => {}
        }
    }
    Robot {
        description: description.expect("a robot comes before its states"),
        states,
    }
}

fn positions(state: &Value) -> Vec<f64> {
    state["positions"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|value| value.as_f64().expect("a number"))
        .collect()
}

/// Largest difference of a joint position, radians.
fn motion_rad(a: &Value, b: &Value) -> f64 {
    positions(a)
        .iter()
        .zip(positions(b))
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

fn pose(row_major: &Value) -> Transform {
    let numbers = row_major
        .as_array()
        .expect("16 numbers")
        .iter()
        .map(|value| value.as_f64().expect("a number"));
    nalgebra::try_convert(Matrix4::from_row_iterator(numbers)).expect("a rigid transform")
}

fn row_major(pose: &Transform) -> Value {
    json!(pose.to_homogeneous().transpose().as_slice())
}

/// A view of the robot from behind a wall, which hides a part of it.
fn first_view() -> Transform {
    let eye = Point3::new(0.75, -1.2, 0.9);
    let rotation =
        UnitQuaternion::face_towards(&(Point3::new(0.15, 0.0, 0.35) - eye), &-Vector3::z());
    Transform::from_parts(eye.into(), rotation)
}

/// The view of a `render` message.
fn view_of(request: &Value) -> PinholeView {
    let pair = |value: &Value| [0, 1].map(|ix| value[ix].as_f64().expect("two numbers"));
    let size_px = [0, 1].map(|ix| {
        request["size_px"][ix]
            .as_u64()
            .and_then(|n| u32::try_from(n).ok())
            .expect("a size")
    });
    PinholeView {
        size_px,
        focal_px: pair(&request["projection"]["focal_px"]),
        principal_px: pair(&request["projection"]["principal_px"]),
        world_from_camera: pose(&request["world_from_camera"]),
    }
}

/// A view, and where its depth is sent.
type DepthJob = (PinholeView, SyncSender<Vec<f32>>);

/// Starts a thread that renders the depth of the scene without the robot.
fn start_renderer() -> SyncSender<DepthJob> {
    let (jobs, queue) = sync_channel::<DepthJob>(1);
    let (ready, started) = sync_channel(1);
    std::thread::spawn(move || {
        let mut scene = RobotMasks::open(Scene::StaticArm, WINDOW_PX).expect("the scene is valid");
        ready.send(()).expect("the test waits");
        for (view, reply) in queue {
            reply
                .send(scene.depth_without_robot_m(&view))
                .expect("the requester waits");
        }
    });
    started.recv().expect("a renderer");
    jobs
}

/// What the page shows and has requested.
struct Stage {
    renderer: Mutex<SyncSender<DepthJob>>,
    robot: Value,
    state: Mutex<Value>,
    last_request: Mutex<Value>,
}

impl Stage {
    /// Serves one page: sends the robot and its current state, and answers requests of pictures.
    fn talk(&self, mut socket: WebSocket<TcpStream>) {
        socket
            .get_ref()
            .set_read_timeout(Some(Duration::from_millis(20)))
            .expect("a timeout");
        let began = Instant::now();
        let clock_millis = || began.elapsed().as_secs_f64() * 1e3;
        let hello = json!({
            "type": "hello", "protocol": 3, "protocols": [3, 4], "capabilities": ["subscribe", "robot"], "server": "test",
            "client": 1, "role": "operator", "max_size_px": [4096, 4096], "default_stages": [1.0], "clock_millis": 0.0,
        });
        let view = json!({
            "type": "scene", "center_m": [0.15, 0.0, 0.35], "radius_m": 1.0, "world_from_camera": row_major(&first_view()),
        });
        let mut outbox: Vec<Message> = [&hello, &view, &self.robot]
            .map(|message| Message::text(message.to_string()))
            .into();
        loop {
            let mut state = self.state.lock().expect("no panic").clone();
            state["captured_millis"] = json!(clock_millis());
            outbox.push(Message::text(state.to_string()));
            for message in outbox.drain(..) {
                if socket.send(message).is_err() {
                    return; // The page was closed.
                }
            }
            match socket.read() {
                Ok(Message::Text(text)) => {
                    let message: Value = serde_json::from_str(&text).expect("JSON");
                    if message["type"] == "ping" {
                        let pong = json!({"type": "pong", "t": message["t"], "clock_millis": clock_millis()});
                        outbox.push(Message::text(pong.to_string()));
                    } else if message["type"] == "render" {
                        outbox.push(picture(&message, &self.depth_m(view_of(&message))));
                        *self.last_request.lock().expect("no panic") = message;
                    }
                }
                Ok(_) => {}
                Err(tungstenite::Error::Io(error))
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return,
            }
        }
    }

    fn depth_m(&self, view: PinholeView) -> Vec<f32> {
        let (reply, depth_m) = sync_channel(1);
        self.renderer
            .lock()
            .expect("no panic")
            .send((view, reply))
            .expect("it renders");
        depth_m.recv().expect("it renders")
    }

    fn view(&self) -> PinholeView {
        view_of(&self.last_request.lock().expect("no panic"))
    }
}

/// A picture of one color with this depth.
fn picture(request: &Value, depth_m: &[f32]) -> Message {
    let size_px = view_of(request).size_px;
    let mut jpeg = std::io::Cursor::new(Vec::new());
    let image = image::RgbImage::from_pixel(size_px[0], size_px[1], image::Rgb(BACKGROUND));
    image
        .write_to(&mut jpeg, image::ImageFormat::Jpeg)
        .expect("encoded");
    let jpeg = jpeg.into_inner();
    let depth: Vec<u8> = depth_m
        .iter()
        .flat_map(|depth| depth.to_le_bytes())
        .collect();
    let header = json!({
        "type": "picture", "id": request["id"], "stage": 0, "n_stages": 1, "scale": 1.0, "last": true,
        "size_px": size_px, "full_size_px": size_px, "world_from_camera": request["world_from_camera"],
        "projection": request["projection"], "near_m": request["near_m"], "far_m": request["far_m"],
        "waited_millis": 0.0, "render_millis": 0.0, "encode_millis": 0.0, "keyframes": null, "newest_keyframe": null,
        "sent_millis": 0.0, "color": {"format": "jpeg", "offset": 0, "bytes": jpeg.len()},
        "depth": {"format": "f32", "size_px": size_px, "meters_per_count": 1.0, "offset": jpeg.len(), "bytes": depth.len()},
    });
    let header = header.to_string().into_bytes();
    let length = u32::try_from(header.len()).expect("short").to_le_bytes();
    Message::binary([&length[..], &header, &jpeg, &depth].concat())
}

/// Where the robot is drawn: the pixels that change when it is hidden.
fn drawn_silhouette(browser: &mut Browser, name: &str) -> Vec<bool> {
    let with_robot = canvas_shot(browser);
    with_robot
        .save(Path::new(env!("CARGO_TARGET_TMPDIR")).join(name))
        .expect("written");
    browser.click("toggle-robot");
    let without_robot = canvas_shot(browser);
    browser.click("toggle-robot");
    let differs = |(a, b): (&image::Rgb<u8>, &image::Rgb<u8>)| {
        a.0.iter()
            .zip(b.0)
            .any(|(a, b)| a.abs_diff(b) > MIN_CONTRAST)
    };
    with_robot
        .pixels()
        .zip(without_robot.pixels())
        .map(differs)
        .collect()
}

#[test]
fn silhouette_of_a_simulated_robot_matches_the_simulator() {
    let Some(program) = browser_for_page() else {
        return;
    };
    let Robot {
        description,
        states,
    } = robot_of_run();
    assert_eq!(
        description["joint_names"][6], "panda_joint7",
        "all joints in order: {}",
        description["joint_names"]
    );
    let stage = Arc::new(Stage {
        renderer: Mutex::new(start_renderer()),
        robot: description,
        state: Mutex::new(states[0].clone()),
        last_request: Mutex::new(Value::Null),
    });
    let talking = Arc::clone(&stage);
    let server = PageServer::start(move |socket| talking.talk(socket));
    let mut browser = Browser::open(&program, &server.url(), WINDOW_PX);
    wait_for(&mut browser, "a full picture", |browser| {
        browser.text("picture-text").contains("100 %")
    });
    browser.click("toggle-grid");
    let mut masks = RobotMasks::open(Scene::StaticArm, WINDOW_PX).expect("the scene is valid");
    let mut exact = Vec::new();
    for (n, state) in states.iter().enumerate() {
        *stage.state.lock().expect("no panic") = state.clone();
        for is_alone in [false, true] {
            let base = pose(&state["world_from_base"]);
            let mut mask = Vec::new();
            let name = format!("simulated-robot-{n}-{is_alone}.png");
            wait_for(
                &mut browser,
                &format!("the silhouette in {name}"),
                |browser| {
                    let drawn = drawn_silhouette(browser, &name);
                    // On a busy machine, the first picture may be of an earlier view.
                    let view = stage.view();
                    mask = masks
                        .mask(&view, &base, &positions(state), is_alone)
                        .expect("seven joints");
                    let overlap = iou(view.size_px, &drawn, &mask);
                    eprintln!("{name}: IoU {overlap:.4}");
                    overlap >= MIN_IOU
                },
            );
            exact.push(mask);
            browser.click("toggle-occlude");
        }
    }
    // The cases differ. If the page had drawn a wrong case, this test would have detected it.
    let size_px = stage.view().size_px;
    for (a, b) in [(0, 1), (0, 2), (1, 3), (2, 3)] {
        let similarity = iou(size_px, &exact[a], &exact[b]);
        assert!(
            similarity < MIN_IOU - 0.02,
            "cases {a} and {b} are too similar: {similarity}"
        );
    }
    drop(browser);
}
