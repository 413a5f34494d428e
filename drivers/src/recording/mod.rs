//! Writes samples to an MCAP file, and reads them back bit for bit and in the same order.
//!
//! `docs/reference/recording.md` lists the topics and describes which samples remain readable after
//! a crash or with a full disk.

mod meshes;
mod reader;
mod record;
mod records;
mod topic;
mod writer;

pub use meshes::{MAX_MESH_BYTES, compress_mesh, decompress_mesh, mesh_attachment};
pub use reader::Recording;
pub use writer::{Recorder, RecordingMetadata};

/// Name of the attachment with the rig file.
pub const RIG_FILE: &str = "rig.toml";

/// Name of the attachment with the robot description (URDF).
pub const URDF_FILE: &str = "robot.urdf";
