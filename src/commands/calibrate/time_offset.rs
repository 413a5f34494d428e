//! `fieldrig calibrate time-offset`: the offset between the clocks of two pose streams.

use super::outputs::{self, ReportFlag};
use super::{matrix_of, print_matrix};
use crate::exit::{self, Exit};
use crate::print;
use calibration::hand_eye::Refusal;
use calibration::time_offset::{
    MotionProfile, PoseSample, TimeOffset, TimeOffsetOptions, estimate_time_offset, motion_profile,
};
use kinematics::Transform;
use messages::{BadInput, InsufficientData};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::Serialize;
use session::calibration_report::TimeOffsetReport;
use std::path::{Path, PathBuf};

/// Flags of `calibrate time-offset`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Poses of the first body as rows t,x,y,z,qx,qy,qz,qw (seconds, meters); other lines that are
    /// not numbers are skipped
    #[arg(value_name = "A.csv")]
    a: PathBuf,
    /// Poses of the second body, which is rigidly attached to the first, in any other fixed frame
    /// and on any other clock
    #[arg(value_name = "B.csv")]
    b: PathBuf,
    /// Also estimate the transform between the bodies
    #[arg(long)]
    hand_eye: bool,
    /// Largest absolute offset to search, seconds [default: all offsets at which the streams
    /// overlap]
    #[arg(long, value_name = "S", value_parser = super::super::number_in_range(0.001..=1e9))]
    max_offset: Option<f64>,
    #[command(flatten)]
    report: ReportFlag,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// The printed result.
#[derive(Debug, Default, Serialize)]
struct Printed {
    /// Seconds to add to the clock of B to get that of A.
    offset_secs: Option<f64>,
    sigma_secs: Option<f64>,
    /// RMS difference of the orientations after alignment, degrees.
    residual_deg: Option<f64>,
    /// Rate of the clock of A relative to that of B, minus 1, in parts per million; null if it is
    /// not significant.
    drift_ppm: Option<f64>,
    drift_sigma_ppm: Option<f64>,
    /// Time on the clock of B at which `offset_secs` holds, if there is a drift.
    mid_secs: Option<f64>,
    /// Pose of the second body in the frame of the first, row by row.
    #[serde(skip_serializing_if = "Option::is_none")]
    a_from_b: Option<[[f64; 4]; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_mm: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_deg: Option<[f64; 3]>,
    /// Why the transform between the bodies was refused, if it was requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    hand_eye_refused: Option<String>,
    refused: Option<String>,
}

/// Estimates and prints the offset. Exit code 4 if the motion does not determine it, or a requested
/// transform.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    // Checked first, so that a wrong path does not cost a calibration.
    let report = args.report.open()?;
    let a = read(&args.a)?;
    let b = read(&args.b)?;
    let options = TimeOffsetOptions {
        hand_eye: args.hand_eye,
        max_offset_secs: args.max_offset,
        ..TimeOffsetOptions::default()
    };
    let result = estimate_time_offset(&a, &b, &options).map_err(anyhow::Error::from);
    let written = match report {
        Some(path) => args.write_report(
            path,
            // A report without the profile is better than none.
            motion_profile(&a, &b, &options).ok().as_ref(),
            &result,
        ),
        None => Ok(()),
    };
    let printed = match result {
        Ok(offset) => Printed::of(&offset),
        Err(error) if exit::of(&error) == Exit::InsufficientData => Printed {
            refused: Some(error.to_string()),
            ..Printed::default()
        },
        Err(error) => return Err(error),
    };
    let refused = printed
        .refused
        .as_ref()
        .or(printed.hand_eye_refused.as_ref())
        .cloned();
    if args.json {
        print::json(&printed)?
    } else {
        describe(&printed)?
    }
    // The result is printed even if the report cannot be written.
    written?;
    match refused {
        None => Ok(Exit::Done),
        // The reason is part of the JSON output already.
        Some(_) if args.json => Ok(Exit::InsufficientData),
        Some(reason) => Err(InsufficientData(reason).into()),
    }
}

impl Args {
    fn write_report(
        &self,
        path: &Path,
        profile: Option<&MotionProfile>,
        result: &anyhow::Result<TimeOffset>,
    ) -> anyhow::Result<()> {
        let offset = result.as_ref().ok();
        let refusal = offset.and_then(|offset| offset.hand_eye.as_ref()?.as_ref().err());
        let warning = refusal
            .map(|refusal| format!("the transform between the bodies is refused: {refusal}"));
        let input = format!("{} and {}", self.a.display(), self.b.display());
        let Some(heading) =
            outputs::heading(Path::new(&input), result, warning.into_iter().collect())
        else {
            return Ok(());
        };
        outputs::write_report(
            path,
            &TimeOffsetReport {
                heading: &heading,
                profile,
                offset,
            }
            .html(),
        )
    }
}

impl Printed {
    fn of(offset: &TimeOffset) -> Self {
        let bodies = offset
            .hand_eye
            .as_ref()
            .and_then(|bodies| bodies.as_ref().ok());
        let refusal = offset
            .hand_eye
            .as_ref()
            .and_then(|bodies| bodies.as_ref().err());
        Self {
            offset_secs: Some(offset.offset_secs),
            sigma_secs: Some(offset.sigma_secs),
            residual_deg: Some(offset.rms_deg),
            drift_ppm: offset.drift_ppm.map(|[drift, _]| drift),
            drift_sigma_ppm: offset.drift_ppm.map(|[_, sigma]| sigma),
            mid_secs: Some(offset.mid_secs),
            a_from_b: bodies.map(|bodies| matrix_of(&bodies.a_body_from_b_body)),
            sigma_mm: bodies.map(|bodies| bodies.sigma_mm),
            sigma_deg: bodies.map(|bodies| bodies.sigma_deg),
            hand_eye_refused: refusal.map(Refusal::to_string),
            refused: None,
        }
    }
}

/// Reads the rows of a file. Comments and a header are skipped; a row of numbers that is not a pose
/// is an error.
fn read(path: &Path) -> anyhow::Result<Vec<PoseSample>> {
    let text = outputs::read_text(path)?;
    let mut samples = Vec::new();
    for (ix, line) in text.lines().enumerate() {
        let parsed = line
            // Any usual separator, because such files come from many programs.
            .split([',', ' ', ';', '\t'])
            .filter(|field| !field.is_empty())
            .map(str::parse::<f64>);
        // Any line that is not all numbers counts as a comment or header.
        let Ok(numbers) = parsed.collect::<Result<Vec<f64>, _>>() else {
            continue;
        };
        if numbers.is_empty() {
            continue;
        }
        let place = || format!("{}, line {}", path.display(), ix + 1);
        let [secs, x, y, z, qx, qy, qz, qw] = <[f64; 8]>::try_from(numbers).map_err(|numbers| {
            BadInput(format!(
                "{}: {} numbers, expected 8: t,x,y,z,qx,qy,qz,qw",
                place(),
                numbers.len()
            ))
        })?;
        const MAX_NORM_ERROR: f64 = 0.01;
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if ![secs, x, y, z].iter().all(|value| value.is_finite()) {
            return Err(BadInput(format!("{}: t, x, y and z must be finite", place())).into());
        }
        let norm = quaternion.norm();
        // Normalized afterwards. A larger deviation shows another order of the columns.
        let is_unit = (norm - 1.0).abs() < MAX_NORM_ERROR; // False for NaN.
        if !is_unit {
            return Err(BadInput(format!(
                "{}: |qx,qy,qz,qw| is {norm:.3}, expected 1",
                place()
            ))
            .into());
        }
        let pose = Transform::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_quaternion(quaternion),
        );
        samples.push(PoseSample { secs, pose });
    }
    if samples.is_empty() {
        return Err(BadInput(format!("{}: no row t,x,y,z,qx,qy,qz,qw", path.display())).into());
    }
    Ok(samples)
}

fn describe(printed: &Printed) -> anyhow::Result<()> {
    let (Some(offset), Some(sigma)) = (printed.offset_secs, printed.sigma_secs) else {
        return Ok(());
    };
    print::line(format!(
        "add {offset:.6} +- {sigma:.6} s to the clock of B to get that of A"
    ))?;
    if let Some(residual) = printed.residual_deg {
        print::line(format!(
            "residual: {residual:.3} degrees (RMS difference of the orientations after alignment)"
        ))?;
    }
    if let (Some(drift), Some(sigma)) = (printed.drift_ppm, printed.drift_sigma_ppm) {
        print::line(format!("drift: {drift:.1} +- {sigma:.1} ppm"))?;
    }
    if let Some(matrix) = printed.a_from_b {
        print::line("a_from_b, row by row (meters):")?;
        print_matrix(&matrix)?;
    }
    Ok(())
}
