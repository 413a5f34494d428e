//! Cameras of the kernel's `Video4Linux2`: webcams, capture cards, and depth cameras without their makers' software.
//!
//! `abi.rs` is the kernel's interface, `device.rs` the only place that crosses into it; `format.rs` and `controls.rs` are tables
//! of what cameras offer and how they are set; `running.rs` moves bytes, `camera.rs` survives an unplugged cable.

mod abi;
mod camera;
mod controls;
mod device;
mod find;
mod format;
mod problem;
mod running;
mod sequence;

pub use camera::{Counts, V4l2Camera};
pub use controls::Settings;
pub use find::{Found, cameras};
pub use format::{Mode, Rates, Sizes, V4l2Format, summary};
pub use problem::Problem;

use kinematics::Intrinsics;
use std::time::Duration;

/// What a rig file says of a V4L2 camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// A path (best a link under `/dev/v4l`, whose name stays), a serial number on USB, or where it is plugged in as the
    /// kernel tells (`usb-0000:00:14.0-2`).
    pub device: String,
    /// Pixel format; `None` takes the first that is offered at this size and rate, see [`V4l2Format::OF_COLOR`].
    pub format: Option<V4l2Format>,
    /// Lens and size of the images.
    pub intrinsics: Intrinsics,
    /// Images a second.
    pub rate_hz: f64,
    /// Metres per count of depth; needed for [`V4l2Format::Z16`].
    pub metres_per_count: Option<f64>,
    /// Exposure, gain, white balance, brightness.
    pub settings: Settings,
    /// Which image a slow caller gets.
    pub delivery: Delivery,
    /// How long a camera that was lost is looked for.
    pub reconnect_for: Duration,
}

/// Which of several waiting images is delivered next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The oldest: none is lost as long as the caller keeps up on the whole.
    Every,
    /// The newest; older ones count as skipped.
    Newest,
}

/// Sets a control of a device by the kernel's number, beside whoever streams from it: for tests that provoke faults.
///
/// Fails with the kernel's answer.
pub fn set_control(node: &std::path::Path, id: u32, value: i32) -> std::io::Result<()> {
    Ok(device::Device::open(node)?.set_control(id, value)?)
}

/// The value of such a control.
pub fn control(node: &std::path::Path, id: u32) -> std::io::Result<i32> {
    Ok(device::Device::open(node)?.control_value(id)?)
}
