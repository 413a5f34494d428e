//! What can be wrong with a V4L2 camera, and what to do about it.

use std::path::PathBuf;
use std::time::Duration;

/// What is wrong with a V4L2 camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// Nothing that is plugged in goes by this name.
    #[error("no V4L2 camera goes by {device:?}: `fieldrig devices` lists those that are plugged in")]
    NoDevice {
        /// Path, serial number or place of the rig file.
        device: String,
    },
    /// Several cameras go by this name.
    #[error("several cameras go by {device:?} ({nodes:?}): name the port instead, by a link of /dev/v4l/by-path")]
    Ambiguous {
        /// Serial number or place of the rig file.
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
        /// Why.
        source: std::io::Error,
    },
    /// The node is of another kind.
    #[error(
        "{path:?} gives no images by streaming: one camera may have several nodes, the first is mostly that of images"
    )]
    NotACamera {
        /// The node.
        path: PathBuf,
    },
    /// It does not offer what is asked for.
    #[error("it does not offer {requested}; it offers {offered}")]
    NoMode {
        /// Format, size and rate of the rig file.
        requested: String,
        /// All that it has.
        offered: String,
    },
    /// It offers something, but does otherwise.
    #[error("asked for {requested}, it gives {got}")]
    OtherMode {
        /// Asked for.
        requested: String,
        /// Told back.
        got: String,
    },
    /// Depth without a scale.
    #[error("its depth counts need camera.NAME.depth.meters_per_count in the rig file (0.001 for a RealSense D4xx)")]
    NoDepthScale,
    /// Another program holds it.
    #[error("another program uses it: `fuser -v {}` names it", path.display())]
    Busy {
        /// The node.
        path: PathBuf,
    },
    /// The kernel found no room for the stream on USB.
    #[error(
        "USB has no bandwidth left for {mode}{}: choose v4l2.format = \"mjpeg\", a smaller size or a lower rate, or plug it into a port of another USB controller (`lsusb -t` shows them)",
        bytes_per_sec.map_or(String::new(), |bytes| format!(" ({:.0} MB/s)", bytes / 1e6))
    )]
    Bandwidth {
        /// Format, size and rate.
        mode: String,
        /// What it needs, where compression does not decide.
        bytes_per_sec: Option<f64>,
    },
    /// A request failed.
    #[error("it refuses to {what}: {source}")]
    Refused {
        /// What was asked.
        what: &'static str,
        /// Why.
        source: std::io::Error,
    },
    /// The rig file sets something that the camera does not have.
    #[error("it has no control for {control}: leave the key out")]
    NoControl {
        /// Name of the key.
        control: &'static str,
    },
    /// The rig file sets something to a value that the camera does not know.
    #[error("{control} is {requested}, it takes {min} to {max} in steps of {step}")]
    ControlRange {
        /// Name of the key.
        control: &'static str,
        /// Asked for, in the units of the key.
        requested: f64,
        /// Least.
        min: f64,
        /// Most.
        max: f64,
        /// Step.
        step: f64,
    },
    /// It took a setting and tells another one.
    #[error("{control} was set to {requested} and reads {got}")]
    ReadBack {
        /// Name of the control.
        control: &'static str,
        /// What was set, counts of the device.
        requested: i32,
        /// What it tells, counts of the device.
        got: i32,
    },
    /// It was unplugged.
    #[error("it was unplugged ({source})")]
    Unplugged {
        /// What the kernel says.
        source: std::io::Error,
    },
    /// It sends nothing.
    #[error("it sent no whole image for {waited:?}")]
    Silent {
        /// How long.
        waited: Duration,
    },
    /// It went away and did not come back in time.
    #[error("it was lost, and not there again after {waited:?} and {n_tries} tries: {last}")]
    Lost {
        /// Since when.
        waited: Duration,
        /// How often it was tried.
        n_tries: u32,
        /// What came of the last try.
        last: Box<Self>,
    },
}
