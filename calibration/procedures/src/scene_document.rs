//! The result of a calibration from a scene as JSON and as text.

use crate::matrix::{Matrix, matrix_lines, matrix_of};
use crate::scene::SceneOutcome;
use calibration::{CameraCorrection, Estimate, PoseSigmas, Trial, rigid_transform};
use serde::Serialize;
use session::{Refine, RelativePose};
use std::collections::BTreeMap;

/// The result of a calibration from a scene. It serializes as JSON.
#[derive(Debug, Serialize)]
pub struct SceneDocument<'a> {
    n_images: usize,
    /// Calibration after the accepted corrections, by name of the camera. Without a rig file, this
    /// is empty.
    cameras: BTreeMap<&'a str, CameraResult>,
    /// For data without a rig file, the pose of each corrected camera in the frame of the given
    /// camera. To correct the poses, multiply each given `world_from_camera` by this pose from the
    /// right.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    given_from_corrected: BTreeMap<&'a str, Matrix>,
    estimates: &'a [Estimate],
    trials: &'a [Trial],
    /// Directions in parameter space that the motion does not determine.
    unobservable: Vec<String>,
    /// Why no camera could be calibrated.
    pub refused: Option<String>,
}

#[derive(Debug, Serialize)]
struct CameraResult {
    /// Number of images used.
    n_images: usize,
    /// Why the extrinsics from the rig file were kept.
    refused: Option<String>,
    parent_from_camera: Matrix,
    /// Standard deviations along and about the axes of the camera; null if its extrinsics were not
    /// estimated.
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
    /// Pose in the frame of the first camera with the same parent; null for that camera.
    relative: Option<RelativeResult>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Time from the stamps of the images to mid-exposure, milliseconds.
    stamp_to_mid_exposure_millis: Option<f64>,
}

/// Pose of a camera in the frame of another camera.
#[derive(Debug, Serialize)]
struct RelativeResult {
    camera: String,
    camera_from_this: Matrix,
    /// Standard deviations along and about the axes of this camera; null if they are unknown.
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
}

impl SceneOutcome {
    /// The result.
    pub fn document(&self) -> SceneDocument<'_> {
        let Self {
            data, calibration, ..
        } = self;
        let cameras = calibration
            .rig
            .iter()
            .flat_map(|rig| &rig.cameras)
            .map(|camera| {
                let sigmas = calibration.sigmas(&camera.name);
                let printed = CameraResult {
                    n_images: data
                        .keyframes
                        .iter()
                        .filter(|keyframe| *keyframe.camera == *camera.name)
                        .count(),
                    refused: calibration.refused.get(&*camera.name).cloned(),
                    parent_from_camera: matrix_of(&camera.parent_from_camera),
                    sigma_mm: sigmas.map(sigma_mm),
                    sigma_deg: sigmas.map(sigma_deg),
                    relative: calibration.relative(&camera.name).map(relative),
                    focal_px: camera.intrinsics.focal_px,
                    principal_px: camera.intrinsics.principal_px,
                    stamp_to_mid_exposure_millis: camera
                        .stamp_to_mid_exposure
                        .as_ref()
                        .map(|offset| offset.value_millis),
                };
                (&*camera.name, printed)
            });
        let alignment = &calibration.alignment;
        SceneDocument {
            n_images: data.keyframes.len(),
            cameras: cameras.collect(),
            // With a rig file, the poses of its cameras contain the same information.
            given_from_corrected: match calibration.rig {
                Some(_) => BTreeMap::new(),
                None => alignment
                    .corrections
                    .iter()
                    .map(given_from_corrected)
                    .collect(),
            },
            estimates: &alignment.estimates,
            trials: &alignment.trials,
            unobservable: alignment
                .unobservable
                .iter()
                .map(ToString::to_string)
                .collect(),
            refused: self.refused.clone(),
        }
    }

    /// The result as text.
    pub fn lines(&self) -> Vec<String> {
        let document = self.document();
        let mut lines = Vec::new();
        lines.push(format!("{} images", document.n_images));
        lines.extend(self.calibration.alignment.lines());
        if document.estimates.is_empty() && document.refused.is_none() {
            lines.push(
                "nothing to correct: no parameter improves the prediction of validation images"
                    .to_owned(),
            );
        }
        for (name, matrix) in &document.given_from_corrected {
            lines.push(format!(
                "pose of the corrected camera {name} in the given one, row by row; multiply each pose by it from the right:"
            ));
            lines.extend(matrix_lines(matrix));
        }
        for (name, camera) in &document.cameras {
            lines.push(format!(
                "parent_from_camera of {name}, row by row ({} images):",
                camera.n_images
            ));
            lines.extend(matrix_lines(&camera.parent_from_camera));
            lines.extend(sigma_line(camera.sigma_mm, camera.sigma_deg));
            if let Some(relative) = &camera.relative {
                lines.push(format!(
                    "pose of {name} in the frame of {}, row by row:",
                    relative.camera
                ));
                lines.extend(matrix_lines(&relative.camera_from_this));
                lines.extend(sigma_line(relative.sigma_mm, relative.sigma_deg));
            }
        }
        lines
    }

    /// Problems of the result, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        // With `auto`, only confirmed corrections are applied.
        let is_auto = self.params == [Refine::Auto];
        if !is_auto
            && self
                .calibration
                .alignment
                .trials
                .iter()
                .any(|trial| !trial.kept)
        {
            warnings.push(
                "the corrections are applied as requested, but validation images do not confirm all of them"
                    .to_owned(),
            );
        }
        // If all cameras are refused, the reason is the error of the command.
        if self.refused.is_none() {
            let cameras = self.document().cameras;
            warnings.extend(cameras.into_iter().filter_map(|(name, camera)| {
                let reason = camera.refused?;
                Some(format!("camera {name:?} keeps its extrinsics: {reason}"))
            }));
        }
        warnings
    }
}

fn relative(relative: RelativePose) -> RelativeResult {
    let RelativePose {
        first,
        first_from_camera,
        sigmas,
    } = relative;
    RelativeResult {
        camera: first,
        camera_from_this: matrix_of(&first_from_camera),
        sigma_mm: sigmas.map(sigma_mm),
        sigma_deg: sigmas.map(sigma_deg),
    }
}

fn sigma_mm(sigmas: PoseSigmas) -> [f64; 3] {
    sigmas.m.map(|m| 1e3 * m)
}

fn sigma_deg(sigmas: PoseSigmas) -> [f64; 3] {
    sigmas.rad.map(f64::to_degrees)
}

fn given_from_corrected<'a>(
    (camera, correction): (&'a String, &CameraCorrection),
) -> (&'a str, Matrix) {
    let corrected_from_given = rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    );
    // The estimate maps given frames to corrected frames. Poses of cameras need the inverse.
    (camera, matrix_of(&corrected_from_given.inverse()))
}

/// Standard deviations of a camera as text.
fn sigma_line(mm: Option<[f64; 3]>, deg: Option<[f64; 3]>) -> Option<String> {
    let list = |values: [f64; 3]| values.map(|value| format!("{value:.3}")).join(", ");
    Some(format!(
        "standard deviations along and about the camera's x, y and z axes: {} mm; {} degrees",
        list(mm?),
        list(deg?)
    ))
}
