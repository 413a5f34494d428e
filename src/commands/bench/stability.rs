//! `fieldrig bench stability`: accuracy over the size of a disturbance, and its break points.

use super::runs_args::RunsArgs;
use crate::exit::Exit;
use crate::named_args::one_of;
use bench::Disturbance;
use bench::stability::StabilityOptions;
use clap::builder::TypedValueParser;
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
        default_value = "all",
        value_parser = disturbances()
    )]
    disturb: Vec<Option<Disturbance>>,
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

/// The disturbances, and `None` for all of them.
fn disturbances() -> impl TypedValueParser<Value = Option<Disturbance>> {
    let each = Disturbance::ALL.map(|disturbance| {
        (
            Some(disturbance),
            disturbance.name(),
            disturbance.description(),
        )
    });
    one_of(each.into_iter().chain([(None, "all", "All disturbances")]))
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.runs
        .run(|host| bench::stability::run(&args.options(), host))
}

impl Args {
    fn options(&self) -> StabilityOptions {
        let is_selected = |disturbance: &Disturbance| {
            (self.disturb.iter()).any(|selected| selected.is_none_or(|one| one == *disturbance))
        };
        StabilityOptions {
            data: self.data.clone(),
            disturbances: Disturbance::ALL.into_iter().filter(is_selected).collect(),
            can_skip_clock_offset: !self.disturb.contains(&Some(Disturbance::ClockOffset)),
            levels: self.levels.clone(),
            rate_hz: self.rate_hz,
            seconds: self.seconds,
            steps: self.steps,
            seeds: self.seeds,
            runs: self.runs.options(),
        }
    }
}
