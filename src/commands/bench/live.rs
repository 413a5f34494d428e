//! `fieldrig bench live`: plays a recording in real time into runs with viewers, and measures
//! latency and accuracy.

use super::run_flags;
use super::runs_args::print_result;
use crate::commands::run::{self, Running};
use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::print;
use anyhow::Context;
use bench::live::{Conditions, HandEyeError, InputCounts, LiveRun, findings};
use bench::{BenchResult, Disturbance, LiveDisturbance, Timeline, Viewer, ViewerOptions};
use capture::{Rig, open};
use messages::InsufficientData;
use session::DiscardedRun;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Flags of `bench live`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Recording of `fieldrig record` or `fieldrig run --record`
    recording: PathBuf,
    /// Rig file [default: the rig file stored in the recording]
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Length of each run in seconds, counted from the first image. After the end of the recording,
    /// training continues
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = number_in_range(1.0..=1e6))]
    seconds: f64,
    /// Play the recording again whenever it ends. If a run takes two minutes or more, the change
    /// per hour of latency, accuracy, training speed and memory is reported
    #[arg(long)]
    repeat: bool,
    /// Numbers of viewers that request pictures back to back, one run each
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "0,1,8", value_parser = clap::value_parser!(u64).range(0..=32))]
    viewers: Vec<u64>,
    /// Width and height of the pictures, pixels
    #[arg(long, value_name = "WxH", default_value = "1024x1024", value_parser = size)]
    size: [u32; 2],
    /// Request panoramas (equirectangular) instead of pinhole views
    #[arg(long)]
    panorama: bool,
    /// Maximum number of pictures that each viewer requests per second [default: back to back]
    #[arg(long, value_name = "HZ", value_parser = number_in_range(0.1..=1000.0))]
    picture_rate: Option<f64>,
    /// Repeat the run with one viewer and a wrong hand-eye calibration: degrees and millimeters in
    /// random directions
    #[arg(long, value_name = "DEG,MM", value_parser = hand_eye_error)]
    hand_eye_error: Option<(f64, f64)>,
    /// Number of directions of the hand-eye error, one run each
    #[arg(long, value_name = "N", default_value_t = 1, requires = "hand_eye_error", value_parser = clap::value_parser!(u64).range(1..=100))]
    directions: u64,
    /// Repeat the run with one viewer and each of these disturbances: `pose-noise` in mm,
    /// `clock-offset` in ms, or `exposure` in EV (a sudden change in the middle of the run)
    #[arg(long, value_name = "WHAT:SIZE,...", value_delimiter = ',', value_parser = disturbance)]
    disturb: Vec<LiveDisturbance>,
    /// Folder for charts and numbers
    #[arg(long, value_name = "DIR", default_value = "bench-live")]
    out: PathBuf,
    /// Print JSON, one object per run
    #[arg(long)]
    json: bool,
    /// More flags for `fieldrig run`
    #[arg(last = true, value_name = "RUN FLAGS")]
    run_flags: Vec<OsString>,
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let parsed = text
        .split_once('x')
        .and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    parsed
        .filter(|size: &[u32; 2]| size.iter().all(|n| (1..=4096).contains(n)))
        .ok_or_else(|| "must be a width and a height from 1 to 4096, such as 1024x1024".to_owned())
}

fn hand_eye_error(text: &str) -> Result<(f64, f64), String> {
    let parsed = text
        .split_once(',')
        .and_then(|(deg, mm)| Some((deg.trim().parse().ok()?, mm.trim().parse().ok()?)));
    parsed
        .filter(|(deg, mm)| (0.0..=90.0).contains(deg) && (0.0..=1000.0).contains(mm))
        .ok_or_else(|| {
            "must be degrees up to 90 and millimeters up to 1000, such as 1,5".to_owned()
        })
}

fn disturbance(text: &str) -> Result<LiveDisturbance, String> {
    let parsed = text.split_once(':').and_then(|(name, level)| {
        let is_named = |disturbance: &&Disturbance| disturbance.name() == name.trim();
        let disturbance = *Disturbance::ALL.iter().find(is_named)?;
        Some(LiveDisturbance {
            disturbance,
            level: level.trim().parse().ok()?,
        })
    });
    let max = |disturbance| match disturbance {
        Disturbance::PoseNoise => 1000.0,
        Disturbance::ClockOffset => 500.0,
        Disturbance::Exposure => 10.0,
        Disturbance::Keyframes => f64::NEG_INFINITY, // A live run has no fixed number of keyframes.
    };
    parsed.filter(|parsed| (0.0..=max(parsed.disturbance)).contains(&parsed.level)).ok_or_else(|| {
        "must be pose-noise:MM up to 1000, clock-offset:MS up to 500 or exposure:EV up to 10, such as exposure:0.5"
            .to_owned()
    })
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("cannot create {}", args.out.display()))?;
    let rig = args
        .rig
        .as_ref()
        .map(|path| Rig::load(path, &[]))
        .transpose()?;
    let rig = open::recording(&args.recording, rig, &[])?.rig;
    let mut runs = Vec::new();
    let mut data_losses = Vec::new();
    for conditions in args.conditions() {
        let Some((run, losses)) = args.measure(&rig, conditions)? else {
            log::warn!("interrupted: the results do not contain the run with {conditions}");
            break;
        };
        // All runs play the same recording, so they have the same losses.
        data_losses.extend(
            losses
                .into_iter()
                .filter(|loss| !data_losses.contains(loss))
                .collect::<Vec<_>>(),
        );
        if args.json {
            print::report_json(&serde_json::json!({ "event": "run", "run": run }))?;
        } else {
            print::report(describe(&run));
        }
        runs.push(run);
    }
    // Without a run, no charts are written, because they would only look like a result.
    if runs.is_empty() {
        anyhow::bail!("interrupted before the first run ended");
    }
    let [width, height] = args.size;
    let kind = if args.panorama {
        "panoramas"
    } else {
        "pictures"
    };
    let mut input = format!(
        "{}, {kind} of {width}x{height}, {} s",
        args.recording.display(),
        args.seconds
    );
    if args.repeat {
        input.push_str(", repeated");
    }
    for flag in &args.run_flags {
        input.push_str(&format!(" {}", flag.display()));
    }
    let findings = findings(&input, &runs);
    let page = findings.write(&args.out)?;
    data_losses
        .iter()
        .for_each(|loss| log::warn!("data loss: {loss}"));
    let exit = exit::from_losses(&data_losses);
    print_result(
        &BenchResult {
            findings,
            page,
            data_losses,
        },
        args.json,
    )?;
    Ok(exit)
}

fn describe(run: &LiveRun) -> String {
    let picture = run.latency("request to complete picture");
    let picture = picture.map_or(String::new(), |latency| {
        format!("  picture {:.1} ms (99 %: {:.1})", latency.p50, latency.p99)
    });
    let psnr = run.psnr.last().map_or(String::new(), |(seconds, psnr)| {
        format!("  {psnr:.2} dB at {seconds:.0} s")
    });
    format!(
        "{}: {:.1} steps per second{picture}{psnr}",
        run.conditions, run.steps_per_sec
    )
}

impl Args {
    fn conditions(&self) -> Vec<Conditions> {
        // Runs with errors and disturbances have one viewer each, so that their load is the same.
        let with_one = Conditions {
            n_viewers: 1,
            hand_eye_error: None,
            disturbance: None,
        };
        let right = self.viewers.iter().map(|&n_viewers| Conditions {
            n_viewers,
            ..with_one
        });
        let wrong = self
            .hand_eye_error
            .into_iter()
            .flat_map(|(degrees, millimeters)| {
                let error = move |seed| HandEyeError {
                    degrees,
                    millimeters,
                    seed,
                };
                // The effect of an error depends on its direction, so several directions are
                // measured.
                (1..=self.directions).map(move |seed| Conditions {
                    hand_eye_error: Some(error(seed)),
                    ..with_one
                })
            });
        let disturbed = self.disturb.iter().map(|&disturbance| Conditions {
            disturbance: Some(disturbance),
            ..with_one
        });
        right.chain(wrong).chain(disturbed).collect()
    }

    /// Measures one run, then removes its folder. Returns its measurements and data losses, or
    /// `None` if it was interrupted.
    fn measure(
        &self,
        rig: &Rig,
        conditions: Conditions,
    ) -> anyhow::Result<Option<(LiveRun, Vec<String>)>> {
        // The folder is named after the process, so that two benchmarks with the same output do not
        // remove each other's folder.
        let folder = self.out.join(format!("run-{}", std::process::id()));
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        let measured = self.measure_in(&folder, rig, conditions);
        if let Err(error) = std::fs::remove_dir_all(&folder) {
            log::warn!("cannot remove {}: {error}", folder.display());
        }
        measured
    }

    fn measure_in(
        &self,
        folder: &Path,
        rig: &Rig,
        conditions: Conditions,
    ) -> anyhow::Result<Option<(LiveRun, Vec<String>)>> {
        let mut rig = rig.clone();
        if let Some(error) = conditions.hand_eye_error {
            error.apply(&mut rig);
        }
        if let Some(disturbance) = conditions.disturbance {
            disturbance.apply_to_rig(&mut rig);
        }
        // The run reads the disturbed rig from a file, as it would read a wrong calibration.
        rig.write_resolved(folder)
            .with_context(|| format!("cannot write into {}", folder.display()))?;
        let mut flags = vec![
            "--from".into(),
            self.recording.clone().into(),
            "--real-time".into(),
        ];
        flags.extend(self.repeat.then(|| "--repeat".into()));
        let rig_file = folder.join(drivers::recording::RIG_FILE);
        let out = folder.join("out");
        let flags = run_flags::parse(
            &rig_file,
            self.seconds,
            (&out, self.json),
            flags,
            &self.run_flags,
        )?;
        let Running { mut run, page, .. } = run::start(&flags, None)?;
        // A disturbance in the middle of the run shows how fast the model recovers.
        let change = conditions
            .disturbance
            .and_then(|disturbance| disturbance.keyframe_change(1, 0.5 * self.seconds));
        if let Some(change) = change {
            run.live.change_keyframes(change);
        }
        let address = page.address();
        let period = self.picture_rate.map_or(Duration::ZERO, |rate_hz| {
            Duration::from_secs_f64(1.0 / rate_hz)
        });
        let options = ViewerOptions {
            size_px: self.size,
            is_panorama: self.panorama,
            period,
        };
        let viewers: Vec<Viewer> = (0..conditions.n_viewers)
            .map(|_| Viewer::connect(address, options))
            .collect::<anyhow::Result<_>>()?;
        let mut timeline = Timeline::default();
        while run.run_time_slice()? {
            timeline.sample(&run.live, &run.gpu, &viewers);
        }
        // The run is measured before the viewers disconnect, because their latencies are part of
        // the measurement.
        let measured = LiveRun::of(conditions, &run.live, &viewers, &timeline);
        drop(viewers);
        let DiscardedRun {
            input_result,
            data_losses,
            no_model_reason,
            is_interrupted,
        } = run.discard()?;
        let input = InputCounts::of(&input_result);
        match (input_result.input_error, no_model_reason) {
            // An interruption explains all other problems, so it comes first.
            _ if is_interrupted => Ok(None),
            (Some(error), _) => {
                Err(anyhow::Error::new(error).context("the recording cannot be read"))
            }
            (None, Some(reason)) => Err(InsufficientData(reason).into()),
            (None, None) => Ok(Some((LiveRun { input, ..measured }, data_losses))),
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

    #[test]
    fn every_viewer_count_and_direction_is_one_run() {
        let line = [
            "live",
            "scan.mcap",
            "--viewers",
            "0,4",
            "--hand-eye-error",
            "1,5",
            "--directions",
            "2",
            "--size",
            "640x480",
            "--disturb",
            "pose-noise:0.5,exposure:1",
        ];
        let args = Flags::parse_from(line).args;
        let conditions: Vec<String> = args
            .conditions()
            .iter()
            .map(Conditions::to_string)
            .collect();
        assert_eq!(conditions[..2], ["0 viewers", "4 viewers"]);
        assert_eq!(
            conditions[3],
            "1 viewer, hand-eye off by 1 degrees, 5 mm (seed 2)"
        );
        assert_eq!(
            conditions[4..],
            ["1 viewer, pose-noise 0.5 mm", "1 viewer, exposure 1 EV"]
        );
        assert_eq!((conditions.len(), args.size), (6, [640, 480]));
        let invalid_disturbances = [
            ["--disturb", "keyframes:3"],
            ["--disturb", "exposure"],
            ["--disturb", "fog:1"],
        ];
        let invalid = [
            ["--size", "10"],
            ["--size", "0x5"],
            ["--hand-eye-error", "1"],
            ["--hand-eye-error", "100,1"],
        ];
        for invalid in invalid.into_iter().chain(invalid_disturbances) {
            assert!(
                Flags::try_parse_from(["live", "scan.mcap"].iter().chain(&invalid)).is_err(),
                "{invalid:?}"
            );
        }
    }
}
