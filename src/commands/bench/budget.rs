//! `fieldrig bench budget`: measures accuracy over the number of splats, and the number of splats
//! that the trainer chooses.

use super::runs_args::RunsArgs;
use crate::exit::Exit;
use bench::budget::BudgetOptions;
use std::path::PathBuf;

/// Maximum number of splats in a rig file.
const MAX_CAP: i64 = 100_000_000;

/// Flags of `bench budget`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    /// Limits on the number of splats, 1 to 100000000, separated by commas
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "2000,4000,8000,16000,32000,64000,128000,256000,512000,1000000",
        value_parser = clap::value_parser!(u32).range(1..=MAX_CAP)
    )]
    splats: Vec<u32>,
    /// Training time of each run in seconds; loading and scoring do not count [default: 60, unless
    /// --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Optimizer steps of each run
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Runs per limit, 1 to 1000, with consecutive seeds from --seed
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    #[command(flatten)]
    runs: RunsArgs,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.runs
        .run(|host| bench::budget::run(&args.options(), host))
}

impl Args {
    fn options(&self) -> BudgetOptions {
        BudgetOptions {
            data: self.data.clone(),
            splats: self.splats.clone(),
            seconds: self.seconds,
            steps: self.steps,
            seeds: self.seeds,
            runs: self.runs.options(),
        }
    }
}
