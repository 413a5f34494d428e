//! Serves the hub's data as topics to Foxglove, on a separate thread and port.

use crate::pictures::picture::live_jpeg;
use crate::topics::keyframes::KeyframePoses;
use crate::topics::live_images::LiveImages;
use crate::topics::published_data::{KeyframePose, Status};
use crate::topics::robot_description::RobotDescription;
use crate::{Error, Hub};
use ::foxglove::messages::{
    CameraCalibration, CompressedImage, FrameTransform, FrameTransforms, JointState, JointStates,
    Pose, PosesInFrame, Quaternion, Timestamp, Vector3,
};
use ::foxglove::{
    Channel, ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, Schema,
    WebSocketServer,
};
use keyframe::LiveImage;
use keyframe::RobotState;
use kinematics::urdf::{Joint, JointKind};
use kinematics::{Stamp, Transform};
use nalgebra::{Translation3, UnitQuaternion};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::sync::watch;

/// Period of checking whether a client is connected. With a longer period, the first image comes
/// later.
const CLIENT_CHECK_PERIOD: Duration = Duration::from_millis(200);
/// Keyframes and metrics are repeated with this period, because Foxglove sends only what comes
/// after a subscription.
const REPEAT_PERIOD: Duration = Duration::from_secs(1);
/// Number of messages that may wait for a client. Older messages are dropped. With more messages, a
/// slow client would show older data.
const MAX_WAITING: usize = 64;
/// The frame of all poses.
const WORLD: &str = "world";
/// Schema of the metrics.
const METRICS_SCHEMA: &str = r#"{"type": "object", "properties": {
    "state": {"type": "string"}, "seconds": {"type": "number"}, "keyframes": {"type": "integer"},
    "method": {"type": "string"}, "step": {"type": "integer"}, "step_millis": {"type": ["number", "null"]},
    "primitives": {"type": "integer"}, "bytes": {"type": "integer"}, "psnr": {"type": ["number", "null"]}}}"#;

/// A running server for Foxglove. Dropping it closes all connections and frees the port.
#[derive(Debug)]
pub struct FoxgloveServer {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl FoxgloveServer {
    /// Starts listening on a loopback address, and serves the hub's data until dropped.
    pub fn start(address: SocketAddr, hub: Hub) -> Result<Self, Error> {
        if !address.ip().is_loopback() {
            return Err(Error::FoxgloveNotLoopback { address });
        }
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|source| Error::Thread { source })?;
        let (started_sender, started) = sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("viz-foxglove".to_owned())
            .spawn(move || {
                runtime.block_on(serve(address, &hub, &started_sender, stopped));
                // Does not wait for images that are still being encoded.
                runtime.shutdown_background();
            })
            .map_err(|source| Error::Thread { source })?;
        let port = match started.recv() {
            Ok(Ok(port)) => port,
            Ok(Err(error)) => {
                return Err(Error::Foxglove {
                    address,
                    reason: error.to_string(),
                });
            }
            Err(_) => {
                return Err(Error::Foxglove {
                    address,
                    reason: "its thread panicked".to_owned(),
                });
            }
        };
        Ok(Self {
            address: SocketAddr::new(address.ip(), port),
            stop,
            thread: Some(thread),
        })
    }

    /// The URL to open in Foxglove.
    pub fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    /// The actual address, with the selected port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for FoxgloveServer {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if self
            .thread
            .take()
            .is_some_and(|thread| thread.join().is_err())
        {
            log::error!("the Foxglove server on {} panicked", self.address);
        }
    }
}

/// Reports whether listening has begun, and publishes topics until the server stops.
async fn serve(
    address: SocketAddr,
    hub: &Hub,
    started: &SyncSender<Result<u16, FoxgloveError>>,
    mut stopped: watch::Receiver<bool>,
) {
    // The server does not use the context of the process, because all servers would share it.
    let context = Context::new();
    let server = WebSocketServer::new()
        .name(concat!("fieldrig ", env!("CARGO_PKG_VERSION")))
        .bind(address.ip().to_string(), address.port())
        .message_backlog_size(MAX_WAITING)
        .context(&context);
    let handle = match server.start().await {
        Ok(handle) => handle,
        Err(error) => return drop(started.send(Err(error))),
    };
    drop(started.send(Ok(handle.port())));
    let topics = Topics::new(&context, hub);
    tokio::select! {
        () = watch_clients(hub, || handle.client_count()) => {}
        () = publish_images(&topics) => {}
        () = publish_robot(&topics) => {}
        () = publish_lists(&topics) => {}
        _ = stopped.changed() => {}
    }
    // Otherwise, the run would continue to decode images for nobody.
    hub.set_observed(false);
    drop(handle.stop());
}

/// Makes the run publish images and robot states while a client is connected. Never returns.
async fn watch_clients(hub: &Hub, n_clients: impl Fn() -> usize) {
    loop {
        hub.set_observed(n_clients() > 0);
        tokio::time::sleep(CLIENT_CHECK_PERIOD).await;
    }
}

/// The topics that exist in every run.
struct Topics {
    context: Arc<Context>,
    hub: Hub,
    transforms: Channel<FrameTransforms>,
    joint_states: Channel<JointStates>,
    keyframes: Channel<PosesInFrame>,
    metrics: Arc<RawChannel>,
}

impl Topics {
    fn new(context: &Arc<Context>, hub: &Hub) -> Self {
        let builder = |topic: &str| ChannelBuilder::new(topic).context(context);
        let metrics = builder("/metrics")
            .message_encoding("json")
            .schema(Schema::new(
                "fieldrig.Metrics",
                "jsonschema",
                METRICS_SCHEMA.as_bytes(),
            ))
            .build_raw()
            .expect("it has a message encoding");
        Self {
            context: Arc::clone(context),
            hub: hub.clone(),
            transforms: builder("/tf").build(),
            joint_states: builder("/joint_states").build(),
            keyframes: builder("/keyframes").build(),
            metrics,
        }
    }
}

/// The topics of a camera.
struct CameraTopics {
    image: Channel<CompressedImage>,
    calibration: Channel<CameraCalibration>,
    published: Option<Stamp>,
}

impl CameraTopics {
    fn new(context: &Arc<Context>, camera: &str) -> Self {
        let topic =
            |name: &str| ChannelBuilder::new(format!("/cameras/{camera}/{name}")).context(context);
        Self {
            image: topic("image").build(),
            calibration: topic("calibration").build(),
            published: None,
        }
    }
}

/// Publishes each new image with the calibration and pose of its camera. Never returns.
async fn publish_images(topics: &Topics) {
    let mut cameras: BTreeMap<Arc<str>, CameraTopics> = BTreeMap::new();
    let mut live_images = topics.hub.latest::<LiveImages>().subscribe();
    live_images.mark_changed();
    while live_images.changed().await.is_ok() {
        let images: Vec<Arc<LiveImage>> =
            live_images.borrow_and_update().values().cloned().collect();
        for image in images {
            let camera = cameras
                .entry(Arc::clone(&image.camera))
                .or_insert_with(|| CameraTopics::new(&topics.context, &image.camera));
            // A new image of one camera changes the map of all cameras.
            if camera.published.replace(image.stamp) == Some(image.stamp) {
                continue;
            }
            camera
                .calibration
                .log_with_time(&calibration(&image), nanos(image.stamp));
            if let Some(world_from_camera) = &image.world_from_camera {
                let transform = frame_transform(
                    image.stamp,
                    WORLD,
                    &camera_frame(&image.camera),
                    world_from_camera,
                );
                topics.transforms.log_with_time(
                    &FrameTransforms {
                        transforms: vec![transform],
                    },
                    nanos(image.stamp),
                );
            }
            // Calibration and pose are cheap, but encoding is not.
            if !camera.image.has_sinks() {
                continue;
            }
            let source = Arc::clone(&image);
            let encoded = tokio::task::spawn_blocking(move || {
                live_jpeg(&source, source.size_px).map(Cow::into_owned)
            });
            match encoded.await {
                Ok(Ok(jpeg)) => camera.image.log_with_time(
                    &CompressedImage {
                        timestamp: Some(timestamp(image.stamp)),
                        frame_id: camera_frame(&image.camera),
                        data: jpeg.into(),
                        format: "jpeg".to_owned(),
                    },
                    nanos(image.stamp),
                ),
                Ok(Err(error)) => log::warn!("live image of camera {:?}: {error}", image.camera),
                Err(error) => log::error!("cannot encode an image for Foxglove: {error}"),
            }
        }
    }
}

/// Publishes joint states and the poses of all links. Never returns.
async fn publish_robot(topics: &Topics) {
    let mut states = topics.hub.latest::<Option<Arc<RobotState>>>().subscribe();
    states.mark_changed();
    while states.changed().await.is_ok() {
        let state = states.borrow_and_update().clone();
        let description = topics
            .hub
            .latest::<Option<Arc<RobotDescription>>>()
            .borrow()
            .clone();
        let (Some(state), Some(description)) = (state, description) else {
            continue;
        };
        let joints = description.joint_names.iter().zip(&state.positions);
        let joint_states = JointStates {
            timestamp: Some(timestamp(state.stamp)),
            joints: joints
                .map(|(name, position)| joint_state(name, *position))
                .collect(),
        };
        topics
            .joint_states
            .log_with_time(&joint_states, nanos(state.stamp));
        let transforms = link_transforms(&description, &state);
        topics
            .transforms
            .log_with_time(&FrameTransforms { transforms }, nanos(state.stamp));
    }
}

fn joint_state(name: &str, position: f64) -> JointState {
    JointState {
        name: name.to_owned(),
        position: Some(position),
        ..JointState::default()
    }
}

/// Publishes keyframes and metrics after every change, and again from time to time. Never returns.
async fn publish_lists(topics: &Topics) {
    let mut keyframes = topics.hub.latest::<KeyframePoses>().subscribe();
    let mut status = topics.hub.latest::<Option<Arc<Status>>>().subscribe();
    let mut repeat = tokio::time::interval(REPEAT_PERIOD);
    repeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        let (has_keyframes, has_status) = tokio::select! {
            _ = repeat.tick() => (true, true),
            Ok(()) = keyframes.changed() => (true, false),
            Ok(()) = status.changed() => (false, true),
        };
        // The list has no own stamp, so it gets the stamp of its newest keyframe.
        if has_keyframes {
            let keyframes = keyframes.borrow_and_update().clone();
            let newest = keyframes
                .iter()
                .map(|keyframe| keyframe.stamp)
                .max()
                .unwrap_or_default();
            topics
                .keyframes
                .log_with_time(&poses_in_frame(&keyframes, newest), nanos(newest));
        }
        if has_status && let Some(status) = status.borrow_and_update().clone() {
            let time = PartialMetadata::with_log_time(nanos(newest_stamp(&topics.hub)));
            topics
                .metrics
                .log_with_meta(metrics(&status).as_bytes(), time);
        }
    }
}

/// Stamp of the newest image or robot state. It is used for metrics, which have no own stamp.
fn newest_stamp(hub: &Hub) -> Stamp {
    let images = hub.latest::<LiveImages>();
    let of_images = images.borrow().values().map(|image| image.stamp).max();
    let of_robot = hub
        .latest::<Option<Arc<RobotState>>>()
        .borrow()
        .as_ref()
        .map(|state| state.stamp);
    of_images.max(of_robot).unwrap_or_default()
}

fn metrics(status: &Status) -> String {
    let model = &status.model;
    serde_json::json!({
        "state": status.state, "seconds": status.seconds, "keyframes": status.keyframes, "method": model.method,
        "step": model.step, "step_millis": model.step_millis, "primitives": model.primitives, "bytes": model.bytes,
        "psnr": model.psnr,
    })
    .to_string()
}

fn poses_in_frame(keyframes: &[KeyframePose], newest: Stamp) -> PosesInFrame {
    PosesInFrame {
        timestamp: Some(timestamp(newest)),
        frame_id: WORLD.to_owned(),
        poses: keyframes
            .iter()
            .map(|keyframe| pose(&keyframe.world_from_camera))
            .collect(),
    }
}

fn pose(transform: &Transform) -> Pose {
    let (position, orientation) = parts(transform);
    Pose {
        position: Some(position),
        orientation: Some(orientation),
    }
}

/// The pinhole part of the lens.
fn calibration(image: &LiveImage) -> CameraCalibration {
    let [fx, fy] = image.focal_px;
    let [cx, cy] = image.principal_px;
    CameraCalibration {
        timestamp: Some(timestamp(image.stamp)),
        frame_id: camera_frame(&image.camera),
        width: image.size_px[0],
        height: image.size_px[1],
        // Pixel centers are at integers in Foxglove, as in ROS. The matrices are row-major.
        k: vec![fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![
            fx,
            0.0,
            cx - 0.5,
            0.0,
            0.0,
            fy,
            cy - 0.5,
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ],
        ..CameraCalibration::default()
    }
}

/// The pose of the root link in the world, and of every other link in its parent.
fn link_transforms(description: &RobotDescription, state: &RobotState) -> Vec<FrameTransform> {
    let robot = &description.robot;
    let in_parent = |joint: &Joint| parent_from_child(joint, description, &state.positions);
    let mut transforms: Vec<FrameTransform> = robot
        .joints()
        .iter()
        .map(|joint| frame_transform(state.stamp, &joint.parent, &joint.child, &in_parent(joint)))
        .collect();
    // The states have the pose of the base link, but the tree of transforms begins at the root.
    let path = robot
        .root()
        .and_then(|root| Ok((root, robot.path(root, &description.base_link)?)));
    match path {
        Ok((root, joints)) => {
            let root_from_base = joints
                .into_iter()
                .map(in_parent)
                .fold(Transform::identity(), |a, b| a * b);
            let world_from_root = state.world_from_base * root_from_base.inverse();
            transforms.push(frame_transform(state.stamp, WORLD, root, &world_from_root));
        }
        Err(error) => log::debug!("cannot publish the pose of the robot: {error}"),
    }
    transforms
}

fn parent_from_child(
    joint: &Joint,
    description: &RobotDescription,
    positions: &[f64],
) -> Transform {
    let measured = |name: &str| measured_position(name, description, positions);
    // Joints that are not measured stay at 0, as on the page.
    let position = match &joint.mimic {
        Some(mimic) => mimic.multiplier * measured(&mimic.source).unwrap_or(0.0) + mimic.offset,
        None => measured(&joint.name).unwrap_or(0.0),
    };
    let motion = match joint.kind {
        JointKind::Fixed | JointKind::Unsupported(_) => Transform::identity(),
        JointKind::Revolute => {
            let rotation = UnitQuaternion::from_axis_angle(&joint.axis, position);
            Transform::from_parts(Translation3::identity(), rotation)
        }
        JointKind::Prismatic => Translation3::from(position * joint.axis.into_inner()).into(),
    };
    joint.parent_from_joint * motion
}

/// The position of a joint in a state; `None` if it is not measured.
fn measured_position(name: &str, description: &RobotDescription, positions: &[f64]) -> Option<f64> {
    let ix = description
        .joint_names
        .iter()
        .position(|other| other == name)?;
    positions.get(ix).copied()
}

fn frame_transform(
    stamp: Stamp,
    parent: &str,
    child: &str,
    parent_from_child: &Transform,
) -> FrameTransform {
    let (translation, rotation) = parts(parent_from_child);
    FrameTransform {
        timestamp: Some(timestamp(stamp)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(translation),
        rotation: Some(rotation),
    }
}

fn parts(transform: &Transform) -> (Vector3, Quaternion) {
    let translation = transform.translation.vector;
    let rotation = transform.rotation.coords;
    let position = Vector3 {
        x: translation.x,
        y: translation.y,
        z: translation.z,
    };
    (
        position,
        Quaternion {
            x: rotation.x,
            y: rotation.y,
            z: rotation.z,
            w: rotation.w,
        },
    )
}

fn camera_frame(camera: &str) -> String {
    format!("camera/{camera}")
}

/// Nanoseconds of a stamp. Foxglove has no negative times, and clocks of fieldrig have none either.
fn nanos(stamp: Stamp) -> u64 {
    u64::try_from(stamp.0).unwrap_or(0)
}

fn timestamp(stamp: Stamp) -> Timestamp {
    const NANOS_PER_SEC: u64 = 1_000_000_000;
    let nanos = nanos(stamp);
    let sec = u32::try_from(nanos / NANOS_PER_SEC).unwrap_or(u32::MAX);
    let nsec = u32::try_from(nanos % NANOS_PER_SEC).unwrap_or_default();
    Timestamp::new_checked(sec, nsec).unwrap_or(Timestamp::MAX)
}
