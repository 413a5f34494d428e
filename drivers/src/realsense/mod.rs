//! RealSense cameras through librealsense2, and files recorded by it.
//!
//! Configuration and problems (`config.rs`, `problem.rs`) are always compiled. All other files need
//! the cargo feature `realsense`. `sdk.rs` wraps the part of the library that `realsense-rust`
//! lacks. `find.rs` lists cameras. `lens.rs` and `stamps.rs` convert lens parameters and time
//! stamps. `options.rs` applies settings, `streams.rs` selects and opens streams, and `filters.rs`
//! filters depth. `image_stream.rs` converts frames to images. `camera.rs` handles disconnections.
//! `emulated/` writes the files of an emulated camera (cargo feature `emulation`).

mod config;
mod problem;

#[cfg(feature = "realsense")]
mod camera;
#[cfg(all(feature = "emulation", feature = "realsense"))]
pub mod emulated;
#[cfg(feature = "realsense")]
mod filters;
#[cfg(feature = "realsense")]
mod find;
#[cfg(feature = "realsense")]
mod image_stream;
#[cfg(feature = "realsense")]
mod lens;
#[cfg(feature = "realsense")]
mod options;
#[cfg(feature = "realsense")]
mod sdk;
#[cfg(feature = "realsense")]
mod stamps;
#[cfg(feature = "realsense")]
mod streams;

#[cfg(feature = "realsense")]
pub use camera::RealsenseCamera;
pub use config::{Config, Filter, Pace, Settings, Stream};
#[cfg(feature = "realsense")]
pub use find::{FoundCamera, cameras};
pub use problem::Problem;
#[cfg(feature = "realsense")]
pub use streams::{Calibration, DepthCalibration};
