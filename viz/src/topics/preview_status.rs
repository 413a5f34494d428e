//! The part of a status that describes the devices of a rig while nothing is trained.

use serde::Serialize;

/// What a preview shows besides images and the robot.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PreviewStatus {
    /// The devices of the rig, in a fixed order.
    pub devices: Vec<DeviceStatus>,
}

/// A device that is read, or that cannot be read.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DeviceStatus {
    /// Name for display, such as `camera "wrist"` or `arm`.
    pub name: String,
    /// Whether it delivers samples.
    pub state: DeviceState,
    /// Samples per second over the last seconds; `None` if too few samples arrived.
    pub rate_hz: Option<f64>,
    /// Samples per second according to the rig file; `None` if the rig file does not say.
    pub expected_hz: Option<f64>,
    /// Time since the newest sample was captured, milliseconds; `None` before the first sample.
    pub age_millis: Option<f64>,
    /// Why there are no samples, in one sentence; empty if samples arrive.
    pub reason: String,
}

/// Whether a device delivers samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceState {
    /// It is being opened, or has not delivered its first sample.
    #[default]
    Opening,
    /// Samples arrive.
    Delivering,
    /// It is open, but no samples have arrived for a while.
    Silent,
    /// It cannot be opened, or has failed. It is tried again and again.
    Failed,
    /// The simulation, or the file that stands for the device, has ended.
    Ended,
}
