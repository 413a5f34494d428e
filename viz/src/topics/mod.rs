//! The kinds of data that clients receive besides pictures.

pub(crate) mod base_path;
pub(crate) mod broadcast;
pub(crate) mod chunk_list;
pub(crate) mod chunk_sender;
pub(crate) mod client_updates;
pub(crate) mod keyframe_log;
pub(crate) mod keyframe_points;
pub(crate) mod observation_map;
mod positions;
pub(crate) mod range_scan;
pub(crate) mod robot;
pub(crate) mod subscriptions;
pub(crate) mod updates;
