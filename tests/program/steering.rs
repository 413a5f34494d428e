//! A client of `/steer` moves the simulated arm of `fieldrig run`, and viewers see it.

use crate::small_rig::{self, Pace};
use crate::steering_client::{Operator, TIMEOUT, numbers};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Instant;
use tungstenite::{Message, WebSocket};

/// How far the tip moves, meters.
const DISTANCE_M: f64 = 0.1;
/// How far a joint may be from its goal when the arm has arrived, radians. The simulated arm follows
/// its setpoints with a controller.
const ARRIVED_RAD: f64 = 0.01;

/// A run, which is killed if the test fails.
pub(crate) struct Run {
    child: Child,
    address: String,
    /// Kept, so that the run can print until its end.
    _stdout: BufReader<ChildStdout>,
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.child.kill(); // Fails if the process has already ended.
        let _ = self.child.wait();
    }
}

impl Run {
    pub(crate) fn start(folder: &Path, flags: &[&str]) -> Self {
        Self::launch(
            Command::new(env!("CARGO_BIN_EXE_fieldrig"))
                .args([
                    "run",
                    "rig.toml",
                    "--sim",
                    "--listen",
                    "127.0.0.1:0",
                    "--json",
                ])
                .args(["--when-done", "exit", "--out", "out"])
                .args(flags)
                .current_dir(folder),
        )
    }

    /// Starts a program that serves the page.
    fn launch(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("it is built");
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        let mut line = String::new();
        stdout.read_line(&mut line).expect("text");
        let serving: Value = serde_json::from_str(&line).expect("an event");
        let url = serving["url"].as_str().expect("a URL");
        let address = url.strip_prefix("http://").expect("a local page");
        Self {
            child,
            address: address.trim_end_matches('/').to_owned(),
            _stdout: stdout,
        }
    }

    /// Connects to a WebSocket; `None` if the server refuses.
    pub(crate) fn connect(&self, path: &str) -> Option<WebSocket<TcpStream>> {
        let stream = TcpStream::connect(&self.address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let url = format!("ws://{}{path}", self.address);
        tungstenite::client(url, stream)
            .ok()
            .map(|(socket, _)| socket)
    }

    /// The head and the text with which the server refuses a WebSocket.
    fn refusal(&self, path: &str) -> String {
        let mut stream = TcpStream::connect(&self.address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close, Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n",
            self.address
        );
        stream.write_all(request.as_bytes()).expect("sent");
        let mut reply = String::new();
        stream.read_to_string(&mut reply).expect("text");
        reply
    }

    /// Kills the program with all its threads.
    fn kill(mut self) {
        self.child.kill().expect("it runs");
        self.child.wait().expect("our own child");
    }

    pub(crate) fn interrupt(mut self) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).expect("it runs");
        assert!(self.child.wait().expect("our own child").success());
    }
}

fn joints(position: &[f64]) -> Value {
    json!({"kind": "joints", "position": position})
}

/// Largest difference.
fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .fold(0.0, |most, (a, b)| f64::max(most, (a - b).abs()))
}

/// Distance between two positions of the tip, meters.
fn tip_distance_m(a: &Value, b: &Value) -> f64 {
    let [a, b] = [a, b].map(|state| numbers(&state["base_from_tip"]));
    a[..3]
        .iter()
        .zip(&b[..3])
        .map(|(a, b)| (a - b).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// Joint positions that viewers of the page receive.
fn watched_positions(socket: &mut WebSocket<TcpStream>) -> Vec<f64> {
    loop {
        let message: Value = match socket.read().expect("the server sends") {
            Message::Text(text) => serde_json::from_str(&text).expect("JSON"),
            _ => continue,
        };
        if message["type"] == "robot_state" {
            return numbers(&message["positions"]);
        }
    }
}

#[test]
fn an_operator_takes_the_simulated_arm_over_and_moves_its_tip_back_by_ten_centimeters() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), Pace::RealTime);
    let run = Run::start(folder.path(), &["--enable-motion"]);
    let mut operator = Operator::connect(&run);

    // The arm is on its tour. The space that it has passed is free, so the operator goes back.
    let mut way = vec![operator.next_state()];
    while tip_distance_m(&way[0], &operator.state) < 2.0 * DISTANCE_M {
        way.push(operator.next_state());
    }
    let client = operator.client;
    operator.send(&json!({"type": "lease", "action": "take"}));
    operator.read_until(|message| message["holder"] == client && message["is_moving"] == false);
    let start = operator.state.clone();

    // A device is first heard with an open switch.
    let rest = numbers(&start["position"]);
    operator.release(&joints(&rest));
    let mut goal = start.clone();
    while tip_distance_m(&start, &goal) < DISTANCE_M {
        goal = way.pop().expect("the way is longer");
        let position = numbers(&goal["position"]);
        operator.hold_until(&joints(&position), |operator| {
            distance(&numbers(&operator.state["position"]), &position) < ARRIVED_RAD
        });
    }
    operator.release(&joints(&rest));
    let left = operator.read_until(|message| {
        message["type"] == "state" && message["is_moving"] == false && message["target"].is_null()
    });
    assert!(tip_distance_m(&start, &left) > 0.9 * DISTANCE_M, "{left}");
    assert_eq!(left["contacts"], 0, "{left}");

    // Viewers see the arm where the operator left it, and it stays there. The server would end the
    // connection of a viewer that did not read before.
    let mut viewer = run.connect("/ws").expect("the page is served");
    for message in [
        json!({"type": "hello", "protocols": [3, 4], "capabilities": ["subscribe", "robot"]}),
        json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 20}),
    ] {
        let message = Message::text(message.to_string());
        viewer.send(message).expect("the server reads");
    }
    let left = numbers(&left["position"]);
    let began = Instant::now();
    while distance(&watched_positions(&mut viewer), &left) > ARRIVED_RAD {
        assert!(began.elapsed() < TIMEOUT, "viewers do not see {left:?}");
    }
    for _ in 0..20 {
        let watched = watched_positions(&mut viewer);
        assert!(
            distance(&watched, &left) < ARRIVED_RAD,
            "{watched:?}, not {left:?}"
        );
    }
    run.interrupt();
    let replayed = replay(folder.path());
    assert_eq!(replayed["identical"], true, "{replayed}");
    assert!(replayed["targets"].as_u64() > Some(100), "{replayed}");
    assert_eq!(
        (&replayed["missing"], &replayed["damage"]),
        (&json!(0), &Value::Null)
    );
    check_incidents(folder.path());
}

/// Repeats the decisions of the run.
pub(crate) fn replay(folder: &Path) -> Value {
    try_replay(folder).expect("a complete line")
}

/// Repeats the decisions of the run; `None` if its log has no complete line yet.
fn try_replay(folder: &Path) -> Option<Value> {
    let output = Command::new(env!("CARGO_BIN_EXE_fieldrig"))
        .args(["runs", "replay", "out", "--json"])
        .current_dir(folder)
        .output()
        .expect("it is built");
    let stderr = String::from_utf8_lossy(&output.stderr);
    if stderr.contains("no steering log") || stderr.contains("it is empty") {
        return None;
    }
    assert!(output.status.success(), "{output:?}");
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
}

/// `fieldrig view` offers the incidents of the run, and shows its robot.
fn check_incidents(folder: &Path) {
    let view = Run::launch(
        Command::new(env!("CARGO_BIN_EXE_fieldrig"))
            .args(["view", "out", "--listen", "127.0.0.1:0", "--json"])
            .current_dir(folder),
    );
    // The address is printed when the models are loaded, and the files are published before.
    let mut stream = TcpStream::connect(&view.address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let request = format!(
        "GET /files/steering-incidents.json HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
        view.address
    );
    stream.write_all(request.as_bytes()).expect("sent");
    let mut reply = String::new();
    stream.read_to_string(&mut reply).expect("text");
    let body = &reply[reply.find("\r\n\r\n").expect("a head")..];
    let list = &body[body.find('{').expect("JSON")..=body.rfind('}').expect("JSON")];
    let list: Value = serde_json::from_str(list).expect("JSON");
    assert_eq!(
        list["joint_names"].as_array().map(Vec::len),
        Some(7),
        "{list}"
    );
    let incidents = list["incidents"].as_array().expect("a list");
    let taken = &incidents[0];
    assert_eq!(taken["kind"], "lease", "{taken}");
    let text = taken["text"].as_str().expect("a text");
    assert!(text.ends_with("took control"), "{text}");
    let robot = view.connect("/ws").map(|mut viewer| {
        for message in [
            json!({"type": "hello", "protocols": [3, 4], "capabilities": ["subscribe", "robot"]}),
            json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 20}),
        ] {
            let message = Message::text(message.to_string());
            viewer.send(message).expect("the server reads");
        }
        loop {
            if let Message::Text(text) = viewer.read().expect("the server sends") {
                let message: Value = serde_json::from_str(&text).expect("JSON");
                if message["type"] == "robot" {
                    break message;
                }
            }
        }
    });
    let robot = robot.expect("the page is served");
    assert_eq!(robot["joint_names"], list["joint_names"], "{robot}");
}

#[test]
fn a_killed_run_leaves_a_log_up_to_its_stop() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), Pace::RealTime);
    let run = Run::start(folder.path(), &["--enable-motion"]);
    let mut operator = Operator::connect(&run);
    let client = operator.client;
    operator.send(&json!({"type": "lease", "action": "take"}));
    operator.read_until(|message| message["holder"] == client);
    operator.send(&json!({"type": "view", "world_from_camera": [1, 0, 2, 0, 0, 0, 1]}));
    operator.send(&json!({"type": "stop"}));
    operator.read_until(|message| message["stop"].is_string());
    // Several further decisions, so that the thread of the log has had time. It does not wait for
    // anything.
    let began = Instant::now();
    loop {
        operator.next_state();
        let replayed = try_replay(folder.path()).unwrap_or_default();
        if replayed["decisions"].as_u64() > Some(2) {
            assert_eq!(replayed["identical"], true, "{replayed}");
            break;
        }
        assert!(began.elapsed() < TIMEOUT, "the stop is not in the log");
    }
    run.kill();
    let replayed = replay(folder.path());
    assert_eq!(
        (&replayed["identical"], &replayed["damage"]),
        (&json!(true), &Value::Null)
    );
}

#[test]
fn a_run_without_the_flag_refuses_operators_with_a_sentence() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write(folder.path(), Pace::RealTime);
    let run = Run::start(folder.path(), &["--seconds", "5"]);
    let refusal = run.refusal("/steer");
    assert!(refusal.starts_with("HTTP/1.1 404"), "{refusal}");
    assert!(refusal.contains("no arm can be steered"), "{refusal}");
}
