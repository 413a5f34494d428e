//! `fieldrig bench curve`: accuracy over time, with several seeds, compared with other trainers.

use super::runs_args::RunsArgs;
use crate::exit::Exit;
use bench::curve::{CurveOptions, DEFAULT_SECONDS};
use std::path::PathBuf;

/// Flags of `bench curve`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Nerfstudio or TUM RGB-D folders, or recordings (.mcap). The chart has one line per input and
    /// method
    #[arg(required = true)]
    data: Vec<PathBuf>,
    /// Training time of each run in seconds; loading and scoring do not count
    #[arg(long, value_name = "S", default_value_t = DEFAULT_SECONDS)]
    seconds: f64,
    /// Runs per line, 1 to 1000, with consecutive seeds from --seed
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Curve of another trainer: JSON with rows of seconds and psnr; can be repeated
    #[arg(long, value_name = "FILE.json")]
    peer: Vec<PathBuf>,
    #[command(flatten)]
    runs: RunsArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.runs
        .run(|host| bench::curve::run(&args.options(), host))
}

impl Args {
    fn options(&self) -> CurveOptions {
        CurveOptions {
            data: self.data.clone(),
            seconds: self.seconds,
            seeds: self.seeds,
            peers: self.peer.clone(),
            runs: self.runs.options(),
        }
    }
}
