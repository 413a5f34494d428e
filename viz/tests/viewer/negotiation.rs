//! Tests versions, capabilities, views, subscriptions and priorities over a real connection.

use crate::client;
use crate::client::TIMEOUT;
use crate::client::{Client, Received};
use crate::local_server::start;
use crate::robot;
use crate::slow::Slow;
use kinematics::{Stamp, Transform};
use serde_json::{Value, json};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};
use viz::{Hub, KeyframePose, LiveImage, LivePixels, PendingRender, Status};

fn next(hub: &Hub) -> PendingRender {
    assert!(
        hub.pictures().wait_for_request(TIMEOUT),
        "no request arrived"
    );
    hub.pictures().next_request().expect("a request is pending")
}

fn render_message(id: u64, view: &str) -> Value {
    json!({
        "type": "render", "id": id, "view": view, "size_px": [160, 120], "stages": [1.0],
        "world_from_camera": [1, 0, 0, 0.0, 0, 0, 1, -2.0, 0, -1, 0, 0.5, 0, 0, 0, 1],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9},
    })
}

fn draw_next(hub: &Hub) {
    let pending = next(hub);
    let picture = analytic_scene::draw(&pending.request);
    pending.deliver(picture);
}

fn keyframe(stamp: i64) -> KeyframePose {
    KeyframePose {
        camera: "wrist".into(),
        stamp: Stamp(stamp),
        world_from_camera: Transform::translation(
            f64::from(i32::try_from(stamp).expect("small")),
            0.0,
            0.0,
        ),
        size_px: [640, 480],
        focal_px: [600.0; 2],
        principal_px: [320.0, 240.0],
    }
}

/// An image of 640 x 480 pixels with texture and sensor noise, as cameras deliver them.
fn camera_image(stamp: i64) -> LiveImage {
    let size_px = [640, 480];
    let request = trainer::RenderRequest {
        world_from_camera: analytic_scene::looking_along_y(),
        size_px,
        projection: trainer::Projection::Pinhole {
            focal_px: [500.0; 2],
            principal_px: [320.0, 240.0],
        },
        shutter: None,
        near_m: 0.01,
        far_m: 50.0,
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.3; 3],
        appearance_of: None,
        depth: false,
    };
    let mut random = numbers::random::Random::new(u64::try_from(stamp).expect("positive"));
    let mut rgba = analytic_scene::draw(&request).rgba_srgb;
    for value in &mut rgba {
        *value = value.saturating_add(u8::try_from(random.below(9)).expect("small"));
    }
    LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(stamp),
        captured_at: Instant::now(),
        size_px,
        pixels: LivePixels::Rgba(rgba.into()),
        world_from_camera: Some(Transform::identity()),
        focal_px: [500.0; 2],
        principal_px: [320.0, 240.0],
    }
}

#[test]
fn versions_and_capabilities_are_negotiated() {
    let (_hub, server) = start();
    let mut client = Client::connect(server.address());
    let hello = client.text();
    assert_eq!(
        hello["protocol"],
        json!(viz::BASE_PROTOCOL_VERSION),
        "older clients expect their version here"
    );
    assert_eq!(
        hello["protocols"],
        json!([viz::BASE_PROTOCOL_VERSION, viz::PROTOCOL_VERSION])
    );
    assert!(
        hello["capabilities"]
            .as_array()
            .is_some_and(|names| names.contains(&json!("parts"))),
        "{hello}"
    );
    client.send_json(&json!({"type": "hello", "protocols": [2, 99], "capabilities": ["parts", "teleport"], "new": 1}));
    let welcome = client.text_of("welcome");
    assert_eq!(
        (&welcome["protocol"], &welcome["capabilities"]),
        (&json!(viz::PROTOCOL_VERSION), &json!(["parts"]))
    );
    // A client of version 3.
    let mut older = Client::connect(server.address());
    older.send_json(&json!({"type": "hello", "protocol": 3}));
    assert_eq!(older.text_of("welcome")["protocol"], json!(3));
    older.settle();
    for (hello, named) in [
        (json!({"protocol": 999}), "999"),
        (json!({"protocols": [1, 2]}), "update the client"),
    ] {
        let mut foreign = Client::connect(server.address());
        let mut message = hello;
        message["type"] = json!("hello");
        foreign.send_json(&message);
        let reason = foreign.text_of("goodbye")["reason"].clone();
        assert!(
            reason.as_str().is_some_and(|reason| reason.contains(named)),
            "{reason}"
        );
        assert_eq!(foreign.receive(), Received::End);
    }
}

#[test]
fn views_are_independent_and_take_turns() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    client.send_json(&render_message(1, "main"));
    client.send_json(&render_message(2, "inset"));
    client.send_json(&render_message(3, "main"));
    client.settle();
    draw_next(&hub);
    draw_next(&hub);
    let mut answered: Vec<_> = (0..2)
        .map(|_| client.binary_of("picture").0)
        .map(|header| {
            (
                header["view"].as_str().unwrap_or_default().to_owned(),
                header["id"].as_u64(),
            )
        })
        .collect();
    answered.sort();
    assert_eq!(
        answered,
        [("inset".to_owned(), Some(2)), ("main".to_owned(), Some(3))],
        "the newest of each view"
    );
    assert!(hub.pictures().next_request().is_none());
    // Errors name the view, too.
    client.send_json(&render_message(4, "inset"));
    next(&hub).fail("the GPU is lost");
    let error = client.text_of("error");
    assert_eq!((&error["id"], &error["view"]), (&json!(4), &json!("inset")));
    for ix in 0..9_u64 {
        client.send_json(&render_message(10 + ix, &format!("view {ix}")));
    }
    let error = client.text_of("error");
    assert_eq!(error["id"], json!(18), "eight views are pending: {error}");
    while hub.pictures().wait_for_request(Duration::ZERO) {
        draw_next(&hub);
        client.binary_of("picture");
    }
    client.send_json(&render_message(30, "another"));
    draw_next(&hub);
    assert_eq!(
        client.binary_of("picture").0["view"],
        json!("another"),
        "idle views make room"
    );
}

#[test]
fn keyframes_are_sent_as_changes() {
    let (hub, server) = start();
    hub.keyframes().set((0..300).map(keyframe).collect());
    let mut client = Client::connect(server.address());
    client.text();
    client.send_json(
        &json!({"type": "hello", "protocols": [3, 4], "capabilities": ["keyframe_changes"]}),
    );
    client.text_of("welcome");
    let mut stamps = std::collections::BTreeSet::new();
    while stamps.len() < 300 {
        let changes = client.text_of("keyframe_changes");
        assert_eq!(changes["from_version"] == json!(0), stamps.is_empty());
        let added = changes["keyframes"].as_array().expect("a list");
        stamps.extend(
            added
                .iter()
                .map(|keyframe| keyframe["stamp_nanos"].as_i64()),
        );
    }
    hub.keyframes().set((1..302).map(keyframe).collect());
    let changes = client.text_of("keyframe_changes");
    let added: Vec<_> = changes["keyframes"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|k| &k["stamp_nanos"])
        .collect();
    assert_eq!(added, [&json!(300), &json!(301)]);
    assert_eq!(changes["removed"].as_array().map(Vec::len), Some(1));
    // Subscribing again requests the complete list.
    client.send_json(&json!({"type": "subscribe", "topic": "keyframes", "rate_hz": 5}));
    assert_eq!(client.text_of("keyframe_changes")["from_version"], json!(0));
}

#[test]
fn live_images_have_the_subscribed_size() {
    let (hub, server) = start();
    let mut thumbnails = Client::connect(server.address());
    let mut large = Client::connect(server.address());
    thumbnails.send_json(
        &json!({"type": "subscribe", "topic": "live_images", "rate_hz": 9, "size_px": [160, 128]}),
    );
    thumbnails.settle();
    large.settle();
    for (client, expected) in [
        (&mut thumbnails, json!([160, 120])),
        (&mut large, json!([640, 480])),
    ] {
        let header = loop {
            hub.set_live_image(camera_image(1));
            let (header, jpeg) = client.binary_of("live_image");
            let decoded = image::load_from_memory_with_format(&jpeg, image::ImageFormat::Jpeg)
                .expect("a JPEG");
            assert_eq!(
                header["size_px"],
                json!([decoded.width(), decoded.height()])
            );
            // An image that was encoded before the subscription may come first.
            if header["size_px"] == expected {
                break header;
            }
        };
        let scale = expected[0].as_f64().expect("a width") / 640.0;
        assert_eq!(header["focal_px"], json!([500.0 * scale, 500.0 * scale]));
    }
    let error_of = |message: Value| {
        let mut client = Client::connect(server.address());
        client.send_json(&message);
        client.text_of("error")["message"]
            .as_str()
            .unwrap_or_default()
            .to_owned()
    };
    assert!(
        error_of(json!({"type": "subscribe", "topic": "live_images", "rate_hz": 1e9}))
            .contains("rate_hz")
    );
    assert!(
        error_of(json!({"type": "subscribe", "topic": "rumors", "rate_hz": 1})).contains("rumors")
    );
}

/// The page's subscriptions, a camera at 30 Hz, a moving robot and a keyframe every 300 ms.
#[test]
fn idle_page_receives_less_than_80_kb_per_second() {
    const SECS: u64 = 4;
    let (hub, server) = start();
    hub.set_robot(robot::description());
    hub.keyframes().set((0..400).map(keyframe).collect());
    let mut client = Client::connect(server.address());
    client.text();
    let capabilities = [
        "views",
        "subscribe",
        "compact_depth",
        "keyframe_changes",
        "parts",
        "heartbeat",
        "robot",
    ];
    client.send_json(&json!({"type": "hello", "protocols": [3, 4], "capabilities": capabilities}));
    // The rates and the size of web/src/topics/.
    for (topic, rate_hz) in [("status", 2), ("keyframes", 2), ("robot_state", 60)] {
        client.send_json(&json!({"type": "subscribe", "topic": topic, "rate_hz": rate_hz}));
    }
    client.send_json(
        &json!({"type": "subscribe", "topic": "live_images", "rate_hz": 4, "size_px": [640, 192]}),
    );
    let images: Vec<_> = (1..9).map(camera_image).collect();
    let publish = |began: Instant, until: Duration| {
        for ix in 0.. {
            let elapsed = began.elapsed();
            if elapsed > until {
                break;
            }
            hub.set_robot_state(robot::state(elapsed.as_secs_f64()));
            if ix % 6 == 0 {
                let image = &images[usize::try_from(ix / 6 % 8).expect("small")];
                hub.set_live_image(LiveImage {
                    captured_at: Instant::now(),
                    ..image.clone()
                });
            }
            if ix % 60 == 0 {
                hub.keyframes()
                    .set((0..=400 + ix / 60).map(keyframe).collect());
                let psnr_history = (0..512)
                    .map(|n| (f64::from(n) * 1.37, 20.0 + f64::from(n) * 0.0123))
                    .collect();
                let model = viz::ModelStatus {
                    step: ix.unsigned_abs(),
                    psnr_history,
                    ..viz::ModelStatus::default()
                };
                hub.set_status(Status {
                    model,
                    ..Status::default()
                });
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    // The complete list and the first images are not part of the idle traffic.
    publish(Instant::now(), Duration::from_secs(1));
    let deadline = Instant::now() + Duration::from_secs(SECS);
    let mut counts = std::collections::BTreeMap::<String, u64>::new();
    let n_bytes = std::thread::scope(|scope| {
        scope.spawn(|| publish(Instant::now(), Duration::from_secs(SECS)));
        // What has arrived in the meantime.
        client.send_json(&json!({"type": "ping", "t": 1}));
        client.text_of("pong");
        let n_before = client.n_received();
        while Instant::now() < deadline {
            client.send_json(&json!({"type": "ping", "t": 2}));
            let kind = match client.receive() {
                Received::Text(message) => message["type"].clone(),
                Received::Binary(header, _) => header["type"].clone(),
                Received::End => panic!("disconnected"),
            };
            *counts
                .entry(kind.as_str().unwrap_or_default().to_owned())
                .or_default() += 1;
            std::thread::sleep(Duration::from_millis(1));
        }
        // The pings of this test are more frequent than those of the page.
        let n_pongs = usize::try_from(counts["pong"]).expect("small");
        client.n_received() - n_before - 60 * n_pongs.saturating_sub(8)
    });
    let kb_per_sec = n_bytes as f64 / 1e3 / SECS as f64;
    assert!(kb_per_sec < 80.0, "{kb_per_sec} kB/s: {counts:?}");
    assert!(
        counts["live_image"] >= 2 * SECS && counts["robot_state"] >= 20 * SECS,
        "the data arrives: {counts:?}"
    );
}

/// A client that reads slowly still gets replies quickly, because pictures are sent in parts.
#[test]
fn replies_do_not_wait_for_pictures() {
    /// 20 Mbit/s.
    const BYTES_PER_SEC: f64 = 2.5e6;
    /// 100 ms of data that the kernel has not sent yet, and a part of the next message: measured
    /// 0.1 to 0.16 MB.
    const MAX_BYTES_BEFORE_REPLY: usize = 350_000;
    let (hub, server) = start();
    let stream = Slow::connect(server.address(), BYTES_PER_SEC);
    let counter = stream.counter();
    let (mut send, pongs) = slow_client(stream, server.address());
    send(&json!({"type": "hello", "protocols": [3, 4], "capabilities": ["parts"]}));
    let mut n_before_replies = Vec::new();
    for id in 0..4 {
        let mut message = render_message(id, "main");
        message["size_px"] = json!([1280, 720]);
        message["outputs"] = json!(["color", "depth"]);
        message["depth_format"] = json!("f32");
        send(&message);
        draw_next(&hub); // 3.7 MB, which take 1.5 s.
        for _ in 0..5 {
            std::thread::sleep(Duration::from_millis(150));
            let n_arrived = counter.n_arrived();
            send(&json!({"type": "ping", "t": 7}));
            n_before_replies.push(
                pongs
                    .recv_timeout(TIMEOUT)
                    .expect("a pong")
                    .saturating_sub(n_arrived),
            );
        }
    }
    // The first picture measures the connection.
    let most = n_before_replies[5..].iter().max().expect("replies");
    eprintln!("bytes before replies: {n_before_replies:?}");
    assert!(
        *most < MAX_BYTES_BEFORE_REPLY,
        "{most} bytes were sent before a reply: {n_before_replies:?}"
    );
}

/// A client on a slow connection. Returns a function that sends, and, for each pong, the number of
/// bytes read until then.
fn slow_client(
    stream: Slow,
    address: SocketAddr,
) -> (impl FnMut(&Value), std::sync::mpsc::Receiver<usize>) {
    let (writer, counter) = (stream.descriptor(), stream.counter());
    let Ok((mut socket, _)) = tungstenite::client(format!("ws://{address}/ws"), stream) else {
        panic!("no WebSocket")
    };
    let (pongs, n_read_at_pongs) = std::sync::mpsc::sync_channel(64);
    std::thread::spawn(move || {
        while let Ok(message) = socket.read() {
            let is_pong = message
                .to_text()
                .is_ok_and(|text| text.contains("\"pong\""));
            if is_pong && pongs.try_send(counter.n_read()).is_err() {
                return;
            }
        }
    });
    let role = tungstenite::protocol::Role::Client;
    let mut sending = tungstenite::WebSocket::from_raw_socket(writer, role, None);
    let send = move |message: &Value| {
        sending
            .send(tungstenite::Message::text(message.to_string()))
            .expect("sent")
    };
    (send, n_read_at_pongs)
}

#[test]
fn silent_clients_get_no_pictures_until_they_return() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    client.send_json(&json!({"type": "hello", "protocols": [3, 4], "capabilities": ["heartbeat"]}));
    client.send_json(&render_message(1, "main"));
    let pending = next(&hub);
    std::thread::sleep(Duration::from_millis(2600));
    let picture = analytic_scene::draw(&pending.request);
    pending.deliver(picture);
    let began = Instant::now();
    while began.elapsed() < Duration::from_millis(600) {
        assert!(
            matches!(client.receive(), Received::Text(_)),
            "only heartbeats"
        );
    }
    client.send_json(&json!({"type": "ping", "t": 1}));
    assert_eq!(client.binary_of("picture").0["id"], json!(1));
}

#[test]
fn compact_depth_is_accurate_and_small() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    let mut message = render_message(1, "");
    message["size_px"] = json!([1280, 720]);
    message["outputs"] = json!(["depth"]);
    let mut depth_in = |format: &str| {
        message["depth_format"] = json!(format);
        client.send_json(&message);
        draw_next(&hub);
        let (header, payload) = client.binary_of("picture");
        assert_eq!(
            (&header["depth"]["size_px"], header.get("view")),
            (&json!([640, 360]), None)
        );
        (
            header["depth"].clone(),
            client::part(&header, "depth", &payload).to_vec(),
        )
    };
    let (header, linear) = depth_in("u16_half");
    let meters_per_count = header["meters_per_count"].as_f64().expect("a scale");
    let (header, compact) = depth_in("compact_half");
    let decoded = decode_compact(&header, &compact);
    for (got, count) in decoded.iter().zip(linear.chunks_exact(2)) {
        let meters = f64::from(u16::from_le_bytes([count[0], count[1]])) * meters_per_count;
        assert!(
            (got - meters).abs() <= 0.0021 * meters,
            "{got} instead of {meters}"
        );
    }
    assert_eq!(decoded.len(), linear.len() / 2);
    assert!(
        compact.len() * 20 < linear.len(),
        "{} of {} bytes",
        compact.len(),
        linear.len()
    );
}

/// An independent decoder, written from `docs/reference/protocol.md`.
fn decode_compact(header: &Value, bytes: &[u8]) -> Vec<f64> {
    use std::io::Read;
    let width = usize::try_from(header["size_px"][0].as_u64().expect("a width")).expect("small");
    let height = usize::try_from(header["size_px"][1].as_u64().expect("a height")).expect("small");
    let (min_m, log_step) = (
        header["min_m"].as_f64().expect("min_m"),
        header["log_step"].as_f64().expect("log_step"),
    );
    let mut stream = Vec::new();
    flate2::read::ZlibDecoder::new(bytes)
        .read_to_end(&mut stream)
        .expect("a zlib stream");
    let (symbols, rest) = stream.split_at(width * height);
    let mut rest = rest
        .chunks_exact(2)
        .map(|count| i64::from(u16::from_le_bytes([count[0], count[1]])));
    let mut counts = vec![vec![0_i64; width]; height];
    for y in 0..height {
        for x in 0..width {
            let predicted = match (x, y) {
                (0, 0) => 0,
                (0, _) => counts[y - 1][0],
                _ => counts[y][x - 1],
            };
            counts[y][x] = match i64::from(symbols[y * width + x]) {
                255 => rest.next().expect("a count"),
                even if even % 2 == 0 => predicted + even / 2,
                odd => predicted - (odd + 1) / 2,
            };
        }
    }
    let meters = |count: i64| {
        if count == 0 {
            0.0
        } else {
            min_m * (log_step * (count as f64 - 1.0)).exp()
        }
    };
    counts.into_iter().flatten().map(meters).collect()
}

#[test]
fn nothing_long_is_sent_before_a_hello_on_a_slow_link() {
    const DELAY: Duration = Duration::from_millis(150);
    let (hub, server) = start();
    hub.keyframes().set((0..40).map(keyframe).collect());
    hub.set_live_image(camera_image(1));
    // Repeated if this computer is so busy that the hello came late.
    for _ in 0..20 {
        let began = Instant::now();
        let mut client = Client::connect(server.address());
        std::thread::sleep(DELAY);
        client.send_json(&json!({"type": "subscribe", "topic": "live_images", "rate_hz": 4, "size_px": [160, 160]}));
        client.send_json(&json!({"type": "hello", "protocols": [3, 4], "capabilities": ["keyframe_changes", "parts"]}));
        if began.elapsed() > 2 * DELAY {
            continue;
        }
        let mut kinds = Vec::new();
        while !kinds.iter().any(|kind| kind == "keyframe_changes")
            || !kinds.iter().any(|kind| kind == "live_image")
        {
            match client.receive() {
                Received::Text(message) => {
                    kinds.push(message["type"].as_str().unwrap_or_default().to_owned())
                }
                Received::Binary(header, _) => {
                    assert_eq!(header["size_px"], json!([160, 120]), "the subscribed size");
                    kinds.push("live_image".to_owned());
                }
                Received::End => panic!("disconnected after {kinds:?}"),
            }
        }
        assert!(
            kinds.iter().all(|kind| kind != "keyframes"),
            "the list of version 3: {kinds:?}"
        );
        let position = |name: &str| kinds.iter().position(|kind| kind == name);
        assert!(
            position("welcome") < position("keyframe_changes").min(position("live_image")),
            "{kinds:?}"
        );
        return;
    }
    panic!("no hello was sent in time");
}

#[test]
fn robot_is_described_and_moves() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    hub.set_robot(robot::description());
    hub.set_robot_state(robot::state(0.0));
    assert!(!hub.needs_robot_state(), "no client has subscribed");
    client.send_json(&json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 60}));
    // The description comes before the first state.
    let mut of_robot = std::iter::repeat_with(|| client.text()).filter(|message| {
        message["type"]
            .as_str()
            .is_some_and(|kind| kind.starts_with("robot"))
    });
    let (description, state) = (
        of_robot.next().expect("endless"),
        of_robot.next().expect("endless"),
    );
    assert_eq!(
        (&description["type"], &state["type"]),
        (&json!("robot"), &json!("robot_state"))
    );
    assert!(hub.needs_robot_state());
    assert_eq!(
        description["links"][1]["shapes"][0]["size_m"],
        json!([0.3, 0.2, 0.3])
    );
    assert_eq!(description["joints"][1]["axis"], json!([0.0, 0.0, 1.0]));
    assert_eq!(state["positions"], json!([0.2, 0.0]));
    assert_eq!(state["world_from_base"][3], json!(-0.4));
    // At the subscribed rate, the latest state replaces older ones.
    let began = Instant::now();
    let mut n_received: u32 = 0;
    for ix in 0..400_u32 {
        hub.set_robot_state(robot::state(f64::from(ix) * 0.001));
        std::thread::sleep(Duration::from_millis(2));
    }
    hub.set_robot_state(robot::state(2.5));
    let elapsed = began.elapsed();
    loop {
        let message = client.text_of("robot_state");
        n_received += 1;
        if message["positions"][1] == json!(2.5) {
            break;
        }
    }
    assert!(
        f64::from(n_received) <= 60.0 * elapsed.as_secs_f64() + 3.0,
        "{n_received} states in {elapsed:?}"
    );
    let mesh = http_get(server.address(), "/robot/0.stl", "");
    assert!(
        mesh.starts_with("HTTP/1.1 200") && mesh.ends_with("solid a"),
        "{mesh}"
    );
    for path in [
        "/robot/1.stl",
        "/robot/0.dae",
        "/robot/..%2f..%2fetc%2fpasswd",
        "/robot/../status.stl",
        "/robot/a.stl",
    ] {
        assert!(
            http_get(server.address(), path, "").starts_with("HTTP/1.1 404"),
            "{path}"
        );
    }
    // Reloading the page does not transfer the meshes again.
    let etag = mesh
        .lines()
        .find_map(|line| line.strip_prefix("etag: "))
        .expect("an ETag");
    let again = http_get(
        server.address(),
        "/robot/0.stl",
        &format!("If-None-Match: {etag}\r\n"),
    );
    assert!(
        again.starts_with("HTTP/1.1 304") && !again.contains("solid"),
        "{again}"
    );
    let other = http_get(server.address(), "/robot/0.stl", "If-None-Match: \"0\"\r\n");
    assert!(other.starts_with("HTTP/1.1 200"), "{other}");
}

/// The response to a request with additional headers.
fn http_get(address: SocketAddr, path: &str, headers: &str) -> String {
    use std::io::{Read, Write};
    let mut stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}\r\n"
    )
    .expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    String::from_utf8_lossy(&answer).into_owned()
}
