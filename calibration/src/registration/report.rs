//! Results of alignment, as data and as text.

use super::corrections::rotation_and_translation;
use super::covariance::ExtrinsicsCovariance;
use super::fit::Fit;
use super::layout::CalibrationParam;
use super::movement::CameraMovement;
use super::solve::Solution;
use super::{AlignmentScene, CalibrationModel};
use crate::{
    CalibratedCamera, CameraCorrection, Candidate, MIN_VALIDATION_IMAGES, ParamSet, Trial,
    rigid_transform,
};
use keyframe::Keyframe;
use kinematics::{Stamp, Transform};
use nalgebra::{DVector, Vector3};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Result of alignment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// Corrections by camera. The map is empty if no corrections were accepted.
    pub corrections: BTreeMap<String, CameraCorrection>,
    /// Accepted corrections with their uncertainties.
    pub estimates: Vec<Estimate>,
    /// Directions of the accepted parameters that the motion does not make observable. Corrections
    /// along these directions are zero.
    pub unobservable: Vec<Unobservable>,
    /// Tested parameter sets, and how much better they predict the validation images.
    pub trials: Vec<Trial>,
    /// Number of compared pairs of images.
    pub n_pairs: usize,
    /// Movements of cameras relative to their mounts, in order of detection. Their corrections are
    /// applied before `corrections`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub movements: Vec<CameraMovement>,
    /// Uncertainty of the extrinsics, if they were estimated. It is not saved.
    #[serde(skip)]
    pub extrinsics_covariance: Option<ExtrinsicsCovariance>,
}

/// One estimated correction. Each sigma is a standard deviation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "parameter", rename_all = "kebab-case")]
pub enum Estimate {
    /// Correction of the camera pose relative to its parent, in the uncorrected axes of the camera.
    HandEye(PoseEstimate),
    /// Correction of the pose of the depth frame in the color frame, in the axes of the color
    /// frame.
    DepthPose(PoseEstimate),
    /// Time from the stamps of the images to their exposure, seconds.
    TimeOffset(ScalarEstimate),
    /// Factor to apply to depth readings, minus 1.
    DepthScale(ScalarEstimate),
    /// Increase of the readout time, seconds.
    Readout(ScalarEstimate),
    /// Offset to add to a joint's readings.
    Joint {
        /// Index of the joint among the chain's moving joints.
        joint_ix: usize,
        /// Offset, radians or meters.
        value: f64,
        /// Standard deviation, radians or meters.
        sigma: f64,
        /// Share of the offset that is not observable separately from other parameters, 0 to 1.
        unobservable_frac: f64,
    },
    /// Correction of the intrinsics.
    Lens {
        /// Name of the camera.
        camera: String,
        /// Factors on the focal lengths, minus 1.
        focal_frac: [f64; 2],
        /// Standard deviations of the factors.
        focal_sigma: [f64; 2],
        /// Offset of the principal point, in focal lengths.
        principal_offset_focals: [f64; 2],
        /// Standard deviations of the offset.
        principal_offset_sigma: [f64; 2],
    },
    /// Individual pose corrections of images.
    ImagePoses {
        /// Name of the camera.
        camera: String,
        /// Number of images.
        n_images: usize,
        /// Root mean square of the translations, meters.
        rms_m: f64,
        /// Root mean square of the rotations, radians.
        rms_rad: f64,
    },
}

/// A rigid motion with its uncertainty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseEstimate {
    /// Name of the camera.
    pub camera: String,
    /// Angle of rotation, radians.
    pub rotation_rad: f64,
    /// Standard deviation, radians.
    pub rotation_sigma_rad: f64,
    /// Unit vector, or zero without rotation.
    pub rotation_axis: [f64; 3],
    /// Length of the translation, meters.
    pub translation_m: f64,
    /// Standard deviation, meters.
    pub translation_sigma_m: f64,
    /// Unit vector, or zero without translation.
    pub translation_axis: [f64; 3],
}

/// An estimate of one parameter of one camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScalarEstimate {
    /// Name of the camera.
    pub camera: String,
    /// Value, in seconds or as a fraction.
    pub value: f64,
    /// Standard deviation, in the unit of the value.
    pub sigma: f64,
}

/// A direction in parameter space that the motion does not make observable. Changing all its parts
/// together changes no residual.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Unobservable {
    /// Descriptions of the parts.
    pub parts: Vec<String>,
    /// Names of the cameras whose extrinsics the direction changes. Empty if the direction also
    /// changes other parameters.
    #[serde(default)]
    pub moves_cameras: Vec<String>,
}

/// Summarizes the accepted model.
pub(super) fn alignment(
    scene: &AlignmentScene,
    kept: &CalibrationModel,
    trials: Vec<Trial>,
    unobservable: Vec<Unobservable>,
) -> Alignment {
    let mut estimates = Vec::new();
    if let Some(fit) = &kept.fit {
        for (ix, param) in fit.layout.params.iter().enumerate() {
            estimates.extend(self::estimate(scene, kept, &fit.solution, ix, *param));
        }
    }
    if kept.set.contains(ParamSet::IMAGE_POSES) {
        estimates.extend(scene.cameras.iter().enumerate().map(|(camera, name)| {
            let drift = &kept.corrections.by_camera[camera].drift;
            Estimate::ImagePoses {
                camera: name.to_string(),
                n_images: drift.len(),
                rms_m: rms(drift, 3..6),
                rms_rad: rms(drift, 0..3),
            }
        }));
    }
    let corrections = scene
        .cameras
        .iter()
        .zip(&kept.corrections.by_camera)
        .map(|(name, correction)| (name.to_string(), correction.clone()));
    // Without accepted parameters, the map is empty instead of containing corrections of zero.
    // Keyframes then stay unchanged.
    let corrections = if kept.set.is_empty() {
        BTreeMap::new()
    } else {
        corrections.collect()
    };
    let extrinsics_covariance = kept
        .fit
        .as_ref()
        .and_then(|fit| ExtrinsicsCovariance::of(scene, &fit.layout.params, &fit.solution));
    Alignment {
        corrections,
        estimates,
        unobservable,
        trials,
        n_pairs: scene.pairs.len(),
        movements: Vec::new(),
        extrinsics_covariance,
    }
}

/// Root mean square over the images of the norm of some parts of their drift.
fn rms(drift: &BTreeMap<i64, [f64; 6]>, parts: std::ops::Range<usize>) -> f64 {
    let squares = drift
        .values()
        .map(|drift| drift[parts.clone()].iter().map(|x| x * x).sum::<f64>());
    (squares.sum::<f64>() / drift.len().max(1) as f64).sqrt()
}

/// The estimate of a group of parameters, which is given by its first parameter. `None` if the
/// parameter is not the first of its group.
fn estimate(
    scene: &AlignmentScene,
    kept: &CalibrationModel,
    solution: &Solution,
    ix: usize,
    param: CalibrationParam,
) -> Option<Estimate> {
    let correction = |camera: usize| &kept.corrections.by_camera[camera];
    let name = |camera: usize| scene.cameras[camera].to_string();
    let number = |camera: usize, value: f64| ScalarEstimate {
        camera: name(camera),
        value,
        sigma: solution.sigma(ix),
    };
    Some(match param {
        CalibrationParam::Extrinsics(camera, 0) => {
            // The correction maps from the uncorrected to the corrected camera. The report contains
            // the motion of the camera, which is the inverse.
            let wrong_extrinsics = rigid_transform(
                correction(camera).rotation_rad.into(),
                correction(camera).translation_m.into(),
            )
            .inverse();
            Estimate::HandEye(pose_estimate(
                name(camera),
                wrong_extrinsics.rotation.scaled_axis(),
                wrong_extrinsics.translation.vector,
                solution,
                ix,
            ))
        }
        CalibrationParam::DepthPose(camera, 0) => {
            let correction = correction(camera);
            Estimate::DepthPose(pose_estimate(
                name(camera),
                correction.depth_rotation_rad.into(),
                correction.depth_translation_m.into(),
                solution,
                ix,
            ))
        }
        CalibrationParam::TimeOffset(camera) => {
            Estimate::TimeOffset(number(camera, correction(camera).time_offset_secs))
        }
        CalibrationParam::DepthScale(camera) => {
            Estimate::DepthScale(number(camera, correction(camera).log_depth_scale.exp_m1()))
        }
        CalibrationParam::Readout(camera) => {
            Estimate::Readout(number(camera, correction(camera).readout_secs))
        }
        CalibrationParam::Joint(joint_ix) => Estimate::Joint {
            joint_ix,
            value: kept.corrections.value(param),
            sigma: solution.sigma(ix),
            unobservable_frac: solution.unobservable_frac(ix),
        },
        CalibrationParam::Lens(camera, 0) => Estimate::Lens {
            camera: name(camera),
            focal_frac: correction(camera).log_focal.map(f64::exp_m1),
            focal_sigma: [solution.sigma(ix), solution.sigma(ix + 1)],
            principal_offset_focals: correction(camera).principal_offset_focals,
            principal_offset_sigma: [solution.sigma(ix + 2), solution.sigma(ix + 3)],
        },
        CalibrationParam::Extrinsics(..)
        | CalibrationParam::DepthPose(..)
        | CalibrationParam::Lens(..) => return None,
    })
}

/// A motion with its uncertainty. Its six parameters start at `begin`: translation, then rotation.
fn pose_estimate(
    camera: String,
    rotation: Vector3<f64>,
    translation: Vector3<f64>,
    solution: &Solution,
    begin: usize,
) -> PoseEstimate {
    // The standard deviations are along the estimated motion, so that they show whether its size is
    // significant.
    let rotation_axis = unit_or_zero(rotation);
    let translation_axis = unit_or_zero(translation);
    PoseEstimate {
        camera,
        rotation_rad: rotation.norm(),
        rotation_sigma_rad: sigma_along(solution, rotation_axis, begin + 3),
        rotation_axis: rotation_axis.into(),
        translation_m: translation.norm(),
        translation_sigma_m: sigma_along(solution, translation_axis, begin),
        translation_axis: translation_axis.into(),
    }
}

/// Direction of a vector. It is zero for a zero vector.
fn unit_or_zero(vector: Vector3<f64>) -> Vector3<f64> {
    vector.try_normalize(0.0).unwrap_or_else(Vector3::zeros)
}

/// Standard deviation of three parameters, starting at `begin`, along a direction.
fn sigma_along(solution: &Solution, axis: Vector3<f64>, begin: usize) -> f64 {
    let mut weights = DVector::zeros(solution.step.len());
    weights.rows_mut(begin, 3).copy_from(&axis);
    solution.variance(&weights).sqrt()
}

/// Unobservable directions of a fit.
pub(super) fn unobservable(scene: &AlignmentScene, fit: &Fit) -> Vec<Unobservable> {
    // Pure translations come first, because they are the most common directions and the easiest to
    // understand.
    let directions = fit
        .solution
        .unobservable(|ix| !is_translation(fit.layout.params[ix]));
    directions
        .iter()
        .map(|direction| describe(scene, &fit.layout.params, direction))
        .collect()
}

/// Whether a parameter is a translation of a camera or of a depth frame.
fn is_translation(param: CalibrationParam) -> bool {
    matches!(
        param,
        CalibrationParam::Extrinsics(_, 0..3) | CalibrationParam::DepthPose(_, 0..3)
    )
}

/// Describes an unobservable direction by its significant parts.
fn describe(
    scene: &AlignmentScene,
    params: &[CalibrationParam],
    direction: &DVector<f64>,
) -> Unobservable {
    /// Parts smaller than this fraction of the largest are omitted.
    const MIN_SHARE: f64 = 0.1;
    let scaled: Vec<f64> = params
        .iter()
        .enumerate()
        .map(|(ix, param)| direction[ix] / param.scale())
        .collect();
    let largest = scaled
        .iter()
        .fold(0.0f64, |largest, value| largest.max(value.abs()));
    let is_significant = |ix: usize, n: usize| {
        let mut parts = scaled[ix..ix + n].iter();
        parts.any(|value| value.abs() > MIN_SHARE * largest)
    };
    let axis = |ix: usize| {
        let along = Vector3::from_fn(|row, _| direction[ix + row]).normalize();
        format!("({:.2} {:.2} {:.2})", along.x, along.y, along.z)
    };
    let mut parts = Vec::new();
    for (ix, param) in params.iter().enumerate() {
        let name = |camera: usize| &scene.cameras[camera];
        // Translations and rotations are described once, at their first part.
        parts.extend(match *param {
            CalibrationParam::Extrinsics(camera, 0) if is_significant(ix, 3) => Some(format!(
                "translation of camera {:?} along its own {} axis",
                name(camera),
                axis(ix)
            )),
            CalibrationParam::Extrinsics(camera, 3) if is_significant(ix, 3) => Some(format!(
                "rotation of camera {:?} about its own {} axis",
                name(camera),
                axis(ix)
            )),
            CalibrationParam::DepthPose(camera, 0) if is_significant(ix, 3) => Some(format!(
                "translation of the depth frame of camera {:?} along {}",
                name(camera),
                axis(ix)
            )),
            CalibrationParam::DepthPose(camera, 3) if is_significant(ix, 3) => Some(format!(
                "rotation of the depth frame of camera {:?} about {}",
                name(camera),
                axis(ix)
            )),
            CalibrationParam::Joint(joint) if is_significant(ix, 1) => {
                Some(format!("offset of joint {joint}"))
            }
            CalibrationParam::TimeOffset(camera) if is_significant(ix, 1) => {
                Some(format!("time offset of camera {:?}", name(camera)))
            }
            CalibrationParam::DepthScale(camera) if is_significant(ix, 1) => {
                Some(format!("depth scale of camera {:?}", name(camera)))
            }
            CalibrationParam::Readout(camera) if is_significant(ix, 1) => {
                Some(format!("readout time of camera {:?}", name(camera)))
            }
            CalibrationParam::Lens(camera, part) if is_significant(ix, 1) => {
                let names = [
                    "focal length along x",
                    "focal length along y",
                    "principal point along x",
                    "principal point along y",
                ];
                Some(format!("{} of camera {:?}", names[part], name(camera)))
            }
            _ => None,
        });
    }
    // `None` if the direction changes anything but extrinsics.
    let moved = (0..params.len())
        .filter(|ix| is_significant(*ix, 1))
        .map(|ix| match params[ix] {
            CalibrationParam::Extrinsics(camera, _) => Some(scene.cameras[camera].to_string()),
            _ => None,
        });
    let moves_cameras: Option<BTreeSet<String>> = moved.collect();
    Unobservable {
        parts,
        moves_cameras: moves_cameras.unwrap_or_default().into_iter().collect(),
    }
}

impl Alignment {
    /// Whether any correction was accepted.
    pub fn has_corrections(&self) -> bool {
        !self.corrections.is_empty()
    }

    /// Whether another alignment gives the camera of a keyframe a noticeably different pose.
    pub(crate) fn differs(&self, other: &Self, keyframe: &Keyframe) -> bool {
        self.camera(keyframe, None)
            .differs_noticeably(&other.camera(keyframe, None))
    }

    /// The camera of a keyframe with these corrections, followed by a correction that was optimized
    /// with the scene.
    pub fn camera(
        &self,
        keyframe: &Keyframe,
        learned: Option<&CameraCorrection>,
    ) -> CalibratedCamera {
        let correction = self.corrections.get(&*keyframe.camera);
        let color_from_depth = keyframe.depth.as_ref().map(|depth| match correction {
            Some(correction) => correction.color_from_depth(keyframe, depth),
            None => keyframe.world_from_camera.inverse() * depth.world_from_camera,
        });
        // The depth map and the mask of a robot are left out, because only the pose is needed and
        // changing all pixels would take time.
        let aligned = self.moved(&Arc::new(Keyframe {
            depth: None,
            ..keyframe.clone()
        }));
        let camera = learned.map_or_else(
            || CalibratedCamera::of(&aligned),
            |correction| correction.apply(&aligned),
        );
        CalibratedCamera {
            color_from_depth,
            ..camera
        }
    }

    /// The keyframe with these corrections.
    pub fn corrected(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        let keyframe = self.with_movements(keyframe);
        match self.corrections.get(&*keyframe.camera) {
            Some(correction) => Arc::new(correction.corrected(&keyframe)),
            None => keyframe,
        }
    }

    /// The keyframe with these corrections. The mask of a robot is not drawn again.
    pub fn moved(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        let movements = self.movement_correction(&keyframe.camera, keyframe.stamp);
        let corrections = movements
            .iter()
            .chain(self.corrections.get(&*keyframe.camera));
        corrections.fold(Arc::clone(keyframe), |keyframe, correction| {
            Arc::new(correction.moved(&keyframe))
        })
    }

    /// The keyframe with the mask of the robot as the corrected camera sees it. Its calibration
    /// stays the same.
    pub fn remasked<'a>(&self, keyframe: &'a Keyframe) -> Cow<'a, Keyframe> {
        if keyframe.robot.is_none() {
            return Cow::Borrowed(keyframe);
        }
        let movements = self.movement_correction(&keyframe.camera, keyframe.stamp);
        let corrections = movements
            .iter()
            .chain(self.corrections.get(&*keyframe.camera));
        corrections.fold(Cow::Borrowed(keyframe), |keyframe, correction| {
            Cow::Owned(correction.remasked(&keyframe))
        })
    }

    /// The keyframe with the corrections of its camera's movements only.
    pub fn with_movements(&self, keyframe: &Arc<Keyframe>) -> Arc<Keyframe> {
        match self.movement_correction(&keyframe.camera, keyframe.stamp) {
            Some(correction) => Arc::new(correction.corrected(keyframe)),
            None => keyframe.clone(),
        }
    }

    /// Combined correction of a camera's movements up to a stamp. `None` if there are none.
    pub fn movement_correction(&self, camera: &str, stamp: Stamp) -> Option<CameraCorrection> {
        let movements = self
            .movements
            .iter()
            .filter(|movement| movement.camera == camera && movement.since_nanos <= stamp.0);
        let total = movements
            .map(CameraMovement::correction)
            .reduce(|before, after| after * before)?;
        let (rotation_rad, translation_m) = rotation_and_translation(&total);
        Some(CameraCorrection {
            rotation_rad,
            translation_m,
            ..CameraCorrection::default()
        })
    }

    /// Adds a movement that was estimated from keyframes with these corrections. `first` is the
    /// stamp of the first keyframe.
    pub fn add_movement(&mut self, movement: CameraMovement, first: Stamp) {
        let extrinsics =
            self.corrections
                .get(&movement.camera)
                .map_or(Transform::identity(), |correction| {
                    rigid_transform(
                        correction.rotation_rad.into(),
                        correction.translation_m.into(),
                    )
                });
        // The movement was estimated in the axes of the corrected camera, but movements are applied
        // before the correction of the extrinsics.
        let before_extrinsics = extrinsics.inverse() * movement.correction() * extrinsics;
        let (rotation_rad, translation_m) = rotation_and_translation(&before_extrinsics);
        let since_secs = (movement.since_nanos - first.0) as f64 * 1e-9;
        self.movements.push(CameraMovement {
            rotation_rad,
            translation_m,
            since_secs,
            ..movement
        });
    }

    /// Whether there were enough validation images for decisions.
    pub fn has_enough_validation_images(&self) -> bool {
        self.trials
            .iter()
            .all(|trial| trial.n_images >= MIN_VALIDATION_IMAGES)
    }

    /// Whether individual image poses were accepted.
    pub fn has_image_poses(&self) -> bool {
        let is_image_poses = |params: &Candidate| matches!(params, Candidate::Cameras(params) if params.contains(ParamSet::IMAGE_POSES));
        self.trials
            .iter()
            .any(|trial| trial.kept && is_image_poses(&trial.candidate))
    }

    /// Text lines with the estimates, unobservable directions and trials.
    pub fn lines(&self) -> Vec<String> {
        let mut lines: Vec<String> = self.estimates.iter().map(ToString::to_string).collect();
        lines.extend(
            self.unobservable
                .iter()
                .map(|unobservable| format!("not observable with this motion: {unobservable}")),
        );
        for trial in &self.trials {
            lines.push(format!(
                "{}: {:+.2} dB (standard error {:.2}) on {} validation images: {}",
                trial.candidate,
                trial.gain_db,
                trial.standard_error_db,
                trial.n_images,
                if trial.kept {
                    "accepted"
                } else if trial.n_images < MIN_VALIDATION_IMAGES {
                    "too few images"
                } else {
                    "rejected"
                }
            ));
        }
        lines
    }
}

impl std::fmt::Display for Unobservable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.parts.join(" together with "))
    }
}

impl std::fmt::Display for PoseEstimate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [ax, ay, az] = self.rotation_axis;
        let [sx, sy, sz] = self.translation_axis;
        write!(
            f,
            "rotated by {:.3} +- {:.3} degrees about ({ax:.2} {ay:.2} {az:.2}), moved by {:.2} +- {:.2} mm along ({sx:.2} {sy:.2} {sz:.2})",
            self.rotation_rad.to_degrees(),
            self.rotation_sigma_rad.to_degrees(),
            1e3 * self.translation_m,
            1e3 * self.translation_sigma_m,
        )
    }
}

impl std::fmt::Display for Estimate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::HandEye(pose_estimate) => {
                write!(f, "hand-eye of {}: {pose_estimate}", pose_estimate.camera)
            }
            Self::DepthPose(pose_estimate) => write!(
                f,
                "depth frame of {}: {pose_estimate}",
                pose_estimate.camera
            ),
            Self::TimeOffset(ScalarEstimate {
                camera,
                value,
                sigma,
            }) => {
                write!(
                    f,
                    "time offset of {camera}: {:.2} +- {:.2} ms",
                    1e3 * value,
                    1e3 * sigma
                )
            }
            Self::DepthScale(ScalarEstimate {
                camera,
                value,
                sigma,
            }) => {
                write!(
                    f,
                    "depth scale of {camera}: {:.4} +- {sigma:.4}",
                    1.0 + value
                )
            }
            Self::Readout(ScalarEstimate {
                camera,
                value,
                sigma,
            }) => {
                write!(
                    f,
                    "readout time of {camera}: {:+.2} +- {:.2} ms",
                    1e3 * value,
                    1e3 * sigma
                )
            }
            Self::Joint {
                joint_ix,
                value,
                sigma,
                unobservable_frac,
            } => {
                let value = value.to_degrees();
                let sigma = sigma.to_degrees();
                write!(
                    f,
                    "offset of joint {joint_ix}: {value:+.3} +- {sigma:.3} degrees"
                )?;
                if *unobservable_frac > 0.1 {
                    f.write_str(", partly indistinguishable from other parameters")
                } else {
                    Ok(())
                }
            }
            Self::Lens {
                camera,
                focal_frac,
                focal_sigma,
                principal_offset_focals,
                principal_offset_sigma,
            } => {
                let percent = |value: f64| 100.0 * value;
                write!(
                    f,
                    "lens of {camera}: focal lengths {:+.3} +- {:.3} % and {:+.3} +- {:.3} %, principal point {:+.3} +- {:.3} % and {:+.3} +- {:.3} % of the focal lengths",
                    percent(focal_frac[0]),
                    percent(focal_sigma[0]),
                    percent(focal_frac[1]),
                    percent(focal_sigma[1]),
                    percent(principal_offset_focals[0]),
                    percent(principal_offset_sigma[0]),
                    percent(principal_offset_focals[1]),
                    percent(principal_offset_sigma[1]),
                )
            }
            Self::ImagePoses {
                camera,
                n_images,
                rms_m,
                rms_rad,
            } => write!(
                f,
                "poses of {n_images} images of {camera}: corrected by {:.2} mm and {:.3} degrees (root mean square)",
                1e3 * rms_m,
                rms_rad.to_degrees()
            ),
        }
    }
}
