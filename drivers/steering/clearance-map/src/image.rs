//! What the map is made from: depth images, and the posture of the robot at their time.

use crate::error::Error;
use kinematics::{Stamp, Transform, transform};
use std::sync::Arc;

/// Where the depth of an image comes from, and therefore how far it is trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthOrigin {
    /// A depth camera.
    Measured,
    /// A scene model that was trained on images. It may lag behind the scene and miss thin things,
    /// so it keeps a larger margin, and never clears what a depth camera has seen.
    Rendered,
}

impl DepthOrigin {
    /// How much closer than the closest one of neighboring readings a surface may be, meters.
    ///
    /// Measured: 8 mm of errors of calibration and depth, and the standard deviation of a stereo
    /// camera whose disparities have an error of 0.08 pixels, at a focal length of 640 pixels and a
    /// baseline of 50 mm (Intel, "Tuning depth cameras for best performance": the error of depth is
    /// `z² * subpixel / (focal * baseline)`). More is not needed, because the closest one of a dozen
    /// readings is already closer than the surface. Rendered: the errors of a model that was trained
    /// for some seconds are a few centimeters at a distance of one meter.
    pub(crate) fn noise(self) -> Noise {
        match self {
            Self::Measured => Noise {
                constant_m: 0.008,
                per_meter: 0.0,
                per_square_meter: 0.0025,
            },
            Self::Rendered => Noise {
                constant_m: 0.02,
                per_meter: 0.03,
                per_square_meter: 0.0025,
            },
        }
    }
}

/// Largest error of a reading that is too far, as a polynomial of the reading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Noise {
    pub(crate) constant_m: f32,
    pub(crate) per_meter: f32,
    pub(crate) per_square_meter: f32,
}

impl Noise {
    /// Depth up to which a ray with this reading is certainly free, meters. It grows with the
    /// reading for all readings up to the maximum of 20 m.
    pub(crate) fn free_up_to_m(self, reading_m: f32) -> f32 {
        let square = self.per_square_meter * reading_m;
        reading_m - self.constant_m - (self.per_meter + square) * reading_m
    }
}

/// Joint positions of the robot and the pose of its base at a time.
#[derive(Clone, Debug, PartialEq)]
pub struct Posture {
    /// Time of the positions.
    pub stamp: Stamp,
    /// Joint positions in the order of the body's chain, rad or m.
    pub position: Vec<f64>,
    /// Pose of the base of the chain. The world is any frame that does not move, the same for all
    /// postures and images. For an arm that does not move, it may be the base itself.
    pub world_from_base: Transform,
}

impl Posture {
    pub(crate) fn check(&self, n_joints: usize) -> Result<(), Error> {
        let got = self.position.len();
        if got != n_joints {
            return Err(Error::JointCount {
                got,
                expected: n_joints,
            });
        }
        if !self.position.iter().all(|position| position.is_finite()) {
            return Err(Error::NotFinite {
                what: "a joint position",
            });
        }
        if !transform::is_finite(&self.world_from_base) {
            return Err(Error::NotFinite {
                what: "the pose of the base",
            });
        }
        Ok(())
    }
}

/// A depth image with the pose of its camera and the posture of the robot at the same time.
#[derive(Clone, Debug)]
pub struct DepthImage {
    /// Name of the camera.
    pub camera: Arc<str>,
    /// Time of the exposure.
    pub stamp: Stamp,
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length of a pinhole, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels. The center of the first pixel is at (0.5, 0.5).
    pub principal_px: [f64; 2],
    /// `[height, width]`, meters along z. Pixels without a reading are 0, NaN or infinite.
    pub depth_m: Arc<[f32]>,
    /// Pose of the camera (x right, y down, z forward) at `stamp`.
    pub world_from_camera: Transform,
    /// Posture of the robot at `stamp`. Its surfaces in the image are not part of the scene.
    pub posture: Posture,
    /// Where the depth comes from.
    pub origin: DepthOrigin,
}

impl DepthImage {
    pub(crate) fn check(&self, n_joints: usize) -> Result<(), Error> {
        let [width, height] = self.size_px;
        let expected = width as usize * height as usize;
        let got = self.depth_m.len();
        let camera = || self.camera.to_string();
        if got != expected || got == 0 {
            return Err(Error::PixelCount {
                camera: camera(),
                width,
                height,
                got,
                expected,
            });
        }
        let is_focal = |focal: &f64| focal.is_finite() && *focal > 0.0;
        if !self.focal_px.iter().all(is_focal) {
            return Err(Error::Camera {
                what: "the focal length",
                camera: camera(),
            });
        }
        if !self.principal_px.iter().all(|x| x.is_finite()) {
            return Err(Error::Camera {
                what: "the principal point",
                camera: camera(),
            });
        }
        if !transform::is_finite(&self.world_from_camera) {
            return Err(Error::Camera {
                what: "the pose",
                camera: camera(),
            });
        }
        self.posture.check(n_joints)
    }
}
