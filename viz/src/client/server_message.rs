//! The messages from the server, as in `docs/reference/protocol.md`.

use crate::client::protocol::{DepthFormat, ProjectionMessage};
use crate::clock::ServerClock;
use crate::pose::row_major;
use crate::server::access::Role;
use crate::topics::published_data::{KeyframePose, PublishedScene, SceneBounds, Status};
use crate::topics::robot_description::{RobotMessage, RobotStateMessage};
use axum::extract::ws::Message;
use keyframe::LiveImage;
use serde::Serialize;
use trainer::ChunkLayout;

/// JSON text messages from the server.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum ServerMessage<'a> {
    /// First message of a connection.
    Hello {
        protocol: u32,
        protocols: [u32; 2],
        capabilities: &'a [&'a str],
        server: &'a str,
        client: u64,
        role: Role,
        max_size_px: [u32; 2],
        default_stages: &'a [f64],
        clock_millis: f64,
        /// Whether the server has a workspace with which pages start.
        has_workspace: bool,
    },
    /// Reply to the client's hello: the version and the capabilities that the connection uses from
    /// now on.
    Welcome {
        protocol: u32,
        capabilities: Vec<&'static str>,
    },
    /// Status of the run.
    Status(&'a Status),
    /// Scene extent and initial view.
    Scene {
        center_m: [f64; 3],
        radius_m: f64,
        world_from_camera: [f64; 16],
        #[serde(skip_serializing_if = "Option::is_none")]
        bounds: Option<SceneBounds>,
    },
    /// Poses of all stored keyframes.
    Keyframes { keyframes: Vec<KeyframeMessage<'a>> },
    /// Keyframes that were added, changed or removed since a version of the list.
    KeyframeChanges {
        from_version: u64,
        version: u64,
        keyframes: Vec<NumberedKeyframe<'a>>,
        removed: Vec<u64>,
    },
    /// Links, joints and shapes of the robot.
    Robot(&'a RobotMessage<'a>),
    /// Joint positions and base pose of the robot.
    RobotState(RobotStateMessage),
    /// Positions of a moving base so far.
    BasePath {
        /// In world, oldest first.
        points_m: Vec<[f64; 3]>,
        /// Indices of the points to which the base has not driven from the previous point.
        line_starts: Vec<usize>,
    },
    /// The message of the topic in `topics/test_topic.rs`.
    #[cfg(test)]
    Weather { celsius: f64 },
    /// Chunks of a model that no longer exist.
    ModelChunksRemoved { method: &'a str, ids: Vec<u64> },
    /// Reason why a message was invalid or a picture failed.
    Error {
        id: Option<u64>,
        #[serde(skip_serializing_if = "Option::is_none")]
        view: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        keyframe: Option<u64>,
        message: &'a str,
    },
    /// Sent at a fixed rate, so that silence indicates a broken connection.
    Heartbeat { clock_millis: f64 },
    /// Reply to a client's `ping`.
    Pong { t: f64, clock_millis: f64 },
    /// Ends the connection.
    Goodbye { reason: &'a str },
}

/// One keyframe of `keyframes`.
#[derive(Debug, Serialize)]
pub(crate) struct KeyframeMessage<'a> {
    camera: &'a str,
    world_from_camera: [f64; 16],
    size_px: [u32; 2],
    focal_px: [f64; 2],
    principal_px: [f64; 2],
}

impl<'a> From<&'a KeyframePose> for KeyframeMessage<'a> {
    fn from(keyframe: &'a KeyframePose) -> Self {
        Self {
            camera: &keyframe.camera,
            world_from_camera: row_major(&keyframe.world_from_camera),
            size_px: keyframe.size_px,
            focal_px: keyframe.focal_px,
            principal_px: keyframe.principal_px,
        }
    }
}

/// One keyframe of `keyframe_changes`.
#[derive(Debug, Serialize)]
pub(crate) struct NumberedKeyframe<'a> {
    id: u64,
    stamp_nanos: i64,
    #[serde(flatten)]
    keyframe: KeyframeMessage<'a>,
}

impl<'a> NumberedKeyframe<'a> {
    /// A keyframe with its number.
    pub(crate) fn new(id: u64, keyframe: &'a KeyframePose) -> Self {
        Self {
            id,
            stamp_nanos: keyframe.stamp.0,
            keyframe: keyframe.into(),
        }
    }
}

impl From<&PublishedScene> for ServerMessage<'_> {
    fn from(PublishedScene { hint, bounds }: &PublishedScene) -> Self {
        Self::Scene {
            center_m: hint.center_m,
            radius_m: hint.radius_m,
            world_from_camera: row_major(&hint.world_from_camera),
            bounds: *bounds,
        }
    }
}

/// Header of a binary message.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum BinaryHeader<'a> {
    /// A rendered picture.
    Picture(&'a PictureHeader),
    /// The current image of a camera.
    LiveImage(&'a LiveHeader<'a>),
    /// Points of a keyframe.
    KeyframePoints(PointsHeader),
    /// The photograph of a keyframe.
    KeyframeImage(&'a KeyframeImageHeader<'a>),
    /// A scan of a range scanner.
    RangeScan(RangeScanHeader<'a>),
    /// When and how precisely each part of the scene was observed.
    Observations(ObservationsHeader),
    /// A chunk of a model.
    ModelChunk(&'a ChunkHeader<'a>),
    /// A part of a binary message.
    Part(PartHeader),
}

/// Header of `keyframe_points`.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct PointsHeader {
    pub(crate) id: u64,
    pub(crate) n_points: usize,
    pub(crate) meters_per_count: f64,
}

/// Header of `keyframe_image`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct KeyframeImageHeader<'a> {
    pub(crate) id: u64,
    pub(crate) keyframe: u64,
    pub(crate) camera: &'a str,
    pub(crate) stamp_nanos: i64,
    pub(crate) size_px: [u32; 2],
    pub(crate) full_size_px: [u32; 2],
    /// Name of the split.
    pub(crate) split: &'static str,
    pub(crate) has_depth: bool,
    /// Row-major pose before the corrections that the model has estimated.
    pub(crate) reported_world_from_camera: [f64; 16],
    /// Speed of the camera at the stamp; `None` if unknown.
    pub(crate) speed_m_s: Option<f64>,
    pub(crate) turn_rad_s: Option<f64>,
    pub(crate) readout_secs: f64,
    pub(crate) color: ColorPart,
    /// `None` if all pixels are valid.
    pub(crate) mask: Option<MaskPart>,
}

/// Position of the valid pixels of a photograph in the payload.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct MaskPart {
    pub(crate) offset: usize,
    pub(crate) bytes: usize,
}

/// Header of `range_scan`.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct RangeScanHeader<'a> {
    pub(crate) scanner: &'a str,
    pub(crate) stamp_nanos: i64,
    pub(crate) captured_millis: f64,
    pub(crate) origin_m: [f64; 3],
    pub(crate) n_points: usize,
    pub(crate) meters_per_count: f64,
}

/// Header of `observations`.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct ObservationsHeader {
    pub(crate) min_m: [f64; 3],
    pub(crate) cell_m: f64,
    pub(crate) n_cells: [u32; 3],
    pub(crate) n_keyframes: usize,
    pub(crate) newest_millis: Option<f64>,
    pub(crate) min_age_secs: f64,
    pub(crate) min_sigma_m: f64,
    pub(crate) log_step: f64,
}

/// Header of `model_chunk`.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct ChunkHeader<'a> {
    pub(crate) method: &'a str,
    pub(crate) id: u64,
    pub(crate) is_coarse: bool,
    pub(crate) n_chunks: usize,
    pub(crate) n_incomplete: usize,
    pub(crate) n_unsent: usize,
    pub(crate) n_incomplete_in_view: Option<usize>,
    pub(crate) n_unsent_in_view: Option<usize>,
    pub(crate) world_from_model: [f64; 16],
    #[serde(flatten)]
    pub(crate) layout: ChunkLayout,
}

/// Header of `part`.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct PartHeader {
    pub(crate) message: u64,
    pub(crate) offset: usize,
    pub(crate) bytes: usize,
}

/// Header of `picture`.
#[derive(Debug, Serialize)]
pub(crate) struct PictureHeader {
    pub(crate) id: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) view: Option<String>,
    pub(crate) stage: usize,
    pub(crate) n_stages: usize,
    pub(crate) scale: f64,
    pub(crate) last: bool,
    pub(crate) size_px: [u32; 2],
    pub(crate) full_size_px: [u32; 2],
    /// The model that was drawn, and its number of steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) method: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) step: Option<u64>,
    pub(crate) world_from_camera: [f64; 16],
    pub(crate) projection: ProjectionMessage,
    pub(crate) near_m: f64,
    pub(crate) far_m: f64,
    pub(crate) waited_millis: f64,
    pub(crate) render_millis: f64,
    pub(crate) encode_millis: Option<f64>,
    pub(crate) keyframes: Option<u64>,
    pub(crate) newest_keyframe: Option<NewestKeyframeMessage>,
    pub(crate) sent_millis: f64,
    pub(crate) color: Option<ColorPart>,
    pub(crate) depth: Option<DepthPart>,
}

/// Times of the keyframe that was added last to the model of a picture, on the server's clock.
#[derive(Debug, Serialize)]
pub(crate) struct NewestKeyframeMessage {
    pub(crate) captured_millis: f64,
    pub(crate) added_millis: f64,
}

/// Position of the color in the payload.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct ColorPart {
    pub(crate) format: &'static str,
    pub(crate) offset: usize,
    pub(crate) bytes: usize,
}

/// Position of the depth in the payload, and its encoding.
#[derive(Debug, Serialize)]
pub(crate) struct DepthPart {
    pub(crate) format: DepthFormat,
    pub(crate) size_px: [u32; 2],
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) meters_per_count: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) min_m: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) log_step: Option<f64>,
    pub(crate) offset: usize,
    pub(crate) bytes: usize,
}

/// Header of `live_image`.
#[derive(Debug, Serialize)]
pub(crate) struct LiveHeader<'a> {
    camera: &'a str,
    stamp_nanos: i64,
    captured_millis: f64,
    size_px: [u32; 2],
    format: &'static str,
    world_from_camera: Option<[f64; 16]>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
}

impl<'a> LiveHeader<'a> {
    /// The header of an image that is sent at `size_px`.
    pub(crate) fn new(image: &'a LiveImage, size_px: [u32; 2], clock: ServerClock) -> Self {
        // The page computes with the intrinsics of the image that it gets.
        let scale = [0, 1].map(|axis| f64::from(size_px[axis]) / f64::from(image.size_px[axis]));
        let scaled = |values: [f64; 2]| [values[0] * scale[0], values[1] * scale[1]];
        Self {
            camera: &image.camera,
            stamp_nanos: image.stamp.0,
            captured_millis: clock.millis(image.captured_at),
            size_px,
            format: "jpeg",
            world_from_camera: image.world_from_camera.as_ref().map(row_major),
            focal_px: scaled(image.focal_px),
            principal_px: scaled(image.principal_px),
        }
    }
}

impl ServerMessage<'_> {
    /// The message.
    pub(crate) fn to_message(&self) -> Message {
        Message::text(self.to_json())
    }

    /// The message as JSON.
    pub(crate) fn to_json(&self) -> String {
        serde_json::to_string(self)
            .expect("these types hold only strings, numbers and maps with string keys")
    }
}

/// A binary message: header length as little-endian u32, JSON header, payload.
pub(crate) fn frame(header: &BinaryHeader<'_>, payload: &[&[u8]]) -> Vec<u8> {
    // The length comes first, because the end of JSON cannot be found without parsing it.
    let header = serde_json::to_vec(header).expect("these types hold only strings and numbers");
    let n_header = u32::try_from(header.len()).expect("a header has some hundred bytes");
    let n_payload: usize = payload.iter().map(|part| part.len()).sum();
    let mut bytes = Vec::with_capacity(4 + header.len() + n_payload);
    bytes.extend_from_slice(&n_header.to_le_bytes());
    bytes.extend_from_slice(&header);
    for part in payload {
        bytes.extend_from_slice(part);
    }
    bytes
}
