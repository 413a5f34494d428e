//! `fieldrig bench ablation`: measures the contribution of each part of the method by training
//! without it.

use super::runs_args::RunsArgs;
use crate::exit::Exit;
use bench::ablation::AblationOptions;
use std::path::PathBuf;

/// Flags of `bench ablation`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    /// Training time of each run in seconds; loading and scoring do not count [default: 16, unless
    /// --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Optimizer steps of each run
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Runs of each variant, 1 to 1000, with consecutive seeds from --seed
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Only the rows whose names contain one of these words, separated by commas
    #[arg(long, value_name = "WORD,...", value_delimiter = ',')]
    only: Vec<String>,
    #[command(flatten)]
    runs: RunsArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.runs
        .run(|host| bench::ablation::run(&args.options(), host))
}

impl Args {
    fn options(&self) -> AblationOptions {
        AblationOptions {
            data: self.data.clone(),
            seconds: self.seconds,
            steps: self.steps,
            seeds: self.seeds,
            only: self.only.clone(),
            runs: self.runs.options(),
        }
    }
}
