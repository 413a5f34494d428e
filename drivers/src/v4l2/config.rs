//! Configuration of a V4L2 camera, and access to its controls for tests that provoke faults.

use super::{Delivery, Settings, V4l2Format, device};
use kinematics::Intrinsics;
use std::path::Path;
use std::time::Duration;

/// Configuration of a V4L2 camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// A path, a USB serial number, or the port as reported by the kernel (`usb-0000:00:14.0-2`).
    /// The best path is a link under `/dev/v4l`, because its name is stable.
    pub device: String,
    /// Pixel format. `None` selects the first of [`V4l2Format::COLOR_FORMATS`] that is available at
    /// this size and rate.
    pub format: Option<V4l2Format>,
    /// Lens parameters and size of the images.
    pub intrinsics: Intrinsics,
    /// Images per second.
    pub rate_hz: f64,
    /// Meters per count of depth. It is required for [`V4l2Format::Z16`].
    pub meters_per_count: Option<f64>,
    /// Exposure, gain, white balance, brightness.
    pub settings: Settings,
    /// Selects the image that the next call returns if the caller is slow.
    pub delivery: Delivery,
    /// Maximum time for reconnecting to a camera.
    pub reconnect_for: Duration,
}

/// Sets a control of a device by its kernel id, even while another process streams from the device.
/// Tests use it to provoke faults.
///
/// # Errors
/// Fails if the kernel rejects the value.
pub fn set_control(node: &Path, id: u32, value: i32) -> std::io::Result<()> {
    Ok(device::Device::open(node)?.set_control(id, value)?)
}

/// Reads a control of a device by its kernel id.
pub fn control(node: &Path, id: u32) -> std::io::Result<i32> {
    Ok(device::Device::open(node)?.control_value(id)?)
}
