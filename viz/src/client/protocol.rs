//! The messages from clients, as in `docs/reference/protocol.md`.

use crate::server::access::Role;
use serde::{Deserialize, Serialize};

/// Newest protocol version of the server.
pub const PROTOCOL_VERSION: u32 = 4;

/// Protocol version of a connection whose client has not negotiated another one. It is also the
/// oldest version that the server supports.
pub const BASE_PROTOCOL_VERSION: u32 = 3;

/// Maximum length of a client's text message, bytes. The longest ones, render requests, have about
/// 1 kB.
pub(crate) const MAX_MESSAGE_BYTES: usize = 64 * 1024;

/// Maximum rate that clients can subscribe to. It limits the work that a single client can cause.
pub(crate) const MAX_RATE_HZ: f64 = 100.0;

/// Maximum number of keyframes in a `keyframe_changes` message. Text messages are not split into
/// parts, so urgent messages wait until a text message is sent. 32 keyframes take about 20 kB. With
/// a smaller maximum, a long list would take more messages.
pub(crate) const MAX_CHANGED_KEYFRAMES: usize = 32;

/// Messages from clients.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum ClientMessage {
    /// Protocol versions and capabilities of the client.
    Hello(ClientHello),
    /// Requests a picture and replaces the previous request for the same view.
    Render(Box<RenderMessage>),
    /// Sets how often a topic is sent, and at which size.
    Subscribe(SubscribeMessage),
    /// Controls the run.
    Control(ControlMessage),
    /// Reports when a picture was shown.
    Shown(ShownMessage),
    /// Requests the photograph of a keyframe.
    KeyframeImage(KeyframeImageMessage),
    /// Edits a model.
    Edit(EditMessage),
    /// Requests the server's time.
    Ping(ClientPing),
    /// The client disconnects.
    Goodbye(ClientGoodbye),
}

impl ClientMessage {
    /// The role that a client needs to send this message. A message that changes the run requires
    /// an operator.
    pub(crate) fn required_role(&self) -> Role {
        // The match has no wildcard, so that the compiler asks for the role of every new message.
        match self {
            Self::Hello(_)
            | Self::Render(_)
            | Self::Subscribe(_)
            | Self::Shown(_)
            | Self::KeyframeImage(_)
            | Self::Ping(_)
            | Self::Goodbye(_) => Role::Viewer,
            Self::Control(_) | Self::Edit(_) => Role::Operator,
        }
    }
}

/// Fields of a client's `hello`. Unknown fields are ignored, because newer clients may send more.
#[derive(Debug, Default, Deserialize)]
pub(crate) struct ClientHello {
    /// The only version of a client that supports no other.
    pub(crate) protocol: Option<u32>,
    /// Oldest and newest version of the client.
    pub(crate) protocols: Option<[u32; 2]>,
    /// Capabilities that the client wants to use.
    #[serde(default)]
    pub(crate) capabilities: Vec<String>,
}

/// Fields of `subscribe`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SubscribeMessage {
    /// Name of the topic.
    pub(crate) topic: String,
    /// Maximum rate; 0 ends the subscription.
    pub(crate) rate_hz: f64,
    /// Camera whose images are sent. If absent, the subscription applies to all cameras that have
    /// no separate subscription.
    pub(crate) camera: Option<String>,
    /// Maximum size of images.
    pub(crate) size_px: Option<[u32; 2]>,
    /// The model whose chunks are sent.
    pub(crate) method: Option<String>,
    /// Maximum rate of changed chunks.
    pub(crate) max_bytes_per_sec: Option<f64>,
}

/// Fields of `control`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ControlMessage {
    /// What the run should do.
    pub(crate) action: Control,
}

/// An action of an operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// Stops training; keyframes are still accepted.
    Pause,
    /// Continues training.
    Resume,
    /// Writes a checkpoint.
    Save,
}

/// Fields of `shown`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ShownMessage {
    /// Number of the request.
    pub(crate) id: u64,
    /// View of the request.
    pub(crate) view: Option<String>,
    /// When its last stage was shown, on the server's clock.
    pub(crate) shown_millis: f64,
}

/// Fields of `keyframe_image`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KeyframeImageMessage {
    /// Number chosen by the client and repeated in the reply.
    pub(crate) id: u64,
    /// Number of the keyframe in `keyframe_changes`.
    pub(crate) keyframe: u64,
    /// Maximum size; larger photographs are downscaled.
    pub(crate) size_px: Option<[u32; 2]>,
}

/// Fields of `edit`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EditMessage {
    /// What to do.
    pub(crate) action: EditKind,
    /// The box to erase.
    #[serde(rename = "box")]
    pub(crate) erased_box: Option<BoxMessage>,
    /// The model to edit; the first if absent.
    pub(crate) method: Option<String>,
    /// Number chosen by the client, repeated in the reply if the edit fails.
    pub(crate) id: Option<u64>,
}

/// Kinds of edits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum EditKind {
    /// Erases the part of the model in a box.
    Erase,
    /// Erases small unconnected parts.
    RemoveFloaters,
    /// Undoes the last edit.
    Undo,
    /// Makes the last undone edit again.
    Redo,
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
    /// Name of the view; requests for other views are independent.
    pub(crate) view: Option<String>,
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
    pub(crate) crop: Option<BoxMessage>,
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
pub(crate) struct BoxMessage {
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
    /// 16-bit counts at half the picture's size. Each count is the nearest depth of 2x2 pixels.
    #[default]
    U16Half,
    /// Logarithmic counts at half the picture's size, compressed: see `compact_depth.rs`.
    CompactHalf,
    /// 32-bit floats at the picture's size, unchanged from the model.
    F32,
}
