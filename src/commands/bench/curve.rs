//! `fieldrig bench curve`: accuracy over time, several seeds each, peers beside it.

use crate::bench::page::{Findings, Table};
use crate::bench::peer::Peer;
use crate::bench::runs::{BenchArgs, Job, NamedData, Run, Runs};
use crate::bench::statistics::{extent, median, sample_std, secs_to};
use crate::chart::{Axis, Chart, Line, Point, Scale, short};
use crate::exit::{self, BadArgument, Exit};
use crate::{marks, training};
use serde::Serialize;
use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;
use trainer::splat::SplatOptions;

/// Qualities whose time is told, dB.
const WANTED_DB: [f64; 3] = [25.0, 28.0, 30.0];
/// Length of a run where no flag says.
const USUAL_SECONDS: f64 = 60.0;

/// Flags of `bench curve`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Nerfstudio or TUM RGB-D folders, or recordings (.mcap); each becomes a line
    #[arg(required = true)]
    data: Vec<PathBuf>,
    /// Length of a run in seconds of training; loading and scoring do not count
    #[arg(long, value_name = "S", default_value_t = USUAL_SECONDS)]
    seconds: f64,
    /// Runs of each data set, 1 to 1000, with seeds counted up from --seed
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// A curve that another trainer measured: JSON with rows of seconds and psnr; may be given several times
    #[arg(long, value_name = "FILE.json")]
    peer: Vec<PathBuf>,
    #[command(flatten)]
    bench: BenchArgs,
}

/// One data set, or one peer.
#[derive(Debug, Serialize)]
struct Measured {
    label: String,
    is_peer: bool,
    /// PSNR at the marks.
    points: Vec<Mark>,
    summary: Summary,
    runs: Vec<Run>,
}

/// The runs at one mark.
#[derive(Debug, PartialEq, Serialize)]
struct Mark {
    /// Median.
    seconds: f64,
    /// Median.
    psnr: f64,
    lowest_psnr: f64,
    highest_psnr: f64,
    n_runs: usize,
}

#[derive(Debug, Serialize)]
struct Summary {
    n_runs: usize,
    /// Median at the end.
    psnr: Option<f64>,
    /// Over the runs, dB.
    psnr_std: Option<f64>,
    primitives: Option<f64>,
    primitives_extent: Option<[f64; 2]>,
    /// Standard deviation over mean.
    primitives_spread: Option<f64>,
    seconds_to: Vec<Reached>,
}

/// When a quality was reached.
#[derive(Debug, PartialEq, Serialize)]
struct Reached {
    psnr: f64,
    /// Median over the runs that reached it.
    seconds: Option<f64>,
    n_runs: usize,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let limits = training::limits(Some(args.seconds), None, USUAL_SECONDS)?;
    if args.seconds == 0.0 {
        return Err(BadArgument("--seconds: must be above 0".into()).into());
    }
    let peers = args.peer.iter().map(|path| Peer::load(path)).collect::<Result<Vec<_>, _>>()?;
    let mut runs = Runs::open(&args.bench, crate::commands::open_gpu()?)?;
    runs.expect(args.data.len() * usize::try_from(args.seeds)?);
    let mut measured: Vec<Measured> = Vec::new();
    let (mut losses, mut names) = (Vec::new(), HashSet::new());
    let mut page = None;
    for path in &args.data {
        let data = runs.load(path, &mut names)?;
        losses.extend(data.data.losses.iter().cloned());
        measured.push(Measured::of_runs(&data, Vec::new()));
        let mut finished = Vec::new();
        for seed in data.options.seed..data.options.seed.saturating_add(args.seeds) {
            finished.push(runs.run(Job {
                name: format!("curve {} seed {seed}", data.name),
                data: &data,
                options: SplatOptions { seed, ..data.options.clone() },
                limits,
                disturbed: None,
                variant: None,
                keyframes: &|| data.data.keyframes.clone(),
                is_thorough: true,
            })?);
            // Written after every run, so that an interrupted bench shows what it has.
            measured.pop();
            measured.push(Measured::of_runs(&data, finished.clone()));
            page = Some(findings(args, &runs, &measured, &peers)?);
        }
    }
    if let Some((findings, page)) = page {
        findings.tell(&page, args.bench.json)?;
    }
    Ok(exit::after(&losses))
}

impl Measured {
    fn of_runs(data: &NamedData, runs: Vec<Run>) -> Self {
        let curves: Vec<Vec<(f64, f64)>> = runs.iter().map(Run::curve).collect();
        let sizes: Vec<f64> = runs.iter().map(|run| run.end.primitives as f64).collect();
        let ends: Vec<f64> = runs.iter().map(Run::psnr).collect();
        Self {
            label: format!("{}, {}", data.name, data.kind.name()),
            is_peer: false,
            points: at_marks(&curves),
            summary: Summary::of(&curves, &ends, &sizes),
            runs,
        }
    }

    fn of_peer(peer: &Peer) -> Self {
        let curves = vec![peer.curve()];
        let last = peer.rows.last();
        let ends: Vec<f64> = last.map(|row| row.psnr).into_iter().collect();
        let sizes: Vec<f64> = last.and_then(|row| row.n).map(|n| n as f64).into_iter().collect();
        Self {
            label: peer.label.clone(),
            is_peer: true,
            points: at_marks(&curves),
            summary: Summary::of(&curves, &ends, &sizes),
            runs: Vec::new(),
        }
    }

    fn line(&self) -> Line {
        let point =
            |mark: &Mark| Point { x: mark.seconds, y: mark.psnr, low: mark.lowest_psnr, high: mark.highest_psnr };
        Line { label: self.label.clone(), points: self.points.iter().map(point).collect(), is_foreign: self.is_peer }
    }
}

/// Median and extent at each mark that at least half of the runs met, in the order of time.
fn at_marks(curves: &[Vec<(f64, f64)>]) -> Vec<Mark> {
    // Keyed by the mark's bits, which order as the marks do; a last point between two marks stands by itself.
    let mut groups: BTreeMap<(u64, bool), Vec<(f64, f64)>> = BTreeMap::new();
    for curve in curves {
        let mut taken = HashSet::new();
        for &(seconds, psnr) in curve {
            let mark = marks::latest(seconds).unwrap_or(0.0).to_bits();
            groups.entry((mark, !taken.insert(mark))).or_default().push((seconds, psnr));
        }
    }
    let mut marks: Vec<Mark> = groups
        .into_values()
        .filter(|group| 2 * group.len() >= curves.len())
        .filter_map(|group| {
            let (seconds, psnr): (Vec<f64>, Vec<f64>) = group.into_iter().unzip();
            let [lowest_psnr, highest_psnr] = extent(&psnr)?;
            let n_runs = psnr.len();
            Some(Mark { seconds: median(&seconds)?, psnr: median(&psnr)?, lowest_psnr, highest_psnr, n_runs })
        })
        .collect();
    marks.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    marks
}

impl Summary {
    fn of(curves: &[Vec<(f64, f64)>], ends: &[f64], sizes: &[f64]) -> Self {
        let reached = |wanted_db: f64| {
            let seconds: Vec<f64> = curves.iter().filter_map(|curve| secs_to(curve, wanted_db)).collect();
            Reached { psnr: wanted_db, seconds: median(&seconds), n_runs: seconds.len() }
        };
        let mean_size = sizes.iter().sum::<f64>() / sizes.len().max(1) as f64;
        Self {
            n_runs: curves.len(),
            psnr: median(ends),
            psnr_std: sample_std(ends),
            primitives: median(sizes),
            primitives_extent: extent(sizes),
            primitives_spread: sample_std(sizes).map(|std| std / mean_size),
            seconds_to: WANTED_DB.map(reached).into(),
        }
    }

    fn row(&self, label: &str) -> Vec<String> {
        let number = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
        };
        let mut row = vec![label.to_owned(), self.n_runs.to_string(), number(self.psnr, 2), number(self.psnr_std, 3)];
        row.push(number(self.primitives, 0));
        let spread = self.primitives_extent.filter(|_| self.n_runs > 1);
        row.push(spread.map_or_else(|| "-".to_owned(), |[low, high]| format!("{low:.0} to {high:.0}")));
        row.push(number(self.primitives_spread.map(|share| 100.0 * share), 2));
        row.extend(self.seconds_to.iter().map(|reached| match reached.seconds {
            None => "not reached".to_owned(),
            Some(seconds) if reached.n_runs == self.n_runs => format!("{seconds:.2} s"),
            Some(seconds) => format!("{seconds:.2} s ({} of {})", reached.n_runs, self.n_runs),
        }));
        row
    }
}

/// Everything known so far, written.
fn findings(
    args: &Args,
    runs: &Runs<'_>,
    measured: &[Measured],
    peers: &[Peer],
) -> anyhow::Result<(Findings, PathBuf)> {
    let peers: Vec<Measured> = peers.iter().map(Measured::of_peer).collect();
    let all = || measured.iter().chain(&peers);
    let last_secs = all().flat_map(|measured| &measured.points).map(|point| point.seconds).fold(1.0, f64::max);
    let (n_seeds, seconds) = (args.seeds, short(args.seconds));
    let subtitle = if n_seeds > 1 {
        format!("median of {n_seeds} seeds; band: lowest to highest; dashed: peers")
    } else {
        "one run a line; dashed: peers".to_owned()
    };
    let chart = Chart {
        title: "PSNR of held-out images over time".into(),
        subtitle,
        x: Axis {
            label: "seconds of training (log)".into(),
            scale: Scale::Log,
            ticks: marks::up_to(1.1 * last_secs).collect(),
        },
        y: Axis { label: "test PSNR, dB".into(), scale: Scale::Linear, ticks: Vec::new() },
        lines: all().map(Measured::line).collect(),
        floors: Vec::new(),
        rules: Vec::new(),
    };
    let head = ["data, method", "runs", "PSNR, dB", "std, dB", "splats", "splats, extent", "spread, %"];
    let head = head.map(str::to_owned).into_iter().chain(WANTED_DB.map(|wanted_db| format!("to {wanted_db} dB")));
    let table = Table {
        title: format!("After {seconds} s (peers: after their last row)"),
        head: head.collect(),
        rows: all().map(|measured| measured.summary.row(&measured.label)).collect(),
    };
    let findings = Findings {
        name: "curve",
        title: "Accuracy over time".into(),
        sentences: vec![
            format!(
                "Each line is one data set, trained {n_seeds} times for {seconds} s with different seeds; loading and scoring \
                 do not count. PSNR is the mean over images that were held out."
            ),
            "A quality is reached where the line between two marks, over the logarithm of time, crosses it; a curve that starts \
             above counts by its first mark. Peers' curves come from their files and may stem from another machine."
                .into(),
            format!("{}; fieldrig {}.", runs.adapter(), env!("CARGO_PKG_VERSION")),
        ],
        charts: vec![("", chart)],
        tables: vec![table],
        numbers: serde_json::json!({
            "bench": "curve",
            "adapter": runs.adapter(),
            "seconds": args.seconds,
            "n_seeds": n_seeds,
            "lines": all().collect::<Vec<_>>(),
        }),
    };
    let page = findings.write(runs.out())?;
    Ok((findings, page))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_meet_at_marks() {
        let curves = [
            vec![(0.26, 10.0), (1.01, 20.0), (2.5, 22.0)],
            vec![(0.30, 12.0), (1.10, 21.0), (2.5, 25.0)],
            vec![(0.55, 15.0), (1.02, 25.0), (2.5, 23.0)],
        ];
        let marks = at_marks(&curves);
        let told: Vec<(f64, f64, usize)> = marks.iter().map(|mark| (mark.seconds, mark.psnr, mark.n_runs)).collect();
        assert_eq!(told, [(0.28, 11.0, 2), (1.02, 21.0, 3), (2.5, 23.0, 3)], "one run alone at 0.5 s makes no point");
        assert_eq!((marks[1].lowest_psnr, marks[1].highest_psnr), (20.0, 25.0));
    }

    #[test]
    fn an_end_between_marks_is_a_point_of_its_own() {
        let marks = at_marks(&[vec![(1.0, 20.0), (1.9, 21.0)], vec![(1.0, 22.0), (1.9, 23.0)]]);
        assert_eq!(marks.iter().map(|mark| mark.psnr).collect::<Vec<_>>(), [21.0, 22.0]);
    }

    #[test]
    fn the_summary_counts_who_reached_a_quality() {
        let curves = [vec![(1.0, 20.0), (4.0, 30.0)], vec![(1.0, 20.0), (4.0, 26.0)]];
        let summary = Summary::of(&curves, &[30.0, 26.0], &[1000.0, 3000.0]);
        assert_eq!((summary.psnr, summary.primitives), (Some(28.0), Some(2000.0)));
        let [to_25, to_28, _] = &summary.seconds_to[..] else { panic!("three qualities") };
        assert_eq!((to_25.n_runs, to_28.n_runs), (2, 1));
        assert_eq!(to_25.seconds.map(|seconds| (seconds * 100.0).round()), Some(259.0));
        let row = summary.row("fox");
        assert!(row[8].ends_with("(1 of 2)") && row[5] == "1000 to 3000", "{row:?}");
    }
}
