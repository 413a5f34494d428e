//! `fieldrig calibrate time-offset`: the offset between the clocks of two pose streams.

use super::flags::ReportFlag;
use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use calibrate::{TimeOffsetDocument, TimeOffsetOutcome, TimeOffsetTask};
use calibration::time_offset::TimeOffsetOptions;
use messages::InsufficientData;
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

/// Estimates and prints the offset. The exit code is 4 if the motion does not determine the offset,
/// or does not determine a requested transform.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let TimeOffsetOutcome { result, written } = args.task().run()?;
    let document = TimeOffsetDocument::of(result)?;
    print::json_or_lines(args.json, &document, document.lines())?;
    // The result is printed even if the report cannot be written.
    written?;
    match document.refusal() {
        None => Ok(Exit::Done),
        // The reason is already part of the JSON output.
        Some(_) if args.json => Ok(Exit::InsufficientData),
        Some(reason) => Err(InsufficientData(reason.to_owned()).into()),
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
