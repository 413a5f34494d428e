//! Webcams by way of `nokhwa`: macOS's `AVFoundation`, Windows's Media Foundation, V4L2 where that is wanted.
//!
//! A call for an image may never return, and cannot be broken off: `worker.rs` makes it on a thread of its own, `camera.rs` watches
//! over it, leaves a thread that hangs behind and begins anew. Images are the device's own bytes. Their numbers are not told:
//! `gap_estimator.rs` estimates from stamps how many were lost.

mod camera;
mod gap_estimator;
mod worker;

pub use camera::{Counts, NokhwaCamera};

use crate::v4l2::{Delivery, V4l2Format};
use kinematics::Intrinsics;
use std::time::Duration;

/// What a rig file says of such a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Name in the rig file.
    pub name: String,
    /// The camera's own name or a part of it, its number, or on Linux the path of its node or of a link to it.
    pub device: String,
    /// Pixel format; `None` takes the first that is offered at this size and rate.
    pub format: Option<V4l2Format>,
    /// Lens and size of the images.
    pub intrinsics: Intrinsics,
    /// Images a second, a whole number.
    pub rate_hz: f64,
    /// Exposure of each image, microseconds, where it is known; the camera is not told.
    pub exposure_micros: Option<f64>,
    /// Which image a slow caller gets.
    pub delivery: Delivery,
    /// How long a camera that was lost is looked for.
    pub reconnect_for: Duration,
}

/// What is wrong with such a camera.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// Nothing that is plugged in goes by this name.
    #[error("no camera goes by {device:?}; there are: {connected}")]
    NoDevice {
        /// Name of the rig file.
        device: String,
        /// Names and numbers of those that are plugged in.
        connected: String,
    },
    /// Its format cannot be read here.
    #[error("{format} cannot be had from nokhwa: mjpeg, yuyv, nv12, rgb and bgr can")]
    Format {
        /// Name of the format.
        format: &'static str,
    },
    /// The rate is no whole number.
    #[error("rate_hz is {rate_hz}, nokhwa sets whole numbers only")]
    Rate {
        /// That of the rig file.
        rate_hz: f64,
    },
    /// It does not stream as wanted.
    #[error("{requested} cannot be had: {reason}")]
    Refused {
        /// Format, size and rate.
        requested: String,
        /// What nokhwa says.
        reason: String,
    },
    /// An image could not be had from a camera that streamed.
    #[error("it is unplugged, or as good as that: {reason}")]
    Unplugged {
        /// What nokhwa says.
        reason: String,
    },
    /// A call has not come back for too long, and was left alone.
    #[error("a call to {what} has not come back for {waited:.1?} and was left behind")]
    Hung {
        /// What was asked for.
        what: &'static str,
        /// For how long.
        waited: Duration,
    },
    /// So many calls hang that no further one is made.
    #[error("{n_abandoned_threads} calls hang; plug the camera in anew, or end the program")]
    TooManyAbandoned {
        /// How many.
        n_abandoned_threads: usize,
    },
    /// It did not come back in time.
    #[error("not there again after {waited:.1?} and {n_tries} tries: {last}")]
    Lost {
        /// Since it was lost.
        waited: Duration,
        /// Tries to open it.
        n_tries: u32,
        /// What the last one said.
        last: Box<Self>,
    },
}
