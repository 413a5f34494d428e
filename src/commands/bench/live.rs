//! `fieldrig bench live`: plays a recording in real time into runs with viewers, and measures
//! latency and accuracy.

use super::run_flags;
use super::runs_args::print_result;
use crate::exit::{self, Exit};
use crate::number_args::{number_in_range, size_up_to};
use crate::print;
use bench::live::{LiveOptions, LiveRun};
use bench::{LiveDisturbance, ViewerOptions};
use std::ffi::OsString;
use std::path::PathBuf;
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
    #[arg(long, value_name = "WxH", default_value = "1024x1024", value_parser = size_up_to(4096))]
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
    #[arg(long, value_name = "WHAT:SIZE,...", value_delimiter = ',')]
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

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let on_run = |run: &LiveRun| {
        if args.json {
            return print::report_json(&serde_json::json!({ "event": "run", "run": run }));
        }
        print::report(run.summary());
        Ok(())
    };
    let result = bench::live::run(
        &args.options(),
        &|requested| run_flags::start(requested, args.json, &args.run_flags),
        on_run,
    )?;
    let exit = exit::from_losses(&result.data_losses);
    print_result(&result, args.json)?;
    Ok(exit)
}

impl Args {
    fn options(&self) -> LiveOptions {
        let period = self.picture_rate.map_or(Duration::ZERO, |rate_hz| {
            Duration::from_secs_f64(1.0 / rate_hz)
        });
        LiveOptions {
            recording: self.recording.clone(),
            rig: self.rig.clone(),
            seconds: self.seconds,
            is_repeated: self.repeat,
            n_viewers: self.viewers.clone(),
            viewers: ViewerOptions {
                size_px: self.size,
                is_panorama: self.panorama,
                period,
            },
            hand_eye_error: self.hand_eye_error,
            n_directions: self.directions,
            disturbances: self.disturb.clone(),
            out: self.out.clone(),
            other_settings: (self.run_flags.iter())
                .map(|flag| flag.display().to_string())
                .collect(),
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
    fn errors_and_disturbances_are_parsed() {
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
        let options = Flags::parse_from(line).args.options();
        assert_eq!(options.n_viewers, [0, 4]);
        assert_eq!(options.viewers.size_px, [640, 480]);
        assert_eq!(options.hand_eye_error, Some((1.0, 5.0)));
        let disturbances = options.disturbances.iter().map(ToString::to_string);
        assert_eq!(
            disturbances.collect::<Vec<_>>(),
            ["pose-noise 0.5 mm", "exposure 1 EV"]
        );
        let invalid = [
            ["--disturb", "keyframes:3"],
            ["--disturb", "exposure"],
            ["--disturb", "exposure:11"],
            ["--disturb", "fog:1"],
            ["--size", "10"],
            ["--size", "0x5"],
            ["--hand-eye-error", "1"],
            ["--hand-eye-error", "100,1"],
        ];
        for invalid in invalid {
            assert!(
                Flags::try_parse_from(["live", "scan.mcap"].iter().chain(&invalid)).is_err(),
                "{invalid:?}"
            );
        }
    }
}
