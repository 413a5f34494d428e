//! `fieldrig bench stamps`: measures the stamp errors of images from a camera with its own clock
//! and a link with jitter.

use super::runs_args::print_result;
use crate::exit::Exit;
use bench::stamps::StampsOptions;
use std::path::PathBuf;

/// Flags of `bench stamps`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Camera rates, images per second, separated by commas
    #[arg(
        long,
        value_name = "HZ,...",
        value_delimiter = ',',
        default_value = "30,60,200"
    )]
    rates: Vec<f64>,
    /// Minimum latency from the shutter to the arrival of an image
    #[arg(long, value_name = "MS", default_value_t = 5.0)]
    fixed_millis: f64,
    /// Maximum random latency added to each image
    #[arg(long, value_name = "MS", default_value_t = 75.0)]
    jitter_millis: f64,
    /// How much faster this computer's clock runs than the camera's clock, parts per million
    #[arg(
        long,
        value_name = "PPM",
        default_value_t = 50.0,
        allow_hyphen_values = true
    )]
    drift_ppm: f64,
    /// Length of a run in seconds
    #[arg(long, value_name = "S", default_value_t = 120.0)]
    seconds: f64,
    /// Seconds at the start of each run for which errors are not counted
    #[arg(long, value_name = "S", default_value_t = 10.0)]
    settle_seconds: f64,
    /// Runs per rate
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Folder for charts and numbers [default: bench-stamps]
    #[arg(long, value_name = "DIR", default_value = "bench-stamps")]
    out: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    print_result(&bench::stamps::run(&args.options())?, args.json)?;
    Ok(Exit::Done)
}

impl Args {
    fn options(&self) -> StampsOptions {
        StampsOptions {
            rates_hz: self.rates.clone(),
            fixed_millis: self.fixed_millis,
            jitter_millis: self.jitter_millis,
            drift_ppm: self.drift_ppm,
            seconds: self.seconds,
            settle_seconds: self.settle_seconds,
            seeds: self.seeds,
            out: self.out.clone(),
        }
    }
}
