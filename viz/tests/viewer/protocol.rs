//! Tests the real server over loopback with an independent client that follows
//! `docs/reference/protocol.md`.

use crate::client;
use crate::client::TIMEOUT;
use crate::client::{Client, Received};
use crate::keyframe_images::header_of_photograph;
use crate::local_server::start;
use crate::robot;
use analytic_scene::draw;
use keyframe::RangePoints;
use kinematics::{Stamp, Transform};
use model_files::Aabb;
use nalgebra::{Translation3, Vector3};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{ChunkData, ChunkLayout, ModelChunk, ModelChunks};
use viz::{
    Advice, CheckpointState, Control, ControlRequest, EditAction, Error, Hub, Identity,
    ImageCounts, KeyframePose, KeyframeStore, LiveImage, LivePixels, ModelStatus, ObservationMap,
    ObservedCell, OperatorStatus, PendingRender, RangeScan, RequestedCheckpoint, SceneBounds,
    SceneHint, Server, ServerConfig, Status,
};

fn render_message(id: u64) -> Value {
    json!({
        "type": "render", "id": id, "size_px": [160, 120],
        "world_from_camera": [1, 0, 0, 0.0, 0, 0, 1, -2.0, 0, -1, 0, 0.5, 0, 0, 0, 1],
        "projection": {"kind": "pinhole", "vertical_fov_rad": 0.9},
    })
}

fn next(hub: &Hub) -> PendingRender {
    assert!(
        hub.pictures().wait_for_request(TIMEOUT),
        "no request arrived"
    );
    hub.pictures().next_request().expect("a request is pending")
}

/// Renders and delivers every pending stage.
fn draw_all(hub: &Hub, n_stages: usize) {
    for _ in 0..n_stages {
        let pending = next(hub);
        let picture = draw(&pending.request);
        pending.deliver(picture);
    }
}

#[test]
fn client_receives_hello_then_current_state() {
    let (hub, server) = start();
    hub.set_status(Status {
        state: "training".to_owned(),
        rejected: [("blurred".to_owned(), 3)].into(),
        model: ModelStatus {
            primitives_label: "Splats".to_owned(),
            psnr: Some(24.5),
            psnr_history: vec![(1.0, 20.0), (2.0, 24.5)],
            ..model_status("splat", 1200)
        },
        others: vec![model_status("tsdf", 30)],
        ..Status::default()
    });
    hub.set_scene_hint(SceneHint {
        center_m: [0.4, 0.0, 0.1],
        radius_m: 0.5,
        world_from_camera: Translation3::new(1.0, 2.0, 3.0).into(),
    });
    hub.keyframes().set(vec![KeyframePose {
        camera: "wrist".into(),
        stamp: Stamp(0),
        world_from_camera: Transform::identity(),
        size_px: [640, 480],
        focal_px: [600.0, 601.0],
        principal_px: [320.0, 240.0],
    }]);
    let mut client = Client::connect(server.address());
    let hello = client.text();
    assert_eq!(
        (&hello["type"], &hello["protocol"]),
        (&json!("hello"), &json!(viz::BASE_PROTOCOL_VERSION))
    );
    assert_eq!(hello["default_stages"], json!([0.1, 0.5, 1.0]));
    let scene = client.text_of("scene");
    assert_eq!(
        scene["world_from_camera"],
        json!([
            1., 0., 0., 1., 0., 1., 0., 2., 0., 0., 1., 3., 0., 0., 0., 1.
        ])
    );
    let status = client.text_of("status");
    assert_eq!(
        (&status["step"], &status["psnr"]),
        (&json!(1200), &json!(24.5))
    );
    assert_eq!(status["psnr_history"], json!([[1.0, 20.0], [2.0, 24.5]]));
    assert_eq!(status["rejected"], json!({"blurred": 3}));
    assert_eq!(status["primitives_label"], json!("Splats"));
    assert_eq!(
        (&status["others"][0]["method"], &status["others"][0]["step"]),
        (&json!("tsdf"), &json!(30))
    );
    let keyframes = client.text_of("keyframes");
    assert_eq!(keyframes["keyframes"][0]["focal_px"], json!([600.0, 601.0]));
    hub.set_status(Status {
        model: model_status("splat", 1300),
        ..Status::default()
    });
    let status = client.text_of("status");
    assert_eq!(
        (&status["step"], &status["others"]),
        (&json!(1300), &json!([]))
    );
}

/// A model after `step` steps.
fn model_status(method: &str, step: u64) -> ModelStatus {
    ModelStatus {
        method: method.to_owned(),
        step,
        ..ModelStatus::default()
    }
}

#[test]
fn client_selects_the_model() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    let mut message = render_message(1);
    message["stages"] = json!([1.0]);
    client.send_json(&message);
    let pending = next(&hub);
    assert_eq!(pending.method(), None, "the first");
    pending.fail("no images received yet");
    assert_eq!(client.text_of("error")["id"], json!(1));
    message["id"] = json!(2);
    message["method"] = json!("tsdf");
    client.send_json(&message);
    let pending = next(&hub);
    assert_eq!(pending.method(), Some("tsdf"));
    let picture = draw(&pending.request);
    // The header names the model that was drawn, not the one in the request.
    pending.of_model("splat", 1520).deliver(picture);
    let header = client.binary_of("picture").0;
    assert_eq!(
        (&header["id"], &header["method"], &header["step"]),
        (&json!(2), &json!("splat"), &json!(1520))
    );
    message["id"] = json!(3);
    client.send_json(&message);
    draw_all(&hub, 1);
    let header = client.binary_of("picture").0;
    assert!(
        header.get("method").is_none() && header.get("step").is_none(),
        "without a model, the request is not taken for it"
    );
}

#[test]
fn stages_stream_and_show_the_scene() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    let mut message = render_message(9);
    message["outputs"] = json!(["color", "depth"]);
    message["depth_format"] = json!("f32");
    client.send_json(&message);
    let mut sizes = Vec::new();
    for stage in 0..3 {
        draw_all(&hub, 1); // The stage arrives before the next one is rendered.
        let (header, payload) = client.binary_of("picture");
        assert_eq!(
            (&header["id"], &header["stage"]),
            (&json!(9), &json!(stage))
        );
        assert_eq!(header["last"], json!(stage == 2));
        check_same_pose(&message["world_from_camera"], &header["world_from_camera"]);
        sizes.push(header["size_px"].clone());
        let color = client::part(&header, "color", &payload);
        let picture = image::load_from_memory_with_format(color, image::ImageFormat::Jpeg)
            .expect("a JPEG")
            .to_rgb8();
        assert_eq!(
            json!([picture.width(), picture.height()]),
            header["size_px"]
        );
        let depth = client::part(&header, "depth", &payload);
        check_against_scene(&request_of_stage(&message, &header), &picture, depth);
    }
    assert_eq!(sizes, [json!([16, 12]), json!([80, 60]), json!([160, 120])]);
    assert!(
        hub.pictures().next_request().is_none(),
        "all stages are drawn"
    );
}

/// The server stores a quaternion, so a matrix returns with rounding errors.
fn check_same_pose(sent: &Value, returned: &Value) {
    let numbers = |value: &Value| {
        value
            .as_array()
            .map(|rows| rows.iter().filter_map(Value::as_f64).collect::<Vec<_>>())
    };
    let (sent, returned) = (
        numbers(sent).expect("numbers"),
        numbers(returned).expect("numbers"),
    );
    assert_eq!((sent.len(), returned.len()), (16, 16));
    assert!(
        sent.iter()
            .zip(&returned)
            .all(|(a, b)| (a - b).abs() < 1e-12),
        "{sent:?} became {returned:?}"
    );
}

/// The request of a stage as described by its header, using only data from the wire.
fn request_of_stage(message: &Value, header: &Value) -> trainer::RenderRequest {
    let numbers = |value: &Value| {
        value
            .as_array()
            .map(|list| list.iter().filter_map(Value::as_f64).collect::<Vec<_>>())
    };
    let scale = header["size_px"][0].as_f64().expect("a size")
        / header["full_size_px"][0].as_f64().expect("a size");
    let focal = numbers(&header["projection"]["focal_px"]).expect("focal lengths");
    let principal = numbers(&header["projection"]["principal_px"]).expect("a principal point");
    assert_eq!(message["size_px"], header["full_size_px"]);
    let size_px = [0, 1].map(|ix| {
        header["size_px"][ix]
            .as_u64()
            .and_then(|n| u32::try_from(n).ok())
            .expect("a size")
    });
    trainer::RenderRequest {
        world_from_camera: analytic_scene::looking_along_y(),
        size_px,
        projection: trainer::Projection::Pinhole {
            focal_px: [focal[0] * scale, focal[1] * scale],
            principal_px: [principal[0] * scale, principal[1] * scale],
        },
        shutter: None,
        near_m: header["near_m"].as_f64().expect("near"),
        far_m: header["far_m"].as_f64().expect("far"),
        crop: None,
        edits: Arc::default(),
        background_srgb: [0.0; 3],
        appearance_of: None,
        depth: true,
    }
}

fn check_against_scene(request: &trainer::RenderRequest, picture: &image::RgbImage, depth: &[u8]) {
    let expected = draw(request);
    // JPEG at these qualities. A mirrored or shifted picture, or one of another stage, is off by
    // tens.
    const MEAN_ABS: f64 = 6.0;
    let colors = expected
        .rgba_srgb
        .chunks_exact(4)
        .flat_map(|pixel| &pixel[..3]);
    let off: f64 = colors
        .zip(picture.as_raw())
        .map(|(a, b)| f64::from(a.abs_diff(*b)))
        .sum();
    let mean_off = off / f64::from(3 * picture.width() * picture.height());
    assert!(
        mean_off < MEAN_ABS,
        "colors differ by {mean_off} on average"
    );
    let depth: Vec<f32> = depth
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    assert_eq!(depth.len(), expected.depth_m.len());
    let worst = depth
        .iter()
        .zip(&expected.depth_m)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    // The focal length was sent as text and scaled once more, so only rounding may differ.
    assert!(worst < 1e-5, "depths differ by up to {worst} m");
}

#[test]
fn newer_request_replaces_unstarted_stages() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    client.send_json(&render_message(1));
    let started = next(&hub);
    client.send_json(&render_message(2));
    client.send_json(&render_message(3));
    client.settle(); // The server answers in order, so the requests have arrived.
    let picture = draw(&started.request);
    started.deliver(picture);
    draw_all(&hub, 3);
    let drawn: Vec<_> = (0..4)
        .map(|_| client.binary_of("picture").0)
        .map(|header| (header["id"].as_u64(), header["stage"].as_u64()))
        .collect();
    assert_eq!(
        drawn,
        [
            (Some(1), Some(0)),
            (Some(3), Some(0)),
            (Some(3), Some(1)),
            (Some(3), Some(2))
        ]
    );
    assert!(hub.pictures().next_request().is_none());
}

#[test]
fn clients_alternate_and_disconnected_ones_are_skipped() {
    let (hub, server) = start();
    let mut first = Client::connect(server.address());
    let mut second = Client::connect(server.address());
    first.send_json(&render_message(10));
    second.send_json(&render_message(20));
    first.settle();
    second.settle();
    assert_eq!(hub.n_clients(), 2);
    draw_all(&hub, 2); // One stage each, regardless of the order of requests.
    assert_eq!(first.binary_of("picture").0["id"], json!(10));
    assert_eq!(second.binary_of("picture").0["id"], json!(20));
    drop(first);
    wait_until(|| hub.n_clients() == 1);
    draw_all(&hub, 2);
    assert_eq!(second.binary_of("picture").0["stage"], json!(1));
    assert_eq!(second.binary_of("picture").0["stage"], json!(2));
    assert!(
        hub.pictures().next_request().is_none(),
        "the remaining stages of the disconnected client are dropped"
    );
}

#[test]
fn malformed_message_gets_error_and_connection_stays() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    let mut wrong_size = render_message(31);
    wrong_size["size_px"] = json!([100_000, 10]);
    let mut wrong_pose = render_message(32);
    wrong_pose["world_from_camera"] = json!(vec![0; 16]);
    let cases = [
        ("{".to_owned(), Value::Null, "cannot parse"),
        ("[]".to_owned(), Value::Null, "cannot parse"),
        (json!({"type": "dance"}).to_string(), Value::Null, "dance"),
        (
            json!({"type": "render", "id": 30}).to_string(),
            json!(30),
            "missing field",
        ),
        (
            render_message(33).to_string().replace("-2.0", "1e999"),
            json!(33),
            "number out of range",
        ),
        (wrong_size.to_string(), json!(31), "size_px"),
        (wrong_pose.to_string(), json!(32), "world_from_camera"),
    ];
    for (message, id, named) in cases {
        client.send_raw(tungstenite::Message::text(message.clone()));
        let error = client.text_of("error");
        assert_eq!(error["id"], id, "{message}");
        let sentence = error["message"].as_str().unwrap_or_default();
        assert!(
            sentence.contains(named) && !sentence.contains('\n'),
            "{message}: {sentence}"
        );
    }
    client.send_raw(tungstenite::Message::binary(vec![0, 1, 2]));
    assert!(
        client.text_of("error")["message"]
            .as_str()
            .is_some_and(|text| text.contains("binary"))
    );
    client.send_json(&render_message(34));
    draw_all(&hub, 3);
    assert_eq!(client.binary_of("picture").0["id"], json!(34));
}

#[test]
fn actions_of_operators_reach_the_run_once() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    for action in ["pause", "pause", "save"] {
        client.send_json(&json!({"type": "control", "action": action}));
    }
    client.send_json(&json!({"type": "control", "action": "explode"}));
    assert!(
        client.text_of("error")["message"]
            .as_str()
            .expect("text")
            .contains("explode")
    );
    assert_eq!(
        hub.operator_requests().take_controls(),
        [Control::Pause, Control::Save]
    );
    assert_eq!(hub.operator_requests().take_controls(), []);
    client.send_json(&json!({"type": "control", "action": "resume"}));
    client.settle();
    let status = status_with_clients(&hub, &mut client);
    let expected = ControlRequest {
        action: Control::Resume,
        client: status["clients"][0]["id"].as_u64().expect("a number"),
    };
    assert_eq!(
        hub.operator_requests().take_control_requests(),
        [expected],
        "the request names its client"
    );
}

/// Publishes a status, and returns what the client receives.
fn status_with_clients(hub: &Hub, client: &mut Client) -> Value {
    hub.set_status(Status::default());
    client.text_of("status")
}

#[test]
fn the_status_lists_the_clients_and_their_roles() {
    let (hub, server) = start();
    hub.set_status(Status::default());
    let mut client = Client::connect(server.address());
    let id = client.text_of("hello")["client"].clone();
    let expected = json!([{"id": id, "role": "operator"}]);
    // Each wait ends with an error of the connection if no such status arrives.
    while client.text_of("status")["clients"] != expected {}
    let other = Client::connect(server.address());
    while client.text_of("status")["clients"].as_array().map(Vec::len) != Some(2) {}
    drop(other);
    while client.text_of("status")["clients"] != expected {}
}

#[test]
fn edits_of_operators_reach_the_run_in_order() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    let erased = json!({"min_m": [-1, 0, 0], "max_m": [1, 0.5, 2]});
    client.send_json(
        &json!({"type": "edit", "action": "erase", "box": erased, "method": "tsdf", "id": 7}),
    );
    client.send_json(&json!({"type": "edit", "action": "remove_floaters"}));
    client.send_json(&json!({"type": "edit", "action": "undo", "id": 8}));
    client.send_json(&json!({"type": "edit", "action": "redo"}));
    let flat = json!({"min_m": [0, 0, 0], "max_m": [1, 0, 1]});
    for (message, named) in [
        (
            json!({"type": "edit", "action": "erase", "id": 9}),
            "box is required",
        ),
        (
            json!({"type": "edit", "action": "undo", "box": erased, "id": 9}),
            "box is required",
        ),
        (
            json!({"type": "edit", "action": "erase", "box": flat, "id": 9}),
            "box needs finite corners",
        ),
        (json!({"type": "edit", "action": "paint", "id": 9}), "paint"),
    ] {
        client.send_json(&message);
        let error = client.text_of("error");
        assert!(
            error["id"] == 9 && error["message"].as_str().expect("text").contains(named),
            "{message}: {error}"
        );
    }
    let edits = hub.operator_requests().take_edits();
    let box_of = |world_from_box| Aabb {
        world_from_box,
        min_m: [-1.0, 0.0, 0.0],
        max_m: [1.0, 0.5, 2.0],
    };
    let actions: Vec<_> = edits
        .iter()
        .map(|edit| (edit.method(), *edit.action()))
        .collect();
    let expected = [
        (
            Some("tsdf"),
            EditAction::Erase(box_of(Transform::identity())),
        ),
        (None, EditAction::RemoveFloaters),
        (None, EditAction::Undo),
        (None, EditAction::Redo),
    ];
    assert_eq!(actions, expected);
    hub.reject_edit(&edits[1], "there are none");
    hub.reject_edit(&edits[2], "there is nothing to undo");
    let errors = [client.text_of("error"), client.text_of("error")];
    assert!(
        errors[0]["id"].is_null() && errors[0]["message"] == "there are none",
        "{errors:?}"
    );
    assert!(
        errors[1]["id"] == 8 && errors[1]["message"] == "there is nothing to undo",
        "{errors:?}"
    );

    // Nobody takes the edits.
    for id in 100..=164 {
        client.send_json(&json!({"type": "edit", "action": "undo", "id": id}));
    }
    let refused = client.text_of("error");
    assert!(
        refused["id"] == 164
            && refused["message"]
                .as_str()
                .expect("text")
                .contains("64 edits"),
        "{refused}"
    );
    assert_eq!(hub.operator_requests().take_edits().len(), 64);
}

#[test]
fn failed_render_sends_error_message() {
    let (hub, server) = start();
    let mut client = Client::connect(server.address());
    client.send_json(&render_message(5));
    next(&hub).fail("the GPU is lost");
    let error = client.text_of("error");
    assert_eq!(
        (&error["id"], &error["message"]),
        (&json!(5), &json!("the GPU is lost"))
    );
    let pending = next(&hub);
    let mut picture = draw(&pending.request);
    picture.rgba_srgb.truncate(7);
    pending.deliver(picture);
    assert!(
        client.text_of("error")["message"]
            .as_str()
            .is_some_and(|text| text.contains("has 7"))
    );
    drop(next(&hub)); // Dropped without an answer: the client's later requests are still served.
    client.send_json(&render_message(6));
    draw_all(&hub, 3);
    assert_eq!(client.binary_of("picture").0["id"], json!(6));
}

#[test]
fn live_images_reach_every_client_once_as_jpeg() {
    let (hub, server) = start();
    let gradient: Arc<[u8]> = (0..64 * 48_u32)
        .flat_map(|ix| [u8::try_from(ix % 64 * 4).unwrap_or(255), 80, 20, 255])
        .collect();
    let image = |stamp| LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(stamp),
        captured_at: Instant::now(),
        size_px: [64, 48],
        pixels: LivePixels::Rgba(Arc::clone(&gradient)),
        world_from_camera: Some(Transform::identity()),
        focal_px: [60.0, 60.0],
        principal_px: [32.0, 24.0],
    };
    hub.set_live_image(image(5));
    let mut clients = [
        Client::connect(server.address()),
        Client::connect(server.address()),
    ];
    for client in &mut clients {
        let (header, jpeg) = client.binary_of("live_image");
        assert_eq!(
            (&header["camera"], &header["stamp_nanos"]),
            (&json!("wrist"), &json!(5))
        );
        let picture = image::load_from_memory_with_format(&jpeg, image::ImageFormat::Jpeg)
            .expect("a JPEG")
            .to_rgb8();
        assert!(
            picture.get_pixel(60, 20)[0].abs_diff(240) < 16,
            "{:?}",
            picture.get_pixel(60, 20)
        );
    }
    let corrections = [("wrist", 0.5), ("other", 2.0)]
        .map(|(name, x)| (name.into(), Transform::translation(x, 0.0, 0.0)));
    hub.set_camera_corrections(corrections.into());
    hub.set_live_image(image(6));
    hub.set_live_image(image(7));
    for client in &mut clients {
        let header = client.binary_of("live_image").0;
        let stamp = &header["stamp_nanos"];
        assert!(*stamp == json!(6) || *stamp == json!(7), "{stamp}");
        assert_eq!(
            header["world_from_camera"][3],
            json!(0.5),
            "the pose is corrected"
        );
    }
}

#[test]
fn every_wire_field_is_documented_and_typed() {
    let folder = std::path::PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let docs =
        std::fs::read_to_string(folder.join("../docs/reference/protocol.md")).expect("the docs");
    let page = std::fs::read_to_string(folder.join("web/src/connection/protocol.ts"))
        .expect("the page's messages");
    assert!(docs.contains(&format!(
        "version **{}** of the protocol",
        viz::PROTOCOL_VERSION
    )));
    assert!(page.contains(&format!("PROTOCOL_VERSION = {};", viz::PROTOCOL_VERSION)));
    let messages = one_of_each();
    for kind in kinds_of(&docs) {
        assert!(
            OTHER_MESSAGES.contains(&kind)
                || messages.iter().any(|message| message["type"] == kind),
            "add {kind} to one_of_each"
        );
    }
    for message in messages {
        let kind = message["type"].as_str().expect("a type");
        let section = section_of(&docs, kind);
        for name in message
            .as_object()
            .expect("an object")
            .keys()
            .filter(|name| *name != "type")
        {
            assert!(
                section.contains(&format!("`{name}`")),
                "{kind}.{name} is not in docs/reference/protocol.md"
            );
            assert!(
                page.contains(&format!("{name}:")) || page.contains(&format!("{name}?:")),
                "{kind}.{name} is not in web/src/connection/protocol.ts"
            );
        }
    }
}

/// Messages that [`one_of_each`] does not contain, because the server sends them only with depth
/// images or over slow connections.
const OTHER_MESSAGES: [&str; 2] = ["keyframe_points", "part"];

/// One message of each type that the server sends.
fn one_of_each() -> Vec<Value> {
    let (hub, server) = start();
    hub.set_status(Status {
        others: vec![model_status("tsdf", 30)],
        operator: full_operator_status(),
        ..Status::default()
    });
    let hint = SceneHint {
        center_m: [0.0; 3],
        radius_m: 1.0,
        world_from_camera: Transform::identity(),
    };
    let bounds = SceneBounds {
        min_m: [-0.6, -0.5, 0.0],
        max_m: [0.6, 0.5, 0.4],
    };
    hub.set_scene(hint, bounds);
    let mut client = Client::connect(server.address());
    hub.set_robot(robot::description());
    hub.set_robot_state(robot::state(0.0));
    let mut messages = vec![client.text()];
    let mut subscribed = Client::connect(server.address());
    subscribed.send_json(&json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 60}));
    messages.push(subscribed.text_of("robot"));
    drop(subscribed);
    messages.extend(["scene", "status", "keyframes", "heartbeat"].map(|kind| client.text_of(kind)));
    client.send_json(&json!({"type": "hello", "protocols": [3, 4], "capabilities": ["keyframe_changes", "parts"]}));
    client.send_json(&json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 60}));
    messages.extend(["welcome", "keyframe_changes"].map(|kind| client.text_of(kind)));
    client.send_json(&json!({"type": "subscribe", "topic": "robot_state", "rate_hz": 60}));
    hub.set_robot_state(robot::state(0.1));
    messages.push(client.text_of("robot_state"));
    client.send_json(&json!({"type": "subscribe", "topic": "base_path", "rate_hz": 2}));
    client.send_json(&json!({"type": "subscribe", "topic": "range_scans", "rate_hz": 10}));
    hub.set_range_scan(range_scan());
    messages.extend([
        client.text_of("base_path"),
        client.binary_of("range_scan").0,
    ]);
    assert!(!hub.needs_observations());
    client.send_json(&json!({"type": "subscribe", "topic": "observations", "rate_hz": 2}));
    client.settle();
    assert!(hub.needs_observations());
    hub.set_observations(&observation_map());
    messages.push(client.binary_of("observations").0);
    client.send_json(&json!({"type": "ping", "t": 1.0}));
    messages.push(client.text_of("pong"));
    hub.set_live_image(LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(1),
        captured_at: Instant::now(),
        size_px: [8, 8],
        pixels: LivePixels::Rgb(vec![0; 192].into()),
        world_from_camera: None,
        focal_px: [8.0; 2],
        principal_px: [4.0; 2],
    });
    messages.push(client.binary_of("live_image").0);
    client.send_json(&render_message(1));
    let pending = next(&hub);
    let picture = draw(&pending.request);
    pending.of_model("splat", 1).deliver(picture);
    messages.push(client.binary_of("picture").0);
    client.send_json(
        &json!({"type": "subscribe", "topic": "model_chunks", "rate_hz": 1, "method": "tsdf"}),
    );
    client.settle();
    hub.model_chunks().set(
        "tsdf",
        ModelChunks {
            is_complete: true,
            chunks: both_chunks(),
            removed: Vec::new(),
        },
    );
    messages.extend([(); 2].map(|()| client.binary_of("model_chunk").0));
    hub.model_chunks().set(
        "tsdf",
        ModelChunks {
            is_complete: true,
            ..ModelChunks::default()
        },
    );
    messages.push(client.text_of("model_chunks_removed"));
    client.send_raw(tungstenite::Message::text("{"));
    messages.push(client.text_of("error"));
    drop(server);
    messages.push(client.text_of("goodbye"));
    messages.push(header_of_photograph());
    messages
}

/// An operator's status with all optional fields.
fn full_operator_status() -> OperatorStatus {
    OperatorStatus {
        identity: Some(Identity::default()),
        advice: Some(Advice::default()),
        images: Some(ImageCounts::default()),
        store: Some(KeyframeStore::default()),
        paused_by: Some(1),
        checkpoint: Some(RequestedCheckpoint {
            state: CheckpointState::Written,
            text: String::new(),
        }),
        ..OperatorStatus::default()
    }
}

fn observation_map() -> ObservationMap {
    ObservationMap {
        cell_m: 0.5,
        n_cells: [1, 2, 1],
        observed: vec![ObservedCell {
            ix: 1,
            age_secs: 1.0,
            sigma_m: 0.002,
        }],
        n_keyframes: 3,
        newest_at: Some(Instant::now()),
        ..ObservationMap::default()
    }
}

fn range_scan() -> RangeScan {
    RangeScan {
        scan: Arc::new(RangePoints {
            scanner: "lidar".into(),
            stamp: Stamp(1),
            world_from_scanner: Transform::identity(),
            points_in_world_m: [[1.0, 2.0, 3.0]].into(),
        }),
        map_from_odom: Transform::identity(),
        captured_at: Instant::now(),
    }
}

/// A chunk of each kind.
fn both_chunks() -> Vec<ModelChunk> {
    let mesh = ChunkLayout::Mesh {
        origin_m: [0.0; 3],
        meters_per_count: 0.1,
        n_vertices: 0,
        n_triangles: 0,
    };
    let splats = ChunkLayout::Splats {
        n_splats: 0,
        min_m: [0.0; 3],
        max_m: [1.0; 3],
        log_scale_range: [-4.0, -2.0],
        scale_factor: 1.0,
        sh_degree: 0,
        sh_ranges: [0.0; 2],
        is_antialiased: false,
    };
    let chunk = |(id, layout)| {
        let fine = ChunkData {
            layout,
            bytes: Vec::new(),
        };
        ModelChunk {
            id,
            change: 1.0,
            coarse: None,
            fine,
        }
    };
    [(1, mesh), (2, splats)].map(chunk).into()
}

/// The part of the docs about messages from the server.
fn from_server(docs: &str) -> &str {
    &docs[docs.find("## From the server").expect("the chapter")..]
}

/// The types of the messages from the server that the docs describe.
fn kinds_of(docs: &str) -> impl Iterator<Item = &str> {
    from_server(docs)
        .split("\n### `")
        .skip(1)
        .filter_map(|section| section.split_once('`'))
        .map(|(kind, _)| kind)
}

/// The part of the docs about a message from the server.
fn section_of<'a>(docs: &'a str, kind: &str) -> &'a str {
    let section = from_server(docs)
        .split("\n### ")
        .find(|section| section.starts_with(&format!("`{kind}`")));
    section.unwrap_or_else(|| panic!("docs/reference/protocol.md has no section about {kind}"))
}

#[test]
fn stopping_server_sends_goodbye_and_frees_port() {
    let (hub, server) = start();
    let address = server.address();
    let mut client = Client::connect(address);
    client.settle();
    drop(server);
    assert_eq!(
        client.text_of("goodbye")["reason"],
        json!("the server has stopped")
    );
    assert_eq!(client.receive(), Received::End);
    assert_eq!(hub.n_clients(), 0);
    drop(Server::start(ServerConfig { listen: address }, hub).expect("the port is free again"));
}

#[test]
fn used_port_and_public_address_are_rejected() {
    let holder = TcpListener::bind("127.0.0.1:0").expect("a free port exists");
    let used_address = holder.local_addr().expect("bound");
    let error = Server::start(
        ServerConfig {
            listen: used_address,
        },
        Hub::new(),
    )
    .expect_err("taken");
    assert!(matches!(error, Error::AddressInUse { address } if address == used_address));
    assert!(
        error.to_string().contains(&used_address.to_string()),
        "{error}"
    );
    let public: SocketAddr = "0.0.0.0:0".parse().expect("an address");
    let error = Server::start(ServerConfig { listen: public }, Hub::new()).expect_err("public");
    assert!(
        matches!(error, Error::NotLoopback { .. }) && error.to_string().contains("add share,"),
        "{error}"
    );
}

#[test]
fn the_page_and_the_status_are_served_over_http() {
    let (hub, server) = start();
    hub.set_status(Status {
        model: model_status("splat", 70_000),
        ..Status::default()
    });
    let page = get(server.address(), "/", "localhost");
    assert!(
        page.starts_with("HTTP/1.1 200") && page.contains("fieldrig"),
        "{page}"
    );
    let status = get(server.address(), "/status", "localhost");
    let body = status.split("\r\n\r\n").nth(1).expect("a body");
    assert_eq!(
        serde_json::from_str::<Value>(body).expect("JSON")["step"],
        json!(70_000),
        "steps may exceed 16 bits"
    );
    assert!(get(server.address(), "/nothing", "localhost").starts_with("HTTP/1.1 404"));
    assert!(get(server.address(), "/status", "example.com").starts_with("HTTP/1.1 403"));
}

fn get(address: SocketAddr, path: &str, host: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
    )
    .expect("sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    String::from_utf8_lossy(&answer).into_owned()
}

fn wait_until(is_done: impl Fn() -> bool) {
    let started = Instant::now();
    while !is_done() {
        assert!(started.elapsed() < TIMEOUT, "timed out");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn analytic_scene_is_asymmetric() {
    let request = request_of_stage(
        &json!({"size_px": [80, 60]}),
        &json!({"size_px": [80, 60], "full_size_px": [80, 60], "near_m": 0.01, "far_m": 100.0,
                "projection": {"focal_px": [60.0, 60.0], "principal_px": [40.0, 30.0]}}),
    );
    let picture = draw(&request);
    let mirrored: Vec<u8> = picture
        .rgba_srgb
        .chunks_exact(4 * 80)
        .flat_map(|row| {
            row.chunks_exact(4)
                .rev()
                .flatten()
                .copied()
                .collect::<Vec<_>>()
        })
        .collect();
    assert_ne!(mirrored, picture.rgba_srgb);
    let in_world = request.world_from_camera.rotation * Vector3::new(0.0, -1.0, 0.0);
    assert!(
        (in_world - Vector3::z()).norm() < 1e-12,
        "the camera's up is the world's"
    );
}
