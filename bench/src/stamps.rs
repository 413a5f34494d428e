//! `fieldrig bench stamps`: measures the stamp errors of images from a camera with its own clock and a link with
//! jitter.

use crate::bench::page::Findings;
use crate::exit::{BadArgument, Exit};
use kinematics::quantile::{Rank, median, quantile};
use kinematics::random::Random;
use kinematics::{ClockMap, JointHistory, JointState, Stamp};
use serde::Serialize;
use session::Table;
use session::chart::{Axis, Chart, Line, Point, Scale};
use std::path::PathBuf;
use std::time::Duration;

/// Width of a histogram bin, milliseconds.
const BIN_MILLIS: f64 = 0.1;
/// Range of the histogram to either side, milliseconds; errors beyond it count in the outermost bins.
const HISTOGRAM_RANGE_MILLIS: f64 = 8.0;
/// Joint states per second.
const JOINT_RATE_HZ: u32 = 1000;
/// Speed of the joint, rad/s. Its angle encodes the time.
const SPEED_RAD_S: f64 = 1.0;
/// Error up to which a stamp counts as correct.
const MAX_ERROR_MILLIS: f64 = 1.0;

/// Flags of `bench stamps`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Camera rates, images per second, separated by commas
    #[arg(long, value_name = "HZ,...", value_delimiter = ',', default_value = "30,60,200")]
    rates: Vec<f64>,
    /// Minimum latency from the shutter to the arrival of an image
    #[arg(long, value_name = "MS", default_value_t = 5.0)]
    fixed_millis: f64,
    /// Maximum random latency added to each image
    #[arg(long, value_name = "MS", default_value_t = 75.0)]
    jitter_millis: f64,
    /// How much faster this computer's clock runs than the camera's, parts per million
    #[arg(long, value_name = "PPM", default_value_t = 50.0, allow_hyphen_values = true)]
    drift_ppm: f64,
    /// Length of a run
    #[arg(long, value_name = "S", default_value_t = 120.0)]
    seconds: f64,
    /// Time at the start of a run that is not counted
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

/// Stamp errors for one camera rate, milliseconds.
#[derive(Debug, Serialize)]
struct StampErrors {
    rate_hz: f64,
    /// Whether the rig file corrects the fixed latency.
    is_calibrated: bool,
    images: usize,
    within_1_ms_frac: f64,
    median_millis: f64,
    p99_abs_millis: f64,
    max_abs_millis: f64,
    /// Share of the images in each bin, from -8 ms in steps of 0.1 ms.
    bars: Vec<f64>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    check(args)?;
    let mut results = Vec::new();
    for rate_hz in &args.rates {
        let errors: Vec<f64> = (1..=args.seeds).flat_map(|seed| errors_millis(args, *rate_hz, seed)).collect();
        for is_calibrated in [true, false] {
            // The rig file's offset is subtracted from every stamp.
            let fixed_latency = if is_calibrated { args.fixed_millis } else { 0.0 };
            let errors: Vec<f64> = errors.iter().map(|error| error - fixed_latency).collect();
            results.push(StampErrors::of(*rate_hz, is_calibrated, &errors));
        }
    }
    std::fs::create_dir_all(&args.out)
        .map_err(|error| anyhow::Error::new(error).context(format!("cannot create {}", args.out.display())))?;
    let findings = findings(args, &results)?;
    findings.print_summary(&findings.write(&args.out)?, args.json)?;
    Ok(Exit::Done)
}

fn check(args: &Args) -> Result<(), BadArgument> {
    let numbers = [
        ("--rates", args.rates.iter().copied().fold(f64::INFINITY, f64::min), 1.0..=10_000.0),
        ("--rates", args.rates.iter().copied().fold(0.0, f64::max), 1.0..=10_000.0),
        ("--fixed-millis", args.fixed_millis, 0.0..=1000.0),
        ("--jitter-millis", args.jitter_millis, 0.0..=1000.0),
        ("--drift-ppm", args.drift_ppm, -200.0..=200.0),
        ("--seconds", args.seconds, 1.0..=3600.0),
        ("--settle-seconds", args.settle_seconds, 0.0..=args.seconds - 0.5),
    ];
    match numbers.into_iter().find(|(_, number, allowed)| !allowed.contains(number)) {
        Some((flag, number, allowed)) => {
            Err(BadArgument(format!("{flag}: {number} is outside {} to {}", allowed.start(), allowed.end())))
        }
        None => Ok(()),
    }
}

/// For each image after the settling time, the time of the pose that the join assigns to it minus the time of its
/// shutter. The fixed latency is included.
#[expect(clippy::cast_possible_truncation, reason = "times of an hour at most, in nanoseconds")]
fn errors_millis(args: &Args, rate_hz: f64, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut clock = ClockMap::new();
    let n_readings =
        (args.seconds + args.fixed_millis * 1e-3 + args.jitter_millis * 1e-3 + 1.0) * f64::from(JOINT_RATE_HZ);
    let mut joints = JointHistory::new(Duration::from_millis(100), n_readings.ceil() as usize + 1);
    for ix in 0..n_readings.ceil() as i64 {
        let stamp = Stamp(ix * 1_000_000_000 / i64::from(JOINT_RATE_HZ));
        let position = vec![SPEED_RAD_S * stamp.secs_since(Stamp(0))];
        let state = JointState { stamp, position, velocity: vec![SPEED_RAD_S], effort: Vec::new() };
        joints.push(state).expect("the states are ordered and finite");
    }
    let mut errors = Vec::new();
    for ix in 0..(args.seconds * rate_hz) as i64 {
        let shutter_secs = ix as f64 / rate_hz;
        let device_nanos = (shutter_secs / (1.0 + args.drift_ppm * 1e-6) * 1e9) as i64;
        let latency_millis = args.fixed_millis + args.jitter_millis * random.unit();
        let arrival = Stamp(((shutter_secs + latency_millis * 1e-3) * 1e9) as i64);
        let stamp = clock.stamp(device_nanos, arrival);
        if shutter_secs < args.settle_seconds {
            continue;
        }
        if let Ok(state) = joints.at(stamp) {
            errors.push((state.position[0] / SPEED_RAD_S - shutter_secs) * 1e3);
        }
    }
    errors
}

impl StampErrors {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the bins")]
    fn of(rate_hz: f64, is_calibrated: bool, errors: &[f64]) -> Self {
        let n_bars = (2.0 * HISTOGRAM_RANGE_MILLIS / BIN_MILLIS).round() as usize;
        let mut bars = vec![0.0; n_bars];
        let n = errors.len();
        for error in errors {
            let bar = ((error + HISTOGRAM_RANGE_MILLIS) / BIN_MILLIS).floor().max(0.0) as usize;
            bars[bar.min(n_bars - 1)] += 1.0 / n as f64;
        }
        let median_millis = median(errors).unwrap_or(f64::NAN);
        let mut sizes: Vec<f64> = errors.iter().map(|error| error.abs()).collect();
        Self {
            rate_hz,
            is_calibrated,
            images: n,
            within_1_ms_frac: sizes.iter().filter(|size| **size <= MAX_ERROR_MILLIS).count() as f64 / n as f64,
            median_millis,
            p99_abs_millis: quantile(&mut sizes, 0.99, Rank::Lower).unwrap_or(f64::NAN),
            max_abs_millis: quantile(&mut sizes, 1.0, Rank::Lower).unwrap_or(f64::NAN),
            bars,
        }
    }

    fn label(&self) -> String {
        let suffix = if self.is_calibrated { "" } else { ", fixed latency unknown" };
        format!("{} Hz{suffix}", self.rate_hz)
    }
}

fn findings(args: &Args, results: &[StampErrors]) -> anyhow::Result<Findings> {
    let point = |(ix, fraction): (usize, &f64)| {
        let y = 100.0 * fraction;
        Point { x: (ix as f64 + 0.5) * BIN_MILLIS - HISTOGRAM_RANGE_MILLIS, y, low: y, high: y }
    };
    let line = |results: &StampErrors| {
        // Draws one empty bin on either side of the nonempty ones.
        let first = results.bars.iter().position(|fraction| *fraction > 0.0).unwrap_or(0).saturating_sub(1);
        let n_empty_after =
            results.bars.iter().rev().position(|fraction| *fraction > 0.0).unwrap_or(0).saturating_sub(1);
        let n_drawn = results.bars.len() - n_empty_after - first;
        Line {
            label: results.label(),
            points: results.bars.iter().enumerate().skip(first).take(n_drawn).map(point).collect(),
            is_peer: !results.is_calibrated,
        }
    };
    let conditions = format!(
        "{} ms fixed latency, 0 to {} ms of jitter, {} ppm of drift; {} runs of {} s, without the first {} s",
        args.fixed_millis, args.jitter_millis, args.drift_ppm, args.seeds, args.seconds, args.settle_seconds
    );
    let row = |results: &StampErrors| {
        vec![
            results.label(),
            format!("{}", results.images),
            format!("{:.2}", 100.0 * results.within_1_ms_frac),
            format!("{:+.3}", results.median_millis),
            format!("{:.3}", results.p99_abs_millis),
            format!("{:.3}", results.max_abs_millis),
        ]
    };
    let head = ["camera", "images", "within 1 ms, %", "median, ms", "99 % within, ms", "maximum, ms"];
    Ok(Findings {
        name: "stamps",
        title: "Errors of image stamps".to_owned(),
        sentences: vec![
            format!("{conditions}."),
            "A joint moves at 1 rad/s and is read 1000 times per second; its angle at the stamp of an image gives the error of that stamp. \
 A fixed latency cannot be detected from stamps: it must be in the rig file (stamp_to_mid_exposure_millis); otherwise it remains, and a warning is logged."
                .to_owned(),
        ],
        charts: vec![(
            "",
            Chart {
                title: "Error of the stamp at which the pose is taken".to_owned(),
                subtitle: conditions,
                x: Axis { label: "ms".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                y: Axis { label: "share of images, % per 0.1 ms".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                lines: results.iter().map(line).collect(),
                thresholds: Vec::new(),
                markers: Vec::new(),
            },
        )],
        tables: vec![Table {
            title: "Stamps".to_owned(),
            head: head.map(str::to_owned).to_vec(),
            rows: results.iter().map(row).collect(),
        }],
        numbers: serde_json::to_value(results)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Flags {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn calibrated_stamps_are_within_one_millisecond() {
        let args = Flags::parse_from(["stamps", "--rates", "30", "--seeds", "3"]).args;
        let errors: Vec<f64> = (1..=3).flat_map(|seed| errors_millis(&args, 30.0, seed)).collect();
        let fixed_latency = StampErrors::of(30.0, true, &errors.iter().map(|error| error - 5.0).collect::<Vec<_>>());
        assert_eq!(fixed_latency.within_1_ms_frac, 1.0, "{fixed_latency:?}");
        assert!((fixed_latency.bars.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        let unknown = StampErrors::of(30.0, false, &errors);
        assert!((unknown.median_millis - 5.0).abs() < 0.5 && unknown.within_1_ms_frac == 0.0, "{unknown:?}");
    }

    #[test]
    fn out_of_range_arguments_are_rejected() {
        for flags in [["--seconds", "0"], ["--rates", "0,30"], ["--drift-ppm", "-900"], ["--settle-seconds", "500"]] {
            let args = Flags::parse_from(["stamps"].into_iter().chain(flags)).args;
            assert!(check(&args).is_err_and(|error| error.to_string().contains(flags[0])), "{flags:?}");
        }
    }
}
