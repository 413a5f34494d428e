//! Measures stamp errors of images from a simulated camera that has its own clock and a connection
//! with jitter.

use crate::findings::{BenchResult, Findings};
use anyhow::{Context, Result};
use kinematics::{ClockMap, JointHistory, JointState, Stamp};
use messages::{BadInput, Setting};
use numbers::quantile::{Rank, median, quantile};
use numbers::random::Random;
use report::Table;
use report::chart::{Axis, Chart, Line, Point, Scale};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// Width of a histogram bin, milliseconds. It is a tenth of the error up to which a stamp counts as
/// correct.
const BIN_MILLIS: f64 = 0.1;
/// Range of the histogram to either side, milliseconds. Larger errors are counted in the outermost
/// bins. The range is large enough for an unknown fixed latency of a few milliseconds.
const HISTOGRAM_RANGE_MILLIS: f64 = 8.0;
/// Joint states per second.
const JOINT_RATE_HZ: u32 = 1000;
/// Speed of the joint, rad/s. The joint angle encodes the time.
const SPEED_RAD_S: f64 = 1.0;
/// Error up to which a stamp counts as correct. At 1 rad/s, it causes a pose error of 1 mrad.
const MAX_ERROR_MILLIS: f64 = 1.0;

/// Options of [`run`] and [`measure`].
#[derive(Clone, Debug)]
pub struct StampsOptions {
    /// Camera rates, images per second, 1 to 10000.
    pub rates_hz: Vec<f64>,
    /// Minimum latency from the shutter to the arrival of an image, 0 to 1000 ms.
    pub fixed_millis: f64,
    /// Maximum random latency added to each image, 0 to 1000 ms.
    pub jitter_millis: f64,
    /// Rate of this computer's clock relative to the camera's clock, as a difference of -200 to 200
    /// parts per million. It is positive if this computer's clock runs faster.
    pub drift_ppm: f64,
    /// Length of a run, 1 to 3600 s.
    pub seconds: f64,
    /// Time at the start of a run that is ignored. It must be at least half a second less than
    /// `seconds`.
    pub settle_seconds: f64,
    /// Runs per rate.
    pub seeds: u64,
    /// Folder for charts and numbers.
    pub out: PathBuf,
}

/// Stamp errors for one camera rate, milliseconds.
#[derive(Clone, Debug, Serialize)]
pub struct StampErrors {
    /// Images per second.
    pub rate_hz: f64,
    /// Whether the rig file corrects the fixed latency of images.
    pub is_calibrated: bool,
    /// Number of images.
    pub images: usize,
    /// Share of the images with an error of at most 1 ms.
    pub within_1_ms_frac: f64,
    /// Median of the errors.
    pub median_millis: f64,
    /// 99th percentile of the absolute errors.
    pub p99_abs_millis: f64,
    /// Largest absolute error.
    pub max_abs_millis: f64,
    /// Share of the images in each bin, from -8 ms in steps of 0.1 ms.
    pub bars: Vec<f64>,
}

/// Measures the stamp errors and draws them as a histogram.
///
/// # Errors
///
/// Fails if an option is out of range, or if the folder cannot be written.
pub fn run(options: &StampsOptions) -> Result<BenchResult> {
    let results = measure(options)?;
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot create {}", options.out.display()))?;
    let findings = findings(options, &results)?;
    let page = findings.write(&options.out)?;
    Ok(BenchResult {
        findings,
        page,
        data_losses: Vec::new(),
    })
}

/// Measures the stamp errors at each rate, first with a calibrated fixed latency, then without
/// calibration.
///
/// # Errors
///
/// Fails if an option is out of range.
pub fn measure(options: &StampsOptions) -> Result<Vec<StampErrors>> {
    check(options)?;
    let mut results = Vec::new();
    for rate_hz in &options.rates_hz {
        let errors: Vec<f64> = (1..=options.seeds)
            .flat_map(|seed| errors_millis(options, *rate_hz, seed))
            .collect();
        for is_calibrated in [true, false] {
            // The rig file's offset is subtracted from every stamp.
            let fixed_latency = if is_calibrated {
                options.fixed_millis
            } else {
                0.0
            };
            let errors: Vec<f64> = errors.iter().map(|error| error - fixed_latency).collect();
            results.push(StampErrors::of(*rate_hz, is_calibrated, &errors));
        }
    }
    Ok(results)
}

fn check(options: &StampsOptions) -> Result<()> {
    let numbers = [
        (
            Setting::Rates,
            options
                .rates_hz
                .iter()
                .copied()
                .fold(f64::INFINITY, f64::min),
            1.0..=10_000.0,
        ),
        (
            Setting::Rates,
            options.rates_hz.iter().copied().fold(0.0, f64::max),
            1.0..=10_000.0,
        ),
        (Setting::FixedMillis, options.fixed_millis, 0.0..=1000.0),
        (Setting::JitterMillis, options.jitter_millis, 0.0..=1000.0),
        (Setting::DriftPpm, options.drift_ppm, -200.0..=200.0),
        (Setting::Seconds, options.seconds, 1.0..=3600.0),
        (
            Setting::SettleSeconds,
            options.settle_seconds,
            0.0..=options.seconds - 0.5,
        ),
    ];
    match numbers
        .into_iter()
        .find(|(_, number, allowed)| !allowed.contains(number))
    {
        Some((setting, number, allowed)) => Err(BadInput(format!(
            "{setting}: {number} is outside {} to {}",
            allowed.start(),
            allowed.end()
        ))
        .into()),
        None => Ok(()),
    }
}

/// The stamp error of each image after the settling time. It is the time at which the joint was at
/// the angle that belongs to the stamp, minus the time of the shutter. The error includes the fixed
/// latency.
#[expect(
    clippy::cast_possible_truncation,
    reason = "times of an hour at most, in nanoseconds"
)]
fn errors_millis(options: &StampsOptions, rate_hz: f64, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut clock = ClockMap::new();
    // The joint states continue until the last image has certainly arrived, because a stamp may be
    // as late as the arrival of its image.
    let n_readings =
        (options.seconds + options.fixed_millis * 1e-3 + options.jitter_millis * 1e-3 + 1.0)
            * f64::from(JOINT_RATE_HZ);
    let mut joints = JointHistory::new(Duration::from_millis(100), n_readings.ceil() as usize + 1);
    for ix in 0..n_readings.ceil() as i64 {
        let stamp = Stamp(ix * 1_000_000_000 / i64::from(JOINT_RATE_HZ));
        let position = vec![SPEED_RAD_S * stamp.secs_since(Stamp(0))];
        let state = JointState {
            stamp,
            position,
            velocity: vec![SPEED_RAD_S],
            effort: Vec::new(),
        };
        joints
            .push(state)
            .expect("the states are ordered and finite");
    }
    let mut errors = Vec::new();
    for ix in 0..(options.seconds * rate_hz) as i64 {
        let shutter_secs = ix as f64 / rate_hz;
        // The camera's clock is slower than the computer's clock by the drift.
        let device_nanos = (shutter_secs / (1.0 + options.drift_ppm * 1e-6) * 1e9) as i64;
        let latency_millis = options.fixed_millis + options.jitter_millis * random.unit();
        let arrival = Stamp(((shutter_secs + latency_millis * 1e-3) * 1e9) as i64);
        // Images are also stamped during the settling time, in which the clock map learns offset
        // and drift.
        let stamp = clock.stamp(device_nanos, arrival);
        if shutter_secs < options.settle_seconds {
            continue;
        }
        if let Ok(state) = joints.at(stamp) {
            errors.push((state.position[0] / SPEED_RAD_S - shutter_secs) * 1e3);
        }
    }
    errors
}

impl StampErrors {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to the bins"
    )]
    fn of(rate_hz: f64, is_calibrated: bool, errors: &[f64]) -> Self {
        let n_bars = (2.0 * HISTOGRAM_RANGE_MILLIS / BIN_MILLIS).round() as usize;
        let mut bars = vec![0.0; n_bars];
        let n = errors.len();
        for error in errors {
            let bar = ((error + HISTOGRAM_RANGE_MILLIS) / BIN_MILLIS)
                .floor()
                .max(0.0) as usize;
            bars[bar.min(n_bars - 1)] += 1.0 / n as f64;
        }
        let median_millis = median(errors).unwrap_or(f64::NAN);
        let mut sizes: Vec<f64> = errors.iter().map(|error| error.abs()).collect();
        Self {
            rate_hz,
            is_calibrated,
            images: n,
            within_1_ms_frac: sizes
                .iter()
                .filter(|size| **size <= MAX_ERROR_MILLIS)
                .count() as f64
                / n as f64,
            median_millis,
            p99_abs_millis: quantile(&mut sizes, 0.99, Rank::Lower).unwrap_or(f64::NAN),
            max_abs_millis: quantile(&mut sizes, 1.0, Rank::Lower).unwrap_or(f64::NAN),
            bars,
        }
    }

    fn label(&self) -> String {
        let suffix = if self.is_calibrated {
            ""
        } else {
            ", fixed latency unknown"
        };
        format!("{} Hz{suffix}", self.rate_hz)
    }

    /// The histogram as a line.
    fn line(&self) -> Line {
        // One empty bin is drawn on either side of the nonempty bins.
        let first = self
            .bars
            .iter()
            .position(|fraction| *fraction > 0.0)
            .unwrap_or(0)
            .saturating_sub(1);
        let n_empty_after = self
            .bars
            .iter()
            .rev()
            .position(|fraction| *fraction > 0.0)
            .unwrap_or(0)
            .saturating_sub(1);
        let n_drawn = self.bars.len() - n_empty_after - first;
        Line {
            label: self.label(),
            points: self
                .bars
                .iter()
                .enumerate()
                .skip(first)
                .take(n_drawn)
                .map(|(ix, fraction)| bin_point(ix, *fraction))
                .collect(),
            is_peer: !self.is_calibrated,
        }
    }

    fn row(&self) -> Vec<String> {
        vec![
            self.label(),
            format!("{}", self.images),
            format!("{:.2}", 100.0 * self.within_1_ms_frac),
            format!("{:+.3}", self.median_millis),
            format!("{:.3}", self.p99_abs_millis),
            format!("{:.3}", self.max_abs_millis),
        ]
    }
}

/// The point of a bin, in percent, at the middle of the bin.
fn bin_point(bin_ix: usize, fraction: f64) -> Point {
    let y = 100.0 * fraction;
    Point {
        x: (bin_ix as f64 + 0.5) * BIN_MILLIS - HISTOGRAM_RANGE_MILLIS,
        y,
        low: y,
        high: y,
    }
}

fn findings(options: &StampsOptions, results: &[StampErrors]) -> Result<Findings> {
    let conditions = format!(
        "{} ms fixed latency, 0 to {} ms of jitter, {} ppm of drift; {} runs of {} s, without the first {} s",
        options.fixed_millis,
        options.jitter_millis,
        options.drift_ppm,
        options.seeds,
        options.seconds,
        options.settle_seconds
    );
    let head = [
        "camera",
        "images",
        "within 1 ms, %",
        "median, ms",
        "99th percentile, ms",
        "maximum, ms",
    ];
    Ok(Findings {
        name: "stamps",
        title: "Errors of image stamps".to_owned(),
        sentences: vec![
            format!("{conditions}."),
            "A joint moves at 1 rad/s and is read 1000 times per second. Its angle at the stamp of an image gives the error of that stamp. \
 A fixed latency cannot be detected from stamps. It remains, with a warning, unless the rig file contains it (stamp_to_mid_exposure_millis)."
                .to_owned(),
        ],
        charts: vec![(
            "",
            Chart {
                title: "Errors of image stamps".to_owned(),
                subtitle: conditions,
                x: Axis { label: "ms".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                y: Axis { label: "share of images, % per 0.1 ms".to_owned(), scale: Scale::Linear, ticks: Vec::new() },
                lines: results.iter().map(StampErrors::line).collect(),
                thresholds: Vec::new(),
                markers: Vec::new(),
            },
        )],
        tables: vec![Table {
            title: "Stamps".to_owned(),
            head: head.map(str::to_owned).to_vec(),
            rows: results.iter().map(StampErrors::row).collect(),
        }],
        numbers: serde_json::to_value(results)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> StampsOptions {
        StampsOptions {
            rates_hz: vec![30.0],
            fixed_millis: 5.0,
            jitter_millis: 75.0,
            drift_ppm: 50.0,
            seconds: 120.0,
            settle_seconds: 10.0,
            seeds: 3,
            out: "bench-stamps".into(),
        }
    }

    #[test]
    fn calibrated_stamps_are_within_one_millisecond() {
        let errors = measure(&options()).expect("in range");
        let [fixed_latency, unknown] = &errors[..] else {
            panic!("one rate")
        };
        assert_eq!(fixed_latency.within_1_ms_frac, 1.0, "{fixed_latency:?}");
        assert!((fixed_latency.bars.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        assert!(
            (unknown.median_millis - 5.0).abs() < 0.5 && unknown.within_1_ms_frac == 0.0,
            "{unknown:?}"
        );
    }

    #[test]
    fn out_of_range_options_are_rejected() {
        for (setting, options) in [
            (
                Setting::Seconds,
                StampsOptions {
                    seconds: 0.0,
                    ..options()
                },
            ),
            (
                Setting::Rates,
                StampsOptions {
                    rates_hz: vec![0.0, 30.0],
                    ..options()
                },
            ),
            (
                Setting::DriftPpm,
                StampsOptions {
                    drift_ppm: -900.0,
                    ..options()
                },
            ),
            (
                Setting::SettleSeconds,
                StampsOptions {
                    settle_seconds: 500.0,
                    ..options()
                },
            ),
        ] {
            assert!(
                check(&options)
                    .is_err_and(|error| error.to_string().contains(&setting.to_string())),
                "{setting}"
            );
        }
    }
}
