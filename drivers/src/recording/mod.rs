//! Recordings: samples to an MCAP file and back, bit for bit and in the same order.
//!
//! Which topic holds what, and why nothing is lost, is told in `docs/reference/recording.md`.

mod reader;
mod record;
mod records;
mod topic;
mod writer;

pub use reader::Recording;
pub use writer::{About, Recorder};

/// The rig file of a recording, an attachment.
pub const RIG_FILE: &str = "rig.toml";

/// The robot's description, an attachment.
pub const URDF_FILE: &str = "robot.urdf";
