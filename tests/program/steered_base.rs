//! A client of `/steer` drives the simulated base of `fieldrig run`.

use crate::small_rig;
use crate::steering::{Run, numbers, replay};
use serde_json::{Value, json};
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Maximum time until an event, on a machine that is busy with other tests.
const TIMEOUT: Duration = Duration::from_secs(300);
/// Time between two commands of the client.
const COMMAND_PERIOD: Duration = Duration::from_millis(25);
/// How far the base is driven, meters.
const DISTANCE_M: f64 = 0.3;
/// Largest difference between the heading and the direction of the motion. The newest pose is a
/// moment old when a motion begins.
const MAX_OFF_RAD: f64 = 0.05;
/// Largest distance between a base that has arrived and its goal, meters.
const AT_GOAL_M: f64 = 0.1;

/// A page that drives the base.
struct Driver {
    socket: WebSocket<TcpStream>,
    client: u64,
    sequence: u64,
    grip: u64,
    /// The newest state, and when it came.
    state: Value,
    state_at: Instant,
}

impl Driver {
    /// Connects as soon as the base is open.
    fn connect(run: &Run) -> Self {
        let began = Instant::now();
        let socket = loop {
            if let Some(socket) = run.connect("/steer") {
                break socket;
            }
            assert!(began.elapsed() < TIMEOUT, "the base is not open");
            std::thread::sleep(Duration::from_millis(100));
        };
        let mut driver = Self {
            socket,
            client: 0,
            sequence: 0,
            grip: 0,
            state: Value::Null,
            state_at: began,
        };
        let robot = driver.read_until(|message| message["type"] == "arm");
        assert_eq!(robot["joints"], json!([]), "{robot}");
        assert_eq!(robot["base"]["max_left_m_s"], 0.3, "{robot}");
        driver.client = robot["client"].as_u64().expect("a number");
        driver
    }

    fn send(&mut self, message: &Value) {
        let message = Message::text(message.to_string());
        self.socket.send(message).expect("the server reads");
    }

    /// Reads messages until one is accepted.
    fn read_until(&mut self, accepts: impl Fn(&Value) -> bool) -> Value {
        let began = Instant::now();
        loop {
            assert!(began.elapsed() < TIMEOUT, "last state: {}", self.state);
            let Message::Text(text) = self.socket.read().expect("the server sends") else {
                continue;
            };
            let message: Value = serde_json::from_str(&text).expect("JSON");
            if message["type"] == "state" {
                self.state = message.clone();
                self.state_at = Instant::now();
            }
            if accepts(&message) {
                return message;
            }
        }
    }

    /// x, y and heading.
    fn pose(&self) -> Vec<f64> {
        numbers(&self.state["base"]["world_from_base"])
    }

    fn command(&mut self, grip: Option<u64>, intent: &Value) {
        self.sequence += 1;
        let state_micros = self.state["time_micros"].as_f64().expect("a number");
        let since = self.state_at.elapsed().as_secs_f64();
        self.send(&json!({
            "type": "command",
            "device": 1,
            "sequence": self.sequence,
            "captured_micros": state_micros + 1e6 * since,
            "grip": grip,
            "intent": intent,
        }));
    }

    /// Holds the switch until the state is as it should be, then releases it. A pause of this
    /// program lets the base brake, so the operator grips again whenever it does not follow.
    fn hold_until(&mut self, intent: &Value, is_reached: impl Fn(&Self) -> bool) {
        let began = Instant::now();
        let mut n_unfollowed = 0;
        self.command(None, intent);
        self.grip += 1;
        while !is_reached(self) {
            assert!(began.elapsed() < TIMEOUT, "last state: {}", self.state);
            self.command(Some(self.grip), intent);
            self.read_until(|message| message["type"] == "state");
            n_unfollowed = if self.state["base"]["target"].is_null() {
                n_unfollowed + 1
            } else {
                0
            };
            if n_unfollowed > 20 {
                self.command(None, intent);
                self.grip += 1;
                n_unfollowed = 0;
            }
            std::thread::sleep(COMMAND_PERIOD);
        }
        self.command(None, intent);
    }

    fn wait_for_rest(&mut self) -> Vec<f64> {
        self.read_until(|message| {
            message["type"] == "state"
                && message["is_moving"] == false
                && message["base"]["target"].is_null()
        });
        // The last poses come through the join.
        let mut pose = self.pose();
        loop {
            self.read_until(|message| message["type"] == "state");
            std::thread::sleep(Duration::from_millis(50));
            let next = self.pose();
            if next == pose {
                return pose;
            }
            pose = next;
        }
    }
}

fn distance_m(a: &[f64], b: &[f64]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[test]
fn an_operator_takes_the_simulated_base_over_drives_it_and_sends_it_back() {
    let folder = tempfile::tempdir().expect("a folder");
    small_rig::write_base(folder.path());
    let run = Run::start(folder.path(), &["--enable-motion"]);
    let mut driver = Driver::connect(&run);

    // The base walks its tour.
    driver.read_until(|message| message["base"]["world_from_base"].is_array());
    let first = driver.pose();
    let began = Instant::now();
    while distance_m(&driver.pose(), &first) < 0.1 {
        driver.read_until(|message| message["type"] == "state");
        assert!(began.elapsed() < TIMEOUT, "it does not walk: {first:?}");
    }
    let client = driver.client;
    driver.send(&json!({"type": "lease", "action": "take"}));
    driver.read_until(|message| message["holder"] == client);
    let start = driver.wait_for_rest();

    let forward =
        json!({"kind": "base_velocity", "forward_m_s": 0.4, "left_m_s": 0, "yaw_rad_s": 0});
    driver.hold_until(&forward, |driver| {
        distance_m(&driver.pose(), &start) > DISTANCE_M
    });
    let end = driver.wait_for_rest();
    let direction = (end[1] - start[1]).atan2(end[0] - start[0]);
    let off_rad = (direction - start[2]).sin().abs();
    assert!(off_rad < MAX_OFF_RAD, "from {start:?} to {end:?}");

    let [x_m, y_m, heading_rad] = [start[0], start[1], start[2]];
    let back = json!({"kind": "base_goal", "x_m": x_m, "y_m": y_m, "heading_rad": heading_rad});
    driver.hold_until(&back, |driver| driver.state["base"]["has_arrived"] == true);
    let back = driver.wait_for_rest();
    assert!(distance_m(&back, &start) < AT_GOAL_M, "{back:?}, {start:?}");

    run.interrupt();
    let replayed = replay(folder.path());
    assert_eq!(replayed["identical"], true, "{replayed}");
    assert!(replayed["targets"].as_u64() > Some(50), "{replayed}");
}
