//! `fieldrig bench memory`: memory use of a long run, and its growth rate once the keyframe store
//! is full.

use super::run_flags;
use super::runs_args::print_result;
use crate::commands::run::{self, Running};
use crate::exit::Exit;
use crate::print;
use anyhow::Context;
use bench::memory::MemoryRun;
use bench::{BenchResult, Sample, Viewer, ViewerOptions};
use messages::BadInput;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Maximum time between two lines on stdout.
const PRINT_PERIOD: Duration = Duration::from_secs(60);
/// Charts and numbers are written with this period, so that an interrupted bench leaves results.
const WRITE_PERIOD: Duration = Duration::from_secs(60);
const BYTES_PER_MB: f64 = 1e6;

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
    #[arg(long, value_name = "S", default_value_t = 900.0)]
    seconds: f64,
    /// Time between two samples, seconds
    #[arg(long, value_name = "S", default_value_t = 1.0)]
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
    args.check()?;
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    // Checkpoints are part of a run, so this bench also writes them. Their folder is removed at the
    // end.
    let run_folder = args.out.join(format!("run-{}", std::process::id()));
    let measured = args
        .run_flags(&run_folder)
        .map_err(Into::into)
        .and_then(|flags| measure(args, &flags));
    if run_folder.exists()
        && let Err(error) = std::fs::remove_dir_all(&run_folder)
    {
        log::warn!("cannot remove {}: {error}", run_folder.display());
    }
    let (measured, input_error) = measured?;
    let findings = measured.findings()?;
    let page = findings.write(&args.out)?;
    print_result(
        &BenchResult {
            findings,
            page,
            data_losses: Vec::new(),
        },
        args.json,
    )?;
    match input_error {
        Some(error) => {
            Err(anyhow::Error::new(error).context("the devices failed before the end of the run"))
        }
        None => Ok(Exit::Done),
    }
}

/// Returns the measurements of a run, and the device error that ended it early, if any.
fn measure(args: &Args, flags: &run::Args) -> anyhow::Result<(MemoryRun, Option<drivers::Error>)> {
    let Running { mut run, page, .. } = run::start(flags, None)?;
    let address = page.address();
    let viewers: Vec<Viewer> = (0..args.viewers)
        .map(|_| Viewer::connect(address, ViewerOptions::default()))
        .collect::<anyhow::Result<_>>()?;
    let every = Duration::from_secs_f64(args.every_secs);
    let mut measured = MemoryRun {
        input: args.input(),
        n_viewers: args.viewers,
        is_software: run.gpu.is_software(),
        ..MemoryRun::default()
    };
    let mut due = Instant::now();
    let mut last_printed = None;
    let mut written = Instant::now();
    while run.run_time_slice()? {
        let now = Instant::now();
        if now < due {
            continue;
        }
        // The period starts now and not at the last due time, so that a long step is not followed
        // by several samples at once.
        due = now + every;
        let sample = measured.add_sample(&run.live, &run.gpu, &viewers)?;
        if args.json {
            print::report_json(&serde_json::json!({ "event": "sample", "sample": sample }))?;
        } else if last_printed
            .is_none_or(|last_printed: Instant| last_printed.elapsed() >= PRINT_PERIOD)
        {
            print::report(describe(&sample));
            last_printed = Some(now);
        }
        // The results are written during the run, so that they survive if the run is killed after
        // hours, for example for lack of memory.
        if written.elapsed() >= WRITE_PERIOD {
            measured.findings()?.write(&args.out)?;
            written = Instant::now();
        }
    }
    drop(viewers);
    Ok((measured, run.discard()?.input_result.input_error))
}

fn describe(sample: &Sample) -> String {
    let mb = |bytes: u64| bytes as f64 / BYTES_PER_MB;
    format!(
        "{:7.1} s  {:8.1} MB resident  {:8.1} MB on the GPU  {:7.1} MB model  {:8.1} MB in {} keyframes, step {}",
        sample.seconds,
        mb(sample.resident_bytes),
        mb(sample.gpu_bytes),
        mb(sample.model_bytes),
        mb(sample.keyframe_bytes),
        sample.keyframes,
        sample.step,
    )
}

impl Args {
    fn check(&self) -> Result<(), BadInput> {
        for (flag, value, allowed) in [
            ("--seconds", self.seconds, 1.0..=1e6),
            ("--every-secs", self.every_secs, 0.01..=3600.0),
        ] {
            if !allowed.contains(&value) {
                let from = allowed.start();
                let to = allowed.end();
                return Err(BadInput(format!(
                    "{flag} {value}: must be a number from {from} to {to}"
                )));
            }
        }
        Ok(())
    }

    fn run_flags(&self, folder: &Path) -> Result<run::Args, BadInput> {
        let mut flags: Vec<OsString> = Vec::new();
        if self.sim {
            flags.push("--sim".into());
        }
        if let Some(from) = &self.from {
            flags.extend(["--from".into(), from.into()]);
        }
        run_flags::parse(
            &self.rig_file,
            self.seconds,
            (folder, self.json),
            flags,
            &self.run_flags,
        )
    }

    fn input(&self) -> String {
        match &self.from {
            Some(recording) => recording.display().to_string(),
            None => format!(
                "{}{}",
                self.rig_file.display(),
                if self.sim { ", simulated" } else { "" }
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Flags {
        #[command(flatten)]
        args: Args,
    }

    fn args(flags: &[&str]) -> Args {
        Flags::parse_from(["memory", "rig.toml"].iter().chain(flags)).args
    }

    #[test]
    fn run_flags_are_forwarded_and_invalid_ones_named() {
        let folder = Path::new("some");
        assert!(
            args(&["--sim", "--", "--method", "tsdf"])
                .run_flags(folder)
                .is_ok()
        );
        let error_message = args(&["--sim", "--", "--metod", "tsdf"])
            .run_flags(folder)
            .expect_err("no such flag");
        assert!(
            error_message.to_string().contains("--metod"),
            "{error_message}"
        );
        for flags in [
            ["--seconds", "0"],
            ["--seconds", "NaN"],
            ["--every-secs", "-1"],
        ] {
            let flags = [format!("{}={}", flags[0], flags[1])];
            let error_message = args(&[flags[0].as_str()])
                .check()
                .expect_err("out of range")
                .to_string();
            assert!(error_message.starts_with("--"), "{error_message}");
        }
    }
}
