//! Problems with V4L2 cameras and their remedies.

use std::path::PathBuf;
use std::time::Duration;

/// Problem with a V4L2 camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// No connected camera has this name.
    #[error(
        "no V4L2 camera named {device:?} found: `fieldrig devices` lists the connected cameras"
    )]
    NoDevice {
        /// Path, serial number or bus address in the rig file.
        device: String,
    },
    /// Several cameras have this name.
    #[error(
        "several cameras match {device:?} ({nodes:?}): select one by its port, with a link in /dev/v4l/by-path"
    )]
    Ambiguous {
        /// Serial number or bus address in the rig file.
        device: String,
        /// Their nodes.
        nodes: Vec<PathBuf>,
    },
    /// The node cannot be opened.
    #[error("cannot open {path:?}: {source}{}", if source.kind() == std::io::ErrorKind::PermissionDenied {
        "; run `sudo usermod -aG video $USER`, then log in again"
    } else {
        ""
    })]
    Open {
        /// The node.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The node does not deliver images.
    #[error(
        "{path:?} cannot stream images: a camera may have several nodes; use the first one, which usually delivers images"
    )]
    NotACamera {
        /// The node.
        path: PathBuf,
    },
    /// The device does not support the requested mode.
    #[error("it does not offer {requested}; it offers {offered}")]
    NoMode {
        /// Requested format, size and rate.
        requested: String,
        /// All modes of the device.
        offered: String,
    },
    /// The device selected a mode that differs from the requested mode.
    #[error("requested {requested}, but it selected {got}")]
    OtherMode {
        /// Requested mode.
        requested: String,
        /// Mode reported by the device.
        got: String,
    },
    /// The scale of depth is missing.
    #[error(
        "depth requires camera.NAME.depth.meters_per_count in the rig file (0.001 for a RealSense D4xx)"
    )]
    NoDepthScale,
    /// Another program uses the device.
    #[error("another program uses it: `fuser -v {}` shows which", path.display())]
    Busy {
        /// The node.
        path: PathBuf,
    },
    /// The USB bandwidth is not sufficient for the stream.
    #[error(
        "USB has no bandwidth left for {mode}{}: choose v4l2.format = \"mjpeg\", a smaller size or a lower rate, or a port of another USB controller (`lsusb -t` lists them)",
        bytes_per_sec.map_or(String::new(), |bytes| format!(" ({:.0} MB/s)", bytes / 1e6))
    )]
    Bandwidth {
        /// Format, size and rate.
        mode: String,
        /// Required bandwidth, bytes per second. `None` for compressed formats.
        bytes_per_sec: Option<f64>,
    },
    /// The device rejected a request.
    #[error("it rejected {what}: {source}")]
    Refused {
        /// Subject of the request.
        what: &'static str,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The camera lacks a control that the rig file sets.
    #[error("it has no control for {control}: remove the key")]
    NoControl {
        /// Name of the key.
        control: &'static str,
    },
    /// A setting is outside the range of the camera.
    #[error("{control} is {requested}, allowed: {min} to {max} in steps of {step}")]
    ControlRange {
        /// Name of the key.
        control: &'static str,
        /// Requested value, in the units of the key.
        requested: f64,
        /// Minimum.
        min: f64,
        /// Maximum.
        max: f64,
        /// Step.
        step: f64,
    },
    /// The camera reports a different value after a setting was written.
    #[error("{control} was set to {requested} and reads back as {got}")]
    ReadBack {
        /// Name of the control.
        control: &'static str,
        /// Value that was set, in units of the device.
        requested: i32,
        /// Value that was read back, in units of the device.
        got: i32,
    },
    /// The device was disconnected.
    #[error("it was disconnected ({source})")]
    Unplugged {
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The device delivers no images.
    #[error("it sent no complete image for {waited:?}")]
    Silent {
        /// Time since the last image.
        waited: Duration,
    },
    /// The device disconnected and did not reconnect in time.
    #[error("it disconnected and did not reconnect within {waited:?} ({n_tries} attempts): {last}")]
    Lost {
        /// Time since it disconnected.
        waited: Duration,
        /// Number of attempts to reopen it.
        n_tries: u32,
        /// Problem at the last attempt.
        last: Box<Self>,
    },
}
