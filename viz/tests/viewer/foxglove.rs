//! Reads all topics with a client of the Foxglove WebSocket protocol.

use crate::client::TIMEOUT;
use crate::robot;
use foxglove::Decode;
use foxglove::messages::{
    CameraCalibration, CompressedImage, FrameTransforms, JointStates, PosesInFrame,
};
use kinematics::{Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};
use viz::{
    Error, FoxgloveServer, Hub, KeyframePose, LiveImage, LivePixels, ModelStatus, RobotState,
    Status,
};

const LOOPBACK: ([u8; 4], u16) = ([127, 0, 0, 1], 0);
/// Stamps of the published data, nanoseconds.
const IMAGE_STAMP: i64 = 12_345_678_901;
const STATE_STAMP: i64 = 12_400_000_007;
const KEYFRAME_STAMP: i64 = 11_000_000_003;

fn connect(address: SocketAddr) -> WebSocket<TcpStream> {
    let mut request = format!("ws://{address}")
        .into_client_request()
        .expect("a request");
    request.headers_mut().insert(
        "sec-websocket-protocol",
        "foxglove.sdk.v1".parse().expect("text"),
    );
    let stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    let (socket, response) = tungstenite::client(request, stream).expect("a WebSocket");
    assert_eq!(
        response.headers()["sec-websocket-protocol"],
        "foxglove.sdk.v1"
    );
    socket
}

fn camera_pose() -> Transform {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.7);
    Transform::from_parts(Translation3::new(0.4, -0.2, 0.9), rotation)
}

fn publish(hub: &Hub, offset: i64) {
    hub.set_status(Status {
        state: "training".to_owned(),
        keyframes: 1,
        model: ModelStatus {
            method: "splat".to_owned(),
            step: 70,
            psnr: Some(24.5),
            ..ModelStatus::default()
        },
        ..Status::default()
    });
    hub.keyframes().set(vec![KeyframePose {
        camera: "wrist".into(),
        stamp: Stamp(KEYFRAME_STAMP),
        world_from_camera: camera_pose(),
        size_px: [64, 48],
        focal_px: [60.0, 61.0],
        principal_px: [32.0, 24.0],
    }]);
    hub.set_robot_state(RobotState {
        stamp: Stamp(STATE_STAMP + offset),
        ..robot::state(0.5)
    });
    hub.set_live_image(LiveImage {
        camera: "wrist".into(),
        stamp: Stamp(IMAGE_STAMP + offset),
        captured_at: Instant::now(),
        size_px: [64, 48],
        pixels: LivePixels::Rgb(vec![200; 64 * 48 * 3].into()),
        world_from_camera: Some(camera_pose()),
        focal_px: [60.0, 61.0],
        principal_px: [32.5, 24.0],
    });
}

/// A message of a subscription.
struct Data {
    log_nanos: u64,
    payload: Vec<u8>,
}

/// Advertised channels, then the first message of each topic, in which transforms are those of the
/// `tf_child`.
fn first_messages(address: SocketAddr) -> (BTreeMap<String, Value>, BTreeMap<String, Vec<Data>>) {
    const TOPICS: usize = 6;
    const MESSAGE_DATA: u8 = 1;
    let mut socket = connect(address);
    let mut channels: BTreeMap<String, Value> = BTreeMap::new();
    let mut messages: BTreeMap<String, Vec<Data>> = BTreeMap::new();
    let started = Instant::now();
    // Transforms of the camera and of the robot come separately.
    while messages.len() < TOPICS || messages["/tf"].len() < 4 {
        assert!(
            started.elapsed() < TIMEOUT,
            "received only {:?} of {:?}",
            messages.keys(),
            channels.keys()
        );
        match socket.read().expect("a message") {
            Message::Text(text) => {
                let message: Value = serde_json::from_str(&text).expect("JSON");
                for channel in message["channels"].as_array().into_iter().flatten() {
                    let subscription = json!({"id": channel["id"], "channelId": channel["id"]});
                    let request = json!({"op": "subscribe", "subscriptions": [subscription]});
                    socket
                        .send(Message::text(request.to_string()))
                        .expect("sent");
                    channels.insert(
                        channel["topic"].as_str().expect("a topic").to_owned(),
                        channel.clone(),
                    );
                }
            }
            Message::Binary(bytes) if bytes[0] == MESSAGE_DATA => {
                let id = u64::from(u32::from_le_bytes(
                    bytes[1..5].try_into().expect("four bytes"),
                ));
                let log_nanos = u64::from_le_bytes(bytes[5..13].try_into().expect("eight bytes"));
                let is_of_channel = |channel: &&Value| channel["id"] == json!(id);
                let channel = channels
                    .values()
                    .find(is_of_channel)
                    .expect("an advertised channel");
                let topic = channel["topic"].as_str().expect("a topic").to_owned();
                messages.entry(topic).or_default().push(Data {
                    log_nanos,
                    payload: bytes[13..].to_vec(),
                });
            }
            _ => {}
        }
    }
    (channels, messages)
}

#[test]
fn all_topics_are_advertised_and_published_with_capture_stamps() {
    let hub = Hub::new();
    let server = FoxgloveServer::start(LOOPBACK.into(), hub.clone()).expect("a free port exists");
    hub.set_robot(robot::description());
    assert!(!hub.needs_live_images(), "nobody is connected");
    let is_done = AtomicBool::new(false);
    let (channels, messages) = std::thread::scope(|scope| {
        // As a live run: images and states only while somebody needs them.
        scope.spawn(|| {
            for offset in 0.. {
                if is_done.load(Ordering::Relaxed) {
                    break;
                }
                if hub.needs_live_images() && hub.needs_robot_state() {
                    publish(&hub, offset);
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        let received = first_messages(server.address());
        is_done.store(true, Ordering::Relaxed);
        received
    });
    for (topic, schema, encoding) in [
        (
            "/cameras/wrist/image",
            "foxglove.CompressedImage",
            "protobuf",
        ),
        (
            "/cameras/wrist/calibration",
            "foxglove.CameraCalibration",
            "protobuf",
        ),
        ("/tf", "foxglove.FrameTransforms", "protobuf"),
        ("/joint_states", "foxglove.JointStates", "protobuf"),
        ("/keyframes", "foxglove.PosesInFrame", "protobuf"),
        ("/metrics", "fieldrig.Metrics", "json"),
    ] {
        let channel = &channels[topic];
        assert_eq!(
            (&channel["schemaName"], &channel["encoding"]),
            (&json!(schema), &json!(encoding)),
            "{topic}"
        );
    }
    let first = |topic: &str| &messages[topic][0];
    let near = |nanos: u64, stamp: i64| nanos.abs_diff(stamp.unsigned_abs()) < 2_000;

    let data = first("/cameras/wrist/image");
    let image = CompressedImage::decode(&data.payload[..]).expect("an image");
    assert_eq!(
        (image.format.as_str(), image.frame_id.as_str()),
        ("jpeg", "camera/wrist")
    );
    let picture = image::load_from_memory(&image.data)
        .expect("a JPEG file")
        .into_rgb8();
    assert!(
        picture.dimensions() == (64, 48)
            && picture.pixels().all(|pixel| pixel.0[0].abs_diff(200) < 3)
    );
    let stamp = image.timestamp.expect("a stamp").total_nanos();
    assert!(
        stamp == data.log_nanos && near(stamp, IMAGE_STAMP),
        "{stamp}"
    );

    let calibration = CameraCalibration::decode(&first("/cameras/wrist/calibration").payload[..])
        .expect("intrinsics");
    assert_eq!(
        calibration.k,
        [60.0, 0.0, 32.0, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0]
    );
    assert_eq!((calibration.width, calibration.height), (64, 48));

    let data = first("/joint_states");
    let joint_states = JointStates::decode(&data.payload[..]).expect("joint states");
    let names: Vec<_> = joint_states
        .joints
        .iter()
        .map(|joint| joint.name.clone())
        .collect();
    let positions: Vec<_> = joint_states
        .joints
        .iter()
        .filter_map(|joint| joint.position)
        .collect();
    assert_eq!(
        (names, positions),
        (
            robot::description().joint_names,
            robot::state(0.5).positions
        )
    );
    assert!(near(data.log_nanos, STATE_STAMP), "{}", data.log_nanos);

    let data = first("/keyframes");
    let keyframes = PosesInFrame::decode(&data.payload[..]).expect("poses");
    let position = keyframes.poses[0].position.expect("a position");
    assert_eq!(
        (
            position.x,
            position.y,
            position.z,
            keyframes.frame_id.as_str()
        ),
        (0.4, -0.2, 0.9, "world")
    );
    assert!(near(data.log_nanos, KEYFRAME_STAMP), "{}", data.log_nanos);

    let metrics: Value = serde_json::from_slice(&first("/metrics").payload).expect("JSON");
    assert_eq!(
        (&metrics["step"], &metrics["psnr"], &metrics["state"]),
        (&json!(70), &json!(24.5), &json!("training"))
    );

    check_tree(&messages["/tf"]);
    drop(server);
    assert!(!hub.needs_live_images(), "nobody is connected any longer");
}

/// Every frame has one parent, and the root of all is the world.
fn check_tree(transforms: &[Data]) {
    let mut parents: BTreeMap<String, String> = BTreeMap::new();
    let mut poses = BTreeMap::new();
    for data in transforms {
        for transform in FrameTransforms::decode(&data.payload[..])
            .expect("transforms")
            .transforms
        {
            let rotation = transform.rotation.expect("a rotation");
            let norm =
                rotation.x.powi(2) + rotation.y.powi(2) + rotation.z.powi(2) + rotation.w.powi(2);
            assert!((norm - 1.0).abs() < 1e-9);
            let child = transform.child_frame_id.clone();
            let parent = parents
                .entry(child.clone())
                .or_insert_with(|| transform.parent_frame_id.clone());
            assert_eq!(
                *parent, transform.parent_frame_id,
                "{child} has two parents"
            );
            poses.insert(child, transform);
        }
    }
    let description = robot::description();
    for frame in description
        .robot
        .links()
        .iter()
        .map(String::as_str)
        .chain(["camera/wrist"])
    {
        let root =
            std::iter::successors(Some(frame), |frame| parents.get(*frame).map(String::as_str))
                .last();
        assert_eq!(root, Some("world"), "{frame}");
    }
    let rotation = poses["camera/wrist"].rotation.expect("a rotation");
    assert!(
        (rotation.z - 0.35_f64.sin()).abs() < 1e-9 && (rotation.w - 0.35_f64.cos()).abs() < 1e-9
    );
}

#[test]
fn used_port_and_public_address_are_rejected() {
    let server = FoxgloveServer::start(LOOPBACK.into(), Hub::new()).expect("a free port exists");
    let error = FoxgloveServer::start(server.address(), Hub::new())
        .expect_err("taken")
        .to_string();
    assert!(error.contains(&server.address().to_string()), "{error}");
    let address = server.address();
    drop(server);
    drop(FoxgloveServer::start(address, Hub::new()).expect("the port is free again"));
    let error = FoxgloveServer::start(([0, 0, 0, 0], 0).into(), Hub::new()).expect_err("public");
    assert!(
        matches!(error, Error::FoxgloveNotLoopback { .. }) && error.to_string().contains("ssh -L"),
        "{error}"
    );
}
