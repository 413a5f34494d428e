//! Devices, recordings and datasets behind a few traits; what comes out is stamped samples.

pub mod align;
pub mod can;
pub mod clock;
pub mod dataset;
mod decode;
mod error;
#[cfg(target_os = "linux")]
pub mod franka;
#[cfg(any(test, fuzzing))]
pub mod fuzz;
pub mod jpeg;
mod live;
pub mod motion;
#[cfg(feature = "nokhwa")]
pub mod nokhwa;
#[cfg(any(target_os = "linux", feature = "nokhwa", feature = "realsense"))]
mod outage;
pub mod realsense;
pub mod recording;
mod sample;
pub mod tags;
#[cfg(test)]
#[path = "../../tests/common/test_data.rs"]
mod test_data;
pub mod udp;
pub mod v4l2;
pub mod wire;
mod yuv;

pub use error::{Error, RecordedSpan};
pub use live::{Devices, Live};
pub use motion::MovableArm;
pub use sample::{BasePose, Image, PixelFormat, RangePoint, RangeScan, Sample, TruthImage};
pub use yuv::{V4l2Colors, YuvColors, YuvLayout, YuvMatrix, YuvRange};

use kinematics::{Intrinsics, JointState};
use std::time::Duration;

/// A live source of images from one camera, real, simulated or replayed.
pub trait Camera: Send {
    /// Name in the rig file; also the name of its frame.
    fn name(&self) -> &str;
    /// Lens parameters of the colour image.
    fn intrinsics(&self) -> &Intrinsics;
    /// Waits for the next image this call has not returned yet, in stamp order; colour and depth are told apart by format.
    ///
    /// A slow caller loses the oldest images; the loss is counted in [`Image::n_skipped`]. A camera that was unplugged and is
    /// looked for says [`Error::Reconnecting`], for a bounded time.
    ///
    /// A camera that is played from a file says [`Error::NotDue`] where its next image comes later, and [`Error::Ended`] at the end.
    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error>;
    /// Whether it waits for a slow caller instead of losing images, as a file can that is played as fast as it is taken.
    fn waits_for_caller(&self) -> bool {
        false
    }
}

/// An arm whose joints can be read.
pub trait Arm: Send {
    /// Names of the joints, in the order of the readings.
    fn joint_names(&self) -> &[String];
    /// Waits for the next joint state this call has not returned yet.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error>;
}

/// Whatever tells where the robot's base is.
pub trait Base: Send {
    /// Waits for the next pose this call has not returned yet, in stamp order.
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error>;
}

/// A live source of range scans from one scanner, real, simulated or replayed.
pub trait RangeScanner: Send {
    /// Name in the rig file; also the name of its frame.
    fn name(&self) -> &str;
    /// Waits for the next scan this call has not returned yet, in stamp order; a slow caller loses the oldest.
    fn next_scan(&mut self, timeout: Duration) -> Result<RangeScan, Error>;
}

/// Anything that yields samples of a whole rig in one deterministic order: a recording, a lockstep simulation, live devices.
pub trait Source: Send {
    /// The next sample, in stamp order as far as the devices allow; `None` at the end.
    fn next_sample(&mut self) -> Result<Option<Sample>, Error>;

    /// Joint states, base poses and range scans that came and gave way to newer ones, so far, because the caller was slow.
    fn n_other_samples_dropped(&self) -> u64 {
        0
    }
}
