//! `fieldrig calibrate scene`: calibrates the cameras of a rig from images of a static scene.

use super::flags::ReportFlag;
use super::terminal::Terminal;
use super::{matrix_of, print_matrix};
use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::print;
use calibrate::{SceneOutcome, SceneTask};
use calibration::{CameraCorrection, Estimate, PoseSigmas, Trial, rigid_transform};
use messages::listed;
use serde::Serialize;
use session::{Refine, RelativePose, SCENE_PARAMS, SceneCalibration};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Flags of `calibrate scene`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Recording (.mcap), nerfstudio or TUM RGB-D folder, or rig file (.toml) whose devices are
    /// read
    #[arg(value_name = "RIG|DATA")]
    input: PathBuf,
    /// Use exactly the keyframes listed by an earlier run (keyframes.txt)
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
    /// Read a recording with this rig file instead of the rig file stored in the recording
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// What to estimate: auto (the parameters that improve the prediction of validation images), or
    /// a list of extrinsics, time-offset, lens and, with depth, joints, depth-pose, depth-scale and
    /// readout
    #[arg(long, value_name = "PARAMS", value_delimiter = ',', default_value = "auto", value_parser = scene_param)]
    params: Vec<Refine>,
    /// With a rig file: simulate all devices
    #[arg(long)]
    sim: bool,
    /// With a rig file: read the devices for S seconds [default: 30]
    #[arg(long, value_name = "S", value_parser = number_in_range(1.0..=3600.0))]
    seconds: Option<f64>,
    /// Write the rig file with the accepted corrections. An existing file is kept with the
    /// extension .old
    #[arg(long, value_name = "FILE")]
    write_rig: Option<PathBuf>,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// The printed result.
#[derive(Debug, Serialize)]
struct Printed<'a> {
    n_images: usize,
    /// Calibration after the accepted corrections, by name of the camera. Without a rig file, this
    /// is empty.
    cameras: BTreeMap<&'a str, PrintedCamera>,
    /// For data without a rig file, the pose of each corrected camera in the frame of the given
    /// camera. To correct the poses, multiply each given `world_from_camera` by this pose from the
    /// right.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    given_from_corrected: BTreeMap<&'a str, [[f64; 4]; 4]>,
    estimates: &'a [Estimate],
    trials: &'a [Trial],
    /// Directions in parameter space that the motion does not determine.
    unobservable: Vec<String>,
    /// Why no camera could be calibrated.
    refused: Option<String>,
}

#[derive(Debug, Serialize)]
struct PrintedCamera {
    /// Number of images used.
    n_images: usize,
    /// Why the extrinsics from the rig file were kept.
    refused: Option<String>,
    parent_from_camera: [[f64; 4]; 4],
    /// Standard deviations along and about the axes of the camera; null if its extrinsics were not
    /// estimated.
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
    /// Pose in the frame of the first camera with the same parent; null for that camera.
    relative: Option<PrintedRelative>,
    focal_px: [f64; 2],
    principal_px: [f64; 2],
    /// Time from the stamps of the images to mid-exposure, milliseconds.
    stamp_to_mid_exposure_millis: Option<f64>,
}

/// Pose of a camera in the frame of another camera.
#[derive(Debug, Serialize)]
struct PrintedRelative {
    camera: String,
    camera_from_this: [[f64; 4]; 4],
    /// Standard deviations along and about the axes of this camera; null if they are unknown.
    sigma_mm: Option<[f64; 3]>,
    sigma_deg: Option<[f64; 3]>,
}

/// Calibrates and prints the estimates. Exit code 4 if the data do not determine the extrinsics of
/// any camera.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let outcome = args.task().run(&Terminal::new(None, args.json))?;
    let exit = exit::from_losses(&outcome.data.data_losses);
    let printed = printed(&outcome);
    let is_refused = printed.refused.is_some();
    if args.json {
        print::json(&printed)?;
    } else {
        describe(
            &printed,
            &outcome.calibration,
            args.params == [Refine::Auto],
        )?;
    }
    match outcome.finish() {
        // The reason is part of the JSON output, so it is not printed again.
        Err(_) if is_refused && args.json => Ok(Exit::InsufficientData),
        finished => finished.map(|()| exit),
    }
}

fn scene_param(text: &str) -> Result<Refine, String> {
    SCENE_PARAMS
        .into_iter()
        .find(|param| param.name() == text)
        .ok_or_else(|| {
            let names = SCENE_PARAMS.map(Refine::name);
            format!(
                "unknown parameter {text:?}, expected {}",
                listed(&names, "or")
            )
        })
}

impl Args {
    fn task(&self) -> SceneTask {
        SceneTask {
            input: self.input.clone(),
            keyframes: self.keyframes.clone(),
            rig: self.rig.clone(),
            params: self.params.clone(),
            sim: self.sim,
            seconds: self.seconds,
            write_rig: self.write_rig.clone(),
            report: self.report.options(),
        }
    }
}

fn printed(outcome: &SceneOutcome) -> Printed<'_> {
    let SceneOutcome {
        data, calibration, ..
    } = outcome;
    let cameras = calibration
        .rig
        .iter()
        .flat_map(|rig| &rig.cameras)
        .map(|camera| {
            let sigmas = calibration.sigmas(&camera.name);
            let printed = PrintedCamera {
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
    Printed {
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
        refused: outcome.refused.clone(),
    }
}

fn relative(relative: RelativePose) -> PrintedRelative {
    let RelativePose {
        first,
        first_from_camera,
        sigmas,
    } = relative;
    PrintedRelative {
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
) -> (&'a str, [[f64; 4]; 4]) {
    let corrected_from_given = rigid_transform(
        correction.rotation_rad.into(),
        correction.translation_m.into(),
    );
    // The estimate maps given frames to corrected frames. Poses of cameras need the inverse.
    (camera, matrix_of(&corrected_from_given.inverse()))
}

fn describe(
    printed: &Printed<'_>,
    calibration: &SceneCalibration,
    is_auto: bool,
) -> anyhow::Result<()> {
    let alignment = &calibration.alignment;
    print::line(format!("{} images", printed.n_images))?;
    for line in alignment.lines() {
        print::line(line)?;
    }
    // With `auto`, only confirmed corrections are applied.
    if !is_auto && alignment.trials.iter().any(|trial| !trial.kept) {
        log::warn!(
            "the corrections are applied as requested, but validation images do not confirm all of them"
        );
    }
    if printed.estimates.is_empty() && printed.refused.is_none() {
        print::line(
            "nothing to correct: no parameter improves the prediction of validation images",
        )?;
    }
    for (name, matrix) in &printed.given_from_corrected {
        print::line(format!(
            "pose of the corrected camera {name} in the given one, row by row; multiply each pose by it from the right:"
        ))?;
        print_matrix(matrix)?;
    }
    for (name, camera) in &printed.cameras {
        // If all cameras are refused, the reason is the error of the command.
        if let (Some(reason), None) = (&camera.refused, &printed.refused) {
            log::warn!("camera {name:?} keeps its extrinsics: {reason}");
        }
        print::line(format!(
            "parent_from_camera of {name}, row by row ({} images):",
            camera.n_images
        ))?;
        print_matrix(&camera.parent_from_camera)?;
        print_sigmas(camera.sigma_mm, camera.sigma_deg)?;
        if let Some(relative) = &camera.relative {
            print::line(format!(
                "pose of {name} in the frame of {}, row by row:",
                relative.camera
            ))?;
            print_matrix(&relative.camera_from_this)?;
            print_sigmas(relative.sigma_mm, relative.sigma_deg)?;
        }
    }
    Ok(())
}

fn print_sigmas(mm: Option<[f64; 3]>, deg: Option<[f64; 3]>) -> anyhow::Result<()> {
    let (Some(mm), Some(deg)) = (mm, deg) else {
        return Ok(());
    };
    let list = |values: [f64; 3]| values.map(|value| format!("{value:.3}")).join(", ");
    print::line(format!(
        "standard deviations along and about the camera's x, y and z axes: {} mm; {} degrees",
        list(mm),
        list(deg)
    ))?;
    Ok(())
}
