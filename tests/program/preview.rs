//! `fieldrig preview`, as a client of its page receives it: simulated, and with real devices of which
//! one is missing. It writes nothing.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::{TcpStream, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Maximum time until an event, on a machine that is busy with other tests.
const TIMEOUT: Duration = Duration::from_secs(300);

/// A running preview, which is killed if the test fails.
struct Preview {
    child: Child,
    socket: WebSocket<TcpStream>,
}

impl Drop for Preview {
    fn drop(&mut self) {
        let _ = self.child.kill(); // Fails if the process has already ended.
        let _ = self.child.wait();
    }
}

impl Preview {
    /// Starts a preview in a folder, and connects to its page.
    fn start(folder: &Path, args: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .arg("preview")
            .args(args)
            .args(["--listen", "127.0.0.1:0", "--json"])
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("it is built");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped"))
            .read_line(&mut line)
            .expect("text");
        let serving: Value = serde_json::from_str(&line).expect("an event");
        let address = serving["url"]
            .as_str()
            .and_then(|url| url.strip_prefix("http://"))
            .expect("a URL")
            .trim_end_matches('/')
            .to_owned();
        let stream = TcpStream::connect(&address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let (socket, _) =
            tungstenite::client(format!("ws://{address}/ws"), stream).expect("a WebSocket");
        let mut preview = Self { child, socket };
        for message in [
            json!({"type": "hello", "protocols": [3, 4], "capabilities": ["subscribe", "robot"]}),
            json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 20}),
        ] {
            let message = Message::text(message.to_string());
            preview.socket.send(message).expect("the server reads");
        }
        preview
    }

    /// Returns the first message, or header of a binary message, that the function accepts.
    fn wait_for(&mut self, what: &str, accepts: impl Fn(&Value) -> bool) -> Value {
        let began = Instant::now();
        loop {
            assert!(began.elapsed() < TIMEOUT, "no {what} within {TIMEOUT:?}");
            let message: Value = match self.socket.read().expect("the server sends") {
                Message::Text(text) => serde_json::from_str(&text).expect("JSON"),
                Message::Binary(bytes) => {
                    let n_header =
                        u32::from_le_bytes(bytes[..4].try_into().expect("four bytes")) as usize;
                    serde_json::from_slice(&bytes[4..4 + n_header]).expect("JSON")
                }
                _ => continue,
            };
            if accepts(&message) {
                return message;
            }
        }
    }

    /// Interrupts the program and checks that it ends as expected.
    fn interrupt(mut self) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).expect("it runs");
        assert!(self.child.wait().expect("our own child").success());
    }
}

/// The device with this name in a status.
fn device<'a>(status: &'a Value, name: &str) -> Option<&'a Value> {
    let devices = status["preview"]["devices"].as_array()?;
    devices.iter().find(|device| device["name"] == name)
}

fn is_in_state(status: &Value, name: &str, state: &str) -> bool {
    device(status, name).is_some_and(|device| device["state"] == state)
}

#[cfg(feature = "sim")]
#[test]
fn simulated_preview_has_posed_images_and_a_moving_robot_and_writes_nothing() {
    use crate::small_rig;
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), small_rig::Pace::RealTime);
    let before = files_in(folder.path());
    let mut preview = Preview::start(folder.path(), &["rig.toml", "--sim"]);
    let robot = preview.wait_for("robot", |message| message["type"] == "robot");
    assert!(
        robot["links"]
            .as_array()
            .is_some_and(|links| links.len() > 5)
    );
    let status = preview.wait_for("delivering devices", |message| {
        is_in_state(message, "camera \"wrist\"", "delivering")
            && is_in_state(message, "arm", "delivering")
            && device(message, "arm").is_some_and(|arm| arm["rate_hz"].is_number())
    });
    assert_eq!(status["state"], "preview");
    let advice = status["advice"]["text"].as_str().expect("advice");
    assert!(advice.contains("nothing is trained"), "{advice}");
    let image = preview.wait_for("image with a pose", |message| {
        message["type"] == "live_image" && message["world_from_camera"].is_array()
    });
    assert_eq!(image["camera"], "wrist");
    let first = preview.wait_for("robot state", |message| message["type"] == "robot_state");
    preview.wait_for("motion of the robot", |message| {
        message["type"] == "robot_state" && message["positions"] != first["positions"]
    });
    // A client that asks for a picture gets an answer.
    let request = json!({"type": "render", "id": 1, "size_px": [64, 48],
        "world_from_camera": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9}});
    let request = Message::text(request.to_string());
    preview.socket.send(request).expect("the server reads");
    let error = preview.wait_for("answer", |message| message["type"] == "error");
    assert!(
        error["message"]
            .as_str()
            .is_some_and(|text| text.contains("preview")),
        "{error}"
    );
    preview.interrupt();
    assert_eq!(files_in(folder.path()), before);
}

#[cfg(target_os = "linux")]
#[test]
fn a_missing_camera_is_listed_while_the_arm_moves() {
    let folder = tempfile::tempdir().expect("a folder");
    // The port is free, because the system has just assigned it.
    let address = UdpSocket::bind("127.0.0.1:0")
        .and_then(|socket| socket.local_addr())
        .expect("a free port");
    let rig = format!(
        "[arm]\ndriver = \"udp\"\naddress = \"{address}\"\nurdf = \"arm.urdf\"\nflange_link = \"tip\"\n\
         [camera.front]\ndriver = \"v4l2\"\ndevice = \"no such serial\"\nsize_px = [640, 480]\nrate_hz = 30\n\
         parent = \"base\"\nintrinsics = {{ focal_px = [600, 600], principal_px = [320, 240] }}\n"
    );
    let urdf = r#"<robot name="crane"><link name="base"/><link name="tip"/>
        <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
        <limit lower="-3" upper="3" velocity="1" effort="1"/></joint></robot>"#;
    std::fs::write(folder.path().join("rig.toml"), rig).expect("written");
    std::fs::write(folder.path().join("arm.urdf"), urdf).expect("written");
    let before = files_in(folder.path());
    let mut preview = Preview::start(folder.path(), &["rig.toml"]);
    let status = preview.wait_for("reason", |message| {
        is_in_state(message, "camera \"front\"", "failed")
    });
    let camera = device(&status, "camera \"front\"").expect("it was found");
    let reason = camera["reason"].as_str().expect("a reason");
    assert!(reason.contains("no such serial"), "{reason}");
    assert!(!reason.contains("--sim"), "the hint is for `run`: {reason}");
    assert_eq!(status["advice"]["is_warning"], true);

    let sender = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let mut seq: u32 = 0;
    let began = Instant::now();
    let stream = preview.socket.get_ref();
    stream
        .set_read_timeout(Some(Duration::from_millis(50)))
        .expect("a timeout");
    // The states are sent until one of them has come back.
    loop {
        assert!(
            began.elapsed() < TIMEOUT,
            "no robot state within {TIMEOUT:?}"
        );
        seq += 1;
        let state = json!({"kind": "joints", "version": 1, "seq": seq, "clock": "monotonic",
            "stamp_nanos": drivers::clock::now().0, "names": ["turn"], "position": [0.01 * f64::from(seq)]});
        let _ = sender.send_to(state.to_string().as_bytes(), address);
        let Ok(Message::Text(text)) = preview.socket.read() else {
            continue;
        };
        let message: Value = serde_json::from_str(&text).expect("JSON");
        let is_moved = message["positions"][0]
            .as_f64()
            .is_some_and(|position| position > 0.0);
        if message["type"] == "robot_state" && is_moved {
            break;
        }
    }
    preview.interrupt();
    assert_eq!(files_in(folder.path()), before);
}

#[test]
fn a_rig_without_cameras_says_what_to_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let rig = "[arm]\ndriver = \"udp\"\naddress = \"127.0.0.1:0\"\nurdf = \"builtin:ur5e\"\n";
    std::fs::write(folder.path().join("rig.toml"), rig).expect("written");
    let mut preview = Preview::start(folder.path(), &["rig.toml"]);
    preview.wait_for("note", |message| {
        let notes = message["notes"].as_array();
        notes.is_some_and(|notes| {
            notes
                .iter()
                .filter_map(Value::as_str)
                .any(|note| note.contains("has no camera") && note.contains("`fieldrig devices`"))
        })
    });
    preview.interrupt();
}

/// Names of the files in a folder.
fn files_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("a folder");
    let mut names: Vec<String> = entries
        .map(|entry| {
            entry
                .expect("readable")
                .file_name()
                .to_string_lossy()
                .into_owned()
        })
        .collect();
    names.sort();
    names
}
