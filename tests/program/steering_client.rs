//! A client of `/steer`, as a page that steers an arm or drives a base.

use crate::steering::Run;
use serde_json::{Value, json};
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Maximum time until an event, on a machine that is busy with other tests.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(300);
/// Time between two commands of the client.
const COMMAND_PERIOD: Duration = Duration::from_millis(25);
/// Number of states without a target after which the operator grips again.
const MAX_UNFOLLOWED: u32 = 20;

/// A page that steers.
pub(crate) struct Operator {
    socket: WebSocket<TcpStream>,
    pub(crate) client: u64,
    /// The robot, as the server describes it.
    pub(crate) robot: Value,
    sequence: u64,
    grip: u64,
    /// The newest state, and when it came.
    pub(crate) state: Value,
    state_at: Instant,
}

impl Operator {
    /// Connects as soon as the robot is open.
    pub(crate) fn connect(run: &Run) -> Self {
        let began = Instant::now();
        let socket = loop {
            if let Some(socket) = run.connect("/steer") {
                break socket;
            }
            assert!(
                began.elapsed() < TIMEOUT,
                "the robot is not open within {TIMEOUT:?}"
            );
            std::thread::sleep(Duration::from_millis(100));
        };
        let mut operator = Self {
            socket,
            client: 0,
            robot: Value::Null,
            sequence: 0,
            grip: 0,
            state: Value::Null,
            state_at: began,
        };
        operator.robot = operator.read_until(|message| message["type"] == "arm");
        assert_eq!(operator.robot["may_steer"], true, "{}", operator.robot);
        operator.client = operator.robot["client"].as_u64().expect("a number");
        operator
    }

    pub(crate) fn send(&mut self, message: &Value) {
        let message = Message::text(message.to_string());
        self.socket.send(message).expect("the server reads");
    }

    /// Reads messages until one is accepted.
    pub(crate) fn read_until(&mut self, accepts: impl Fn(&Value) -> bool) -> Value {
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

    pub(crate) fn next_state(&mut self) -> Value {
        self.read_until(|message| message["type"] == "state")
    }

    pub(crate) fn take_control(&mut self) {
        let client = self.client;
        self.send(&json!({"type": "lease", "action": "take"}));
        self.read_until(|message| message["holder"] == client);
    }

    /// Sends a command with an open switch.
    pub(crate) fn release(&mut self, intent: &Value) {
        self.command(None, intent);
    }

    /// Sends a command, whose device was read now.
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
    /// program lets the robot brake, so the operator grips again whenever it does not follow.
    pub(crate) fn hold_until(&mut self, intent: &Value, is_reached: impl Fn(&Self) -> bool) {
        let began = Instant::now();
        let mut n_unfollowed = 0;
        self.command(None, intent);
        self.grip += 1;
        while !is_reached(self) {
            assert!(began.elapsed() < TIMEOUT, "last state: {}", self.state);
            self.command(Some(self.grip), intent);
            let state = self.next_state();
            let is_unfollowed = state["target"].is_null() && state["base"]["target"].is_null();
            n_unfollowed = if is_unfollowed { n_unfollowed + 1 } else { 0 };
            if n_unfollowed > MAX_UNFOLLOWED {
                self.command(None, intent);
                self.grip += 1;
                n_unfollowed = 0;
            }
            std::thread::sleep(COMMAND_PERIOD);
        }
        self.command(None, intent);
    }

    /// Waits until nothing moves.
    pub(crate) fn wait_for_rest(&mut self) {
        self.read_until(|message| {
            message["type"] == "state"
                && message["is_moving"] == false
                && message["target"].is_null()
                && message["base"]["target"].is_null()
        });
    }

    /// x, y and heading of the base.
    pub(crate) fn base_pose(&self) -> Vec<f64> {
        numbers(&self.state["base"]["world_from_base"])
    }

    /// Waits until the base has a pose.
    pub(crate) fn wait_for_base_pose(&mut self) {
        self.read_until(|message| message["base"]["world_from_base"].is_array());
    }

    /// Waits until the base is at rest, and returns its pose. The last poses come through the join.
    pub(crate) fn base_at_rest(&mut self) -> Vec<f64> {
        self.wait_for_rest();
        let mut pose = self.base_pose();
        loop {
            self.next_state();
            std::thread::sleep(Duration::from_millis(50));
            let next = self.base_pose();
            if next == pose {
                return pose;
            }
            pose = next;
        }
    }
}

pub(crate) fn numbers(value: &Value) -> Vec<f64> {
    let list = value
        .as_array()
        .unwrap_or_else(|| panic!("no list: {value}"));
    list.iter()
        .map(|number| number.as_f64().expect("a number"))
        .collect()
}
