//! The part of a status that an operator reads first: the robot, the advice, the counts of images,
//! and the connected clients.

use crate::server::access::Role;
use serde::Serialize;

/// The fields of a status for the operator's header. All of them are optional, because saved models
/// and calibrations have only some of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct OperatorStatus {
    /// Which robot and run this is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub identity: Option<Identity>,
    /// What the run does now, and what the operator should do. `None` if the state of the run is
    /// enough.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub advice: Option<Advice>,
    /// Whether the devices send nothing more, so that old images and robot poses are expected.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub input_ended: bool,
    /// What happened to the images of the cameras so far.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub images: Option<ImageCounts>,
    /// How full the store of keyframes is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub store: Option<KeyframeStore>,
    /// The connected clients. The hub fills them in.
    pub clients: Vec<ConnectedClient>,
    /// Whether clients can connect to `/steer`. The hub fills it in.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub steering: bool,
    /// Number of the client that has paused training; `None` if it is not paused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paused_by: Option<u64>,
    /// The last checkpoint that an operator requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint: Option<RequestedCheckpoint>,
    /// The notes of the status that only inform, so that nobody has to act.
    pub infos: Vec<String>,
}

/// Which robot and run a server shows.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Identity {
    /// Name of the rig file without its extension; `None` for saved models.
    pub rig: Option<String>,
    /// Name of the robot in its URDF; `None` without a robot.
    pub robot: Option<String>,
    /// Name of the run folder, or of the folder or file of a saved model.
    pub run: Option<String>,
}

/// One sentence or two about the state of a run, for operators.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Advice {
    /// Such as `Scanning. 7 of 8 images are lost: lower rate_hz of the cameras`.
    pub text: String,
    /// Whether the operator should act, because data are lost or missing.
    pub is_warning: bool,
}

/// What happened to the color images of a run, counted from its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ImageCounts {
    /// Images that arrived.
    pub received: u64,
    /// Images dropped by devices, or because the computer was too slow. They did not arrive.
    pub dropped: u64,
    /// Images that became keyframes.
    pub accepted: u64,
    /// Keyframes that were removed, because the store was full.
    pub evicted: u64,
}

/// How full the store of keyframes is. A new keyframe replaces a similar one in a full store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct KeyframeStore {
    /// Number of keyframes in the store.
    pub keyframes: u64,
    /// Maximum number of keyframes.
    pub max_keyframes: u64,
    /// Memory of the keyframes, bytes.
    pub bytes: u64,
    /// Maximum memory of the keyframes, bytes.
    pub max_bytes: u64,
    /// Whether there is no room for another keyframe.
    pub is_full: bool,
}

/// A client of the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ConnectedClient {
    /// Number of the client, which the server's `hello` contains.
    pub id: u64,
    /// What it may do.
    pub role: Role,
}

/// Progress of a checkpoint that an operator requested.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RequestedCheckpoint {
    /// Whether it is on disk.
    pub state: CheckpointState,
    /// The state in one sentence, such as `checkpoint written after 677 s`.
    pub text: String,
}

/// Whether a checkpoint is on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckpointState {
    /// It is not complete yet.
    Requested,
    /// It is complete.
    Written,
    /// It could not be written.
    Failed,
}
