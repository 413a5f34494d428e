//! The current corrections, and the application of optimizer steps to them.

use super::layout::{CalibrationParam, Layout};
use super::prepared_image::PreparedImage;
use super::view::CorrectedView;
use crate::{CameraCorrection, rigid_transform};
use kinematics::{Transform, Twist, transform};
use nalgebra::{DVector, Vector3};
use rayon::prelude::*;

/// One correction per camera.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Corrections {
    pub(super) by_camera: Vec<CameraCorrection>,
}

impl Corrections {
    pub(super) fn none(n_cameras: usize) -> Self {
        Self {
            by_camera: vec![CameraCorrection::default(); n_cameras],
        }
    }

    /// Corrected views of the images. All images have depth.
    pub(super) fn views(&self, images: &[PreparedImage], layout: &Layout) -> Vec<CorrectedView> {
        let view = |image: &PreparedImage| {
            CorrectedView::new(image, &self.by_camera[image.camera], layout)
                .expect("prepared images have depth")
        };
        images.par_iter().map(view).collect()
    }

    /// Current value of a parameter. Extrinsics are expressed as a motion of the camera, which is
    /// exact to first order.
    pub(super) fn value(&self, param: CalibrationParam) -> f64 {
        match param {
            CalibrationParam::Extrinsics(camera, part) if part < 3 => {
                -self.by_camera[camera].translation_m[part]
            }
            CalibrationParam::Extrinsics(camera, part) => {
                -self.by_camera[camera].rotation_rad[part - 3]
            }
            CalibrationParam::TimeOffset(camera) => self.by_camera[camera].time_offset_secs,
            CalibrationParam::Joint(joint) => self
                .by_camera
                .iter()
                .find_map(|correction| correction.joint_offsets.get(joint))
                .copied()
                .unwrap_or(0.0),
            CalibrationParam::DepthPose(camera, part) if part < 3 => {
                self.by_camera[camera].depth_translation_m[part]
            }
            CalibrationParam::DepthPose(camera, part) => {
                self.by_camera[camera].depth_rotation_rad[part - 3]
            }
            CalibrationParam::Lens(camera, part) if part < 2 => {
                self.by_camera[camera].log_focal[part]
            }
            CalibrationParam::Lens(camera, part) => {
                self.by_camera[camera].principal_offset_focals[part - 2]
            }
            CalibrationParam::DepthScale(camera) => self.by_camera[camera].log_depth_scale,
            CalibrationParam::Readout(camera) => self.by_camera[camera].readout_secs,
        }
    }

    /// Applies a step in the parameters of a layout, in their units.
    pub(super) fn apply_step(&mut self, layout: &Layout, step: &DVector<f64>) {
        for (ix, param) in layout.params.iter().enumerate() {
            let delta = step[ix];
            match *param {
                // A motion has six parameters. The first parameter applies all six, and the other
                // five are skipped below.
                CalibrationParam::Extrinsics(camera, 0) => {
                    let correction = &mut self.by_camera[camera];
                    // The step is a motion of the camera. The correction is applied after
                    // `camera_from_world`, so it is the inverse of this motion.
                    let extrinsics = transform::exp(&twist(step, ix), -1.0)
                        * rigid_transform(
                            correction.rotation_rad.into(),
                            correction.translation_m.into(),
                        );
                    (correction.rotation_rad, correction.translation_m) =
                        rotation_and_translation(&extrinsics);
                }
                CalibrationParam::DepthPose(camera, 0) => {
                    let correction = &mut self.by_camera[camera];
                    let before = rigid_transform(
                        correction.depth_rotation_rad.into(),
                        correction.depth_translation_m.into(),
                    );
                    (
                        correction.depth_rotation_rad,
                        correction.depth_translation_m,
                    ) = rotation_and_translation(&(transform::exp(&twist(step, ix), 1.0) * before));
                }
                CalibrationParam::Extrinsics(..) | CalibrationParam::DepthPose(..) => {}
                CalibrationParam::TimeOffset(camera) => {
                    self.by_camera[camera].time_offset_secs += delta
                }
                // Joints carry all cameras of an arm, so the offset is stored with each of them.
                CalibrationParam::Joint(joint) => {
                    for correction in &mut self.by_camera {
                        let n = correction.joint_offsets.len().max(joint + 1);
                        correction.joint_offsets.resize(n, 0.0);
                        correction.joint_offsets[joint] += delta;
                    }
                }
                CalibrationParam::Lens(camera, part) if part < 2 => {
                    self.by_camera[camera].log_focal[part] += delta
                }
                CalibrationParam::Lens(camera, part) => {
                    self.by_camera[camera].principal_offset_focals[part - 2] += delta
                }
                CalibrationParam::DepthScale(camera) => {
                    self.by_camera[camera].log_depth_scale += delta
                }
                CalibrationParam::Readout(camera) => self.by_camera[camera].readout_secs += delta,
            }
        }
    }
}

/// Interprets six consecutive numbers of a step as a motion: meters, then radians.
pub(super) fn twist(step: &DVector<f64>, begin: usize) -> Twist {
    let part = |from: usize| Vector3::from_fn(|row, _| step[begin + from + row]);
    Twist {
        linear_m_s: part(0),
        angular_rad_s: part(3),
    }
}

/// Splits a motion into its rotation vector and translation.
pub(super) fn rotation_and_translation(motion: &Transform) -> ([f64; 3], [f64; 3]) {
    (
        motion.rotation.scaled_axis().into(),
        motion.translation.vector.into(),
    )
}
