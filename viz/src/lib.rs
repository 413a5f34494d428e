//! The web viewer: a render server and its web page.
//!
//! The training thread publishes to a [`Hub`], which never blocks it. A [`Server`] sends the hub's
//! data to browsers over one port. `docs/reference/protocol.md` describes the messages.
//!
//! ```
//! use viz::{Hub, Status};
//!
//! let hub = Hub::new();
//! hub.set_status(Status { state: "training".to_owned(), seconds: 1.5, ..Status::default() });
//! assert_eq!(hub.n_clients(), 0);
//! assert!(hub.pictures().next_request().is_none(), "nobody requests a picture yet");
//! ```

mod client;
mod clock;
mod demands;
mod edit;
mod error;
#[cfg(feature = "foxglove")]
mod foxglove_server;
mod hub;
mod operator_requests;
mod pictures;
mod pose;
mod server;
mod steering;
mod topics;
mod workspace;

pub use client::keyframe_image::ReadKeyframe;
pub use client::protocol::{BASE_PROTOCOL_VERSION, Control, PROTOCOL_VERSION};
pub use edit::{EditAction, EditRequest};
pub use error::Error;
#[cfg(feature = "foxglove")]
pub use foxglove_server::FoxgloveServer;
pub use hub::Hub;
pub use keyframe::{LiveImage, LivePixels, RangeScan, RobotState};
pub use operator_requests::{ControlRequest, OperatorRequests};
pub use pictures::picture_requests::{PendingRender, PictureRequests};
pub use pictures::picture_times::{NewestKeyframe, ShownPicture, TrainedKeyframes};
pub use server::access::{Role, Token, Tokens};
pub use server::certificate::Certificate;
pub use server::downloads::{OpenFile, ServedFile, publish_files};
pub use server::served_page::{CertificateSource, PageOptions, ServedPage};
pub use server::{Server, ServerConfig, ServerThread, Sharing};
pub use steering::arm_description::{ArmDescription, BaseAvoidance, BaseDescription, SteeredJoint};
pub use steering::preview::{Preview, PreviewVerdict};
pub use steering::request::{
    PreviewGoal, PreviewRequest, ReceivedRequest, RefusedRequest, SteeringCommand, SteeringIntent,
    SteeringRequest,
};
pub use steering::state::{
    AppliedCommand, AppliedLimit, LimitEffect, LimitLink, SteeredBaseState, SteeredPart,
    SteeringState,
};
pub use steering::steering_server::{SteeringServer, publish_steering};
pub use topics::edit_status::{ErasedBox, LastEdit, SavedEdits};
pub use topics::keyframes::PublishedKeyframes;
pub use topics::model_chunks::PublishedChunks;
pub use topics::observations::{ObservationMap, ObservedCell};
pub use topics::operator_status::{
    Advice, CheckpointState, ConnectedClient, Identity, ImageCounts, KeyframeStore, OperatorStatus,
    RequestedCheckpoint,
};
pub use topics::photograph_coverage::{CoverageItem, ImagePartCoverage, PhotographCoverage};
pub use topics::preview_status::{DeviceState, DeviceStatus, PreviewStatus};
pub use topics::published_data::{
    FileLink, Grade, Guidance, KeyframePose, ModelSource, ModelStatus, RunResult, SceneBounds,
    SceneHint, SourceKind, StateProgress, Status, Verdict,
};
pub use topics::robot_description::{MeshFormat, RobotDescription, RobotMesh};
pub use workspace::Workspace;

/// Handles the messages of a client, one per line, and panics if a result is inconsistent.
#[cfg(fuzzing)]
pub fn check_messages(messages: &str) {
    client::message_checks::check_messages(messages);
}

/// Handles the messages of a client that steers, one per line, and panics if a result is
/// inconsistent.
#[cfg(fuzzing)]
pub fn check_steering_messages(messages: &str) {
    steering::message_checks::check_messages(messages);
}
