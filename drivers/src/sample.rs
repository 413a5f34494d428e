//! What devices deliver.

use crate::{YuvColors, YuvLayout};
use kinematics::{JointState, Stamp, Transform};
use std::sync::Arc;

/// How the bytes of an [`Image`] are to be read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PixelFormat {
    /// Three bytes a pixel, red first.
    Rgb8,
    /// Three bytes a pixel, blue first.
    Bgr8,
    /// One byte a pixel.
    Gray8,
    /// Luma and colour differences.
    Yuv {
        /// How they lie in the bytes.
        layout: YuvLayout,
        /// What they mean.
        colors: YuvColors,
    },
    /// A JPEG file as the device sent it.
    Jpeg,
    /// A PNG file.
    Png,
    /// Depth along the camera's z axis as little-endian 16-bit counts; 0 where the sensor saw nothing.
    DepthU16 {
        /// Metres per count; of a RealSense D4xx 0.001 unless set otherwise, of a D405 0.0001, of an L515 0.00025.
        meters_per_count: f64,
    },
}

/// One image of one camera, colour or depth.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Name of the camera in the rig file.
    pub camera: Arc<str>,
    /// Mid-exposure, when the device says so.
    pub stamp: Stamp,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// How `data` is to be read.
    pub format: PixelFormat,
    /// The bytes, row major from the top left, no padding between rows (see [`Image::pack_rows`]).
    pub data: Arc<[u8]>,
    /// Exposure time where the device tells it, seconds.
    pub exposure_secs: Option<f64>,
    /// Images of this camera and kind lost just before this one.
    pub n_skipped: u64,
}

/// Pose of the robot's base at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct BasePose {
    /// When the base was there.
    pub stamp: Stamp,
    /// Pose of the base.
    pub world_from_base: Transform,
}

/// What a simulated camera would have seen without noise, blur or shear, and from where.
#[derive(Clone, Debug, PartialEq)]
pub struct TruthImage {
    /// The noise-free image, [`PixelFormat::Rgb8`] or `Png`, same camera and stamp as the noisy one.
    pub image: Image,
    /// Noise-free depth along z, metres, `[height, width]`; 0 where nothing is. Empty when not asked for.
    pub depth_m: Arc<[f32]>,
    /// True pose of the camera at mid-exposure of the middle row.
    pub world_from_camera: Transform,
    /// PSNR, dB, of the delivered image against the same image, shear and blur kept, before its noise; `None` without noise.
    pub psnr_ceiling: Option<f64>,
}

/// One echo of a range scanner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangePoint {
    /// Where the surface was in the sensor's frame (x ahead, z up) at the instant of this point, metres.
    pub position_m: [f32; 3],
    /// Which of the scanner's rings measured it, from the lowest.
    pub ring: u16,
    /// From the stamp of the scan to this point, microseconds.
    pub offset_micros: u32,
}

/// One turn of a range scanner; directions without an echo have no point.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeScan {
    /// Name of the scanner in the rig file; also the name of its frame.
    pub scanner: Arc<str>,
    /// When the turn began.
    pub stamp: Stamp,
    /// In the order in which they were measured. The scanner may move in between: each is told where the sensor was then.
    pub points: Arc<[RangePoint]>,
}

/// One delivery of one device.
#[derive(Clone, Debug, PartialEq)]
pub enum Sample {
    /// Colour or depth.
    Image(Image),
    /// Joint readings.
    Joints(JointState),
    /// Base pose.
    Base(BasePose),
    /// One turn of a range scanner.
    Range(RangeScan),
    /// Where a simulated base truly was when it told a pose.
    BaseTruth(BasePose),
    /// Ground truth of a simulated image.
    Truth(TruthImage),
}

impl Sample {
    /// When it was so.
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Image(image) => image.stamp,
            Self::Joints(state) => state.stamp,
            Self::Base(pose) | Self::BaseTruth(pose) => pose.stamp,
            Self::Range(scan) => scan.stamp,
            Self::Truth(truth) => truth.image.stamp,
        }
    }
}
