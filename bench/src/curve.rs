//! Measures the accuracy over time with several seeds, and compares it with other trainers.

use crate::findings::{BenchResult, Findings};
use crate::peer::Peer;
use crate::runs::{Host, Job, NamedData, Run, Runs, RunsOptions};
use crate::statistics::{extent, sample_std, secs_to};
use anyhow::Result;
use messages::{BadInput, Setting};
use numbers::quantile::median;
use report::Table;
use report::chart::{Axis, Chart, Line, Point, Scale, compact_number};
use serde::Serialize;
use session::evaluation_schedule;
use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;
use trainer::{ModelKind, ModelSpec};

/// PSNR levels for which the time to reach the level is reported, dB.
const TARGET_DB: [f64; 3] = [25.0, 28.0, 30.0];
/// Default training time of a run, seconds.
pub const DEFAULT_SECONDS: f64 = 60.0;

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct CurveOptions {
    /// Folders or recordings. Each gives one line per method.
    pub data: Vec<PathBuf>,
    /// Training time of each run, seconds.
    pub seconds: f64,
    /// Runs per line, with consecutive seeds.
    pub seeds: u64,
    /// Files with the curves of other trainers.
    pub peers: Vec<PathBuf>,
    /// Models, images and folder.
    pub runs: RunsOptions,
}

/// Result of one method on one data set, or of one peer.
#[derive(Debug, Serialize)]
struct CurveResult {
    label: String,
    /// `None` for a peer.
    method: Option<&'static str>,
    is_peer: bool,
    /// PSNR on the evaluation schedule.
    points: Vec<CurvePoint>,
    summary: Summary,
    runs: Vec<Run>,
}

/// PSNR of several runs at one evaluation.
#[derive(Debug, PartialEq, Serialize)]
struct CurvePoint {
    /// Median time.
    seconds: f64,
    /// Median PSNR, dB.
    psnr: f64,
    min_psnr: f64,
    max_psnr: f64,
    n_runs: usize,
}

#[derive(Debug, Serialize)]
struct Summary {
    n_runs: usize,
    /// Median PSNR at the end, dB.
    psnr: Option<f64>,
    /// Standard deviation over the runs, dB.
    psnr_std: Option<f64>,
    /// Median training time. A method that finishes early does not use its whole time limit.
    seconds: Option<f64>,
    primitives: Option<f64>,
    primitives_extent: Option<[f64; 2]>,
    /// Standard deviation divided by the mean.
    primitives_spread: Option<f64>,
    /// Median size at the end.
    bytes: Option<f64>,
    seconds_to: Vec<TimeToQuality>,
}

/// Final values of the runs of a line.
#[derive(Debug, Default)]
struct FinalValues {
    psnr: Vec<f64>,
    seconds: Vec<f64>,
    primitives: Vec<f64>,
    bytes: Vec<f64>,
}

/// Time to reach a PSNR level.
#[derive(Debug, PartialEq, Serialize)]
struct TimeToQuality {
    psnr: f64,
    /// Median over the runs that reached the level.
    seconds: Option<f64>,
    n_runs: usize,
}

/// Trains every method on every data set with several seeds.
///
/// # Errors
///
/// Fails if an option or a file of a peer is invalid, if data cannot be read or scored, or if
/// training fails.
pub fn run(options: &CurveOptions, host: &Host<'_>) -> Result<BenchResult> {
    let limits = session::limits(Some(options.seconds), None, DEFAULT_SECONDS)?;
    if options.seconds == 0.0 {
        return Err(BadInput(format!("{}: must be above 0", Setting::Seconds)).into());
    }
    let peers = options
        .peers
        .iter()
        .map(|path| Peer::load(path))
        .collect::<Result<Vec<_>>>()?;
    let mut runs = Runs::open(&options.runs, host)?;
    let mut bench = Bench {
        options,
        peers,
        results: Vec::new(),
        notes: Vec::new(),
    };
    let mut data_losses = Vec::new();
    let mut names = HashSet::new();
    let mut page = None;
    for (path, n_left) in options.data.iter().zip((1..=options.data.len()).rev()) {
        let data = runs.load(path, &mut names)?;
        data_losses.extend(data.data.data_losses.iter().cloned());
        // The methods of later data sets are not known yet. The estimated number of runs assumes
        // that each later data set has as many methods as this data set. Each data set corrects the
        // estimate.
        let model_specs = bench.applicable(&data);
        runs.expect((n_left * model_specs.len()) as u64 * options.seeds);
        for model_spec in model_specs {
            let mut finished = Vec::new();
            // This result is empty until the first run replaces it.
            bench
                .results
                .push(CurveResult::of_runs(&data, model_spec.kind, Vec::new()));
            let first_seed = model_spec.options.common.seed;
            for seed in first_seed..first_seed.saturating_add(options.seeds) {
                finished.push(
                    runs.run(Job {
                        name: format!("curve {} {} seed {seed}", data.name, model_spec.kind.name()),
                        data: &data,
                        model_spec: ModelSpec {
                            kind: model_spec.kind,
                            options: model_spec
                                .options
                                .clone()
                                .with(|model| model.common.seed = seed),
                        },
                        limits,
                        disturbed: None,
                        variant: None,
                        keyframes: &|| data.data.keyframes.clone(),
                        is_thorough: true,
                    })?,
                );
                // Findings are written after every run, so that an interrupted bench leaves
                // results.
                bench.results.pop();
                bench.results.push(CurveResult::of_runs(
                    &data,
                    model_spec.kind,
                    finished.clone(),
                ));
                page = Some(bench.findings(&runs)?);
            }
        }
    }
    BenchResult::of(page, data_losses)
}

impl CurveResult {
    fn of_runs(data: &NamedData, kind: ModelKind, runs: Vec<Run>) -> Self {
        let curves: Vec<Vec<(f64, f64)>> = runs.iter().map(Run::curve).collect();
        let ends = FinalValues {
            psnr: runs.iter().map(Run::psnr).collect(),
            seconds: runs.iter().map(|run| run.end.seconds).collect(),
            primitives: runs.iter().map(|run| run.end.primitives as f64).collect(),
            bytes: runs.iter().map(|run| run.end.bytes as f64).collect(),
        };
        Self {
            label: format!("{}, {}", data.name, kind.name()),
            method: Some(kind.name()),
            is_peer: false,
            points: median_curve(&curves),
            summary: Summary::of(&curves, &ends),
            runs,
        }
    }

    fn of_peer(peer: &Peer) -> Self {
        let curves = vec![peer.curve()];
        let last = peer.rows.last();
        let ends = FinalValues {
            psnr: last.map(|row| row.psnr).into_iter().collect(),
            seconds: last.map(|row| row.seconds).into_iter().collect(),
            primitives: last
                .and_then(|row| row.n)
                .map(|n| n as f64)
                .into_iter()
                .collect(),
            bytes: last
                .and_then(|row| row.bytes)
                .map(|bytes| bytes as f64)
                .into_iter()
                .collect(),
        };
        Self {
            label: peer.label.clone(),
            method: None,
            is_peer: true,
            points: median_curve(&curves),
            summary: Summary::of(&curves, &ends),
            runs: Vec::new(),
        }
    }

    fn line(&self) -> Line {
        let point = |evaluation: &CurvePoint| Point {
            x: evaluation.seconds,
            y: evaluation.psnr,
            low: evaluation.min_psnr,
            high: evaluation.max_psnr,
        };
        Line {
            label: self.label.clone(),
            points: self.points.iter().map(point).collect(),
            is_peer: self.is_peer,
        }
    }

    /// The final PSNR over the size of the model. The line has no point if either value is unknown.
    fn size_line(&self) -> Line {
        let Summary { psnr, bytes, .. } = self.summary;
        let megabytes = bytes
            .map(|bytes| bytes / 1e6)
            .filter(|megabytes| *megabytes > 0.0);
        let point = megabytes.zip(psnr).map(|(x, y)| Point {
            x,
            y,
            low: y,
            high: y,
        });
        Line {
            label: self.label.clone(),
            points: point.into_iter().collect(),
            is_peer: self.is_peer,
        }
    }
}

/// Median and range at each scheduled evaluation that at least half of the runs reached, ordered by
/// time.
fn median_curve(curves: &[Vec<(f64, f64)>]) -> Vec<CurvePoint> {
    // The key contains the bits of the scheduled time, which sort like the time itself. The flag
    // marks a final evaluation between two scheduled times, which gets a separate group.
    let mut groups: BTreeMap<(u64, bool), Vec<(f64, f64)>> = BTreeMap::new();
    for curve in curves {
        let mut taken = HashSet::new();
        for &(seconds, psnr) in curve {
            let scheduled_bits = evaluation_schedule::latest(seconds)
                .unwrap_or(0.0)
                .to_bits();
            groups
                .entry((scheduled_bits, !taken.insert(scheduled_bits)))
                .or_default()
                .push((seconds, psnr));
        }
    }
    let mut evaluations: Vec<CurvePoint> = groups
        .into_values()
        .filter(|group| 2 * group.len() >= curves.len())
        .filter_map(|group| {
            let (seconds, psnr): (Vec<f64>, Vec<f64>) = group.into_iter().unzip();
            let [min_psnr, max_psnr] = extent(&psnr)?;
            let n_runs = psnr.len();
            Some(CurvePoint {
                seconds: median(&seconds)?,
                psnr: median(&psnr)?,
                min_psnr,
                max_psnr,
                n_runs,
            })
        })
        .collect();
    evaluations.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    evaluations
}

impl Summary {
    fn of(curves: &[Vec<(f64, f64)>], ends: &FinalValues) -> Self {
        let mean_size = ends.primitives.iter().sum::<f64>() / ends.primitives.len().max(1) as f64;
        Self {
            n_runs: curves.len(),
            psnr: median(&ends.psnr),
            psnr_std: sample_std(&ends.psnr),
            seconds: median(&ends.seconds),
            primitives: median(&ends.primitives),
            primitives_extent: extent(&ends.primitives),
            primitives_spread: sample_std(&ends.primitives).map(|std| std / mean_size),
            bytes: median(&ends.bytes),
            seconds_to: TARGET_DB
                .map(|target_db| TimeToQuality::of(curves, target_db))
                .into(),
        }
    }

    fn row(&self, label: &str) -> Vec<String> {
        let number = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
        };
        let mut row = vec![
            label.to_owned(),
            self.n_runs.to_string(),
            number(self.psnr, 2),
            number(self.psnr_std, 3),
        ];
        row.extend([number(self.seconds, 2), number(self.primitives, 0)]);
        let spread = self.primitives_extent.filter(|_| self.n_runs > 1);
        row.push(spread.map_or_else(
            || "-".to_owned(),
            |[low, high]| format!("{low:.0} to {high:.0}"),
        ));
        row.push(number(self.primitives_spread.map(|share| 100.0 * share), 2));
        row.push(number(self.bytes.map(|bytes| bytes / 1e6), 2));
        row.extend(self.seconds_to.iter().map(|reached| match reached.seconds {
            None => "not reached".to_owned(),
            Some(seconds) if reached.n_runs == self.n_runs => format!("{seconds:.2} s"),
            Some(seconds) => format!("{seconds:.2} s ({} of {})", reached.n_runs, self.n_runs),
        }));
        row
    }
}

impl TimeToQuality {
    fn of(curves: &[Vec<(f64, f64)>], target_db: f64) -> Self {
        // Runs that have not reached the level have no time, and are only counted.
        let seconds: Vec<f64> = curves
            .iter()
            .filter_map(|curve| secs_to(curve, target_db))
            .collect();
        Self {
            psnr: target_db,
            seconds: median(&seconds),
            n_runs: seconds.len(),
        }
    }
}

/// The axis of the PSNR.
fn psnr_axis() -> Axis {
    Axis {
        label: "test PSNR, dB".into(),
        scale: Scale::Linear,
        ticks: Vec::new(),
    }
}

/// PSNR over time.
fn time_chart(n_seeds: u64, all: &[&CurveResult]) -> Chart {
    let last_secs = all
        .iter()
        .flat_map(|results| &results.points)
        .map(|point| point.seconds)
        .fold(1.0, f64::max);
    let subtitle = if n_seeds > 1 {
        format!("median of {n_seeds} seeds; band: minimum to maximum; dashed: peers")
    } else {
        "one run per line; dashed: peers".to_owned()
    };
    Chart {
        title: "PSNR of test images over time".into(),
        subtitle,
        x: Axis {
            label: "seconds of training (log)".into(),
            scale: Scale::Log,
            // The last evaluation begins slightly late. The factor 1.1 ensures that its time still
            // has a tick.
            ticks: evaluation_schedule::up_to(1.1 * last_secs).collect(),
        },
        y: psnr_axis(),
        lines: all.iter().map(|results| results.line()).collect(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

/// PSNR at the end over the size of the model.
fn size_chart(seconds: &str, all: &[&CurveResult]) -> Chart {
    Chart {
        title: "PSNR of test images over the size of the model".into(),
        subtitle: format!("after {seconds} s; median of the runs"),
        x: Axis {
            label: "GPU memory of the model, MB (log)".into(),
            scale: Scale::Log,
            ticks: Vec::new(),
        },
        y: psnr_axis(),
        lines: all.iter().map(|results| results.size_line()).collect(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

/// The results so far.
struct Bench<'a> {
    options: &'a CurveOptions,
    peers: Vec<Peer>,
    results: Vec<CurveResult>,
    /// Notes for the page.
    notes: Vec<String>,
}

impl Bench<'_> {
    /// The methods that support these data. If there are none, all methods are returned, so that
    /// training reports the problem.
    fn applicable<'a>(&mut self, data: &'a NamedData) -> Vec<&'a ModelSpec> {
        let (applicable, without_depth): (Vec<_>, Vec<_>) = data
            .model_specs
            .iter()
            .partition(|model_spec| data.data.has_depth() || !model_spec.kind.entry().needs_depth);
        if applicable.is_empty() {
            return without_depth;
        }
        for model_spec in without_depth {
            let note = format!(
                "{} has no depth, which {} needs: this line is omitted",
                data.name,
                model_spec.kind.name()
            );
            log::warn!("{note}");
            self.notes.push(note + ".");
        }
        applicable
    }

    /// Writes the findings so far.
    fn findings(&self, runs: &Runs<'_>) -> Result<(Findings, PathBuf)> {
        let peers: Vec<CurveResult> = self.peers.iter().map(CurveResult::of_peer).collect();
        let all: Vec<&CurveResult> = self.results.iter().chain(&peers).collect();
        let n_seeds = self.options.seeds;
        let seconds = compact_number(self.options.seconds);
        let over_time = time_chart(n_seeds, &all);
        let over_size = size_chart(&seconds, &all);
        let head = [
            "data, method",
            "runs",
            "PSNR, dB",
            "std, dB",
            "seconds",
            "primitives",
            "range",
            "spread, %",
            "MB",
        ];
        let head = head
            .map(str::to_owned)
            .into_iter()
            .chain(TARGET_DB.map(|target_db| format!("to {target_db} dB")));
        let table = Table {
            title: format!("After {seconds} s (peers: after their last row)"),
            head: head.collect(),
            rows: all
                .iter()
                .map(|results| results.summary.row(&results.label))
                .collect(),
        };
        let mut sentences = vec![
            format!(
                "Each line is one method on one data set, trained {n_seeds} times for {seconds} s with different seeds. Time \
 excludes loading and scoring. PSNR is the mean over the test images."
            ),
            "The time to reach a PSNR level is interpolated between two evaluations over the logarithm of time. For a curve that starts \
 above the level, it is the time of the first evaluation. Curves of peers are read from files and may come from another computer."
                .into(),
            "Primitives are splats, voxel blocks (tsdf) or table entries (nerf). The line of a distance field ends when \
 every image has been fused once."
                .into(),
        ];
        sentences.extend(self.notes.iter().cloned());
        sentences.push(format!(
            "{}; fieldrig {}.",
            runs.adapter(),
            env!("CARGO_PKG_VERSION")
        ));
        let findings = Findings {
            name: "curve",
            title: "Accuracy over time".into(),
            sentences,
            charts: vec![("", over_time), ("-size", over_size)],
            tables: vec![table],
            numbers: serde_json::json!({
                "bench": "curve",
                "adapter": runs.adapter(),
                "seconds": self.options.seconds,
                "n_seeds": n_seeds,
                "notes": self.notes,
                "lines": all,
            }),
        };
        let page = findings.write(runs.out())?;
        Ok((findings, page))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_grouped_by_evaluation_time() {
        let curves = [
            vec![(0.26, 10.0), (1.01, 20.0), (2.5, 22.0)],
            vec![(0.30, 12.0), (1.10, 21.0), (2.5, 25.0)],
            vec![(0.55, 15.0), (1.02, 25.0), (2.5, 23.0)],
        ];
        let evaluations = median_curve(&curves);
        let points: Vec<(f64, f64, usize)> = evaluations
            .iter()
            .map(|point| (point.seconds, point.psnr, point.n_runs))
            .collect();
        assert_eq!(
            points,
            [(0.28, 11.0, 2), (1.02, 21.0, 3), (2.5, 23.0, 3)],
            "a single run at 0.5 s gives no point"
        );
        assert_eq!(
            (evaluations[1].min_psnr, evaluations[1].max_psnr),
            (20.0, 25.0)
        );
    }

    #[test]
    fn end_between_evaluations_is_a_separate_point() {
        let evaluations = median_curve(&[
            vec![(1.0, 20.0), (1.9, 21.0)],
            vec![(1.0, 22.0), (1.9, 23.0)],
        ]);
        assert_eq!(
            evaluations
                .iter()
                .map(|point| point.psnr)
                .collect::<Vec<_>>(),
            [21.0, 22.0]
        );
    }

    #[test]
    fn summary_counts_runs_that_reached_a_quality() {
        let curves = [
            vec![(1.0, 20.0), (4.0, 30.0)],
            vec![(1.0, 20.0), (4.0, 26.0)],
        ];
        let ends = FinalValues {
            psnr: vec![30.0, 26.0],
            primitives: vec![1000.0, 3000.0],
            bytes: vec![5e6, 7e6],
            ..FinalValues::default()
        };
        let summary = Summary::of(&curves, &ends);
        assert_eq!(
            (summary.psnr, summary.primitives),
            (Some(28.0), Some(2000.0))
        );
        let [to_25, to_28, _] = &summary.seconds_to[..] else {
            panic!("three qualities")
        };
        assert_eq!((to_25.n_runs, to_28.n_runs), (2, 1));
        assert_eq!(
            to_25.seconds.map(|seconds| (seconds * 100.0).round()),
            Some(259.0)
        );
        let row = summary.row("fox");
        assert!(
            row[10].ends_with("(1 of 2)") && row[6] == "1000 to 3000" && row[8] == "6.00",
            "{row:?}"
        );
    }
}
