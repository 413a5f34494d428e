//! `/steer` between a page and the loop that steers an arm.

use crate::client::{Client, TIMEOUT, n_unread};
use crate::shared::Shared;
use crate::steering_client::{
    Desk, N_JOINTS, SteeringClient, command, is_end_of, requests_until, serve, state,
};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::mpsc;
use std::time::{Duration, Instant};
use trainer::Picture;
use viz::{
    AppliedCommand, AppliedLimit, LimitEffect, LimitLink, Preview, PreviewGoal, PreviewVerdict,
    RefusedRequest, SteeredPart, SteeringIntent, SteeringRequest, SteeringState, publish_steering,
};

/// Duration of a lease that a test waits for. The tests take the requests much faster.
const LEASE_SECS: f64 = 2.0;

/// Status line and body of a GET request.
fn get(address: SocketAddr, path: &str) -> (String, String) {
    let mut stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    )
    .expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
    let status = head.lines().next().unwrap_or_default();
    (status.to_owned(), body.to_owned())
}

/// Whether the server accepts a WebSocket, and otherwise the status of its answer.
fn try_connect(address: SocketAddr) -> Result<(), u16> {
    let stream = TcpStream::connect(address).expect("the server listens");
    let url = format!("ws://{address}/steer");
    SteeringClient::over(stream, &url, &[])
        .map(|_| ())
        .map_err(|(status, _)| status)
}

fn requests(desk: &Desk) -> Vec<SteeringRequest> {
    let taken = desk.arm.take_requests().into_iter();
    taken.map(|received| received.request).collect()
}

/// Sequence numbers and grips of the commands among requests.
fn commands(requests: &[SteeringRequest]) -> Vec<(u64, Option<u64>)> {
    let commands = requests.iter().filter_map(|request| match request {
        SteeringRequest::Command(command) => Some((command.sequence, command.grip)),
        _ => None,
    });
    commands.collect()
}

#[test]
fn without_an_arm_there_is_nothing_to_steer() {
    let (hub, server) = serve();
    let address = server.address();
    let is_not_found = || {
        let (status, body) = get(address, "/steer");
        assert!(status.starts_with("HTTP/1.1 404"), "{status}");
        assert!(
            body.contains("[arm.motion]") && body.lines().count() == 1,
            "{body}"
        );
        assert_eq!(try_connect(address), Err(404));
    };
    is_not_found();
    // A run may open its arm after the page.
    let desk = Desk::start();
    publish_steering(&hub, Some(Arc::clone(&desk.arm)));
    let mut client = SteeringClient::connect(address);
    publish_steering(&hub, None);
    assert_eq!(client.close_reason(), "the arm is no longer steered");
    is_not_found();
    // Another run without motion, while this one steers.
    let (_hub, without_motion) = serve();
    assert_eq!(try_connect(desk.address()), Ok(()));
    assert_eq!(try_connect(without_motion.address()), Err(404));
}

#[test]
fn the_status_tells_pages_whether_they_can_steer() {
    let (hub, server) = serve();
    hub.set_state("training");
    let mut page = Client::connect(server.address());
    assert_eq!(page.text_of("status")["steering"], Value::Null);
    let desk = Desk::start();
    publish_steering(&hub, Some(Arc::clone(&desk.arm)));
    // A status from before may arrive first.
    while page.text_of("status")["steering"] != json!(true) {}
    publish_steering(&hub, None);
    while page.text_of("status")["steering"] != Value::Null {}
}

#[test]
fn a_client_learns_the_arm_and_its_own_number_first() {
    let desk = Desk::start();
    let mut page = Client::connect(desk.address());
    let number_of_page = page.text()["client"].as_u64().expect("a number");
    let first = desk.client();
    let expected = json!({
        "base": null,
        "type": "arm", "client": first.number(), "may_steer": true,
        "base_link": "base", "tip_link": "tool",
        "joints": [
            {"name": "shoulder", "lower": -1.5, "upper": null, "is_prismatic": false, "velocity": 0.5},
            {"name": "elbow", "lower": -1.5, "upper": null, "is_prismatic": false, "velocity": 0.5},
        ],
        "expiry_secs": 0.12, "lease_secs": 3000.0, "servo_round_trip_millis": 80.0,
    });
    assert_eq!(first.arm, expected);
    let mut numbers = vec![number_of_page, first.number()];
    drop(first);
    for _ in 0..3 {
        numbers.push(desk.client().number());
        let mut page = Client::connect(desk.address());
        numbers.push(page.text()["client"].as_u64().expect("a number"));
    }
    assert!(
        numbers.is_sorted_by(|a, b| a < b),
        "a number was used twice: {numbers:?}"
    );
}

#[test]
fn requests_arrive_in_order_with_their_senders() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    client.send(&json!({"type": "lease", "action": "take"}));
    client.send(&command(1, None, now_micros));
    client.send(&command(2, Some(1), now_micros));
    client.send(&json!({"type": "preview", "id": 9, "position": [0.5, 0.25]}));
    client.send(&json!({"type": "lease", "action": "offer", "to": 77}));
    client.send(&json!({"type": "stop"}));
    client.send(&json!({"type": "rearm", "stop": 1}));
    client.send(&json!({"type": "lease", "action": "release"}));
    client.settle();
    let received = desk.arm.take_requests();
    assert!(
        received
            .iter()
            .all(|received| received.client == client.number())
    );
    assert!(received.is_sorted_by_key(|received| received.received_at));
    let requests: Vec<_> = received
        .into_iter()
        .map(|received| received.request)
        .collect();
    let [
        SteeringRequest::TakeLease,
        SteeringRequest::Command(open),
        SteeringRequest::Command(closed),
        SteeringRequest::Preview(preview),
        SteeringRequest::OfferLease { to: 77 },
        SteeringRequest::Stop,
        SteeringRequest::Rearm { stop: 1 },
        SteeringRequest::ReleaseLease,
    ] = &requests[..]
    else {
        panic!("other requests, or another order: {requests:?}");
    };
    assert_eq!((open.sequence, open.grip), (1, None));
    assert_eq!((closed.device, closed.grip), (1, Some(1)));
    let velocity = vec![0.1, 0.0];
    assert_eq!(
        closed.intent,
        Some(SteeringIntent::JointVelocity { velocity })
    );
    let position = vec![0.5, 0.25];
    let goal = PreviewGoal::Joints { position };
    assert_eq!((preview.id, &preview.goal), (9, &goal));
    assert!(desk.arm.take_requests().is_empty());
}

#[test]
fn the_newest_command_wins_and_no_grip_is_lost() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    let grips = [None, Some(1), None, Some(2)];
    // Nobody takes the requests meanwhile.
    for (sequence, grip) in (0..).zip(grips.into_iter().flat_map(|grip| [grip; 100])) {
        client.send(&command(sequence, grip, now_micros));
    }
    client.settle();
    let expected = [(99, None), (199, Some(1)), (299, None), (399, Some(2))];
    assert_eq!(commands(&requests(&desk)), expected);
}

#[test]
fn answers_reach_only_the_client_that_asked() {
    let desk = Desk::start();
    let (mut asking, mut other) = (desk.client(), desk.client());
    let number = asking.number();
    let preview = Preview {
        verdict: PreviewVerdict::NeverSeen,
        text: "the space around the elbow has never been seen".to_owned(),
        position: None,
        place: Some([0.1, 0.2, 0.3]),
    };
    desk.arm.answer_preview(number, 5, preview);
    let text = "operator 3 has control".to_owned();
    desk.arm.refuse(number, RefusedRequest::Lease, text);
    let expected = json!({
        "type": "preview", "id": 5, "verdict": "never seen", "position": null,
        "text": "the space around the elbow has never been seen", "place": [0.1, 0.2, 0.3],
    });
    assert_eq!(asking.next_of("preview"), expected);
    let refused = ("lease".to_owned(), "operator 3 has control".to_owned());
    assert_eq!(asking.refusal(), refused);
    let (_, messages) = other.settle();
    assert!(messages.is_empty(), "{messages:?}");
    // A client that has left gets nothing, and that is no error.
    desk.arm
        .refuse(999_999, RefusedRequest::Lease, String::new());
}

#[test]
fn states_have_all_fields_on_the_servers_clock() {
    let desk = Desk::start();
    let mut client = desk.client();
    let now_micros = client.now_micros();
    client.send(&command(4, Some(1), now_micros));
    client.settle();
    let received = requests(&desk);
    let [SteeringRequest::Command(received)] = &received[..] else {
        panic!("one command, not {received:?}");
    };
    desk.arm.publish(SteeringState {
        at: received.captured_at + Duration::from_millis(30),
        holder: Some(client.number()),
        lease_left_secs: Some(4.5),
        offered_to: Some(8),
        is_moving: true,
        moved_part: Some(SteeredPart::Arm),
        target: Some(vec![0.5, 0.25]),
        base_from_target: Some([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        limits: vec![AppliedLimit {
            part: SteeredPart::Arm,
            link: LimitLink::SelfCollision,
            effect: LimitEffect::Slowed,
            speed_scale: 0.25,
            text: "the elbow is 20 mm from the base".to_owned(),
            place: Some([0.0, 0.5, 1.0]),
        }],
        applied: Some(AppliedCommand {
            device: received.device,
            sequence: received.sequence,
            captured_at: received.captured_at,
            applied_at: received.captured_at + Duration::from_millis(20),
        }),
        contacts: Some(3),
        base: None,
        ..state()
    });
    let mut message = client.next_of("state");
    let mut millis_after_capture = |pointer: &str| {
        let micros = message.pointer_mut(pointer).expect("a field").take();
        ((micros.as_f64().expect("a time") - now_micros) * 1e-3).round()
    };
    // The page gets its own stamp back, to measure the time from the hand to the joint.
    assert_eq!(
        [
            "/time_micros",
            "/applied/captured_micros",
            "/applied/applied_micros"
        ]
        .map(&mut millis_after_capture),
        [30.0, 0.0, 20.0]
    );
    let expected = json!({
        "type": "state", "time_micros": null, "holder": client.number(), "lease_left_secs": 4.5,
        "offered_to": 8, "stop": null, "stop_number": null, "is_recovering": false, "is_moving": true, "moved_part": "arm", "position": vec![0.0; N_JOINTS],
        "target": [0.5, 0.25], "base_from_tip": [0.4, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
        "base_from_target": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "limits": [{
            "part": "arm", "link": "self-collision", "effect": "slowed", "speed_scale": 0.25,
            "text": "the elbow is 20 mm from the base", "place": [0.0, 0.5, 1.0],
        }],
        "applied": {"device": 1, "sequence": 4, "captured_micros": null, "applied_micros": null},
        "contacts": 3, "clients": [{"id": client.number(), "role": "operator"}], "base": null,
    });
    assert_eq!(message, expected);
}

#[test]
fn states_are_thinned_but_the_newest_and_each_stop_arrive() {
    const N_STATES: u32 = 2000;
    let desk = Desk::start();
    let mut client = desk.client();
    let position_at = |ix: u32| vec![f64::from(ix), 0.0];
    for ix in 0..=N_STATES {
        desk.arm.publish(SteeringState {
            position: position_at(ix),
            ..state()
        });
    }
    let mut n_received = 1;
    while client.next_of("state")["position"] != json!(position_at(N_STATES)) {
        n_received += 1;
    }
    assert!(n_received < N_STATES, "{n_received} states were sent");
    // The number alone shows a stop by somebody who gives the same reason.
    for (number, stop) in [(1, "first"), (2, "second"), (3, "second")] {
        desk.arm.publish(SteeringState {
            stop: Some(stop.to_owned()),
            stop_number: Some(number),
            ..state()
        });
        loop {
            let state = client.next_of("state");
            if state["stop"] == json!(stop) && state["stop_number"] == json!(number) {
                break;
            }
        }
    }
    desk.arm.publish(SteeringState {
        stop: Some("second".to_owned()),
        stop_number: Some(3),
        is_recovering: true,
        ..state()
    });
    while client.next_of("state")["is_recovering"] != json!(true) {}
    // A client that connects later gets the newest state.
    assert_eq!(desk.client().next_of("state")["stop"], json!("second"));
}

#[test]
fn all_clients_learn_who_else_is_connected() {
    let desk = Desk::start();
    desk.arm.publish(state());
    let mut first = desk.client();
    let second = desk.client();
    let ids = |client: &mut SteeringClient<TcpStream>| -> Vec<u64> {
        let state = client.next_of("state");
        let clients = state["clients"].as_array().expect("a list").iter();
        clients
            .map(|client| client["id"].as_u64().expect("a number"))
            .collect()
    };
    while ids(&mut first) != [first.number(), second.number()] {}
    let number = first.number();
    drop(second);
    while ids(&mut first) != [number] {}
    assert_eq!(desk.arm.clients().len(), 1);
}

#[test]
fn a_client_that_leaves_releases_what_it_held() {
    let desk = Desk::start();
    let take = json!({"type": "lease", "action": "take"});
    let mut closing = desk.client();
    closing.send(&take);
    closing.settle();
    assert_eq!(requests(&desk), [SteeringRequest::TakeLease]);
    closing.socket.close(None).expect("a close frame is sent");
    desk.requests_until(is_end_of(closing.number()));

    // The connection ends without a close frame, as when a browser crashes.
    let mut crashing = desk.client();
    crashing.send(&take);
    crashing.settle();
    desk.arm.take_requests();
    let number = crashing.number();
    drop(crashing);
    desk.requests_until(is_end_of(number));
}

#[test]
fn a_half_open_connection_releases_after_the_time_of_a_lease() {
    let desk = Desk::with_leases_of(LEASE_SECS);
    let mut half_open = desk.client();
    half_open.send(&json!({"type": "lease", "action": "take"}));
    half_open.settle();
    desk.requests_until(|received| received.request == SteeringRequest::TakeLease);
    // The socket stays open, but nobody sends, and nobody answers pings.
    desk.requests_until(is_end_of(half_open.number()));
    // The client comes back. It may take the lease again, and is heard once per silence.
    half_open.send(&json!({"type": "lease", "action": "take"}));
    let received = desk.requests_until(|received| received.request == SteeringRequest::TakeLease);
    assert_eq!(received.len(), 1, "{received:?}");
    desk.requests_until(is_end_of(half_open.number()));
}

#[test]
fn a_client_that_answers_pings_but_is_silent_releases_its_lease() {
    let desk = Desk::with_leases_of(LEASE_SECS);
    let mut hanging = desk.client();
    hanging.send(&json!({"type": "lease", "action": "take"}));
    let number = hanging.number();
    // Reading answers the pings of the server, as browsers do for a page that hangs.
    std::thread::scope(|scope| {
        scope.spawn(move || while hanging.next().is_some() {});
        let received = desk.requests_until(is_end_of(number));
        assert_eq!(received[0].request, SteeringRequest::TakeLease);
        // Ends the connection, and with it the thread.
        publish_steering(&desk.hub, None);
    });
}

#[test]
fn a_server_that_stops_says_so_and_releases_leases() {
    let desk = Desk::start();
    let mut client = desk.client();
    client.send(&json!({"type": "lease", "action": "take"}));
    client.settle();
    desk.arm.take_requests();
    let Desk { arm, server, .. } = desk;
    let stopping = std::thread::spawn(move || drop(server));
    assert_eq!(client.close_reason(), "the server stops");
    let number = client.number();
    drop(client);
    stopping.join().expect("the server stops");
    requests_until(&arm, is_end_of(number));
}

#[test]
fn viewers_watch_and_stop_over_tls() {
    let shared = Shared::start();
    let desk = Desk::start();
    publish_steering(&shared.hub, Some(Arc::clone(&desk.arm)));
    let connect = |token: &str| {
        let headers = [("authorization", format!("Bearer {token}"))];
        let url = format!("wss://{}/steer", shared.address());
        SteeringClient::over(shared.tls(), &url, &headers).expect("a WebSocket")
    };
    let mut viewer = connect(&shared.viewer);
    assert_eq!(viewer.arm["may_steer"], json!(false));
    let now_micros = viewer.now_micros();
    let (take, rearm) = (
        json!({"type": "lease", "action": "take"}),
        json!({"type": "rearm", "stop": 1}),
    );
    let preview = json!({"type": "preview", "id": 1, "position": [0, 0]});
    let closing = command(1, Some(1), now_micros);
    for (message, kind) in [
        (&take, "lease"),
        (&rearm, "rearm"),
        (&preview, "preview"),
        (&closing, "command"),
    ] {
        viewer.send(message);
        let (refused, text) = viewer.refusal();
        assert_eq!(refused, kind);
        assert!(text.contains("role operator"), "{text}");
    }
    assert!(desk.arm.take_requests().is_empty());
    viewer.send(&json!({"type": "stop"}));
    viewer.settle();
    assert_eq!(requests(&desk), [SteeringRequest::Stop]);
    desk.arm.publish(state());
    viewer.next_of("state");

    let mut operator = connect(&shared.operator);
    assert_eq!(operator.arm["may_steer"], json!(true));
    for message in [&take, &rearm, &closing] {
        operator.send(message);
    }
    operator.settle();
    assert_eq!(requests(&desk).len(), 3);
}

/// The thread of the server sends pictures and encodes lists. Here, it does not continue at all
/// while a client steers.
#[test]
fn a_server_thread_that_is_held_up_delays_neither_commands_nor_states() {
    let desk = Desk::start();
    desk.hub.set_state("training");
    let mut client = desk.client();
    let (release, released) = mpsc::sync_channel::<()>(1);
    let (holding, held) = mpsc::sync_channel(1);
    std::thread::scope(|scope| {
        let hub = desk.hub.clone();
        scope.spawn(move || {
            hub.change_status(|_| {
                holding.send(()).expect("the test waits");
                // Ends when the test ends, also if it fails.
                let _ = released.recv();
            });
        });
        held.recv().expect("the status is being changed");
        // The server needs the status for its answer.
        let mut waiting = TcpStream::connect(desk.address()).expect("the server listens");
        write!(waiting, "GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("sent");
        std::thread::sleep(Duration::from_millis(300));
        for sequence in 1..=20_u32 {
            let now_micros = client.now_micros();
            client.send(&command(sequence.into(), Some(1), now_micros));
            let received = desk.requests_until(|received| {
                matches!(&received.request, SteeringRequest::Command(command)
                    if command.sequence == u64::from(sequence))
            });
            assert_eq!(received.len(), 1);
            let position = vec![f64::from(sequence), 0.0];
            desk.arm.publish(SteeringState {
                position: position.clone(),
                ..state()
            });
            while client.next_of("state")["position"] != json!(position) {}
        }
        assert_eq!(n_unread(&waiting), 0, "the server thread was not held up");
        drop(release);
    });
}

#[test]
fn a_picture_that_is_not_read_delays_neither_commands_nor_states() {
    const SIZE_PX: [u32; 2] = [2040, 2040];
    let desk = Desk::start();
    let mut page = Client::connect(desk.address());
    page.send_json(&json!({
        "type": "render", "id": 1, "size_px": SIZE_PX, "stages": [1.0], "outputs": ["depth"],
        "depth_format": "f32",
        "world_from_camera": [1, 0, 0, 0.0, 0, 0, 1, -2.0, 0, -1, 0, 0.5, 0, 0, 0, 1],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9},
    }));
    assert!(desk.hub.pictures().wait_for_request(TIMEOUT));
    let pending = desk.hub.pictures().next_request().expect("a request waits");
    let n_px = (SIZE_PX[0] * SIZE_PX[1]) as usize;
    // Almost 16 MiB, more than the sockets hold. The page does not read it.
    pending.deliver(Picture {
        size_px: SIZE_PX,
        rgba_srgb: vec![0; 4 * n_px],
        depth_m: vec![1.0; n_px],
    });
    let deadline = Instant::now() + TIMEOUT;
    while page.n_arrived() < 100_000 {
        assert!(Instant::now() < deadline, "the picture is not sent");
        std::thread::sleep(Duration::from_millis(5));
    }
    let mut client = desk.client();
    let now_micros = client.now_micros();
    client.send(&command(1, Some(1), now_micros));
    desk.requests_until(|received| matches!(received.request, SteeringRequest::Command(_)));
    desk.arm.publish(state());
    client.next_of("state");
    assert_eq!(page.binary_of("picture").0["id"], json!(1));
}
