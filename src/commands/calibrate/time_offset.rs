//! `fieldrig calibrate time-offset`: the offset between the clocks of two pose streams.

use super::flags::ReportFlag;
use super::{matrix_of, print_matrix};
use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::print;
use calibrate::{TimeOffsetOutcome, TimeOffsetTask};
use calibration::hand_eye::Refusal;
use calibration::time_offset::{TimeOffset, TimeOffsetOptions};
use messages::InsufficientData;
use serde::Serialize;
use std::path::PathBuf;

/// Flags of `calibrate time-offset`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Poses of the first body as rows t,x,y,z,qx,qy,qz,qw (seconds, meters). Lines that do not
    /// contain numbers are skipped
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
    #[arg(long, value_name = "S", value_parser = number_in_range(0.001..=1e9))]
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
    /// Seconds to add to the clock of B to get the clock of A.
    offset_secs: Option<f64>,
    sigma_secs: Option<f64>,
    /// RMS difference of the orientations after alignment, degrees.
    residual_deg: Option<f64>,
    /// Rate of the clock of A relative to the clock of B, minus 1, in parts per million; null if it
    /// is not significant.
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

/// Estimates and prints the offset. The exit code is 4 if the motion does not determine the offset,
/// or does not determine a requested transform.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let TimeOffsetOutcome { result, written } = args.task().run()?;
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
        // The reason is already part of the JSON output.
        Some(_) if args.json => Ok(Exit::InsufficientData),
        Some(reason) => Err(InsufficientData(reason).into()),
    }
}

impl Args {
    fn task(&self) -> TimeOffsetTask {
        TimeOffsetTask {
            a: self.a.clone(),
            b: self.b.clone(),
            options: TimeOffsetOptions {
                hand_eye: self.hand_eye,
                max_offset_secs: self.max_offset,
                ..TimeOffsetOptions::default()
            },
            report: self.report.options(),
        }
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
