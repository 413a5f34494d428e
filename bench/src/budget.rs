//! Measures the accuracy over the number of splats, and compares it with the number that the
//! trainer chooses.

use crate::findings::{BenchResult, Findings};
use crate::runs::{Host, Job, NamedData, Run, Runs, RunsOptions};
use crate::statistics::{db_per_doubling, extent};
use anyhow::Result;
use messages::{BadInput, Setting};
use numbers::quantile::median;
use report::Table;
use report::chart::{Axis, Chart, Line, Marker, Point, Scale};
use serde::Serialize;
use std::collections::HashSet;
use std::path::PathBuf;
use trainer::splat::{CountPolicy, SplatOptions};
use trainer::{MethodOptions, ModelSpec};

/// Training time of a run if no flag limits it.
const DEFAULT_SECONDS: f64 = 60.0;
/// Gain below which doubling the splats is not worthwhile, dB. The trainer uses the same value to
/// choose their number, as the text of the page explains. Doubling the splats doubles the memory of
/// the model.
const MIN_GAIN_DB: f64 = 0.1;

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct BudgetOptions {
    /// Folder or recording.
    pub data: PathBuf,
    /// Limits on the number of splats.
    pub splats: Vec<u32>,
    /// Training time of each run, seconds. Runs without any limit train for 60 s.
    pub seconds: Option<f64>,
    /// Optimizer steps of each run.
    pub steps: Option<u64>,
    /// Runs per limit, with consecutive seeds.
    pub seeds: u64,
    /// Models, images and folder.
    pub runs: RunsOptions,
}

/// The runs with one limit on the number of splats.
#[derive(Clone, Debug, Serialize)]
struct Capped {
    /// The limit. `None` if the trainer chooses the number.
    cap: Option<u32>,
    /// Median number of splats at the end.
    primitives: f64,
    /// Median PSNR at the end, dB.
    psnr: f64,
    psnr_extent: [f64; 2],
    runs: Vec<Run>,
}

/// Gain from more splats, between two limits.
#[derive(Debug, Serialize)]
struct Gain {
    to_cap: Option<u32>,
    from_primitives: f64,
    to_primitives: f64,
    db_per_doubling: f64,
}

/// Trains splats with each limit on their number, and without a limit.
///
/// # Errors
///
/// Fails if an option is invalid, if the data cannot be read or scored, or if training fails.
pub fn run(options: &BudgetOptions, host: &Host<'_>) -> Result<BenchResult> {
    let limits = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?;
    if options.runs.training.max_splats.is_some() || options.runs.training.count.is_some() {
        let message = format!(
            "{}, {}: this bench sets them; choose limits with {}",
            Setting::MaxSplats,
            Setting::Count,
            Setting::Splats
        );
        return Err(BadInput(message).into());
    }
    let mut caps: Vec<Option<u32>> = options.splats.iter().copied().map(Some).collect();
    caps.sort_unstable();
    caps.dedup();
    // The number chosen by the trainer is measured first, because it is the most important result.
    caps.insert(0, None);
    let mut runs = Runs::open(&options.runs, host)?;
    runs.expect(caps.len() as u64 * options.seeds);
    let data = runs.load(&options.data, &mut HashSet::new())?;
    let base_options = data.splats()?;
    let mut capped = Vec::new();
    let mut page = None;
    for cap in caps {
        let mut finished = Vec::new();
        let cap_name = cap.map_or_else(|| "no cap".to_owned(), |cap| format!("cap {cap}"));
        let first_seed = base_options.common.seed;
        for seed in first_seed..first_seed.saturating_add(options.seeds) {
            let capped_options = base_options.clone().with(|model| {
                model.common.seed = seed;
                // With a cap, the bench measures a model with exactly this number of splats. The
                // trainer's own tests of the number would reduce it.
                model.specific.count = if cap.is_some() {
                    CountPolicy::ToCap
                } else {
                    CountPolicy::Tested
                };
                model.specific.max_splats = cap.unwrap_or(model.specific.max_splats);
            });
            finished.push(runs.run(Job {
                name: format!("budget {} {cap_name} seed {seed}", data.name),
                data: &data,
                model_spec: ModelSpec::of(&capped_options)?,
                limits,
                disturbed: None,
                variant: None,
                keyframes: &|| data.data.keyframes.clone(),
                is_thorough: false,
            })?);
        }
        capped.extend(Capped::of(cap, finished));
        page = Some(findings(options, &runs, &data, &capped)?);
    }
    BenchResult::of(page, data.data.data_losses)
}

impl Capped {
    fn of(cap: Option<u32>, runs: Vec<Run>) -> Option<Self> {
        let sizes: Vec<f64> = runs.iter().map(|run| run.end.primitives as f64).collect();
        let ends: Vec<f64> = runs.iter().map(Run::psnr).collect();
        Some(Self {
            cap,
            primitives: median(&sizes)?,
            psnr: median(&ends)?,
            psnr_extent: extent(&ends)?,
            runs,
        })
    }

    fn point(&self) -> Point {
        let [low, high] = self.psnr_extent;
        Point {
            x: self.primitives.max(1.0),
            y: self.psnr,
            low,
            high,
        }
    }

    fn cap_label(&self) -> String {
        self.cap
            .map_or_else(|| "none".to_owned(), |cap| cap.to_string())
    }
}

/// Gains per doubling between neighboring limits, if the number of splats grew from one limit to
/// the next.
fn gains(by_cap: &[&Capped]) -> Vec<Gain> {
    by_cap
        .windows(2)
        .filter_map(|pair| gain_between(pair[0], pair[1]))
        .collect()
}

/// Gain from more splats. `None` if the number of splats hardly grew, because the cap was not
/// reached.
fn gain_between(fewer: &Capped, more: &Capped) -> Option<Gain> {
    let db_per_doubling =
        db_per_doubling((fewer.primitives, fewer.psnr), (more.primitives, more.psnr))?;
    Some(Gain {
        to_cap: more.cap,
        from_primitives: fewer.primitives,
        to_primitives: more.primitives,
        db_per_doubling,
    })
}

/// An axis of a number of splats.
fn size_axis(label: &str) -> Axis {
    Axis {
        label: label.to_owned(),
        scale: Scale::Log,
        ticks: Vec::new(),
    }
}

fn line(label: &str, points: Vec<Point>) -> Line {
    Line {
        label: label.to_owned(),
        points,
        is_peer: false,
    }
}

/// PSNR over the number of splats, and the number that the trainer has chosen.
fn accuracy_chart(subtitle: &str, by_cap: &[&Capped], chosen: Option<&Capped>) -> Chart {
    let own_curve_point = chosen.map(Capped::point);
    let own_marker = chosen.map(|chosen| Marker {
        x: chosen.primitives.max(1.0),
        label: format!(
            "chosen by the trainer: {} splats, {:.2} dB",
            chosen.primitives, chosen.psnr
        ),
        line_ix: 1,
    });
    // If neither of two caps is reached, the larger cap may give fewer splats.
    let mut points: Vec<Point> = by_cap.iter().map(|capped| capped.point()).collect();
    points.sort_by(|a, b| a.x.total_cmp(&b.x));
    Chart {
        title: "PSNR of test images over the number of splats".into(),
        subtitle: subtitle.to_owned(),
        x: size_axis("splats at the end (log)"),
        y: Axis {
            label: "test PSNR, dB".into(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: vec![
            line("with a cap", points),
            line("no cap", own_curve_point.into_iter().collect()),
        ],
        thresholds: Vec::new(),
        markers: own_marker.into_iter().collect(),
    }
}

/// The gain per doubling over the number of splats.
fn gain_chart(subtitle: &str, gains: &[Gain]) -> Chart {
    Chart {
        title: "Gain from doubling the splats".into(),
        subtitle: format!("{subtitle}; each point is between two neighboring caps"),
        x: size_axis("splats (log)"),
        y: Axis {
            label: "gain, dB per doubling".into(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: vec![line(
            "gain per doubling",
            gains.iter().map(Gain::point).collect(),
        )],
        thresholds: vec![(
            MIN_GAIN_DB,
            format!("{MIN_GAIN_DB} dB: minimum worthwhile gain"),
        )],
        markers: Vec::new(),
    }
}

impl Gain {
    fn point(&self) -> Point {
        Point {
            // The geometric mean is the middle on a logarithmic axis.
            x: (self.from_primitives * self.to_primitives).sqrt(),
            y: self.db_per_doubling,
            low: self.db_per_doubling,
            high: self.db_per_doubling,
        }
    }
}

/// The row of a cap, with the gain from the next smaller cap.
fn table_row(capped: &Capped, gains: &[Gain]) -> Vec<String> {
    let gain = gains
        .iter()
        .find(|gain| capped.cap.is_some() && gain.to_cap == capped.cap);
    vec![
        capped.cap_label(),
        format!("{:.0}", capped.primitives),
        format!("{:.2}", capped.psnr),
        gain.map_or_else(
            || "-".to_owned(),
            |gain| format!("{:+.2}", gain.db_per_doubling),
        ),
    ]
}

/// Writes the findings so far.
fn findings(
    options: &BudgetOptions,
    runs: &Runs<'_>,
    data: &NamedData,
    capped: &[Capped],
) -> Result<(Findings, PathBuf)> {
    let by_cap: Vec<&Capped> = capped
        .iter()
        .filter(|capped| capped.cap.is_some())
        .collect();
    let chosen = capped.iter().find(|capped| capped.cap.is_none());
    let gains = gains(&by_cap);
    let length = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?.describe();
    let spread = if options.seeds > 1 {
        format!(
            "median of {} seeds; band: minimum to maximum",
            options.seeds
        )
    } else {
        "one run per cap".to_owned()
    };
    let subtitle = format!("{}, splat, {length}; {spread}", data.name);
    let accuracy = accuracy_chart(&subtitle, &by_cap, chosen);
    let gain_chart = gain_chart(&subtitle, &gains);
    let head = ["cap", "splats", "PSNR, dB", "gain per doubling, dB"]
        .map(str::to_owned)
        .to_vec();
    let findings = Findings {
        name: "budget",
        title: format!("Accuracy over size: {}", data.name),
        sentences: vec![
            format!(
                "Each point is a model trained for {length} with a cap on its splats and scored on test images. \
 In the run without a cap, the trainer chooses the number of splats (at most {}): it halves the number as long as \
 this costs less than {MIN_GAIN_DB} dB on validation images.",
                data.splats()?.specific.max_splats
            ),
            format!(
                "Doubling the splats is not worthwhile if it gains less than {MIN_GAIN_DB} dB."
            ),
            format!(
                "{}; fieldrig {}.",
                runs.adapter(),
                env!("CARGO_PKG_VERSION")
            ),
        ],
        charts: vec![("", accuracy), ("-gain", gain_chart)],
        tables: vec![Table {
            title: format!("After {length}"),
            head,
            rows: capped
                .iter()
                .map(|capped| table_row(capped, &gains))
                .collect(),
        }],
        numbers: serde_json::json!({
            "bench": "budget",
            "data": data.path,
            "method": SplatOptions::METHOD,
            "adapter": runs.adapter(),
            "automatic": chosen,
            "caps": by_cap,
            "gains": gains,
        }),
    };
    let page = findings.write(runs.out())?;
    Ok((findings, page))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runs::tests::run;

    #[test]
    fn caps_that_are_not_reached_give_no_gain() {
        let capped = |cap: u32, n_splats: u64, psnr: f64| {
            Capped::of(Some(cap), vec![run("a", &[(1.0, psnr)], n_splats)]).expect("a run")
        };
        let all = [
            capped(1000, 1000, 20.0),
            capped(4000, 4000, 23.0),
            capped(8000, 4100, 23.1),
        ];
        let gains = gains(&all.iter().collect::<Vec<_>>());
        assert_eq!((gains.len(), gains[0].to_cap), (1, Some(4000)), "{gains:?}");
        assert!((gains[0].db_per_doubling - 1.5).abs() < 1e-12);
    }
}
