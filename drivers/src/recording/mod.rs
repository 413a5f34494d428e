//! Recordings: samples to an MCAP file and back, bit for bit and in the same order.
//!
//! `docs/reference/recording.md` lists the topics and describes what a crash or a full disk leaves readable.

mod reader;
mod record;
mod records;
mod topic;
mod writer;

pub use reader::Recording;
pub use writer::{Recorder, RecordingMetadata};

/// The rig file of a recording, an attachment.
pub const RIG_FILE: &str = "rig.toml";

/// The robot's description, an attachment.
pub const URDF_FILE: &str = "robot.urdf";
