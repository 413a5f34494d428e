//! What a rig file says of a camera; and its controls from beside, for tests that provoke faults.

use super::{Delivery, Settings, V4l2Format, device};
use kinematics::Intrinsics;
use std::path::Path;
use std::time::Duration;

/// What a rig file says of a V4L2 camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// A path (best a link under `/dev/v4l`, whose name stays), a serial number on USB, or where it is plugged in as the
    /// kernel tells (`usb-0000:00:14.0-2`).
    pub device: String,
    /// Pixel format; `None` takes the first that is offered at this size and rate, see [`V4l2Format::COLOR_FORMATS`].
    pub format: Option<V4l2Format>,
    /// Lens and size of the images.
    pub intrinsics: Intrinsics,
    /// Images a second.
    pub rate_hz: f64,
    /// Metres per count of depth; needed for [`V4l2Format::Z16`].
    pub meters_per_count: Option<f64>,
    /// Exposure, gain, white balance, brightness.
    pub settings: Settings,
    /// Which image a slow caller gets.
    pub delivery: Delivery,
    /// How long a camera that was lost is looked for.
    pub reconnect_for: Duration,
}

/// Sets a control of a device by the kernel's number, beside whoever streams from it: for tests that provoke faults.
///
/// Fails with the kernel's answer.
pub fn set_control(node: &Path, id: u32, value: i32) -> std::io::Result<()> {
    Ok(device::Device::open(node)?.set_control(id, value)?)
}

/// The value of such a control.
pub fn control(node: &Path, id: u32) -> std::io::Result<i32> {
    Ok(device::Device::open(node)?.control_value(id)?)
}
