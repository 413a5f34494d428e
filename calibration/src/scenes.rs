//! Keyframes with known calibration errors. They show a simulated room of textured planes, and the
//! camera is on an arm with four joints.

use crate::{CameraCorrection, rigid_transform};
use keyframe::{DepthMap, Keyframe, Split};
use kinematics::{Stamp, Transform, Twist, transform};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use numbers::random::Random;
use rayon::prelude::*;
use std::sync::Arc;

/// Size of color and depth images, pixels.
pub const SIZE_PX: [u32; 2] = [160, 120];
const FOCAL_PX: [f64; 2] = [150.0, 148.0];
const PRINCIPAL_PX: [f64; 2] = [81.0, 59.0];
const N_IMAGES: usize = 40;
const READOUT_SECS: f64 = 0.02;

/// Azimuth, elevation, roll (radians) and reach (meters).
pub type Joints = [f64; 4];

/// Azimuth, elevation, roll (radians) and reach (meters).
fn base_from_flange([azimuth, elevation, roll, reach]: Joints) -> Transform {
    let rotation = |axis: Vector3<f64>, angle: f64| {
        let rotation = UnitQuaternion::from_scaled_axis(axis * angle);
        Isometry3::from_parts(Translation3::identity(), rotation)
    };
    let translation = |x: f64, y: f64, z: f64| Isometry3::translation(x, y, z);
    // At joint positions of zero, the flange looks along x. Its x axis points to the right, which
    // is -y of the base.
    let look_at = UnitQuaternion::from_matrix(&nalgebra::Matrix3::from_columns(&[
        -Vector3::y(),
        -Vector3::z(),
        Vector3::x(),
    ]));
    rotation(Vector3::z(), azimuth)
        * translation(0.1, 0.0, 0.5)
        * rotation(Vector3::y(), elevation)
        * translation(reach, 0.05, 0.0)
        * rotation(Vector3::x(), roll)
        * Isometry3::from_parts(Translation3::identity(), look_at)
}

fn flange_from_camera() -> Transform {
    Transform::new(
        Vector3::new(0.03, -0.02, 0.05),
        Vector3::new(0.05, -0.1, 0.3),
    )
}

/// Pose of the camera in the base frame at joint positions.
pub fn camera_at(joints: Joints) -> Transform {
    base_from_flange(joints) * flange_from_camera()
}

/// Joint positions of a scan at a time in seconds. Either all joints move, or only the azimuth
/// moves.
pub fn joints_at(secs: f64, azimuth_only: bool) -> Joints {
    let wave = |size: f64, hz: f64, phase: f64| {
        size * (2.0 * std::f64::consts::PI * hz * secs + phase).sin()
    };
    if azimuth_only {
        [wave(0.5, 0.11, 0.2), 0.15, 0.2, 0.1]
    } else {
        // The frequencies have no common period, so that no configuration repeats.
        [
            wave(0.4, 0.11, 0.2),
            0.15 + wave(0.25, 0.23, 1.0),
            wave(0.5, 0.17, 2.0),
            0.1 + wave(0.1, 0.31, 0.5),
        ]
    }
}

/// Twist of the camera when the joints move along a direction.
fn twist_along(joints: Joints, direction: Joints) -> Twist {
    const STEP: f64 = 1e-5;
    let at = |sign: f64| {
        let step = sign * STEP;
        camera_at(std::array::from_fn(|ix| joints[ix] + step * direction[ix]))
    };
    transform::log(&(at(-1.0).inverse() * at(1.0)), 2.0 * STEP)
}

/// Distance along the ray to the nearest plane, and the brightness there.
fn cast(from: Point3<f64>, ray: Vector3<f64>) -> (f64, f64) {
    let planes = [
        (Vector3::x(), 1.2),
        (Vector3::new(-0.4, 1.0, 0.1).normalize(), 0.8),
        (Vector3::new(-0.3, -1.0, 0.0).normalize(), 0.7),
        (-Vector3::z(), 0.1),
        (Vector3::new(0.8, 0.2, -1.0).normalize(), 0.75),
        (Vector3::z(), 1.4),
    ];
    let mut nearest = f64::INFINITY;
    for (normal, offset) in planes {
        let along = normal.dot(&ray);
        let distance = (offset - normal.dot(&from.coords)) / along;
        // Planes behind the camera do not count. Planes that are seen from outside the room do not
        // count either.
        if along > 0.0 && distance > 0.0 {
            nearest = nearest.min(distance);
        }
    }
    // The texture is a sum of waves in space. It has gradients in all directions and at several
    // scales.
    let p = from + ray * nearest;
    let wave = |size: f64, x: f64, y: f64, z: f64, phase: f64| {
        size * (x * p.x + y * p.y + z * p.z + phase).sin()
    };
    let brightness = 128.0
        + wave(30.0, 21.0, 13.0, -17.0, 0.3)
        + wave(25.0, -11.0, 29.0, 9.0, 1.3)
        + wave(25.0, 8.0, -7.0, 31.0, 2.1)
        + wave(20.0, 3.0, 5.0, 4.0, 0.0)
        + wave(12.0, 43.0, -31.0, 37.0, 0.7);
    (nearest, brightness.clamp(0.0, 255.0))
}

/// Calibration errors and image noise.
#[derive(Clone)]
pub struct Miscalibration {
    /// Extrinsics error. The input camera pose is the true pose times this transform.
    pub extrinsics: Transform,
    /// Time by which the input poses lag behind the images, seconds.
    pub time_offset_secs: f64,
    /// Error of the joint readings.
    pub joints: Joints,
    /// Error of the depth pose. The input pose of the depth frame is the true pose times this
    /// transform.
    pub depth_pose: Transform,
    /// Relative error of the focal lengths.
    pub focal_frac: f64,
    /// Relative error of depth.
    pub depth_frac: f64,
    /// Error of the readout time, seconds.
    pub readout_secs: f64,
    /// Whether only the azimuth moves.
    pub azimuth_only: bool,
    /// Whether rows are exposed one after the other.
    pub has_rolling_shutter: bool,
    /// Image noise relative to the noise of a real camera.
    pub noise: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl Miscalibration {
    /// No calibration error, with ordinary noise.
    pub fn none() -> Self {
        Self {
            extrinsics: Transform::identity(),
            time_offset_secs: 0.0,
            joints: [0.0; 4],
            depth_pose: Transform::identity(),
            focal_frac: 0.0,
            depth_frac: 0.0,
            readout_secs: 0.0,
            azimuth_only: false,
            has_rolling_shutter: false,
            noise: 1.0,
            seed: 1,
        }
    }
}

/// Normally distributed noise. The same key always gives the same value.
fn noise(key: u64) -> f64 {
    Random::new(key).normal()
}

/// Distance of the nearest plane at the center of a pixel, along the optical axis, and the
/// brightness there.
fn cast_pixel(pose: &Transform, x: usize, y: usize) -> (f64, f64) {
    let at = [x as f64 + 0.5, y as f64 + 0.5];
    // The z coordinate of the ray is 1, so distances along the ray are depths.
    let ray = Vector3::new(
        (at[0] - PRINCIPAL_PX[0]) / FOCAL_PX[0],
        (at[1] - PRINCIPAL_PX[1]) / FOCAL_PX[1],
        1.0,
    );
    cast(Point3::from(pose.translation.vector), pose.rotation * ray)
}

/// Keyframes of a scan of the room.
pub fn capture(miscalibration: &Miscalibration) -> Vec<Arc<Keyframe>> {
    (0..N_IMAGES)
        .into_par_iter()
        .map(|ix| {
            let shot = Shot {
                miscalibration,
                ix,
                // Irregular times ensure that images do not fall on the same phases of the joints.
                secs: 0.3 * ix as f64 + 0.05 * (ix as f64 * 1.7).sin(),
            };
            Arc::new(shot.keyframe())
        })
        .collect()
}

/// One image of the scan.
struct Shot<'a> {
    miscalibration: &'a Miscalibration,
    ix: usize,
    /// Time of the exposure.
    secs: f64,
}

impl Shot<'_> {
    /// True joint positions at a time.
    fn joints(&self, secs: f64) -> Joints {
        joints_at(secs, self.miscalibration.azimuth_only)
    }

    /// Noise of a pixel of the color image (stream 0) or of depth (stream 1). It does not depend on
    /// the order of threads.
    fn noise(&self, pixel: usize, stream: u64) -> f64 {
        let key = self.miscalibration.seed * 1_000_003
            + (self.ix as u64 * 100_000 + pixel as u64) * 2
            + stream;
        noise(key)
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "rounded and clamped"
    )]
    fn rgba(&self) -> Vec<u8> {
        let [width, height] = SIZE_PX.map(|side| side as usize);
        let mut rgba = Vec::new();
        for y in 0..height {
            // The middle row is exposed at the time of the image.
            let share = (y as f64 + 0.5) / height as f64 - 0.5;
            let delay_secs = if self.miscalibration.has_rolling_shutter {
                share * READOUT_SECS
            } else {
                0.0
            };
            let pose = camera_at(self.joints(self.secs + delay_secs));
            for x in 0..width {
                let (_, value) = cast_pixel(&pose, x, y);
                let value = (value + self.miscalibration.noise * self.noise(y * width + x, 0))
                    .round()
                    .clamp(0.0, 255.0) as u8;
                rgba.extend([value, value, value, 255]);
            }
        }
        rgba
    }

    #[expect(clippy::cast_possible_truncation, reason = "depth is stored as f32")]
    fn depth_m(&self, depth_pose: &Transform) -> Vec<f32> {
        let [width, height] = SIZE_PX.map(|side| side as usize);
        (0..width * height)
            .map(|pixel| {
                let z = cast_pixel(depth_pose, pixel % width, pixel / width).0;
                // The noise of stereo cameras grows with the square of the distance.
                ((z + 0.0007 * self.miscalibration.noise * z * z * self.noise(pixel, 1))
                    * (1.0 - self.miscalibration.depth_frac)) as f32
            })
            .collect()
    }

    #[expect(clippy::cast_possible_truncation, reason = "the stamp of a test")]
    fn keyframe(&self) -> Keyframe {
        let miscalibration = self.miscalibration;
        let depth_from_true = Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::zeros());
        let depth_m = self.depth_m(&(camera_at(self.joints(self.secs)) * depth_from_true));
        // All reported values contain the errors, whereas the images show the truth.
        let reported_secs = self.secs - miscalibration.time_offset_secs;
        let moved = self.joints(reported_secs);
        let reported_joints =
            std::array::from_fn(|joint| moved[joint] - miscalibration.joints[joint]);
        let reported = camera_at(reported_joints) * miscalibration.extrinsics;
        let attached = |twist: Twist| twist.of_attached(&miscalibration.extrinsics);
        let before = self.joints(reported_secs - 1e-4);
        let after = self.joints(reported_secs + 1e-4);
        let rates = std::array::from_fn(|joint| (after[joint] - before[joint]) / 2e-4);
        let unit =
            |joint: usize| std::array::from_fn(|other| if joint == other { 1.0 } else { 0.0 });
        Keyframe {
            camera: "wrist".into(),
            stamp: Stamp((self.secs * 1e9) as i64),
            size_px: SIZE_PX,
            focal_px: FOCAL_PX.map(|focal| focal * (1.0 + miscalibration.focal_frac)),
            principal_px: PRINCIPAL_PX,
            rgba_srgb: self.rgba().into(),
            depth: Some(DepthMap {
                size_px: SIZE_PX,
                focal_px: FOCAL_PX,
                principal_px: PRINCIPAL_PX,
                depth_m: depth_m.into(),
                world_from_camera: reported * depth_from_true * miscalibration.depth_pose,
            }),
            world_from_camera: reported,
            twist: Some(attached(twist_along(reported_joints, rates))),
            readout_secs: if miscalibration.has_rolling_shutter {
                READOUT_SECS - miscalibration.readout_secs
            } else {
                0.0
            },
            joint_twists: (0..4)
                .map(|joint| attached(twist_along(reported_joints, unit(joint))))
                .collect(),
            base: None,
            split: Split::of(self.ix),
            truth: None,
            robot: None,
        }
    }
}

/// An extrinsics error of about 1 degree and 5 mm.
pub fn wrong_extrinsics() -> Transform {
    Transform::new(
        Vector3::new(0.003, -0.0035, 0.002),
        Vector3::new(0.01, 0.012, -0.008),
    )
}

/// Rotation and translation of the extrinsics error that remains after a correction, degrees and
/// millimeters.
pub fn remaining(correction: &CameraCorrection, miscalibration: &Transform) -> (f64, f64) {
    let estimated = rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    );
    let remaining = miscalibration * estimated.inverse();
    (
        remaining.rotation.angle().to_degrees(),
        1e3 * remaining.translation.vector.norm(),
    )
}
