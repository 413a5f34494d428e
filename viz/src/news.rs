//! What the training side tells the operators: plain values, the latest of each counts.

use kinematics::{Stamp, Transform};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

/// Points of the accuracy curve that are kept for the page; a longer curve is thinned evenly.
const MAX_HISTORY: usize = 512;

/// Where a run stands.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Status {
    /// One or two words for the operator, such as `waiting for images` or `training`.
    pub state: String,
    /// `splat`, `nerf` or `tsdf`.
    pub method: String,
    /// Wall time since the first image, seconds.
    pub seconds: f64,
    /// Optimiser updates so far.
    pub step: u64,
    /// GPU time of a step, milliseconds, smoothed; `None` before the first.
    pub step_millis: Option<f64>,
    /// Splats, voxel blocks or table entries.
    pub primitives: u64,
    /// Bytes of GPU memory the model holds.
    pub bytes: u64,
    /// Keyframes accepted and held.
    pub keyframes: u64,
    /// Images refused as keyframes, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Mean over the test keyframes, decibel; `None` before the first evaluation.
    pub psnr: Option<f64>,
    /// `(seconds, psnr)` of every evaluation so far, in order.
    pub psnr_history: Vec<(f64, f64)>,
    /// Sentences that an operator should read, such as a lost camera.
    pub notes: Vec<String>,
}

impl Status {
    /// The same status with a curve short enough to send several times a second; first and last point stay.
    pub(crate) fn thinned(mut self) -> Self {
        let n = self.psnr_history.len();
        if n > MAX_HISTORY {
            let last = n - 1;
            self.psnr_history = (0..MAX_HISTORY).map(|ix| self.psnr_history[ix * last / (MAX_HISTORY - 1)]).collect();
        }
        self
    }
}

/// Where the scene is and where an operator's view starts.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneHint {
    /// What to look at and turn around, in world, metres.
    pub center_m: [f64; 3],
    /// Distance from the center that holds what matters, metres.
    pub radius_m: f64,
    /// First view.
    pub world_from_camera: Transform,
}

/// Pose and lens of an accepted keyframe, to be drawn as a frustum.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframePose {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Pose at the keyframe's stamp.
    pub world_from_camera: Transform,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// Pixels of a live image, sRGB.
#[derive(Clone, Debug)]
pub enum LivePixels {
    /// A whole JPEG file, sent as it is.
    Jpeg(Arc<[u8]>),
    /// `[height, width, 3]`.
    Rgb(Arc<[u8]>),
    /// `[height, width, 4]`; alpha is ignored.
    Rgba(Arc<[u8]>),
}

/// What a camera sees now.
#[derive(Clone, Debug)]
pub struct LiveImage {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Mid-exposure.
    pub stamp: Stamp,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// The image.
    pub pixels: LivePixels,
    /// Pose at the stamp, where known.
    pub world_from_camera: Option<Transform>,
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// A live image that is encoded at most once, however many clients look.
#[derive(Debug)]
pub(crate) struct LiveSlot {
    /// The image as it came.
    pub(crate) image: LiveImage,
    /// JPEG bytes, or why there are none; filled by the first client that looks.
    pub(crate) jpeg: OnceLock<Result<Vec<u8>, String>>,
}

#[cfg(test)]
mod tests {
    use super::{MAX_HISTORY, Status};

    #[test]
    fn a_long_curve_is_thinned_and_keeps_its_ends() {
        let psnr_history: Vec<_> = (0..5000).map(|ix| (f64::from(ix), f64::from(ix) * 0.5)).collect();
        let status = Status { psnr_history, ..Status::default() }.thinned();
        assert_eq!(status.psnr_history.len(), MAX_HISTORY);
        assert_eq!(status.psnr_history.first(), Some(&(0.0, 0.0)));
        assert_eq!(status.psnr_history.last(), Some(&(4999.0, 2499.5)));
        assert!(status.psnr_history.windows(2).all(|pair| pair[0].0 < pair[1].0));
        let short = Status { psnr_history: vec![(1.0, 2.0)], ..Status::default() };
        assert_eq!(short.clone().thinned(), short);
    }
}
