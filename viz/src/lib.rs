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
mod clock;
mod error;
mod hub;
mod jpeg;
mod page;
mod picture;
mod pose;
mod protocol;
mod queue;
mod server;
mod session;
mod updates;
mod view_request;

pub use error::Error;
pub use hub::{Hub, PendingRender};
pub use protocol::PROTOCOL_VERSION;
pub use server::{Server, ServerConfig};
pub use updates::{KeyframePose, LiveImage, LivePixels, ModelStatus, RunResult, SceneHint, Status};
