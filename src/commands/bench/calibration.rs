//! `fieldrig bench calibration`: measures calibration on simulated measurements with a known truth.

use super::runs_args::print_result;
use crate::exit::Exit;
use bench::calibration::CalibrationOptions;
use std::path::PathBuf;

/// Flags of `bench calibration`.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Calibrations per kind, for the coverage of the reported uncertainty
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    runs: u64,
    /// Scenes per number of poses and per combination of conditions
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Also calibrate simulated rigs without a target: this rig file with wrong camera poses
    #[arg(long, value_name = "RIG_FILE")]
    rig: Option<PathBuf>,
    /// With --rig: number of rigs, each with another seed and direction of the error
    #[arg(long, value_name = "N", default_value_t = 10, requires = "rig", value_parser = clap::value_parser!(u64).range(1..=1000))]
    rigs: u64,
    /// With --rig: length of each scan in seconds
    #[arg(long, value_name = "S", default_value_t = 30.0, requires = "rig", value_parser = super::super::number_in_range(1.0..=3600.0))]
    seconds: f64,
    /// Folder for charts and numbers [default: bench-calibration]
    #[arg(long, value_name = "DIR", default_value = "bench-calibration")]
    out: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let Args { runs, seeds, rig, rigs, seconds, out, .. } = args.clone();
    let options = CalibrationOptions { runs, seeds, rig, rigs, scan_secs: seconds, out };
    print_result(&bench::calibration::run(&options)?, args.json)?;
    Ok(Exit::Done)
}
