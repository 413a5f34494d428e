//! The printed result of `fieldrig calibrate hand-eye`.

use crate::commands::calibrate::{matrix_of, print_matrix};
use crate::print;
use calibrate::{LensFile, pose_toml};
use calibration::hand_eye::{HandEyeCalibration, NextPose, SampleStatus, Setup};
use kinematics::Transform;
use report::calibration_report::Unused;
use serde::Serialize;

type Matrix = [[f64; 4]; 4];

/// The printed result. Matrices are row by row. Standard deviations are along and about the axes of
/// the camera.
#[derive(Debug, Default, Serialize)]
pub(super) struct Printed {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) flange_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) base_from_camera: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) base_from_board: Option<Option<Matrix>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) flange_from_board: Option<Option<Matrix>>,
    pub(super) scatter_mm: Option<f64>,
    pub(super) scatter_deg: Option<f64>,
    pub(super) held_out_scatter_mm: Option<f64>,
    pub(super) held_out_scatter_deg: Option<f64>,
    pub(super) rms_px: Option<f64>,
    pub(super) held_out_rms_px: Option<f64>,
    pub(super) sigma_mm: Option<[f64; 3]>,
    pub(super) sigma_deg: Option<[f64; 3]>,
    /// The estimated intrinsics, if they were requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) intrinsics: Option<LensFile>,
    pub(super) joint_offsets: Vec<PrintedJoint>,
    pub(super) samples: Vec<PrintedSample>,
    /// The poses that would lower the uncertainty most.
    pub(super) next_poses: Vec<PrintedPose>,
    pub(super) warnings: Vec<String>,
    pub(super) refused: Option<String>,
}

/// A suggested robot pose.
#[derive(Debug, Serialize)]
pub(super) struct PrintedPose {
    pub(super) base_from_flange: Matrix,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) joints: Option<Vec<f64>>,
    pub(super) motion: String,
    /// Standard deviations with this pose, relative to the standard deviations without it.
    pub(super) sigma_frac: f64,
}

#[derive(Debug, Serialize)]
pub(super) struct PrintedJoint {
    pub(super) joint: String,
    /// Offset to add to the readings, radians (meters for prismatic joints); null if it cannot be
    /// observed.
    pub(super) offset: Option<f64>,
    pub(super) sigma: Option<f64>,
}

#[derive(Debug, Default, Serialize)]
pub(super) struct PrintedSample {
    pub(super) name: String,
    pub(super) status: &'static str,
    /// Why the target was not found in its image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) reason: Option<String>,
    #[serde(skip)]
    pub(super) is_unreadable: bool,
    pub(super) position_mm: Option<f64>,
    pub(super) rotation_deg: Option<f64>,
    pub(super) rms_px: Option<f64>,
}

impl PrintedPose {
    pub(super) fn of(next: NextPose) -> Self {
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

pub(super) fn printed(calibration: &HandEyeCalibration) -> Printed {
    let camera = Some(matrix_of(&calibration.parent_from_camera));
    let board = Some(matrix_of(&calibration.parent_from_board));
    // The outer `Option` says whether the setup has this matrix. The inner `Option` says whether
    // the matrix is known.
    let of_setup =
        |setup: Setup, matrix: Option<Matrix>| (calibration.setup == setup).then_some(matrix);
    let held_out = calibration.held_out_scatter;
    Printed {
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
            .map(|offset| PrintedJoint {
                joint: offset.joint.clone(),
                offset: offset.estimate.map(|[value, _]| value),
                sigma: offset.estimate.map(|[_, sigma]| sigma),
            })
            .collect(),
        samples: calibration
            .samples
            .iter()
            .map(|sample| PrintedSample {
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
    }
}

impl PrintedSample {
    /// A sample whose image has no target.
    pub(super) fn unused(unused: &Unused) -> Self {
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

impl Printed {
    /// A printed result for the case that there is no result.
    pub(super) fn refused(setup: Setup, reason: String) -> Self {
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
}

fn three(values: Option<[f64; 3]>, unit: &str) -> String {
    let values = values
        .unwrap_or_default()
        .map(|value| format!("{value:.3}"));
    format!("{} {unit}", values.join(", "))
}

/// Prints the result. `rig_pose`: `parent_from_camera` for the rig file.
pub(super) fn describe(printed: &Printed, rig_pose: Option<&Transform>) -> anyhow::Result<()> {
    let matrices = [
        ("flange_from_camera", printed.flange_from_camera),
        ("base_from_camera", printed.base_from_camera),
        ("base_from_board", printed.base_from_board),
        ("flange_from_board", printed.flange_from_board),
    ];
    for (name, matrix) in matrices {
        let Some(Some(matrix)) = matrix else { continue };
        print::line(format!("{name}, row by row (meters):"))?;
        print_matrix(&matrix)?;
    }
    if let Some(pose) = rig_pose {
        print::line(format!(
            "rig file:\nparent_from_camera = {}",
            pose_toml(pose)
        ))?;
    }
    if let Some(intrinsics) = &printed.intrinsics {
        print::line(format!("intrinsics = {}", intrinsics.to_toml()))?;
    }
    print::line(format!(
        "standard deviations of the camera along and about its x, y and z axes: {}; {}",
        three(printed.sigma_mm, "mm"),
        three(printed.sigma_deg, "degrees")
    ))?;
    if let (Some(mm), Some(deg)) = (printed.scatter_mm, printed.scatter_deg) {
        print::line(format!(
            "scatter of the board over the samples: {mm:.2} mm, {deg:.3} degrees"
        ))?;
    }
    if let (Some(mm), Some(deg)) = (printed.held_out_scatter_mm, printed.held_out_scatter_deg) {
        print::line(format!(
            "the same for samples that were left out: {mm:.2} mm, {deg:.3} degrees"
        ))?;
    }
    if let Some(rms_px) = printed.rms_px {
        print::line(format!("reprojection error: {rms_px:.3} px (RMS)"))?;
    }
    for joint in &printed.joint_offsets {
        print::line(match (joint.offset, joint.sigma) {
            (Some(offset), Some(sigma)) => {
                format!(
                    "offset of {}: {offset:.6} +- {sigma:.6} (radians or meters)",
                    joint.joint
                )
            }
            _ => format!("offset of {}: cannot be observed", joint.joint),
        })?;
    }
    // Images that cannot be read were reported in a warning.
    let is_news = |sample: &&PrintedSample| sample.status != "used" && !sample.is_unreadable;
    for sample in printed.samples.iter().filter(is_news) {
        let reason = sample.reason.as_deref().unwrap_or(sample.status);
        print::line(format!("not used: {}: {reason}", sample.name))?;
    }
    if let Some(next) = printed.next_poses.first() {
        let percent = 100.0 * (1.0 - next.sigma_frac);
        print::line(format!(
            "next pose: {} (lowers the standard deviations by {percent:.0} %)",
            next.motion
        ))?;
    }
    for warning in &printed.warnings {
        log::warn!("{warning}");
    }
    Ok(())
}
