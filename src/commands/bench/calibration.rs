//! `fieldrig bench calibration`: measures calibration on simulated measurements with a known truth.

use super::runs_args::print_result;
use crate::exit::Exit;
use crate::named_args::one_of;
use crate::number_args::number_in_range;
use bench::calibration::{CalibrationOptions, CoverageScenes, Part};
use std::path::PathBuf;

/// Flags of `bench calibration`.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// What to measure. The part `rigs` needs --rig
    #[arg(long, value_name = "PART", value_delimiter = ',', default_values = Part::ALL.map(Part::name),
        value_parser = one_of(Part::ALL.map(|part| (part, part.name(), part.description()))))]
    parts: Vec<Part>,
    /// With coverage: number of calibrations of each kind
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    runs: u64,
    /// With coverage: images or robot poses per calibration
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u16).range(5..=1000))]
    poses: u16,
    /// With coverage: standard deviation of the corners in pixels
    #[arg(long, value_name = "PX", default_value_t = 0.1, value_parser = number_in_range(0.001..=10.0))]
    corner_px: f64,
    /// With coverage: seed of the first scene
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=1_000_000))]
    first_seed: u64,
    /// Number of scenes for each number of poses and for each combination of conditions
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Also calibrate simulated rigs without a target. The rigs are this rig file with wrong camera
    /// poses
    #[arg(long, value_name = "RIG_FILE")]
    rig: Option<PathBuf>,
    /// With --rig: number of rigs. Each rig has another seed and another direction of the error
    #[arg(long, value_name = "N", default_value_t = 10, requires = "rig", value_parser = clap::value_parser!(u64).range(1..=1000))]
    rigs: u64,
    /// With --rig: index of the first rig, counted from 1
    #[arg(long, value_name = "N", default_value_t = 1, requires = "rig", value_parser = clap::value_parser!(u64).range(1..=1000))]
    first_rig: u64,
    /// With --rig: length of each scan in seconds
    #[arg(long, value_name = "S", default_value_t = 30.0, requires = "rig", value_parser = number_in_range(1.0..=3600.0))]
    seconds: f64,
    /// Folder for charts and numbers [default: bench-calibration]
    #[arg(long, value_name = "DIR", default_value = "bench-calibration")]
    out: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let Args {
        parts,
        runs,
        first_seed,
        poses,
        corner_px,
        seeds,
        rig,
        rigs,
        first_rig,
        seconds,
        out,
        ..
    } = args.clone();
    let coverage = CoverageScenes {
        runs,
        first_seed,
        n_poses: poses.into(),
        corner_px,
    };
    let options = CalibrationOptions {
        parts,
        coverage,
        seeds,
        rig,
        rigs,
        first_rig,
        scan_secs: seconds,
        out,
    };
    print_result(&bench::calibration::run(&options)?, args.json)?;
    Ok(Exit::Done)
}
