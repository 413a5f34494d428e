//! The messages of `docs/reference/protocol.md` as serialized on the wire.

use crate::clock::ServerClock;
use crate::pose::row_major;
use crate::updates::{KeyframePose, LiveImage, SceneHint, Status};
use serde::{Deserialize, Serialize};

/// Protocol version. Clients with another version are disconnected.
pub const PROTOCOL_VERSION: u32 = 3;

/// Maximum length of a client's text message, bytes.
pub(crate) const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// Messages from clients.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum ClientMessage {
    /// Protocol version of the client.
    Hello(ClientHello),
    /// Requests a picture and replaces the client's previous request.
    Render(Box<RenderMessage>),
    /// Requests the server's time.
    Ping(ClientPing),
    /// The client disconnects.
    Goodbye(ClientGoodbye),
}

/// Fields of a client's `hello`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ClientHello {
    /// See [`PROTOCOL_VERSION`].
    pub(crate) protocol: u32,
}

/// Fields of `ping`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ClientPing {
    /// Repeated in the `pong`.
    pub(crate) t: f64,
}

/// A client's `goodbye` has no fields.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ClientGoodbye {}

/// Fields of `render`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RenderMessage {
    /// Number chosen by the client and repeated in the pictures.
    pub(crate) id: u64,
    /// Requested model; the first if absent.
    pub(crate) method: Option<String>,
    /// Row-major pose.
    pub(crate) world_from_camera: [f64; 16],
    /// Full size, at scale 1.
    pub(crate) size_px: [u32; 2],
    /// Projection from directions to pixels.
    pub(crate) projection: ProjectionMessage,
    /// Linear scales of the full size.
    pub(crate) stages: Option<Vec<f64>>,
    /// Near limit along z.
    pub(crate) near_m: Option<f64>,
    /// Far limit along z.
    pub(crate) far_m: Option<f64>,
    /// Box outside which the scene is not rendered.
    pub(crate) crop: Option<CropMessage>,
    /// Requested outputs.
    pub(crate) outputs: Option<Vec<Output>>,
    /// Encoding of depth; used only with the output `depth`.
    pub(crate) depth_format: Option<DepthFormat>,
    /// Background color, 0 to 1.
    pub(crate) background_srgb: Option<[f32; 3]>,
}

/// Projection from directions to pixels.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum ProjectionMessage {
    /// Either `focal_px` or `vertical_fov_rad`.
    Pinhole {
        /// Pixels of the full size.
        #[serde(skip_serializing_if = "Option::is_none")]
        focal_px: Option<[f64; 2]>,
        /// Pixels of the full size; the center if absent.
        #[serde(skip_serializing_if = "Option::is_none")]
        principal_px: Option<[f64; 2]>,
        /// Angle from the top to the bottom edge, with square pixels.
        #[serde(skip_serializing_if = "Option::is_none")]
        vertical_fov_rad: Option<f64>,
    },
    /// Covers all directions.
    Equirectangular {},
}

/// A box with sides along the axes of its frame.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CropMessage {
    /// Row major; aligned with the world axes if absent.
    pub(crate) world_from_box: Option<[f64; 16]>,
    /// Minimum corner.
    pub(crate) min_m: [f64; 3],
    /// Maximum corner.
    pub(crate) max_m: [f64; 3],
}

/// Outputs of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Output {
    /// JPEG.
    Color,
    /// Meters along z, see [`DepthFormat`].
    Depth,
}

/// Encoding of depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum DepthFormat {
    /// 16-bit counts at half the picture's size; the nearest of each 2x2 pixels.
    #[default]
    U16Half,
    /// 32-bit floats at the picture's size, unchanged from the model.
    F32,
}

/// JSON text messages from the server.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum ServerMessage<'a> {
    /// First message of a connection.
    Hello {
        protocol: u32,
        server: &'a str,
        client: u64,
        max_size_px: [u32; 2],
        default_stages: &'a [f64],
        clock_millis: f64,
    },
    /// Status of the run.
    Status(&'a Status),
    /// Scene extent and initial view.
    Scene { center_m: [f64; 3], radius_m: f64, world_from_camera: [f64; 16] },
    /// Poses of all stored keyframes.
    Keyframes { keyframes: Vec<KeyframeMessage<'a>> },
    /// Reason why a message was invalid or a picture failed.
    Error { id: Option<u64>, message: &'a str },
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

impl From<&SceneHint> for ServerMessage<'_> {
    fn from(hint: &SceneHint) -> Self {
        Self::Scene {
            center_m: hint.center_m,
            radius_m: hint.radius_m,
            world_from_camera: row_major(&hint.world_from_camera),
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
}

/// Header of `picture`.
#[derive(Debug, Serialize)]
pub(crate) struct PictureHeader {
    pub(crate) id: u64,
    pub(crate) stage: usize,
    pub(crate) n_stages: usize,
    pub(crate) scale: f64,
    pub(crate) last: bool,
    pub(crate) size_px: [u32; 2],
    pub(crate) full_size_px: [u32; 2],
    pub(crate) world_from_camera: [f64; 16],
    pub(crate) projection: ProjectionMessage,
    pub(crate) near_m: f64,
    pub(crate) far_m: f64,
    pub(crate) waited_millis: f64,
    pub(crate) render_millis: f64,
    pub(crate) encode_millis: Option<f64>,
    pub(crate) keyframes: Option<u64>,
    pub(crate) color: Option<ColorPart>,
    pub(crate) depth: Option<DepthPart>,
}

/// Position of the color in the payload.
#[derive(Debug, Serialize)]
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
    pub(crate) meters_per_count: f64,
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
    /// The header of an image sent at `size_px`, after dividing its sides by `factor`.
    pub(crate) fn new(image: &'a LiveImage, size_px: [u32; 2], factor: u32, clock: ServerClock) -> Self {
        let scaled_down = |value: f64| value / f64::from(factor);
        Self {
            camera: &image.camera,
            stamp_nanos: image.stamp.0,
            captured_millis: clock.millis(image.captured_at),
            size_px,
            format: "jpeg",
            world_from_camera: image.world_from_camera.as_ref().map(row_major),
            focal_px: image.focal_px.map(scaled_down),
            principal_px: image.principal_px.map(scaled_down),
        }
    }
}

impl ServerMessage<'_> {
    /// The message as JSON.
    pub(crate) fn to_json(&self) -> String {
        serde_json::to_string(self).expect("these types hold only strings, numbers and maps with string keys")
    }
}

/// A binary message: header length as little-endian u32, JSON header, payload.
pub(crate) fn frame(header: &BinaryHeader<'_>, payload: &[&[u8]]) -> Vec<u8> {
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
