//! The result of a hand-eye calibration as JSON and as text.

use super::{HandEyeOutcome, pose_toml};
use crate::lens::LensFile;
use crate::matrix::{Matrix, matrix_lines, matrix_of};
use calibration::hand_eye::{HandEyeCalibration, NextPose, SampleStatus, Setup};
use kinematics::Transform;
use messages::ErrorClass;
use report::calibration_report::Unused;
use serde::Serialize;

/// The result of a hand-eye calibration. It serializes as JSON. Matrices are row by row. Standard
/// deviations are along and about the axes of the camera.
#[derive(Debug, Default, Serialize)]
pub struct HandEyeDocument {
    #[serde(skip_serializing_if = "Option::is_none")]
    flange_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_from_board: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    flange_from_board: Option<Option<Matrix>>,
    scatter_mm: Option<f64>,
    scatter_deg: Option<f64>,
    held_out_scatter_mm: Option<f64>,
    held_out_scatter_deg: Option<f64>,
    rms_px: Option<f64>,
    held_out_rms_px: Option<f64>,
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
    /// The estimated intrinsics, if they were requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    intrinsics: Option<LensFile>,
    joint_offsets: Vec<DocumentJoint>,
    samples: Vec<DocumentSample>,
    /// The poses that would lower the uncertainty most.
    next_poses: Vec<SuggestedPose>,
    /// Problems of the result, one sentence each.
    pub warnings: Vec<String>,
    /// Why there is no result.
    pub refused: Option<String>,
    /// `parent_from_camera` for the rig file.
    #[serde(skip)]
    rig_pose: Option<Transform>,
}

/// A suggested robot pose.
#[derive(Debug, Serialize)]
struct SuggestedPose {
    base_from_flange: Matrix,
    #[serde(skip_serializing_if = "Option::is_none")]
    joints: Option<Vec<f64>>,
    motion: String,
    /// Standard deviations with this pose, relative to the standard deviations without it.
    sigma_frac: f64,
}

#[derive(Debug, Serialize)]
struct DocumentJoint {
    joint: String,
    /// Offset to add to the readings, radians (meters for prismatic joints); null if it cannot be
    /// observed.
    offset: Option<f64>,
    sigma: Option<f64>,
}

#[derive(Debug, Default, Serialize)]
struct DocumentSample {
    name: String,
    status: &'static str,
    /// Why the target was not found in its image.
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    #[serde(skip)]
    is_unreadable: bool,
    position_mm: Option<f64>,
    rotation_deg: Option<f64>,
    rms_px: Option<f64>,
}

impl SuggestedPose {
    fn of(next: NextPose) -> Self {
        let NextPose {
            base_from_flange,
            joints,
            motion,
            sigma_frac,
            ..
        } = next;
        Self {
            base_from_flange: matrix_of(&base_from_flange),
            joints,
            motion,
            sigma_frac,
        }
    }
}

impl HandEyeOutcome {
    /// The result, or a refusal if the samples do not determine it. `None` after other errors.
    pub fn document(&self) -> Option<HandEyeDocument> {
        let mut document = match &self.result {
            Ok(calibrated) => HandEyeDocument {
                next_poses: calibrated
                    .next_poses
                    .iter()
                    .cloned()
                    .map(SuggestedPose::of)
                    .collect(),
                rig_pose: Some(calibrated.rig_pose),
                ..of_calibration(&calibrated.calibration)
            },
            Err(error) if session::class(error) == ErrorClass::InsufficientData => {
                HandEyeDocument::refused(self.setup(), format!("{error:#}"))
            }
            Err(_) => return None,
        };
        let unused = self.unused().iter().map(DocumentSample::unused);
        document.samples.extend(unused);
        document
            .warnings
            .extend(self.size_warning().map(str::to_owned));
        Some(document)
    }
}

fn of_calibration(calibration: &HandEyeCalibration) -> HandEyeDocument {
    let camera = Some(matrix_of(&calibration.parent_from_camera));
    let board = Some(matrix_of(&calibration.parent_from_board));
    // The outer `Option` says whether the setup has this matrix. The inner `Option` says whether
    // the matrix is known.
    let of_setup =
        |setup: Setup, matrix: Option<Matrix>| (calibration.setup == setup).then_some(matrix);
    let held_out = calibration.held_out_scatter;
    HandEyeDocument {
        flange_from_camera: of_setup(Setup::EyeInHand, camera),
        base_from_camera: of_setup(Setup::EyeToHand, camera),
        base_from_board: of_setup(Setup::EyeInHand, board),
        flange_from_board: of_setup(Setup::EyeToHand, board),
        scatter_mm: Some(calibration.scatter.mm),
        scatter_deg: Some(calibration.scatter.deg),
        held_out_scatter_mm: held_out.map(|scatter| scatter.mm),
        held_out_scatter_deg: held_out.map(|scatter| scatter.deg),
        rms_px: calibration.rms_px,
        held_out_rms_px: calibration.held_out_rms_px,
        sigma_mm: Some(calibration.sigma_mm),
        sigma_deg: Some(calibration.sigma_deg),
        intrinsics: calibration
            .intrinsics
            .as_ref()
            .map(|(intrinsics, _)| LensFile::of(intrinsics)),
        joint_offsets: calibration
            .joint_offsets
            .iter()
            .map(|offset| DocumentJoint {
                joint: offset.joint.clone(),
                offset: offset.estimate.map(|[value, _]| value),
                sigma: offset.estimate.map(|[_, sigma]| sigma),
            })
            .collect(),
        samples: calibration
            .samples
            .iter()
            .map(|sample| DocumentSample {
                name: sample.name.clone(),
                reason: None,
                is_unreadable: false,
                status: match sample.status {
                    SampleStatus::Used => "used",
                    SampleStatus::Outlier => "outlier",
                    SampleStatus::NoBoard => "no-board",
                    SampleStatus::Repeated => "repeated",
                },
                position_mm: sample.position_mm,
                rotation_deg: sample.rotation_deg,
                rms_px: sample.rms_px,
            })
            .collect(),
        // The caller adds them, because they depend on the target.
        next_poses: Vec::new(),
        warnings: calibration.warnings.clone(),
        refused: None,
        rig_pose: None,
    }
}

impl DocumentSample {
    /// A sample whose image has no target.
    fn unused(unused: &Unused) -> Self {
        Self {
            name: unused.name.clone(),
            status: if unused.is_unreadable {
                "unreadable"
            } else {
                "no-board"
            },
            reason: Some(unused.reason.clone()),
            is_unreadable: unused.is_unreadable,
            ..Self::default()
        }
    }
}

impl HandEyeDocument {
    /// A document for the case that there is no result.
    fn refused(setup: Setup, reason: String) -> Self {
        // The keys are the same as in a result, but matrices are null.
        let of_setup = |other: Setup| (setup == other).then_some(None);
        Self {
            flange_from_camera: of_setup(Setup::EyeInHand),
            base_from_board: of_setup(Setup::EyeInHand),
            base_from_camera: of_setup(Setup::EyeToHand),
            flange_from_board: of_setup(Setup::EyeToHand),
            refused: Some(reason),
            ..Self::default()
        }
    }

    /// The result as text.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        let matrices = [
            ("flange_from_camera", self.flange_from_camera),
            ("base_from_camera", self.base_from_camera),
            ("base_from_board", self.base_from_board),
            ("flange_from_board", self.flange_from_board),
        ];
        for (name, matrix) in matrices {
            let Some(Some(matrix)) = matrix else { continue };
            lines.push(format!("{name}, row by row (meters):"));
            lines.extend(matrix_lines(&matrix));
        }
        if let Some(pose) = &self.rig_pose {
            lines.push(format!(
                "rig file:\nparent_from_camera = {}",
                pose_toml(pose)
            ));
        }
        if let Some(intrinsics) = &self.intrinsics {
            lines.push(format!("intrinsics = {}", intrinsics.to_toml()));
        }
        lines.push(format!(
            "standard deviations of the camera along and about its x, y and z axes: {}; {}",
            three(self.sigma_mm, "mm"),
            three(self.sigma_deg, "degrees")
        ));
        if let (Some(mm), Some(deg)) = (self.scatter_mm, self.scatter_deg) {
            lines.push(format!(
                "scatter of the board over the samples: {mm:.2} mm, {deg:.3} degrees"
            ));
        }
        if let (Some(mm), Some(deg)) = (self.held_out_scatter_mm, self.held_out_scatter_deg) {
            lines.push(format!(
                "the same for samples that were left out: {mm:.2} mm, {deg:.3} degrees"
            ));
        }
        if let Some(rms_px) = self.rms_px {
            lines.push(format!("reprojection error: {rms_px:.3} px (RMS)"));
        }
        for joint in &self.joint_offsets {
            lines.push(match (joint.offset, joint.sigma) {
                (Some(offset), Some(sigma)) => {
                    format!(
                        "offset of {}: {offset:.6} +- {sigma:.6} (radians or meters)",
                        joint.joint
                    )
                }
                _ => format!("offset of {}: cannot be observed", joint.joint),
            });
        }
        // Images that cannot be read were reported in a warning.
        let is_news = |sample: &&DocumentSample| sample.status != "used" && !sample.is_unreadable;
        for sample in self.samples.iter().filter(is_news) {
            let reason = sample.reason.as_deref().unwrap_or(sample.status);
            lines.push(format!("not used: {}: {reason}", sample.name));
        }
        if let Some(next) = self.next_poses.first() {
            let percent = 100.0 * (1.0 - next.sigma_frac);
            lines.push(format!(
                "next pose: {} (lowers the standard deviations by {percent:.0} %)",
                next.motion
            ));
        }
        lines
    }
}

fn three(values: Option<[f64; 3]>, unit: &str) -> String {
    let values = values
        .unwrap_or_default()
        .map(|value| format!("{value:.3}"));
    format!("{} {unit}", values.join(", "))
}
