//! Converts device images to the arrays of a keyframe: decoded, undistorted, depth in meters.

use super::camera_motion::CameraPose;
use crate::{config, downscale};
use anyhow::Context;
use drivers::{Image, TruthImage};
use keyframe::{DepthMap, Truth};
use kinematics::{Intrinsics, Undistortion};
use numbers::quantile::{Rank, quantile};
use std::sync::Arc;

/// Undistorts and scales the images of one camera. The maps are computed once.
pub(super) struct Undistorter {
    full: Intrinsics,
    pinhole: Intrinsics,
    undistortion: Option<Undistortion>,
}

impl Undistorter {
    /// Creates the maps of a camera. `scale`: factor for the width and height of the undistorted
    /// images.
    pub(super) fn new(intrinsics: &Intrinsics, scale: f64) -> anyhow::Result<Self> {
        let undistortion = (!intrinsics.is_pinhole()).then(|| Undistortion::new(intrinsics));
        let full = intrinsics.undistorted();
        Ok(Self {
            pinhole: downscale::intrinsics(&full, scale)?,
            full,
            undistortion,
        })
    }

    /// The pinhole camera of the undistorted images at the size of the device images.
    pub(super) fn full(&self) -> &Intrinsics {
        &self.full
    }

    /// The pinhole camera of the keyframe images.
    pub(super) fn pinhole(&self) -> &Intrinsics {
        &self.pinhole
    }

    /// Whether keyframe images are smaller than device images.
    pub(super) fn is_downscaled(&self) -> bool {
        self.pinhole.size_px != self.full.size_px
    }

    /// Undistorts and scales `[height, width, 3]` to `[height, width, 4]`. Alpha is 0 where the
    /// source image has no pixel.
    pub(super) fn rgba(&self, rgb: &[u8]) -> anyhow::Result<Arc<[u8]>> {
        // At full size, no intermediate image is needed.
        if !self.is_downscaled() {
            return match &self.undistortion {
                Some(undistortion) => Ok(undistortion.apply_rgb(rgb)?.into()),
                None => Ok(opaque(rgb).collect()),
            };
        }
        // Undistortion comes before scaling, because the lens model is that of the full size.
        let rgba = match &self.undistortion {
            Some(undistortion) => undistortion.apply_rgb(rgb)?,
            None => opaque(rgb).collect(),
        };
        Ok(downscale::rgba(rgba, self.full.size_px, self.pinhole.size_px).into())
    }

    fn depth_m(&self, depth_m: Vec<f32>) -> anyhow::Result<Vec<f32>> {
        match &self.undistortion {
            Some(undistortion) => Ok(undistortion.apply_depth(&depth_m)?),
            None => Ok(depth_m),
        }
    }
}

/// The bytes of an RGB image with alpha 255 after each pixel.
fn opaque(rgb: &[u8]) -> impl Iterator<Item = u8> {
    rgb.as_chunks::<3>()
        .0
        .iter()
        .flat_map(|[red, green, blue]| [*red, *green, *blue, 255])
}

/// Decodes and undistorts a depth image. Readings outside the sensor's range become 0.
pub(super) fn depth_map(
    image: &Image,
    depth: &config::Depth,
    undistorter: &Undistorter,
    camera_pose: &CameraPose,
) -> anyhow::Result<DepthMap> {
    expect_size(image, &depth.intrinsics)?;
    let mut depth_m = undistorter.depth_m(image.decode_depth_m()?)?;
    #[expect(
        clippy::cast_possible_truncation,
        reason = "f32 is precise enough for a range in meters"
    )]
    let [factor, min_m, max_m] = [depth.factor, depth.min_m, depth.max_m].map(|value| value as f32);
    for depth_m in &mut depth_m {
        *depth_m *= factor;
        // NaN is in no range, so it becomes 0 as well.
        if !(min_m..=max_m).contains(depth_m) {
            *depth_m = 0.0;
        }
    }
    Ok(DepthMap {
        size_px: undistorter.pinhole.size_px,
        focal_px: undistorter.pinhole.focal_px,
        principal_px: undistorter.pinhole.principal_px,
        depth_m: depth_m.into(),
        world_from_camera: camera_pose.world_from_camera * depth.camera_from_depth,
    })
}

/// Decodes a color image to `[height, width, 3]`. Its size must be the one in the rig file.
pub(super) fn rgb(image: &Image, intrinsics: &Intrinsics) -> anyhow::Result<Vec<u8>> {
    expect_size(image, intrinsics)?;
    Ok(image.decode_rgb()?)
}

/// The simulator's ground truth for a keyframe, undistorted with the same maps as the image.
pub(super) fn truth(
    truth: &TruthImage,
    intrinsics: &Intrinsics,
    undistorter: &Undistorter,
) -> anyhow::Result<Truth> {
    let rgba_srgb = undistorter
        .rgba(&rgb(&truth.image, intrinsics)?)
        .context("the true image")?;
    // The PSNR ceiling is that of the noise at full size. Averaging areas removes much of the
    // noise, so the ceiling does not apply to scaled images.
    let psnr_ceiling = if undistorter.is_downscaled() {
        None
    } else {
        truth.psnr_ceiling
    };
    Ok(Truth {
        rgba_srgb,
        world_from_camera: truth.world_from_camera,
        psnr_ceiling,
    })
}

/// Median of a depth map, sampled at every eighth pixel of every eighth row; `None` if there are no
/// readings.
pub(super) fn median_depth_m(map: &DepthMap) -> Option<f64> {
    let width = map.size_px[0] as usize;
    // Every 64th pixel is enough for a median that only scales a predicted speed, and keeps this
    // test cheaper than decoding.
    let rows = map.depth_m.chunks(width.max(1)).step_by(8);
    let mut valid_depths: Vec<f64> = rows
        .flat_map(|row| row.iter().step_by(8).copied())
        .filter(|depth_m| *depth_m > 0.0)
        .map(f64::from)
        .collect();
    quantile(&mut valid_depths, 0.5, Rank::Upper)
}

fn expect_size(image: &Image, intrinsics: &Intrinsics) -> Result<(), drivers::Error> {
    if image.size_px == intrinsics.size_px {
        return Ok(());
    }
    Err(drivers::Error::ImageSize {
        camera: image.camera.to_string(),
        stamp: image.stamp,
        got_px: image.size_px,
        expected_px: intrinsics.size_px,
    })
}
