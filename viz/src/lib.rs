//! The web viewer: a render server and its web page.
//!
//! The training thread publishes to a [`Hub`], which never blocks it. A [`Server`] sends the hub's data to browsers
//! over one port. `docs/reference/protocol.md` describes the messages.
//!
//! ```
//! use viz::{Hub, Status};
//!
//! let hub = Hub::new();
//! hub.set_status(Status { state: "training".to_owned(), seconds: 1.5, ..Status::default() });
//! assert_eq!(hub.n_clients(), 0);
//! assert!(hub.next_request().is_none(), "nobody requests a picture yet");
//! ```

mod access;
mod admission;
mod base_path;
mod broadcast;
mod certificate;
mod chunk_list;
mod chunk_sender;
mod client_log;
mod client_updates;
mod clock;
mod compact_depth;
mod edit;
mod error;
#[cfg(feature = "foxglove")]
mod foxglove_server;
mod hub;
mod jpeg;
mod keyframe_log;
mod keyframe_points;
mod link_rate;
#[cfg(any(test, fuzzing))]
mod message_checks;
mod negotiation;
mod observation_map;
mod page;
mod picture;
mod picture_times;
mod pose;
mod positions;
mod protocol;
mod queue;
mod range_scan;
mod robot;
mod server;
mod server_context;
mod server_message;
mod session;
mod subscriptions;
mod tls;
mod updates;
mod view_request;
mod viewpoint;
mod writer;

pub use access::{Role, Token, Tokens};
pub use certificate::Certificate;
pub use edit::{EditAction, EditRequest};
pub use error::Error;
#[cfg(feature = "foxglove")]
pub use foxglove_server::FoxgloveServer;
pub use hub::{Hub, PendingRender};
pub use observation_map::{ObservationMap, ObservedCell};
pub use picture_times::{NewestKeyframe, ShownPicture, TrainedKeyframes};
pub use protocol::{BASE_PROTOCOL_VERSION, Control, PROTOCOL_VERSION};
pub use range_scan::RangeScan;
pub use robot::{MeshFormat, RobotDescription, RobotMesh, RobotState};
pub use server::{Server, ServerConfig, Sharing};
pub use updates::{Guidance, KeyframePose, LiveImage, LivePixels, ModelStatus, RunResult, SceneHint, Status};

/// Handles the messages of a client, one per line, and panics if a result is inconsistent.
#[cfg(fuzzing)]
pub fn check_session(session: &str) {
    message_checks::check_session(session);
}
