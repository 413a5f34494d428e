//! Cameras of the kernel's `Video4Linux2`: webcams, capture cards, and depth cameras without their makers' software.
//!
//! `abi.rs` is the kernel's interface, `device.rs` the only place that crosses into it; `format.rs` and `controls.rs` are tables
//! of what cameras offer and how they are set; `stream.rs` moves bytes, `camera.rs` survives an unplugged cable. Elsewhere than on
//! Linux only the names are there, which rig files have everywhere.

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
pub use camera::{Counts, V4l2Camera};
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

/// Which of several waiting images is delivered next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The oldest: none is lost as long as the caller keeps up on the whole.
    Every,
    /// The newest; older ones count as skipped.
    Newest,
}
