//! Posed images for training, as plain arrays without driver types.

use crate::Error;
use crate::masked_robot::MaskedRobot;
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::Vector3;
use std::sync::Arc;

/// How a keyframe may be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Used for training.
    Train,
    /// Used to choose hyperparameters and to decide trials. Afterwards, these keyframes are also
    /// used for training.
    Validation,
    /// Used only for reported scores.
    Test,
}

impl Split {
    /// The split of the keyframe at index `ix` of a camera. Every 8th keyframe is for testing,
    /// starting at index 0. Every 8th keyframe is for validation, starting at index 4.
    pub fn of(ix: usize) -> Self {
        match ix % 8 {
            0 => Self::Test,
            4 => Self::Validation,
            _ => Self::Train,
        }
    }
}

/// One posed, undistorted image at its own size.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Mid-exposure of the middle row.
    pub stamp: Stamp,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length of the undistorted image, pixels.
    pub focal_px: [f64; 2],
    /// Principal point of the undistorted image, pixels.
    pub principal_px: [f64; 2],
    /// `[height, width, 4]`, sRGB. Alpha is 255 for valid pixels, and 0 for pixels that are masked
    /// or left empty by undistortion.
    pub rgba_srgb: Arc<[u8]>,
    /// Depth, if the camera provides it.
    pub depth: Option<DepthMap>,
    /// Pose at `stamp`.
    pub world_from_camera: Transform,
    /// Velocity of the camera at `stamp`, if known. Together with `readout_secs`, it describes the
    /// rolling shutter.
    pub twist: Option<Twist>,
    /// Time from the exposure of the first row to the exposure of the last row, seconds. It is 0
    /// for a global shutter.
    pub readout_secs: f64,
    /// For each joint that carries the camera, the twist of the camera, in its own axes, when only
    /// that joint moves at unit speed. Empty if unknown.
    pub joint_twists: Arc<[Twist]>,
    /// State of the base that carries the camera. `None` if the base is fixed.
    pub base: Option<BaseState>,
    /// How the keyframe may be used.
    pub split: Split,
    /// Ground truth from a simulator.
    pub truth: Option<Truth>,
    /// The robot that is masked in this image. `None` if the robot is not masked in the images of
    /// this camera.
    pub robot: Option<Arc<MaskedRobot>>,
}

impl Keyframe {
    /// Whether most of the image has no depth. The result is true if the keyframe has no depth. It
    /// is also true if the depth comes from a range scanner, which covers only a band of the image.
    pub fn lacks_dense_depth(&self) -> bool {
        self.depth
            .as_ref()
            .is_none_or(|depth| depth.known_frac() < 0.5)
    }

    /// Host memory of the arrays, bytes.
    pub fn bytes(&self) -> u64 {
        let depth = self
            .depth
            .as_ref()
            .map_or(0, |depth| size_of_val(&*depth.depth_m));
        let truth = self.truth.as_ref().map_or(0, |truth| truth.rgba_srgb.len());
        let robot = self.robot.as_ref().map_or(0, |robot| robot.bytes());
        (self.rgba_srgb.len() + depth + truth) as u64 + robot
    }

    /// Checks that the lengths of the arrays match their sizes in pixels.
    pub fn check(&self) -> Result<(), Error> {
        let [width, height] = self.size_px;
        let got = self.rgba_srgb.len();
        let expected = 4 * width as usize * height as usize;
        if got != expected {
            return Err(Error::ImageBytes {
                width,
                height,
                got,
                expected,
            });
        }
        let Some(depth) = &self.depth else {
            return Ok(());
        };
        let [width, height] = depth.size_px;
        let got = depth.depth_m.len();
        let expected = width as usize * height as usize;
        if got != expected {
            return Err(Error::DepthPixels {
                width,
                height,
                got,
                expected,
            });
        }
        Ok(())
    }

    /// Returns the keyframe with a corrected base pose. All poses of the keyframe are multiplied by
    /// `map_from_odom` from the left.
    pub fn with_base_correction(&self, map_from_odom: &Transform) -> Self {
        Self {
            world_from_camera: map_from_odom * self.world_from_camera,
            depth: self.depth.clone().map(|depth| DepthMap {
                world_from_camera: map_from_odom * depth.world_from_camera,
                ..depth
            }),
            base: self.base.clone().map(|base| BaseState {
                map_from_odom: map_from_odom * base.map_from_odom,
                ..base
            }),
            ..self.clone()
        }
    }

    /// Whether all camera parameters are finite. Depth readings are not checked.
    pub fn is_finite(&self) -> bool {
        let twists = self.twist.iter().chain(self.joint_twists.iter());
        transform::is_finite(&self.world_from_camera)
            && is_valid_lens(self.focal_px, self.principal_px)
            && self.readout_secs.is_finite()
            && twists
                .flat_map(|twist| twist.linear_m_s.iter().chain(twist.angular_rad_s.iter()))
                .all(|x| x.is_finite())
            && self.depth.as_ref().is_none_or(|depth| {
                transform::is_finite(&depth.world_from_camera)
                    && is_valid_lens(depth.focal_px, depth.principal_px)
            })
    }
}

/// Whether focal lengths are positive and all values finite.
fn is_valid_lens(focal_px: [f64; 2], principal_px: [f64; 2]) -> bool {
    focal_px
        .iter()
        .all(|focal| focal.is_finite() && *focal > 0.0)
        && principal_px.iter().all(|x| x.is_finite())
}

/// State of a mobile base at the time of a keyframe.
#[derive(Clone, Debug, PartialEq)]
pub struct BaseState {
    /// Index of the station at which the base is stationary, counted from 0. `None` while the base
    /// moves.
    pub station: Option<usize>,
    /// Reported pose of the base at the keyframe's stamp, without correction.
    pub world_from_base: Transform,
    /// Drift correction. The poses of the keyframe have been multiplied by it from the left.
    pub map_from_odom: Transform,
    /// The true pose of the base, from a simulator.
    pub truth: Option<Transform>,
}

/// Depth along a camera's z axis, with its own size, intrinsics and pose.
#[derive(Clone, Debug)]
pub struct DepthMap {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
    /// `[height, width]`, meters along z. Pixels without a reading are 0.
    pub depth_m: Arc<[f32]>,
    /// Pose at the stamp of the depth image.
    pub world_from_camera: Transform,
}

impl DepthMap {
    /// Fraction of the pixels with a reading, 0 to 1.
    pub fn known_frac(&self) -> f64 {
        // NaN compares false, so it counts as unknown.
        let n_known = self.depth_m.iter().filter(|z| **z > 0.0).count();
        n_known as f64 / self.depth_m.len().max(1) as f64
    }

    /// Point at depth `z_m` on the ray through the center of a pixel, in the depth camera's axes,
    /// meters.
    ///
    /// ```
    /// use keyframe::DepthMap;
    /// use kinematics::Transform;
    ///
    /// let depth = DepthMap {
    ///     size_px: [4, 2],
    ///     focal_px: [2.0, 2.0],
    ///     principal_px: [2.0, 1.0],
    ///     depth_m: vec![1.5; 8].into(),
    ///     world_from_camera: Transform::identity(),
    /// };
    /// // The center of pixel (3, 0) is at (3.5, 0.5).
    /// assert_eq!(depth.point(3, 0, 1.5).as_slice(), [1.125, -0.375, 1.5]);
    /// ```
    pub fn point(&self, x: u32, y: u32, z_m: f64) -> Vector3<f64> {
        let ray = |pixel: u32, axis: usize| {
            (f64::from(pixel) + 0.5 - self.principal_px[axis]) / self.focal_px[axis]
        };
        Vector3::new(ray(x, 0), ray(y, 1), 1.0) * z_m
    }

    /// Returns a smaller depth map. It contains the center pixel of every square of `stride` by
    /// `stride` pixels, with the same reading along the same ray. `stride` must be odd. Incomplete
    /// squares at the right and lower edges are dropped.
    #[must_use]
    pub fn subsampled(&self, stride: u32) -> Self {
        let [width, height] = self.size_px.map(|size| size / stride);
        // The ray of the center pixel does not change, because its position divided by the stride
        // is the center of the small pixel. The intrinsics therefore only have to be scaled.
        let at = |x: u32, y: u32| {
            ((y * stride + stride / 2) * self.size_px[0] + x * stride + stride / 2) as usize
        };
        let depth_m = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| self.depth_m[at(x, y)]);
        let scaled = |value_px: [f64; 2]| value_px.map(|px| px / f64::from(stride));
        Self {
            size_px: [width, height],
            focal_px: scaled(self.focal_px),
            principal_px: scaled(self.principal_px),
            depth_m: depth_m.collect(),
            world_from_camera: self.world_from_camera,
        }
    }
}

/// The noise-free image and the true pose, from a simulator.
#[derive(Clone, Debug)]
pub struct Truth {
    /// `[height, width, 4]`, sRGB, without noise.
    pub rgba_srgb: Arc<[u8]>,
    /// True pose at the keyframe's stamp.
    pub world_from_camera: Transform,
    /// PSNR of the keyframe's image against its noise-free version, dB. A perfect model reaches
    /// this score. `None` if the image has no noise.
    pub psnr_ceiling: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subsampled_depth_keeps_its_points() {
        let size_px = [8, 7];
        let depth_m: Vec<f32> = (0..56).map(|ix| 1.0 + ix as f32).collect();
        let full = DepthMap {
            size_px,
            focal_px: [5.0, 6.0],
            principal_px: [3.7, 3.1],
            depth_m: depth_m.into(),
            world_from_camera: Transform::identity(),
        };
        let subsampled = full.subsampled(3);
        assert_eq!((subsampled.size_px, subsampled.depth_m.len()), ([2, 2], 4));
        for (x, y) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let z_m = subsampled.depth_m[(y * 2 + x) as usize];
            assert_eq!(
                z_m,
                full.depth_m[((3 * y + 1) * 8 + 3 * x + 1) as usize],
                "{x} {y}"
            );
            let difference =
                subsampled.point(x, y, z_m.into()) - full.point(3 * x + 1, 3 * y + 1, z_m.into());
            assert!(difference.norm() < 1e-12, "{x} {y}: {difference}");
        }
        assert_eq!(full.subsampled(1).depth_m, full.depth_m);
    }
}
