//! Cameras of the kernel's `Video4Linux2`: webcams, capture cards, and depth cameras without vendor
//! software.
//!
//! `abi.rs` declares the kernel interface, and only `device.rs` calls it. `config.rs` and
//! `problem.rs` define configuration and errors. `find.rs` lists devices. `format.rs`,
//! `pixel_format.rs` and `controls.rs` select formats and settings. `stream.rs` and `sequence.rs`
//! read images. `camera.rs` handles disconnections. On systems other than Linux, only the names of
//! the formats are available. Rig files need these names on every system.

#[cfg(target_os = "linux")]
mod abi;
#[cfg(target_os = "linux")]
mod camera;
#[cfg(target_os = "linux")]
mod config;
#[cfg(target_os = "linux")]
mod controls;
#[cfg(target_os = "linux")]
mod device;
#[cfg(target_os = "linux")]
mod find;
#[cfg(target_os = "linux")]
mod format;
mod pixel_format;
#[cfg(target_os = "linux")]
mod problem;
#[cfg(target_os = "linux")]
mod sequence;
#[cfg(target_os = "linux")]
mod stream;

#[cfg(target_os = "linux")]
pub use camera::V4l2Camera;
#[cfg(target_os = "linux")]
pub use config::{Config, control, set_control};
#[cfg(target_os = "linux")]
pub use controls::Settings;
#[cfg(target_os = "linux")]
pub use find::{FoundCamera, cameras, check_connected};
#[cfg(target_os = "linux")]
pub use format::{Mode, Rates, Sizes, summary};
pub use pixel_format::V4l2Format;
#[cfg(target_os = "linux")]
pub use problem::Problem;

/// Selects which of several queued images is delivered next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The oldest image. No images are dropped as long as the caller keeps up on average.
    Every,
    /// The newest image. Older images count as skipped.
    Newest,
}
