//! Devices, recordings and datasets as sources of stamped samples, behind a few traits.
//!
//! A program without a driver can send base poses, joint states and range scans as UDP datagrams:
//!
//! ```
//! use drivers::wire::datagram::{Clock, DatagramHeader, PoseDatagram, decode_pose, encode_pose};
//! use kinematics::Transform;
//!
//! let header = DatagramHeader { seq: 1, clock: Clock::Monotonic, stamp_nanos: 1_000_000_000 };
//! let pose = PoseDatagram { header, world_from_base: Transform::translation(1.0, 2.0, 0.0), covariance: None };
//! assert_eq!(decode_pose(&encode_pose(&pose))?, pose);
//! # Ok::<(), drivers::wire::Malformed>(())
//! ```

pub mod align;
pub mod base_motion;
pub mod can;
pub mod clock;
mod datagrams;
pub mod dataset;
mod decode;
pub mod device_names;
mod error;
mod flange_difference;
#[cfg(target_os = "linux")]
pub mod franka;
#[cfg(any(test, fuzzing))]
pub mod fuzz;
#[cfg(feature = "nokhwa")]
mod gap_estimator;
pub mod jpeg;
mod live_devices;
pub mod motion;
mod network_address;
#[cfg(feature = "nokhwa")]
pub mod nokhwa;
#[cfg(any(target_os = "linux", feature = "nokhwa", feature = "realsense"))]
mod outage;
mod playback;
pub mod realsense;
#[cfg(any(target_os = "linux", feature = "nokhwa", feature = "realsense"))]
mod reconnecting;
pub mod recording;
mod repeating;
mod sample;
#[cfg(test)]
mod scripted;
#[cfg(target_os = "linux")]
pub mod servos;
pub mod tags;
pub mod udp;
#[cfg(target_os = "linux")]
pub mod ur;
pub mod v4l2;
pub mod wire;
mod yuv;

pub use base_motion::MovableBase;
pub use error::{Error, RecordedSpan};
pub use flange_difference::FlangeDifference;
pub use live_devices::{Devices, LiveDevices};
pub use motion::MovableArm;
pub use network_address::NetworkAddress;
pub use playback::{Playback, PlaybackClock};
#[cfg(any(target_os = "linux", feature = "nokhwa", feature = "realsense"))]
pub use reconnecting::CameraCounts;
pub use repeating::Repeating;
pub use sample::{BasePose, Image, PixelFormat, RangePoint, RangeScan, Sample, TruthImage};
pub use yuv::{V4l2Colors, YuvColors, YuvLayout, YuvMatrix, YuvRange};

use kinematics::{Intrinsics, JointState};
use std::time::Duration;

/// A live source of images from one camera, real, simulated or replayed.
pub trait Camera: Send {
    /// Name in the rig file; also the name of its frame.
    fn name(&self) -> &str;
    /// Lens parameters of the color image.
    fn intrinsics(&self) -> &Intrinsics;
    /// Waits for the next image that was not returned yet, in stamp order. The format distinguishes
    /// color and depth.
    ///
    /// If the caller is too slow, the oldest images are dropped and counted in
    /// [`Image::n_skipped`].
    ///
    /// # Errors
    /// [`Error::NoImage`] if no image arrives within `timeout`. [`Error::Reconnecting`] while the
    /// driver tries to reconnect to the camera; the driver gives up after a time limit. A camera
    /// that is played back from a file returns [`Error::NotDue`] if its next image is due later. It
    /// returns [`Error::Ended`] after its last image. A simulated camera returns
    /// [`Error::SimulationLags`] if the image is late because the computer is too slow.
    fn next_image(&mut self, timeout: Duration) -> Result<Image, Error>;
    /// Whether the camera waits for a slow caller instead of dropping images. A file that is read
    /// as fast as possible, for example, waits for its caller.
    fn waits_for_caller(&self) -> bool {
        false
    }
}

/// An arm whose joints can be read.
pub trait Arm: Send {
    /// Names of the joints, in the order of the values of a joint state.
    fn joint_names(&self) -> &[String];
    /// Waits for the next joint state that was not returned yet.
    fn read(&mut self, timeout: Duration) -> Result<JointState, Error>;
    /// Difference between the flange poses of the robot description and of the controller, when the
    /// arm was opened. `None` if the device reports only joints.
    fn flange_difference(&self) -> Option<FlangeDifference> {
        None
    }
}

/// A source of poses of the robot's base.
pub trait Base: Send {
    /// Waits for the next pose that was not returned yet, in stamp order.
    fn next_pose(&mut self, timeout: Duration) -> Result<BasePose, Error>;
}

/// A live source of range scans from one scanner, real, simulated or replayed.
pub trait RangeScanner: Send {
    /// Name in the rig file; also the name of its frame.
    fn name(&self) -> &str;
    /// Waits for the next scan that was not returned yet, in stamp order. If the caller is too
    /// slow, the oldest scans are dropped.
    fn next_scan(&mut self, timeout: Duration) -> Result<RangeScan, Error>;
}

/// A source of all samples of a rig in one deterministic order: a recording, a lockstep simulation
/// or live devices.
pub trait Source: Send {
    /// Returns the next sample, in stamp order as far as the devices allow, or `None` at the end.
    fn next_sample(&mut self) -> Result<Option<Sample>, Error>;

    /// Number of joint states, base poses and range scans dropped so far because the caller was too
    /// slow.
    fn n_other_samples_dropped(&self) -> u64 {
        0
    }

    /// Number of restarts of the source up to the latest sample. The robot's pose jumps at a
    /// restart, so samples before and after it must not be interpolated.
    fn n_restarts(&self) -> u64 {
        0
    }
}
