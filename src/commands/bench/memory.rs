//! `fieldrig bench memory`: memory use of a long run, and its growth rate once the keyframe store
//! is full.

use super::run_flags;
use super::runs_args::print_result;
use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use bench::Sample;
use bench::memory::MemoryOptions;
use session::RunInput;
use std::ffi::OsString;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Maximum time between two lines on stdout.
const PRINT_PERIOD: Duration = Duration::from_secs(60);

/// Flags of `bench memory`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras, arm and training settings (TOML)
    rig_file: PathBuf,
    /// Simulate the devices of the rig file, in real time
    #[arg(long, conflicts_with = "from")]
    sim: bool,
    /// Replay a recording instead of live devices; training continues after its end
    #[arg(long, value_name = "RECORDING")]
    from: Option<PathBuf>,
    /// Length of the run in seconds, counted from the first image
    #[arg(long, value_name = "S", default_value_t = 900.0, value_parser = number_in_range(1.0..=1e6))]
    seconds: f64,
    /// Time between two samples, seconds
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = number_in_range(0.01..=3600.0))]
    every_secs: f64,
    /// Number of connected viewers that request images back to back, 0 to 32
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(0..=32))]
    viewers: u64,
    /// Folder for charts and numbers
    #[arg(long, value_name = "DIR", default_value = "bench-memory")]
    out: PathBuf,
    /// Print JSON, one object per sample
    #[arg(long)]
    json: bool,
    /// More flags for `fieldrig run`
    #[arg(last = true, value_name = "RUN FLAGS")]
    run_flags: Vec<OsString>,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let mut last_printed: Option<Instant> = None;
    let on_sample = |sample: &Sample| {
        if args.json {
            return print::report_json(&serde_json::json!({ "event": "sample", "sample": sample }));
        }
        if last_printed.is_none_or(|last_printed| last_printed.elapsed() >= PRINT_PERIOD) {
            print::report(sample.summary());
            last_printed = Some(Instant::now());
        }
        Ok(())
    };
    let measured = bench::memory::run(
        &args.options(),
        &|requested| run_flags::start(requested, args.json, &args.run_flags),
        on_sample,
    )?;
    print_result(&measured.result, args.json)?;
    match measured.input_error {
        Some(error) => {
            Err(anyhow::Error::new(error).context("the devices failed before the end of the run"))
        }
        None => Ok(Exit::Done),
    }
}

impl Args {
    fn options(&self) -> MemoryOptions {
        MemoryOptions {
            rig_file: self.rig_file.clone(),
            input: match &self.from {
                Some(path) => RunInput::Recording {
                    path: path.clone(),
                    is_real_time: false,
                    is_repeated: false,
                },
                None => RunInput::Devices {
                    is_simulated: self.sim,
                    is_lockstep: false,
                },
            },
            seconds: self.seconds,
            sample_period: Duration::from_secs_f64(self.every_secs),
            n_viewers: self.viewers,
            out: self.out.clone(),
        }
    }
}
