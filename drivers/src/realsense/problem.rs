//! Problems with RealSense cameras and their remedies.

use std::path::PathBuf;
use std::time::Duration;

/// Problem with a RealSense camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// A call to the library failed.
    #[error("librealsense2 failed ({what}): {reason}")]
    Library {
        /// Purpose of the call.
        what: &'static str,
        /// Error of the library.
        reason: String,
    },
    /// No camera is connected, or the requested camera is not connected.
    #[error(
        "no RealSense camera {}is connected; found: {}",
        if serial.is_empty() { String::new() } else { format!("with the serial number {serial:?} ") },
        if connected.is_empty() { "none (check with `lsusb -d 8086:` and install the udev rules of the SDK)".to_owned() }
        else { connected.join(", ") }
    )]
    NoDevice {
        /// Serial number in the rig file. It may be empty.
        serial: String,
        /// Names and serial numbers of the connected cameras.
        connected: Vec<String>,
    },
    /// Several cameras are connected, and the rig file does not select one of them.
    #[error("several RealSense cameras are connected: set device = \"SERIAL\" in the rig file to one of {}", connected.join(", "))]
    Ambiguous {
        /// Names and serial numbers of the connected cameras.
        connected: Vec<String>,
    },
    /// A recorded file cannot be read or written.
    #[error("cannot use {path:?}: {reason}")]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the library.
        reason: String,
    },
    /// The camera does not support the requested mode.
    #[error("it does not offer {requested}; it offers {offered}")]
    NoMode {
        /// Requested stream, size and rate.
        requested: String,
        /// All modes of that stream.
        offered: String,
    },
    /// The camera does not support a setting.
    #[error("it does not support {setting}: remove the key")]
    NoSetting {
        /// Name of the key.
        setting: &'static str,
    },
    /// A setting is outside the range of the camera.
    #[error("{setting} is {requested}, allowed: {allowed}")]
    SettingRange {
        /// Name of the key.
        setting: &'static str,
        /// Requested value, in the units of the key.
        requested: String,
        /// Allowed values.
        allowed: String,
    },
    /// The camera reports a different value after a setting was written.
    #[error("{setting} was set to {requested} and reads back as {got}")]
    ReadBack {
        /// Name of the key.
        setting: &'static str,
        /// Value that was set, in units of the camera.
        requested: f32,
        /// Value that was read back.
        got: f32,
    },
    /// The lens model of a stream is not supported.
    #[error("its {stream} stream has the lens model {model}, which is not supported")]
    Lens {
        /// Name of the stream.
        stream: &'static str,
        /// Name of the model in the library.
        model: String,
    },
    /// The camera delivers no images.
    #[error("it sent no image for {waited:?}")]
    Silent {
        /// Time since the last image.
        waited: Duration,
    },
    /// The camera disconnected or hung and did not reconnect in time.
    #[error(
        "it disconnected and did not reconnect within {waited:?} ({n_tries} attempts, {n_resets} resets): {last}"
    )]
    Lost {
        /// Time since it disconnected.
        waited: Duration,
        /// Number of attempts to reopen it.
        n_tries: u32,
        /// Number of resets.
        n_resets: u32,
        /// Problem at the last attempt.
        last: Box<Self>,
    },
}
