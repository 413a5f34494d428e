//! Webcams through `nokhwa`: `AVFoundation` on macOS, Media Foundation on Windows, and optionally
//! V4L2.
//!
//! A call for an image may never return and cannot be canceled. `worker.rs` therefore calls nokhwa
//! on a separate thread. `camera.rs` monitors the thread, abandons it if it hangs, and starts a new
//! one. Images are the unmodified bytes of the device. They have no sequence numbers, so the number
//! of dropped images is estimated from stamps (`gap_estimator.rs` of the crate).

mod camera;
mod worker;

pub use camera::NokhwaCamera;

use crate::v4l2::{Delivery, V4l2Format};
use kinematics::Intrinsics;
use std::time::Duration;

/// Configuration of a nokhwa camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// The device: its name, a part of its name, or its number. On Linux, it may also be the path
    /// of the device node, or of a link to the node.
    pub device: String,
    /// Pixel format. `None` selects the first format that is available at this size and rate.
    pub format: Option<V4l2Format>,
    /// Lens parameters and size of the images.
    pub intrinsics: Intrinsics,
    /// Images per second, an integer.
    pub rate_hz: f64,
    /// Exposure time of each image, microseconds, if known. The driver does not set it on the
    /// camera.
    pub exposure_micros: Option<f64>,
    /// Selects the image that the next call returns if the caller is slow.
    pub delivery: Delivery,
    /// Maximum time for reconnecting to a camera.
    pub reconnect_for: Duration,
}

/// Problems with a nokhwa camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// No connected camera has this name.
    #[error("no camera named {device:?} found; connected cameras: {connected}")]
    NoDevice {
        /// Name in the rig file.
        device: String,
        /// Names and numbers of the connected cameras.
        connected: String,
    },
    /// The pixel format is not supported by this driver.
    #[error(
        "the format {format} is not supported by the nokhwa driver, expected mjpeg, yuyv, nv12, rgb or bgr"
    )]
    Format {
        /// Name of the format.
        format: &'static str,
    },
    /// The rate is not an integer.
    #[error("rate_hz is {rate_hz}, expected an integer for the nokhwa driver")]
    Rate {
        /// Rate in the rig file.
        rate_hz: f64,
    },
    /// The camera cannot stream as requested.
    #[error("cannot start {requested}: {reason}")]
    Refused {
        /// Requested format, size and rate.
        requested: String,
        /// Error of nokhwa.
        reason: String,
    },
    /// Reading an image from a streaming camera failed.
    #[error("it was disconnected or stopped delivering images: {reason}")]
    Unplugged {
        /// Error of nokhwa.
        reason: String,
    },
    /// A call did not return in time and was abandoned.
    #[error("a call to {what} did not return within {waited:.1?} and was abandoned")]
    Hung {
        /// Purpose of the call.
        what: &'static str,
        /// Time spent waiting.
        waited: Duration,
    },
    /// So many calls hang that no further call is started.
    #[error("{n_abandoned_threads} calls hang: reconnect the camera, or restart the program")]
    TooManyAbandoned {
        /// Number of calls that hang.
        n_abandoned_threads: usize,
    },
    /// The camera did not reconnect in time.
    #[error(
        "it disconnected and did not reconnect within {waited:.1?} ({n_tries} attempts): {last}"
    )]
    Lost {
        /// Time since the camera was disconnected.
        waited: Duration,
        /// Number of attempts to reopen it.
        n_tries: u32,
        /// Problem at the last attempt.
        last: Box<Self>,
    },
}
