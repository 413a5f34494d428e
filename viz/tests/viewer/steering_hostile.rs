//! Clients of `/steer` that must not move the arm: foreign pages, stolen leases, repeated messages,
//! floods, and messages that are wrong in every way.

use crate::client::TIMEOUT;
use crate::shared::Shared;
use crate::steering_client::{Desk, SteeringClient, command, is_end_of};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tungstenite::Message;
use viz::{ReceivedRequest, RefusedRequest, SteeringRequest, SteeringServer, publish_steering};

/// Attempts to open a WebSocket. The error is the status of the response.
fn attempt(address: SocketAddr, headers: &[(&'static str, String)]) -> Result<(), u16> {
    let stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let url = format!("ws://{address}/steer");
    SteeringClient::over(stream, &url, headers)
        .map(|_| ())
        .map_err(|(status, _)| status)
}

fn upgrade_request(address: SocketAddr, headers: &str) -> String {
    format!(
        "GET /steer HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{headers}\r\n"
    )
}

#[test]
fn foreign_pages_cannot_connect() {
    let desk = Desk::start();
    let address = desk.address();
    let origin = |origin: String| [("origin", origin)];
    for foreign in [
        "http://example.com".to_owned(),
        "null".to_owned(),
        format!("https://{address}"),
        format!("http://127.0.0.1:{}", address.port() ^ 1),
        format!("http://{address}.example.com"),
    ] {
        assert_eq!(attempt(address, &origin(foreign)), Err(403));
    }
    let rebound = [("host", format!("example.com:{}", address.port()))];
    assert_eq!(attempt(address, &rebound), Err(403));
    assert!(desk.arm.clients().is_empty() && desk.arm.take_requests().is_empty());
    assert_eq!(
        attempt(address, &origin(format!("http://{address}"))),
        Ok(())
    );
}

#[test]
fn beyond_this_computer_a_client_needs_a_token_tls_and_the_right_origin() {
    let shared = Shared::start();
    let desk = Desk::start();
    publish_steering(&shared.hub, Some(Arc::clone(&desk.arm)));
    let address = shared.address();
    let connect = |headers: &[(&'static str, String)]| {
        let url = format!("wss://{address}/steer");
        let client = SteeringClient::over(shared.tls(), &url, headers);
        client.map(|_| ()).map_err(|(status, _)| status)
    };
    let bearer = |token: &str| ("authorization", format!("Bearer {token}"));
    let origin = |text: &str| ("origin", text.to_owned());
    assert_eq!(connect(&[]), Err(401));
    assert_eq!(connect(&[bearer("0123")]), Err(401));
    for foreign in ["https://example.com", "null", "http://127.0.0.1"] {
        let headers = [bearer(&shared.operator), origin(foreign)];
        assert_eq!(connect(&headers), Err(403));
    }
    // Without TLS, not even the token of an operator helps.
    let mut plain = TcpStream::connect(address).expect("the server listens");
    plain.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let token = format!("Authorization: Bearer {}\r\n", shared.operator);
    plain
        .write_all(upgrade_request(address, &token).as_bytes())
        .expect("sent");
    let mut answer = String::new();
    let _ = plain.read_to_string(&mut answer); // The request is not read, so a reset may follow.
    assert!(answer.starts_with("HTTP/1.1 400"), "{answer}");
    assert!(desk.arm.clients().is_empty() && desk.arm.take_requests().is_empty());
    let own = origin(&format!("https://{address}"));
    assert_eq!(connect(&[bearer(&shared.operator), own]), Ok(()));
}

/// A loop that moves a joint with the commands of the holder of the lease, and refuses others.
struct MiniLoop<'a> {
    arm: &'a SteeringServer,
    holder: Option<u64>,
    is_stopped: bool,
    /// Clients whose commands moved the arm.
    moved_by: Vec<u64>,
}

impl<'a> MiniLoop<'a> {
    fn new(arm: &'a SteeringServer) -> Self {
        Self {
            arm,
            holder: None,
            is_stopped: false,
            moved_by: Vec::new(),
        }
    }

    fn run(&mut self) {
        self.handle(self.arm.take_requests());
    }

    fn handle(&mut self, requests: Vec<ReceivedRequest>) {
        for ReceivedRequest {
            client, request, ..
        } in requests
        {
            let is_holder = self.holder == Some(client);
            match request {
                SteeringRequest::TakeLease if self.holder.is_none() => self.holder = Some(client),
                SteeringRequest::ReleaseLease | SteeringRequest::Disconnected if is_holder => {
                    self.holder = None;
                }
                SteeringRequest::Stop => self.is_stopped = true,
                SteeringRequest::Rearm { .. } if is_holder => self.is_stopped = false,
                SteeringRequest::Command(command) if is_holder && !self.is_stopped => {
                    self.moved_by.extend(command.grip.map(|_| client));
                }
                SteeringRequest::Disconnected => {}
                _ => {
                    let text = "another operator has control".to_owned();
                    self.arm.refuse(client, RefusedRequest::Command, text);
                }
            }
        }
    }
}

#[test]
fn a_client_cannot_act_for_the_holder_of_the_lease() {
    let desk = Desk::start();
    let mut arm_loop = MiniLoop::new(&desk.arm);
    let (mut holder, mut thief) = (desk.client(), desk.client());
    let now_micros = holder.now_micros();
    holder.send(&json!({"type": "lease", "action": "take"}));
    holder.send(&command(1, Some(1), now_micros));
    holder.settle();
    arm_loop.run();
    assert_eq!(arm_loop.moved_by, [holder.number()]);
    // The server identifies the sender by its connection, not by the content of a message.
    let mut forged = command(2, Some(1), now_micros);
    for field in ["client", "operator", "holder", "from"] {
        forged[field] = json!(holder.number());
    }
    for mut message in [
        forged,
        command(3, Some(2), now_micros),
        json!({"type": "lease", "action": "take"}),
        json!({"type": "lease", "action": "release"}),
        json!({"type": "rearm", "stop": 1}),
        json!({"type": "lease", "action": "offer"}),
    ] {
        if message["action"] == "offer" {
            message["to"] = json!(thief.number());
        }
        thief.send(&message);
        thief.settle();
        let received = desk.arm.take_requests();
        assert!(
            received
                .iter()
                .all(|received| received.client == thief.number()),
            "{received:?}"
        );
        arm_loop.handle(received);
    }
    assert_eq!(thief.refusal().1, "another operator has control");
    assert_eq!(arm_loop.moved_by, [holder.number()]);
    assert_eq!(arm_loop.holder, Some(holder.number()));
    // The thief leaves. The holder keeps the lease.
    let number = thief.number();
    drop(thief);
    while desk.arm.clients().iter().any(|client| client.id == number) {
        std::thread::yield_now();
    }
    arm_loop.run();
    assert_eq!(arm_loop.holder, Some(holder.number()));
}

#[test]
fn repeated_messages_do_not_move_the_arm_again() {
    let desk = Desk::start();
    let mut arm_loop = MiniLoop::new(&desk.arm);
    let mut holder = desk.client();
    let now_micros = holder.now_micros();
    let recorded: Vec<Value> = (1..=5)
        .map(|sequence| command(sequence, Some(1), now_micros))
        .collect();
    holder.send(&json!({"type": "lease", "action": "take"}));
    for message in &recorded {
        holder.send(message);
        holder.settle();
        arm_loop.run();
    }
    assert_eq!(arm_loop.moved_by.len(), 5);
    for message in &recorded {
        holder.send(message);
        let (request, text) = holder.refusal();
        assert_eq!(request, "command");
        assert!(text.contains("came after command 5"), "{text}");
        arm_loop.run();
    }
    // Another connection that repeats them does not become the holder.
    let mut other = desk.client();
    for message in &recorded {
        other.send(message);
    }
    other.settle();
    arm_loop.run();
    assert_eq!(arm_loop.moved_by.len(), 5);
    assert_eq!(other.refusal().1, "another operator has control");
}

#[test]
fn commands_of_another_clock_are_refused() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    // A page that sends the time of the epoch, or its own time, instead of the server's.
    for captured_micros in [1.8e15, now_micros + 60e6, now_micros - 60e6, -1e300] {
        client.send(&command(1, Some(1), captured_micros));
        let (request, text) = client.refusal();
        assert_eq!(request, "command");
        assert!(text.contains("the server's clock"), "{text}");
    }
    assert!(desk.arm.take_requests().is_empty());
    client.send(&command(1, Some(1), now_micros));
    client.settle();
    assert_eq!(desk.arm.take_requests().len(), 1);
}

#[test]
fn wrong_messages_are_refused_and_the_connection_stays() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    let mut wrong: Vec<String> = [
        "",
        "stop",
        "{}",
        "[]",
        "null",
        "\u{0}\u{1}",
        r#"{"type":"launch"}"#,
        r#"{"type":{"type":"stop"}}"#,
        r#"{"type":"lease","action":"steal"}"#,
        r#"{"type":"preview","id":1e999,"position":[0,0]}"#,
        r#"{"type":"preview","id":1,"position":[0,NaN]}"#,
        r#"{"type":"preview","id":1,"position":[0,Infinity]}"#,
    ]
    .map(str::to_owned)
    .to_vec();
    wrong.push("[".repeat(4000));
    let valid = command(1, Some(1), now_micros).to_string();
    for (part, replacement) in [
        ("0.1", "1e999"),
        ("0.1", "-1e999"),
        ("0.1", "1e300"),
        ("0.1,", ""),
        ("0.1", "0.1,0.1"),
        ("0.1", "\"0.1\""),
        (":1,", ":18446744073709551615,"),
        (":1,", ":18446744073709551616,"),
        (":1,", ":-1,"),
    ] {
        assert!(valid.contains(part), "{part} is not in {valid}");
        wrong.push(valid.replace(part, replacement));
    }
    for text in &wrong {
        client.send_text(text);
        let (_, reason) = client.refusal();
        assert!(
            !reason.is_empty() && reason.lines().count() == 1,
            "{reason}"
        );
    }
    client
        .socket
        .send(Message::binary(valid.clone().into_bytes()))
        .expect("sent");
    assert!(client.refusal().1.contains("send JSON as text"));
    assert!(desk.arm.take_requests().is_empty());
    let now_micros = client.now_micros();
    client.send(&command(1, Some(1), now_micros));
    client.settle();
    assert_eq!(desk.arm.take_requests().len(), 1);
}

#[test]
fn a_long_message_ends_the_connection_and_the_lease() {
    let desk = Desk::start();
    let mut client = desk.client();
    client.send(&json!({"type": "lease", "action": "take", "padding": "x".repeat(3900)}));
    client.settle();
    assert_eq!(desk.arm.take_requests().len(), 1);
    client.send(&json!({"type": "lease", "action": "renew", "padding": "x".repeat(4100)}));
    assert_eq!(client.next(), None);
    desk.requests_until(is_end_of(client.number()));
}

/// Sends messages as fast as possible.
fn flood(client: &mut SteeringClient<TcpStream>, messages: &[String]) {
    for text in messages {
        client
            .socket
            .write(Message::text(text.as_str()))
            .expect("sent");
    }
    client.socket.flush().expect("sent");
}

#[test]
fn a_stop_passes_a_flood_of_its_own_sender() {
    const N_MESSAGES: u64 = 10_000;
    let desk = Desk::start();
    let mut client = desk.client();
    let mut other = desk.client();
    let now_micros = client.now_micros();
    // Commands with ever new grips, so that they cannot be merged.
    let mut messages: Vec<String> = (1..=N_MESSAGES)
        .map(|sequence| command(sequence, Some(sequence), now_micros).to_string())
        .collect();
    messages.insert(5000, json!({"type": "stop"}).to_string());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            flood(&mut client, &messages);
            answered(&mut client);
        });
        // Other clients are served meanwhile.
        other.send(&json!({"type": "lease", "action": "take"}));
        other.settle();
    });
    let received = desk.arm.take_requests();
    // Of the flood, no more is kept than a loop can handle between two cycles.
    assert!(received.len() <= 100, "{} requests", received.len());
    let has = |request| received.iter().any(|received| received.request == request);
    assert!(has(SteeringRequest::Stop) && has(SteeringRequest::TakeLease));
}

/// The loop takes requests while a client floods, as it does in a run.
#[test]
fn a_loop_gets_the_stop_while_the_flood_continues() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    let mut arm_loop = MiniLoop::new(&desk.arm);
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            client.send(&json!({"type": "lease", "action": "take"}));
            let commands: Vec<String> = (1..=10_000)
                .map(|sequence| command(sequence, Some(sequence), now_micros).to_string())
                .collect();
            flood(&mut client, &commands);
            client.send(&json!({"type": "stop"}));
            // The flood goes on until the loop has the stop. Nobody reads the refusals.
            while !is_over.load(Ordering::Relaxed) {
                flood(&mut client, &commands[..100]);
            }
        });
        let deadline = Instant::now() + TIMEOUT;
        while !arm_loop.is_stopped && Instant::now() < deadline {
            desk.arm.wait_for_requests(Duration::from_millis(10));
            arm_loop.run();
        }
        is_over.store(true, Ordering::Relaxed);
    });
    assert!(arm_loop.is_stopped, "the stop did not arrive");
}

#[test]
fn a_client_learns_that_it_floods_and_may_then_continue() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    let renew = json!({"type": "lease", "action": "renew"}).to_string();
    let messages = vec![renew; 2000];
    let deadline = Instant::now() + TIMEOUT;
    // A slow computer may need some attempts to send enough messages within a second.
    let is_flood = |message: &Value| {
        let text = message["text"].as_str().unwrap_or_default();
        message["request"] == "message" && text.contains("messages in a second")
    };
    let mut is_reported = false;
    while !is_reported {
        assert!(Instant::now() < deadline, "the flood is not noticed");
        flood(&mut client, &messages);
        // The reply to the ping may be missing in the flood, so several are sent.
        is_reported = answered(&mut client).iter().any(is_flood);
    }
    // The opening of a switch is obeyed in any case.
    desk.arm.take_requests();
    flood(&mut client, &messages);
    client.send(&command(1, None, now_micros));
    desk.requests_until(|received| {
        matches!(&received.request, SteeringRequest::Command(command) if command.grip.is_none())
    });
    answered(&mut client);
    client.send(&json!({"type": "lease", "action": "take"}));
    desk.requests_until(|received| received.request == SteeringRequest::TakeLease);
}

/// Sends pings until one is answered. Returns the messages before the answer.
fn answered(client: &mut SteeringClient<TcpStream>) -> Vec<Value> {
    let stream = client.socket.get_ref();
    let pause = Duration::from_millis(200);
    stream.set_read_timeout(Some(pause)).expect("a timeout");
    let deadline = Instant::now() + TIMEOUT;
    let mut before = Vec::new();
    let mut is_answered = false;
    client.send(&json!({"type": "ping", "id": 1000}));
    while !is_answered {
        assert!(Instant::now() < deadline, "no ping is answered");
        match client.socket.read() {
            Ok(Message::Text(text)) => {
                let message: Value = serde_json::from_str(&text).expect("JSON");
                is_answered = message["type"] == "pong";
                before.push(message);
            }
            Ok(_) => {}
            // Nothing arrived for a while.
            Err(tungstenite::Error::Io(_)) => client.send(&json!({"type": "ping", "id": 1000})),
            Err(error) => panic!("the connection broke: {error}"),
        }
    }
    let stream = client.socket.get_ref();
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    before
}

#[test]
fn clients_that_only_connect_do_not_keep_others_away() {
    let desk = Desk::start();
    let mut holder = desk.client();
    holder.send(&json!({"type": "lease", "action": "take"}));
    holder.settle();
    desk.arm.take_requests();
    // Half of a handshake, whole ones that then do nothing, and connections that end at once.
    let mut open = Vec::new();
    for ix in 0..40 {
        let mut stream = TcpStream::connect(desk.address()).expect("the server listens");
        let request = upgrade_request(desk.address(), "");
        let n_bytes = if ix % 2 == 0 { request.len() } else { 60 };
        let _ = stream.write_all(&request.as_bytes()[..n_bytes]);
        if ix % 3 == 0 {
            let _ = stream.shutdown(Shutdown::Write);
        }
        open.push(stream);
        // The holder stays active.
        holder.send(&json!({"type": "lease", "action": "renew"}));
        holder.settle();
    }
    let renewed = desk.arm.take_requests();
    assert!(
        renewed
            .iter()
            .all(|received| received.client == holder.number()),
        "{renewed:?}"
    );
    let mut other = desk.client();
    other.settle();
    holder.settle();
    drop(open);
}
