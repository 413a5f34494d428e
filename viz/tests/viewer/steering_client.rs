//! A blocking client of `/steer`, and a server with an arm.

use crate::client::TIMEOUT;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tungstenite::client::IntoClientRequest;
use tungstenite::{HandshakeError, Message, WebSocket};
use viz::{
    ArmDescription, Hub, ReceivedRequest, Server, ServerConfig, SteeredJoint, SteeringRequest,
    SteeringServer, SteeringState, publish_steering,
};

/// Number of joints of the arm.
pub(crate) const N_JOINTS: usize = 2;

/// An arm with two joints.
pub(crate) fn arm(lease_secs: f64) -> Arc<SteeringServer> {
    let joint = |name: &str| SteeredJoint {
        name: name.to_owned(),
        lower: Some(-1.5),
        upper: None,
        is_prismatic: false,
        velocity: 0.5,
    };
    SteeringServer::new(ArmDescription {
        base_link: "base".to_owned(),
        tip_link: "tool".to_owned(),
        joints: vec![joint("shoulder"), joint("elbow")],
        expiry_secs: 0.12,
        lease_secs,
        servo_round_trip_millis: 80.0,
        base: None,
    })
}

/// A state in which nothing happens.
pub(crate) fn state() -> SteeringState {
    SteeringState {
        at: Instant::now(),
        holder: None,
        lease_left_secs: None,
        offered_to: None,
        stop: None,
        stop_number: None,
        is_recovering: false,
        is_moving: false,
        moved_part: None,
        position: vec![0.0; N_JOINTS],
        target: None,
        base_from_tip: [0.4, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
        base_from_target: None,
        limits: Vec::new(),
        applied: None,
        contacts: None,
        base: None,
    }
}

/// A server on this computer, and the arm that its clients may steer.
pub(crate) struct Desk {
    pub(crate) hub: Hub,
    pub(crate) arm: Arc<SteeringServer>,
    pub(crate) server: Server,
}

impl Desk {
    /// With leases that last longer than a test.
    pub(crate) fn start() -> Self {
        Self::with_leases_of(3000.0)
    }

    pub(crate) fn with_leases_of(lease_secs: f64) -> Self {
        let (hub, server) = serve();
        let arm = arm(lease_secs);
        publish_steering(&hub, Some(Arc::clone(&arm)));
        Self { hub, arm, server }
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.server.address()
    }

    pub(crate) fn client(&self) -> SteeringClient<TcpStream> {
        SteeringClient::connect(self.address())
    }

    /// Takes requests until one of them matches. Returns all of them.
    pub(crate) fn requests_until(
        &self,
        matches: impl Fn(&ReceivedRequest) -> bool,
    ) -> Vec<ReceivedRequest> {
        requests_until(&self.arm, matches)
    }
}

/// A server without an arm.
pub(crate) fn serve() -> (Hub, Server) {
    let hub = Hub::new();
    let listen = SocketAddr::from(([127, 0, 0, 1], 0));
    let server = Server::start(ServerConfig { listen }, hub.clone());
    (hub, server.expect("a free port exists"))
}

/// Takes requests until one of them matches. Returns all of them.
pub(crate) fn requests_until(
    arm: &SteeringServer,
    matches: impl Fn(&ReceivedRequest) -> bool,
) -> Vec<ReceivedRequest> {
    let deadline = Instant::now() + TIMEOUT;
    let mut received = Vec::new();
    while Instant::now() < deadline {
        arm.wait_for_requests(Duration::from_millis(100));
        received.extend(arm.take_requests());
        if received.iter().any(&matches) {
            return received;
        }
    }
    panic!("the expected request did not arrive, only {received:?}");
}

/// Whether a request is the end of a client.
pub(crate) fn is_end_of(client: u64) -> impl Fn(&ReceivedRequest) -> bool {
    move |received| received.client == client && received.request == SteeringRequest::Disconnected
}

/// A command that moves the joints.
pub(crate) fn command(sequence: u64, grip: Option<u64>, now_micros: f64) -> Value {
    json!({
        "type": "command", "device": 1, "sequence": sequence, "captured_micros": now_micros,
        "grip": grip, "intent": {"kind": "joint_velocity", "velocity": [0.1, 0.0]},
    })
}

/// A connection to `/steer`.
pub(crate) struct SteeringClient<S> {
    pub(crate) socket: WebSocket<S>,
    /// The first message.
    pub(crate) arm: Value,
    n_pings: u64,
}

impl SteeringClient<TcpStream> {
    pub(crate) fn connect(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).expect("the server listens");
        stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
        Self::over(stream, &format!("ws://{address}/steer"), &[]).expect("a WebSocket")
    }
}

impl<S: Read + Write> SteeringClient<S> {
    /// Opens a WebSocket with additional headers. The error is the status and the text of the
    /// response.
    pub(crate) fn over(
        stream: S,
        url: &str,
        headers: &[(&'static str, String)],
    ) -> Result<Self, (u16, String)> {
        let mut request = url.into_client_request().expect("a request");
        for (name, value) in headers {
            request
                .headers_mut()
                .insert(*name, value.parse().expect("text"));
        }
        let mut socket = match tungstenite::client(request, stream) {
            Ok((socket, _)) => socket,
            Err(HandshakeError::Failure(tungstenite::Error::Http(response))) => {
                let body = response.body().clone().unwrap_or_default();
                let text = String::from_utf8_lossy(&body).into_owned();
                return Err((response.status().as_u16(), text));
            }
            Err(error) => panic!("no WebSocket: {error}"),
        };
        let arm = next_json(&mut socket).expect("a first message");
        assert_eq!(arm["type"], "arm", "{arm}");
        Ok(Self {
            socket,
            arm,
            n_pings: 0,
        })
    }

    pub(crate) fn number(&self) -> u64 {
        self.arm["client"].as_u64().expect("a number")
    }

    pub(crate) fn send(&mut self, message: &Value) {
        self.send_text(&message.to_string());
    }

    pub(crate) fn send_text(&mut self, text: &str) {
        self.socket.send(Message::text(text)).expect("sent");
    }

    /// The next message; `None` when the connection has ended.
    pub(crate) fn next(&mut self) -> Option<Value> {
        next_json(&mut self.socket)
    }

    /// The next message of a type.
    pub(crate) fn next_of(&mut self, kind: &str) -> Value {
        loop {
            let message = self.next();
            let message = message.unwrap_or_else(|| panic!("the connection ended before {kind:?}"));
            if message["type"] == kind {
                return message;
            }
        }
    }

    /// The text of the next refusal, and what was refused.
    pub(crate) fn refusal(&mut self) -> (String, String) {
        let refused = self.next_of("refused");
        let text = |field: &str| refused[field].as_str().expect("text").to_owned();
        (text("request"), text("text"))
    }

    /// Waits until the server has read all messages sent so far. Returns the server's time in
    /// microseconds, and the messages before it.
    pub(crate) fn settle(&mut self) -> (f64, Vec<Value>) {
        self.n_pings += 1;
        let id = self.n_pings;
        self.send(&json!({"type": "ping", "id": id}));
        let mut before = Vec::new();
        loop {
            let message = self.next().expect("a connection");
            if message["type"] == "pong" && message["id"] == json!(id) {
                return (message["time_micros"].as_f64().expect("a time"), before);
            }
            before.push(message);
        }
    }

    /// The server's clock, microseconds.
    pub(crate) fn now_micros(&mut self) -> f64 {
        self.settle().0
    }

    /// The reason with which the server closes the connection.
    pub(crate) fn close_reason(&mut self) -> String {
        loop {
            match self.socket.read() {
                Ok(Message::Close(Some(frame))) => return frame.reason.to_string(),
                Ok(_) => {}
                Err(error) => panic!("the connection ended without a reason: {error}"),
            }
        }
    }
}

fn next_json<S: Read + Write>(socket: &mut WebSocket<S>) -> Option<Value> {
    loop {
        match socket.read() {
            Ok(Message::Text(text)) => return Some(serde_json::from_str(&text).expect("JSON")),
            Ok(_) => {}
            Err(tungstenite::Error::Io(error))
                if error.kind() == std::io::ErrorKind::WouldBlock =>
            {
                panic!("nothing arrived in time")
            }
            Err(_) => return None,
        }
    }
}
