//! How well the arm follows a hand that draws a figure of eight, and how late.

use super::arms::ArmKind;
use super::operator::{Operator, hand_at};
use super::rig::SteeredRig;
use super::trace::{Excess, Sample, largest_excess};
use anyhow::Result;
use drivers::clock;
use kinematics::{Chain, Stamp};
use nalgebra::Vector3;
use numbers::quantile::{Rank, median, quantile};
use report::Table;
use serde::Serialize;
use std::f64::consts::TAU;

/// Width of the figure, meters.
const WIDTH_M: f64 = 0.2;
/// Speed of the hand, m/s.
const HAND_M_S: f64 = 0.1;
/// The tip is compared with where the hand was this long before, seconds.
const COMPARED_LAG_SECS: f64 = 0.15;
/// Time at the start for which the tip is not compared, seconds: the hand starts at full speed.
const SETTLE_SECS: f64 = 1.5;
/// Number of points at which the length of the figure is summed. Their distance is a tenth of a
/// millimeter.
const N_POINTS: usize = 8192;
/// Time between two positions of the tip that are kept, seconds.
const KEPT_PERIOD_SECS: f64 = 0.01;
/// Lags that are tried to find the lag of the arm, seconds.
const LAG_STEP_SECS: f64 = 0.002;
const N_LAGS: u32 = 151;

/// How well an arm followed the hand.
#[derive(Clone, Debug, Serialize)]
pub struct Tracking {
    /// The arm.
    pub arm: ArmKind,
    /// Time for which the arm followed the hand, seconds. It is shorter than planned if the arm
    /// braked.
    pub seconds: f64,
    /// Planned time, seconds.
    pub planned_seconds: f64,
    /// Largest distance between the tip and where the hand was 150 ms before, millimeters.
    pub max_error_mm: Option<f64>,
    /// Median of this distance, millimeters.
    pub p50_error_mm: Option<f64>,
    /// The lag with the smallest distances, milliseconds: from the hand to the joints.
    pub lag_millis: Option<f64>,
    /// Largest distance with this lag, millimeters.
    pub max_error_at_lag_mm: Option<f64>,
    /// Time from a sample of the hand until its setpoint is given to the arm, milliseconds: median.
    pub applied_p50_millis: Option<f64>,
    /// The same: 99th percentile.
    pub applied_p99_millis: Option<f64>,
    /// Fraction of the robot's cycles that got a command in time, if the arm counts it.
    pub success_frac: Option<f64>,
    /// The largest excess over a limit.
    pub excess: Option<Excess>,
}

/// Position of the tip at a time since the start of the figure.
#[derive(Clone, Copy, Debug, PartialEq)]
struct TipAt {
    secs: f64,
    tip_m: Vector3<f64>,
}

/// Lets the arm follow the figure for some time.
///
/// # Errors
///
/// If the arm cannot be steered.
pub(super) fn measure(rig: &SteeredRig, planned_seconds: f64) -> Result<Tracking> {
    let mut operator = Operator::connect(rig)?;
    operator.prepare()?;
    let figure = Figure::new();
    let tip_at_start_m = operator.tip_m()?;
    operator.begin_grip()?;
    let braked_before = operator.arm()?.braked_motion;
    rig.robot.recorder.take();
    let began_at = clock::now();
    let mut record = Record::default();
    let mut secs = 0.0;
    while secs < planned_seconds && operator.arm()?.braked_motion == braked_before {
        operator.wait_for_sample();
        secs = clock::now().secs_since(began_at);
        let sample = operator.closed_sample(&hand_at(figure.at(secs)));
        operator.client.send(&sample)?;
        record.add(&rig.robot.recorder.take(), rig, began_at)?;
    }
    let open = operator.open_sample();
    operator.client.send(&open)?;
    let mut applied_millis = operator.client.applied_millis();
    for tip in &mut record.tips {
        tip.tip_m -= tip_at_start_m;
    }
    let followed = |tip: &&TipAt| tip.secs >= SETTLE_SECS && tip.secs <= secs;
    let tips: Vec<TipAt> = record.tips.iter().filter(followed).copied().collect();
    let mut errors_mm = errors_mm(&figure, &tips, COMPARED_LAG_SECS);
    let lag_secs = best_lag_secs(&figure, &tips);
    Ok(Tracking {
        arm: rig.robot.kind,
        seconds: secs,
        planned_seconds,
        p50_error_mm: median(&errors_mm),
        max_error_mm: quantile(&mut errors_mm, 1.0, Rank::Lower),
        lag_millis: lag_secs.map(|secs| 1e3 * secs),
        max_error_at_lag_mm: lag_secs.and_then(|lag_secs| {
            quantile(
                &mut self::errors_mm(&figure, &tips, lag_secs),
                1.0,
                Rank::Lower,
            )
        }),
        applied_p50_millis: median(&applied_millis),
        applied_p99_millis: quantile(&mut applied_millis, 0.99, Rank::Lower),
        success_frac: rig.robot.running.success_frac(),
        excess: record.excess,
    })
}

/// Recorded motion of the arm. A sample per millisecond would need too much memory.
#[derive(Default)]
struct Record {
    tips: Vec<TipAt>,
    excess: Option<Excess>,
}

impl Record {
    fn add(&mut self, samples: &[Sample], rig: &SteeredRig, began_at: Stamp) -> Result<()> {
        let robot = &rig.robot;
        let arm = robot.arm()?;
        let excess = largest_excess(samples, &robot.checked_limits, robot.period);
        self.excess = self.excess.or(excess);
        for sample in samples {
            let secs = sample.at.secs_since(began_at);
            let kept_until = self.tips.last().map_or(f64::NEG_INFINITY, |tip| tip.secs);
            if secs >= kept_until + KEPT_PERIOD_SECS {
                let tip_m = tip_m(&arm.chain, sample)?;
                self.tips.push(TipAt { secs, tip_m });
            }
        }
        Ok(())
    }
}

fn tip_m(chain: &Chain, sample: &Sample) -> Result<Vector3<f64>> {
    let pose = chain.forward(&sample.setpoint.position)?;
    Ok(pose.translation.vector)
}

/// Distances between the tip and where the hand was before, millimeters.
fn errors_mm(figure: &Figure, tips: &[TipAt], lag_secs: f64) -> Vec<f64> {
    let error_mm = |tip: &TipAt| 1e3 * (tip.tip_m - figure.at(tip.secs - lag_secs)).norm();
    tips.iter().map(error_mm).collect()
}

/// The lag with the smallest sum of squared distances.
fn best_lag_secs(figure: &Figure, tips: &[TipAt]) -> Option<f64> {
    if tips.is_empty() {
        return None;
    }
    let lags = (0..N_LAGS).map(|ix| f64::from(ix) * LAG_STEP_SECS);
    let sum = |lag_secs: f64| {
        let errors = errors_mm(figure, tips, lag_secs);
        errors.iter().map(|error| error * error).sum::<f64>()
    };
    let sums = lags.map(|lag_secs| (lag_secs, sum(lag_secs)));
    let best = sums.min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(best.0)
}

/// A figure of eight in the plane of y and z, the lemniscate of Gerono, drawn at constant speed.
struct Figure {
    /// Distance along the figure at equally spaced values of its parameter, from 0 to a full turn.
    lengths_m: Vec<f64>,
}

impl Figure {
    fn new() -> Self {
        let mut lengths_m = vec![0.0];
        let mut length_m = 0.0;
        for ix in 1..=N_POINTS {
            let point = |ix: usize| point_m(TAU * ix as f64 / N_POINTS as f64);
            length_m += (point(ix) - point(ix - 1)).norm();
            lengths_m.push(length_m);
        }
        Self { lengths_m }
    }

    /// The position of the hand relative to its start, meters.
    fn at(&self, secs: f64) -> Vector3<f64> {
        let round_m = self.lengths_m[N_POINTS];
        let length_m = (HAND_M_S * secs.max(0.0)).rem_euclid(round_m);
        let after_ix = self
            .lengths_m
            .partition_point(|along_m| *along_m <= length_m);
        let ix = after_ix.clamp(1, N_POINTS);
        let [before_m, after_m] = [self.lengths_m[ix - 1], self.lengths_m[ix]];
        let frac = (length_m - before_m) / (after_m - before_m);
        point_m(TAU * (ix as f64 - 1.0 + frac) / N_POINTS as f64)
    }
}

fn point_m(parameter: f64) -> Vector3<f64> {
    let half_m = 0.5 * WIDTH_M;
    let (sin, cos) = parameter.sin_cos();
    Vector3::new(0.0, half_m * sin, half_m * sin * cos)
}

/// The table of all arms.
pub(super) fn table(results: &[Tracking]) -> Table {
    let head = [
        "arm",
        "followed, s",
        "of planned, s",
        "largest error to 150 ms before, mm",
        "median, mm",
        "hand to joints, ms",
        "largest error at this lag, mm",
        "hand to setpoint p50, ms",
        "p99, ms",
        "commands in time, %",
        "limits exceeded",
    ];
    let cells = |result: &Tracking| {
        let cell = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |n| format!("{n:.1}"));
        vec![
            result.arm.name().to_owned(),
            format!("{:.1}", result.seconds),
            format!("{:.1}", result.planned_seconds),
            cell(result.max_error_mm),
            cell(result.p50_error_mm),
            cell(result.lag_millis),
            cell(result.max_error_at_lag_mm),
            cell(result.applied_p50_millis),
            cell(result.applied_p99_millis),
            result
                .success_frac
                .map_or_else(|| "-".to_owned(), |frac| format!("{:.3}", 100.0 * frac)),
            if result.excess.is_some() { "yes" } else { "no" }.to_owned(),
        ]
    };
    Table {
        title: "Figure of eight".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: results.iter().map(cells).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hand_draws_the_whole_figure_at_constant_speed() {
        const STEP_SECS: f64 = 0.01;
        let figure = Figure::new();
        assert!(figure.at(0.0).norm() < 1e-12);
        let round_secs = figure.lengths_m[N_POINTS] / HAND_M_S;
        let mut width_m: f64 = 0.0;
        let mut secs = 0.0;
        while secs < round_secs {
            let step_m = (figure.at(secs + STEP_SECS) - figure.at(secs)).norm();
            let speed_m_s = step_m / STEP_SECS;
            assert!(
                (speed_m_s - HAND_M_S).abs() < 1e-3 * HAND_M_S,
                "{speed_m_s}"
            );
            width_m = width_m.max(2.0 * figure.at(secs).y);
            secs += STEP_SECS;
        }
        assert!((width_m - WIDTH_M).abs() < 1e-4, "{width_m}");
    }

    #[test]
    fn the_lag_of_an_arm_that_follows_late_is_found() {
        let figure = Figure::new();
        let tips: Vec<TipAt> = (200..1200)
            .map(|ix| {
                let secs = f64::from(ix) * 0.01;
                let tip_m = figure.at(secs - 0.07);
                TipAt { secs, tip_m }
            })
            .collect();
        let lag_secs = best_lag_secs(&figure, &tips).expect("tips");
        assert!((lag_secs - 0.07).abs() < 1e-9, "{lag_secs}");
        let max_mm = errors_mm(&figure, &tips, COMPARED_LAG_SECS)
            .into_iter()
            .fold(0.0, f64::max);
        // 80 ms at 0.1 m/s are 8 mm.
        assert!((max_mm - 8.0).abs() < 0.1, "{max_mm}");
        assert_eq!(best_lag_secs(&figure, &[]), None);
    }
}
