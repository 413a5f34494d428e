//! The current data of the devices of a robot, for the viewers of a run.

use crate::RangePoints;
use kinematics::{Stamp, Transform};
use std::sync::Arc;
use std::time::Instant;

/// Pixels of a [`LiveImage`], sRGB.
#[derive(Clone, Debug)]
pub enum LivePixels {
    /// A complete JPEG file.
    Jpeg(Arc<[u8]>),
    /// `[height, width, 3]`.
    Rgb(Arc<[u8]>),
    /// `[height, width, 4]`. Alpha is ignored.
    Rgba(Arc<[u8]>),
}

/// The current image of a camera, as received from the device.
#[derive(Clone, Debug)]
pub struct LiveImage {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Mid-exposure.
    pub stamp: Stamp,
    /// Mid-exposure on this process's clock, from which the age of the image is computed.
    ///
    /// Recordings and simulations stamp with other clocks. For them, pass the time at which the
    /// image was read.
    pub captured_at: Instant,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// The pixels, not undistorted.
    pub pixels: LivePixels,
    /// Pose of the camera at the stamp, if known.
    pub world_from_camera: Option<Transform>,
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// Positions of the robot's joints and pose of its base at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotState {
    /// Time of the joint positions or of the base pose, whichever is older.
    pub stamp: Stamp,
    /// The same time on this process's clock, from which the age of the state is computed.
    ///
    /// Recordings and simulations stamp with other clocks. For them, pass the time at which the
    /// state was read.
    pub captured_at: Instant,
    /// Pose of the base link.
    pub world_from_base: Transform,
    /// Joint positions in the order of the rig file, radians or meters.
    pub positions: Vec<f64>,
}

/// A scan of a range scanner, and the correction of its base pose.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeScan {
    /// The points, before the correction.
    pub scan: Arc<RangePoints>,
    /// Corrects the world coordinates of the points.
    pub map_from_odom: Transform,
    /// Start of the revolution. If the stamp of the scan is on another clock, this is the time at
    /// which the scan was read.
    pub captured_at: Instant,
}
