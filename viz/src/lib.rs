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

mod admission;
mod broadcast;
mod chunk_list;
mod chunk_sender;
mod client_updates;
mod clock;
mod compact_depth;
mod error;
mod hub;
mod jpeg;
mod keyframe_log;
mod keyframe_points;
mod link_rate;
#[cfg(any(test, fuzzing))]
mod message_checks;
mod negotiation;
mod page;
mod picture;
mod pose;
mod protocol;
mod queue;
mod robot;
mod server;
mod server_context;
mod server_message;
mod session;
mod subscriptions;
mod updates;
mod view_request;
mod writer;

pub use error::Error;
pub use hub::{Hub, PendingRender};
pub use protocol::{BASE_PROTOCOL_VERSION, PROTOCOL_VERSION};
pub use robot::{MeshFormat, RobotDescription, RobotMesh, RobotState};
pub use server::{Server, ServerConfig};
pub use updates::{KeyframePose, LiveImage, LivePixels, ModelStatus, RunResult, SceneHint, Status};

/// Handles the messages of a client, one per line, and panics if a result is inconsistent.
#[cfg(fuzzing)]
pub fn check_session(session: &str) {
    message_checks::check_session(session);
}
