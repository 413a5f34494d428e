//! Decides which images of one camera become keyframes.
//!
//! The tests run from cheap to expensive: motion, then predicted blur and shear, then the pixels.

use super::camera_motion::{self, CameraPose};
use super::pixels::{PixelStatistics, SharpnessHistory};
use super::rejection::Rejection;
use super::spacing::Spacing;
use crate::config::{self, JoinConfig};
use kinematics::{Intrinsics, Stamp, Transform};

/// The acceptance test of one camera.
pub(super) struct Acceptance {
    config: JoinConfig,
    spacing: Spacing,
    is_fixed: bool,
    readout_secs: f64,
    /// All poses accepted so far, including the poses of evicted keyframes. Without the evicted
    /// poses, a full store would accept the same views again and again. The number of poses is
    /// limited, because the camera can reach only a limited space and poses have a minimum spacing.
    accepted: Vec<Transform>,
    last: Option<Stamp>,
    sharpness: SharpnessHistory,
}

impl Acceptance {
    /// Creates the test for a camera. `is_fixed`: whether the camera never moves.
    pub(super) fn new(
        config: &JoinConfig,
        camera: &config::Camera,
        is_fixed: bool,
        spacing: Spacing,
    ) -> Self {
        Self {
            config: config.clone(),
            spacing,
            is_fixed,
            readout_secs: camera.readout_micros.unwrap_or(0.0) * 1e-6,
            accepted: Vec::new(),
            last: None,
            sharpness: SharpnessHistory::default(),
        }
    }

    pub(super) fn readout_secs(&self) -> f64 {
        self.readout_secs
    }

    /// Checks that the camera has moved enough since the nearest keyframe. For a fixed camera,
    /// checks instead that enough time has passed.
    pub(super) fn check_motion(&self, stamp: Stamp, pose: &Transform) -> Result<(), Rejection> {
        // A fixed camera never moves by the minimum spacing. Its images still show moving objects,
        // so it gets a keyframe at regular intervals.
        let moved = if self.is_fixed {
            let waited = self.last.is_none_or(|last| {
                stamp.secs_since(last) * 1e3 >= self.config.fixed_interval_millis
            });
            waited && self.accepted.len() < self.config.fixed_keyframes
        } else {
            // The distance to every accepted pose counts, not only the distance to the last one.
            // Otherwise, an arm that repeats its path would add the same views in each round.
            self.accepted
                .iter()
                .all(|accepted| self.spacing.between(accepted, pose) >= 1.0)
        };
        if moved {
            Ok(())
        } else {
            Err(Rejection::NotMoved)
        }
    }

    /// Checks that the camera is slow enough for its exposure and readout time. `depth_m`: distance
    /// of the scene.
    pub(super) fn check_speed(
        &self,
        camera_pose: &CameraPose,
        pinhole: &Intrinsics,
        exposure_secs: Option<f64>,
        depth_m: f64,
    ) -> Result<(), Rejection> {
        let Some(twist) = &camera_pose.twist else {
            // Shear is proportional to the readout time, so a global shutter needs no velocity.
            // Blur cannot be predicted without a velocity either, but the sharpness test detects
            // strong blur.
            return if self.readout_secs > 0.0 {
                Err(Rejection::ShearUnknown)
            } else {
                Ok(())
            };
        };
        let speed_px_s = camera_motion::image_speed_px_s(twist, pinhole, depth_m);
        // If a camera does not report its exposure time, its images are not tested for blur here.
        // The sharpness test finds its blurred images.
        let blur_px = speed_px_s * exposure_secs.unwrap_or(0.0);
        let shear_px = speed_px_s * self.readout_secs;
        // The comparison is written so that a NaN speed is also rejected.
        match (
            blur_px <= self.config.max_blur_px,
            shear_px <= self.config.max_shear_px,
        ) {
            (true, true) => Ok(()),
            (false, _) => Err(Rejection::Blur),
            (true, false) => Err(Rejection::Shear),
        }
    }

    /// Checks exposure and sharpness. `rgb` is `[height, width, 3]`.
    pub(super) fn check_pixels(&mut self, rgb: &[u8], size_px: [u32; 2]) -> Result<(), Rejection> {
        let statistics = PixelStatistics::of(rgb, size_px);
        let is_well_exposed =
            (self.config.min_luma_frac..=self.config.max_luma_frac).contains(&statistics.luma_frac);
        if !is_well_exposed || statistics.clipped_frac > self.config.max_clipped_frac {
            return Err(Rejection::Exposure);
        }
        // The history of sharpness is updated before the test, even with images that are rejected.
        // Otherwise, once a camera rotates toward a scene with little texture, all its later images
        // would be rejected.
        let relative = self.sharpness.relative(statistics.sharpness);
        if relative >= self.config.min_sharpness_frac {
            Ok(())
        } else {
            Err(Rejection::NotSharp)
        }
    }

    /// Adds the pose of a keyframe of the resumed run. Its stamp may come from another clock, so
    /// the interval of a fixed camera starts again.
    pub(super) fn accept_resumed(&mut self, pose: &Transform) {
        self.accepted.push(*pose);
    }

    /// Adds the pose of a new keyframe.
    pub(super) fn accept(&mut self, stamp: Stamp, pose: &Transform) {
        self.accepted.push(*pose);
        self.last = Some(stamp);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Override, Rig};
    use kinematics::Twist;
    use std::path::Path;

    #[test]
    fn stationary_camera_of_a_resumed_run_ignores_earlier_stamps() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
        let rig = Rig::load(&path, &[]).expect("a rig");
        let fixed = || {
            let spacing = Spacing {
                translation_m: 1.0,
                rotation_rad: 1.0,
            };
            Acceptance::new(&rig.join, &rig.cameras[0], true, spacing)
        };
        let (mut running, mut resumed, pose) = (fixed(), fixed(), Transform::identity());
        running.accept(Stamp(3_600_000_000_000), &pose);
        assert_eq!(
            running.check_motion(Stamp(0), &pose),
            Err(Rejection::NotMoved)
        );
        resumed.accept_resumed(&pose);
        assert_eq!(resumed.check_motion(Stamp(0), &pose), Ok(()));
    }

    #[test]
    fn unknown_velocity_is_rejected_only_for_rolling_shutters() {
        for (readout_micros, expected) in [(0, Ok(())), (15_000, Err(Rejection::ShearUnknown))] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/static-arm.toml");
            let rig = Rig::load(
                &path,
                &[Override::new("camera.wrist.readout_micros", readout_micros)],
            )
            .expect("a rig");
            let camera = &rig.cameras[0];
            let acceptance = Acceptance::new(
                &rig.join,
                camera,
                false,
                Spacing {
                    translation_m: 1.0,
                    rotation_rad: 1.0,
                },
            );
            let check = |twist| {
                let camera_pose = CameraPose {
                    world_from_camera: Transform::identity(),
                    twist,
                    joint_twists: [].into(),
                    base: None,
                };
                acceptance.check_speed(&camera_pose, &camera.intrinsics, Some(0.01), 0.5)
            };
            assert_eq!(check(None), expected);
            assert_eq!(check(Some(Twist::zero())), Ok(()));
            let mut broken = Twist::zero();
            broken.linear_m_s.x = f64::NAN;
            assert_eq!(check(Some(broken)), Err(Rejection::Blur));
        }
    }
}
