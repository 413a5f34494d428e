//! RealSense cameras by their maker's library (librealsense2), and files that it recorded.
//!
//! What a rig file says of them (`config.rs`, `problem.rs`) is there always; the rest needs the cargo feature `realsense`.
//! `sdk.rs` is the part of the library that `realsense-rust` leaves out, `lens.rs` and `stamps.rs` say what its numbers mean,
//! `options.rs` sets a camera up; `session.rs` moves bytes, `camera.rs` survives an unplugged cable. `emulated/` writes files as a
//! simulated camera.

mod config;
mod problem;

#[cfg(feature = "realsense")]
mod camera;
#[cfg(feature = "realsense")]
pub mod emulated;
#[cfg(feature = "realsense")]
mod filters;
#[cfg(feature = "realsense")]
mod find;
#[cfg(feature = "realsense")]
mod lens;
#[cfg(feature = "realsense")]
mod options;
#[cfg(feature = "realsense")]
mod sdk;
#[cfg(feature = "realsense")]
mod session;
#[cfg(feature = "realsense")]
mod stamps;
#[cfg(feature = "realsense")]
mod streams;

#[cfg(feature = "realsense")]
pub use camera::{Counts, RealsenseCamera};
pub use config::{Config, Filter, Pace, Settings, Stream};
#[cfg(feature = "realsense")]
pub use find::{FoundCamera, cameras};
pub use problem::Problem;
#[cfg(feature = "realsense")]
pub use streams::{Calibration, DepthCalibration};
