//! Samples delivered by devices.

use crate::{YuvColors, YuvLayout};
use kinematics::{JointState, Stamp, Transform};
use std::sync::Arc;

/// Format of the bytes of an [`Image`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PixelFormat {
    /// Three bytes per pixel, red first.
    Rgb8,
    /// Three bytes per pixel, blue first.
    Bgr8,
    /// One byte per pixel.
    Gray8,
    /// YUV: luma and chroma.
    Yuv {
        /// Memory layout.
        layout: YuvLayout,
        /// Matrix and range.
        colors: YuvColors,
    },
    /// A JPEG file as sent by the device.
    Jpeg,
    /// A PNG file.
    Png,
    /// Depth along the camera's z axis as little-endian 16-bit counts. A count of 0 means that the
    /// depth is unknown.
    DepthU16 {
        /// Meters per count. By default 0.001 for a RealSense D4xx, 0.0001 for a D405 and 0.00025
        /// for an L515.
        meters_per_count: f64,
    },
}

/// One color or depth image of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Name of the camera in the rig file.
    pub camera: Arc<str>,
    /// Time of the image. It is the middle of the exposure if the device reports that time.
    pub stamp: Stamp,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Format of `data`.
    pub format: PixelFormat,
    /// Pixels in row-major order from the top left, without padding between rows (see
    /// [`Image::pack_rows`]).
    pub data: Arc<[u8]>,
    /// Exposure time in seconds, if the device reports it.
    pub exposure_secs: Option<f64>,
    /// Number of images of this camera and kind that were dropped just before this one.
    pub n_skipped: u64,
}

/// Pose of the robot's base at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct BasePose {
    /// Time of the pose.
    pub stamp: Stamp,
    /// Pose of the base.
    pub world_from_base: Transform,
}

/// Ground truth of a simulated image: the image without noise, blur and shear, and the camera pose.
#[derive(Clone, Debug, PartialEq)]
pub struct TruthImage {
    /// The noise-free image, [`PixelFormat::Rgb8`] or `Png`, with the camera and stamp of the noisy
    /// one.
    pub image: Image,
    /// Noise-free depth along z, meters, `[height, width]`. A value of 0 means that there is no
    /// surface. The array is empty if depth was not requested.
    pub depth_m: Arc<[f32]>,
    /// True pose of the camera at mid-exposure of the middle row.
    pub world_from_camera: Transform,
    /// PSNR in dB of the delivered image relative to the same image before noise was added. Both
    /// images include shear and blur. `None` if the camera has no noise.
    pub psnr_ceiling: Option<f64>,
}

/// One return of a range scanner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangePoint {
    /// Position of the surface in the sensor frame (x forward, z up) at the time of this point,
    /// meters.
    pub position_m: [f32; 3],
    /// Ring of the scanner that measured the point, counted from the lowest.
    pub ring: u16,
    /// Time from the stamp of the scan to this point, microseconds.
    pub offset_micros: u32,
}

/// One revolution of a range scanner. Directions without a return have no point.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeScan {
    /// Name of the scanner in the rig file; also the name of its frame.
    pub scanner: Arc<str>,
    /// Start of the revolution.
    pub stamp: Stamp,
    /// Points in the order of measurement. Each point is expressed in the sensor frame at its own
    /// time, since the scanner may move during a scan.
    pub points: Arc<[RangePoint]>,
}

/// One sample of one device.
#[derive(Clone, Debug, PartialEq)]
pub enum Sample {
    /// Color or depth image.
    Image(Image),
    /// Joint state.
    Joints(JointState),
    /// Base pose.
    Base(BasePose),
    /// One revolution of a range scanner.
    Range(RangeScan),
    /// True pose of a simulated base at the stamp of a reported pose.
    BaseTruth(BasePose),
    /// Ground truth of a simulated image.
    Truth(TruthImage),
}

impl Sample {
    /// Time of the sample.
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Image(image) => image.stamp,
            Self::Joints(state) => state.stamp,
            Self::Base(pose) | Self::BaseTruth(pose) => pose.stamp,
            Self::Range(scan) => scan.stamp,
            Self::Truth(truth) => truth.image.stamp,
        }
    }

    /// Adds a time to the stamp, nanoseconds.
    pub(crate) fn shift(&mut self, nanos: i64) {
        let stamp = match self {
            Self::Image(image) => &mut image.stamp,
            Self::Joints(state) => &mut state.stamp,
            Self::Base(pose) | Self::BaseTruth(pose) => &mut pose.stamp,
            Self::Range(scan) => &mut scan.stamp,
            Self::Truth(truth) => &mut truth.image.stamp,
        };
        stamp.0 = stamp.0.saturating_add(nanos);
    }
}
