//! `fieldrig bench stability`: accuracy over the size of a disturbance, and its break points.

use super::runs_args::RunsArgs;
use crate::exit::Exit;
use bench::Disturbance;
use bench::stability::StabilityOptions;
use std::path::PathBuf;

/// Flags of `bench stability`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    /// What to disturb, separated by commas
    #[arg(
        long,
        value_name = "WHAT,...",
        value_delimiter = ',',
        default_value = "all"
    )]
    disturb: Vec<DisturbanceArg>,
    /// Sizes of the disturbance instead of the default sizes (mm, ms, EV or keyframes), separated
    /// by commas. Needs a single disturbance
    #[arg(long, value_name = "N,...", value_delimiter = ',')]
    levels: Vec<f64>,
    /// Image rate of a folder without time stamps, Hz. `clock-offset` requires it for such a folder
    #[arg(long, value_name = "HZ")]
    rate_hz: Option<f64>,
    /// Training time of each run in seconds; loading and scoring do not count [default: 30, unless
    /// --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Optimizer steps of each run
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Runs per size, 1 to 1000, with consecutive seeds from --seed
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    #[command(flatten)]
    runs: RunsArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum DisturbanceArg {
    /// Errors of training poses: 0 to 50 mm and 0 to 5 degrees
    PoseNoise,
    /// Poses from 0 to 200 ms after the image stamps
    ClockOffset,
    /// A sudden change of the exposure by 0 to 1 EV in the middle of the capture
    Exposure,
    /// 3 to 300 training keyframes
    Keyframes,
    /// All disturbances
    All,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.runs
        .run(|host| bench::stability::run(&args.options(), host))
}

impl Args {
    fn options(&self) -> StabilityOptions {
        let disturbances = Disturbance::ALL.into_iter().filter(|disturbance| {
            self.disturb
                .iter()
                .any(|selected| selected.includes(*disturbance))
        });
        StabilityOptions {
            data: self.data.clone(),
            disturbances: disturbances.collect(),
            can_skip_clock_offset: !self.disturb.contains(&DisturbanceArg::ClockOffset),
            levels: self.levels.clone(),
            rate_hz: self.rate_hz,
            seconds: self.seconds,
            steps: self.steps,
            seeds: self.seeds,
            runs: self.runs.options(),
        }
    }
}

impl DisturbanceArg {
    fn includes(self, disturbance: Disturbance) -> bool {
        match self {
            Self::All => true,
            Self::PoseNoise => disturbance == Disturbance::PoseNoise,
            Self::ClockOffset => disturbance == Disturbance::ClockOffset,
            Self::Exposure => disturbance == Disturbance::Exposure,
            Self::Keyframes => disturbance == Disturbance::Keyframes,
        }
    }
}
