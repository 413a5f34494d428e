//! `fieldrig bench stability`: accuracy over the size of a disturbance, and where it breaks.

use crate::bench::disturb::Disturbance;
use crate::bench::page::{Findings, Table};
use crate::bench::runs::{BenchArgs, Disturbed, Job, NamedData, Run, Runs};
use crate::bench::statistics::{Between, break_point, extent, median};
use crate::bench::variant::{CAMERAS_AS_GIVEN, Variant};
use crate::chart::{Axis, Chart, Line, Point, Rule, Scale, short};
use crate::exit::{self, BadArgument, Exit};
use crate::method::Recipe;
use crate::session::Limits;
use crate::training;
use anyhow::ensure;
use serde::Serialize;
use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;
use trainer::splat::SplatOptions;
use trainer::{Keyframe, Split};

/// Length of a run where no flag says.
const USUAL_SECONDS: f64 = 30.0;
/// Losses of quality whose disturbance is told, dB.
const BREAKS_DB: [f64; 2] = [1.0, 3.0];
const NANOS_PER_SEC: f64 = 1e9;
/// Between the stamps of images that are only counted.
const NANOS_PER_COUNT: f64 = 1e6;

/// All meet the same disturbances: one line each in every chart.
const VARIANTS: &[Variant] = &[Variant { name: "as settled by --refine", change: |options| options }, CAMERAS_AS_GIVEN];

/// Flags of `bench stability`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A nerfstudio or TUM RGB-D folder, or a recording (.mcap)
    data: PathBuf,
    /// What is disturbed, separated by commas
    #[arg(long, value_name = "WHAT,...", value_delimiter = ',', default_value = "all")]
    disturb: Vec<What>,
    /// Sizes in place of the usual ones (mm, ms, EV or keyframes), separated by commas; for one disturbance
    #[arg(long, value_name = "N,...", value_delimiter = ',')]
    levels: Vec<f64>,
    /// Images a second of a folder without times; clock-offset needs it there
    #[arg(long, value_name = "HZ")]
    rate_hz: Option<f64>,
    /// Length of a run in seconds of training; loading and scoring do not count [default: 30, unless --steps is given]
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Length of a run in optimiser steps
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Runs of each size, 1 to 1000, with seeds counted up from --seed
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    #[command(flatten)]
    bench: BenchArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// Training poses off by 0 to 50 mm and 0 to 5 degrees
    PoseNoise,
    /// Poses of a time 0 to 200 ms later
    ClockOffset,
    /// A step of 0 to 1 EV in the middle of the capture
    Exposure,
    /// 3 to 300 training keyframes
    Keyframes,
    /// All of them
    All,
}

/// What is measured of one disturbance.
struct Plan {
    what: Disturbance,
    /// From the least disturbed on.
    levels: Vec<f64>,
    nanos_per_sec: f64,
    rate_hz: Option<f64>,
}

/// Everything measured of one disturbance.
#[derive(Debug, Serialize)]
struct Envelope {
    name: &'static str,
    unit: &'static str,
    variants: Vec<Curve>,
    #[serde(skip)]
    what: Disturbance,
}

/// One way to train under one disturbance.
#[derive(Clone, Debug, Serialize)]
struct Curve {
    name: &'static str,
    /// From the least disturbed on.
    points: Vec<Level>,
    breaks: Vec<Break>,
}

#[derive(Clone, Debug, Serialize)]
struct Level {
    level: f64,
    /// Median, dB.
    psnr: f64,
    psnr_extent: [f64; 2],
    runs: Vec<Run>,
}

/// Where the PSNR has fallen this far below the undisturbed one; `None` if no size did it.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Break {
    drop_db: f64,
    level: Option<f64>,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let limits = training::limits(args.seconds, args.steps, USUAL_SECONDS)?;
    args.check()?;
    let mut runs = Runs::open(&args.bench, crate::commands::open_gpu()?)?;
    let data = runs.load(&args.data, &mut HashSet::new())?;
    let plans = args.plans(&data)?;
    let n_levels: usize = plans.iter().map(|plan| plan.levels.len()).sum();
    let variants = told_apart(&data.only_recipe()?.options);
    runs.expect(n_levels * variants.len() * usize::try_from(args.seeds)?);
    let mut envelopes: Vec<Envelope> = Vec::new();
    let mut page = None;
    for plan in &plans {
        envelopes.push(Envelope {
            name: plan.what.name(),
            unit: plan.what.unit(),
            variants: Vec::new(),
            what: plan.what,
        });
        for &variant in &variants {
            let mut curve = Curve { name: variant.name, points: Vec::new(), breaks: Vec::new() };
            for level in &plan.levels {
                let finished = measure(args, &mut runs, &data, limits, plan, variant, *level)?;
                curve.add(plan.what, *level, finished);
                // Written after every size, so that an interrupted bench shows what it has.
                let variants = &mut envelopes.last_mut().expect("pushed above").variants;
                variants.retain(|curve| curve.name != variant.name);
                variants.push(curve.clone());
                page = Some(findings(args, &runs, &data, &envelopes)?);
            }
        }
    }
    if let Some((findings, page)) = page {
        findings.tell(&page, args.bench.json)?;
    }
    Ok(exit::after(&data.data.losses))
}

/// The ways to train that differ for these data: where nothing is looked for about cameras there is one.
fn told_apart(options: &SplatOptions) -> Vec<&'static Variant> {
    let mut told_apart: Vec<&Variant> = Vec::new();
    for variant in VARIANTS {
        let changed = variant.options(options);
        if told_apart.iter().all(|other| other.options(options) != changed) {
            told_apart.push(variant);
        }
    }
    if told_apart.len() < VARIANTS.len() {
        log::warn!("nothing is looked for about cameras here: see --refine; only one way to train is measured");
    }
    told_apart
}

/// The runs of one size.
fn measure(
    args: &Args,
    runs: &mut Runs<'_>,
    data: &NamedData,
    limits: Limits,
    plan: &Plan,
    variant: &Variant,
    level: f64,
) -> anyhow::Result<Vec<Run>> {
    let what = plan.what;
    let is_clean = is_clean(what, level, n_train(data));
    // The undisturbed run is the same whatever is not disturbed in it: it is done once.
    let size = if is_clean { "undisturbed".to_owned() } else { format!("{} {level} {}", what.name(), what.unit()) };
    let disturbed = (!is_clean).then(|| Disturbed {
        what: what.name().to_owned(),
        level,
        unit: what.unit().to_owned(),
        rate_hz: plan.rate_hz,
    });
    let mut finished = Vec::new();
    let Recipe { kind, options: usual } = data.only_recipe()?;
    for seed in usual.seed..usual.seed.saturating_add(args.seeds) {
        finished.push(runs.run(Job {
            name: format!("stability {} {} {size} seed {seed}", data.name, variant.name),
            data,
            recipe: Recipe { kind: *kind, options: variant.options(&SplatOptions { seed, ..usual.clone() }) },
            limits,
            disturbed: disturbed.clone(),
            variant: Some(variant.name.to_owned()),
            keyframes: &|| disturb(plan, &data.data.keyframes, level, seed, is_clean),
            is_thorough: false,
        })?);
    }
    Ok(finished)
}

fn disturb(plan: &Plan, keyframes: &[Arc<Keyframe>], level: f64, seed: u64, is_clean: bool) -> Vec<Arc<Keyframe>> {
    if is_clean { keyframes.to_vec() } else { plan.what.apply(keyframes, level, seed, plan.nanos_per_sec) }
}

/// Images that are trained on when nothing is disturbed.
fn n_train(data: &NamedData) -> usize {
    data.data.keyframes.iter().filter(|keyframe| keyframe.split != Split::Test).count()
}

/// Whether this size of a disturbance is none.
fn is_clean(what: Disturbance, level: f64, n_train: usize) -> bool {
    if what == Disturbance::Keyframes { level >= n_train as f64 } else { level == 0.0 }
}

impl Args {
    fn disturbances(&self) -> Vec<Disturbance> {
        let is_wanted = |what: Disturbance| {
            self.disturb.iter().any(|wanted| match wanted {
                What::All => true,
                What::PoseNoise => what == Disturbance::PoseNoise,
                What::ClockOffset => what == Disturbance::ClockOffset,
                What::Exposure => what == Disturbance::Exposure,
                What::Keyframes => what == Disturbance::Keyframes,
            })
        };
        Disturbance::ALL.into_iter().filter(|what| is_wanted(*what)).collect()
    }

    fn check(&self) -> Result<(), BadArgument> {
        let wanted = self.disturbances();
        if !self.levels.is_empty() && wanted.len() != 1 {
            return Err(BadArgument(
                "--levels: name one disturbance with --disturb, its sizes are in units of its own".into(),
            ));
        }
        let least = if wanted == [Disturbance::Keyframes] { 1.0 } else { 0.0 };
        if let Some(level) = self.levels.iter().find(|level| !level.is_finite() || **level < least) {
            return Err(BadArgument(format!("--levels {level}: must be a number of at least {least}")));
        }
        if self.rate_hz.is_some_and(|rate| !rate.is_finite() || rate <= 0.0) {
            return Err(BadArgument("--rate-hz: must be a number above 0".into()));
        }
        Ok(())
    }

    /// What is measured; a clock offset without times is refused, or left out of `all`.
    fn plans(&self, data: &NamedData) -> anyhow::Result<Vec<Plan>> {
        let mut wanted = self.disturbances();
        let (nanos_per_sec, rate_hz) = match (data.data.has_times, self.rate_hz) {
            (true, _) => (NANOS_PER_SEC, None),
            (false, Some(rate_hz)) => (NANOS_PER_COUNT * rate_hz, Some(rate_hz)),
            (false, None) => {
                let reason = "the images have no times: tell with --rate-hz how many a second they are";
                let told = format!("clock-offset: {}: {reason}", data.path.display());
                if self.disturb.contains(&What::ClockOffset) {
                    return Err(BadArgument(told).into());
                }
                if wanted.contains(&Disturbance::ClockOffset) {
                    log::warn!("left out: {told}");
                }
                wanted.retain(|what| *what != Disturbance::ClockOffset);
                (NANOS_PER_SEC, None)
            }
        };
        ensure!(!wanted.is_empty(), "nothing is left to disturb");
        let plan = |what: Disturbance| {
            let asked = if self.levels.is_empty() { what.usual_levels() } else { &self.levels };
            let rate_hz = rate_hz.filter(|_| what == Disturbance::ClockOffset);
            Plan { what, levels: levels(what, asked, n_train(data)), nanos_per_sec, rate_hz }
        };
        Ok(wanted.into_iter().map(plan).collect())
    }
}

/// The sizes to measure, from no disturbance to a large one.
fn levels(what: Disturbance, asked: &[f64], n_train: usize) -> Vec<f64> {
    let mut levels = asked.to_vec();
    if what == Disturbance::Keyframes {
        levels.iter_mut().for_each(|level| *level = level.round());
        levels.retain(|level| *level < n_train as f64);
        levels.push(n_train as f64);
    } else {
        levels.push(0.0);
    }
    levels.sort_by(f64::total_cmp);
    levels.dedup();
    if what == Disturbance::Keyframes {
        levels.reverse();
    }
    levels
}

impl Curve {
    fn add(&mut self, what: Disturbance, level: f64, runs: Vec<Run>) {
        let ends: Vec<f64> = runs.iter().map(Run::psnr).collect();
        let Some((psnr, psnr_extent)) = median(&ends).zip(extent(&ends)) else { return };
        self.points.push(Level { level, psnr, psnr_extent, runs });
        let curve: Vec<(f64, f64)> = self.points.iter().map(|point| (point.level, point.psnr)).collect();
        let break_at = |drop_db| Break { drop_db, level: break_point(&curve, drop_db, what.between()) };
        self.breaks = BREAKS_DB.map(break_at).into();
    }

    fn line(&self, label: &str) -> Line {
        let point = |at: &Level| Point { x: at.level, y: at.psnr, low: at.psnr_extent[0], high: at.psnr_extent[1] };
        let mut points: Vec<Point> = self.points.iter().map(point).collect();
        points.sort_by(|a, b| a.x.total_cmp(&b.x));
        Line { label: label.to_owned(), points, is_foreign: false }
    }
}

impl Envelope {
    /// `of_one` names the line where there is only one variant.
    fn chart(&self, subtitle: &str, of_one: &str) -> Chart {
        let levels = || {
            let mut levels: Vec<f64> =
                self.variants.iter().flat_map(|curve| &curve.points).map(|point| point.level).collect();
            levels.sort_by(f64::total_cmp);
            levels.dedup();
            levels
        };
        let (scale, ticks) = match self.what.between() {
            Between::Log => (Scale::Log, levels()),
            Between::Linear => (Scale::Levels(levels()), Vec::new()),
        };
        let rule = |line_ix: usize, at: &Break| {
            let level = at.level?;
            let label = format!("-{} dB at {} {}", at.drop_db, significant(level), self.unit);
            let label =
                if self.variants.len() > 1 { format!("{}: {label}", self.variants[line_ix].name) } else { label };
            Some(Rule { x: level, label, line_ix })
        };
        let curves = self.variants.iter().enumerate();
        let label = |curve: &Curve| if self.variants.len() > 1 { curve.name } else { of_one };
        Chart {
            title: format!("PSNR of held-out images under {}", in_words(self.what)),
            subtitle: subtitle.to_owned(),
            x: Axis { label: self.what.axis().to_owned(), scale, ticks },
            y: Axis { label: "test PSNR, dB".into(), scale: Scale::Linear, ticks: Vec::new() },
            lines: self.variants.iter().map(|curve| curve.line(label(curve))).collect(),
            floors: Vec::new(),
            rules: curves.flat_map(|(ix, curve)| curve.breaks.iter().filter_map(move |at| rule(ix, at))).collect(),
        }
    }

    fn rows(&self) -> impl Iterator<Item = Vec<String>> {
        self.variants.iter().map(|curve| {
            let clean = curve.points.first().map_or(0.0, |point| point.psnr);
            let mut row = vec![self.name.to_owned(), curve.name.to_owned(), format!("{clean:.2}")];
            row.extend(curve.breaks.iter().map(|at| match at.level {
                Some(level) => format!("{} {}", significant(level), self.unit),
                None => "not reached".to_owned(),
            }));
            row
        })
    }
}

fn in_words(what: Disturbance) -> &'static str {
    match what {
        Disturbance::PoseNoise => "pose noise",
        Disturbance::ClockOffset => "a clock offset",
        Disturbance::Exposure => "an exposure step",
        Disturbance::Keyframes => "few training images",
    }
}

/// Two or three digits that count: more would claim what one curve cannot tell.
fn significant(level: f64) -> String {
    match level {
        level if level >= 10.0 => format!("{level:.0}"),
        level if level >= 1.0 => format!("{level:.1}"),
        level => format!("{level:.2}"),
    }
}

/// Everything known so far, written.
fn findings(
    args: &Args,
    runs: &Runs<'_>,
    data: &NamedData,
    envelopes: &[Envelope],
) -> anyhow::Result<(Findings, PathBuf)> {
    let length = training::limits(args.seconds, args.steps, USUAL_SECONDS)?.in_words();
    let spread = if args.seeds > 1 {
        format!("median of {} seeds, band: lowest to highest", args.seeds)
    } else {
        "one run a size".to_owned()
    };
    let subtitle = format!("after {length}; {spread}");
    let label = format!("{}, {}", data.name, data.only_recipe()?.kind.name());
    let part = |what: Disturbance| match what {
        Disturbance::PoseNoise => "-pose-noise",
        Disturbance::ClockOffset => "-clock-offset",
        Disturbance::Exposure => "-exposure",
        Disturbance::Keyframes => "-keyframes",
    };
    let charts = envelopes.iter().map(|envelope| (part(envelope.what), envelope.chart(&subtitle, &label)));
    let head = ["disturbance", "trainer", "undisturbed, dB", "-1 dB at", "-3 dB at"].map(str::to_owned).to_vec();
    let level_rows = envelopes.iter().flat_map(|envelope| {
        envelope.variants.iter().flat_map(|curve| {
            curve.points.iter().map(|point| {
                vec![
                    format!("{}, {}", envelope.name, curve.name),
                    format!("{} {}", short(point.level), envelope.unit),
                    format!("{:.2}", point.psnr),
                    format!("{:+.2}", point.psnr - curve.points[0].psnr),
                ]
            })
        })
    });
    let level_head =
        ["disturbance, trainer", "size", "PSNR, dB", "against undisturbed, dB"].map(str::to_owned).to_vec();
    let findings = Findings {
        name: "stability",
        title: format!("Stability: {}", data.name),
        sentences: vec![
            format!(
                "Each point is a model trained for {length} on disturbed images and scored on held-out images that are not disturbed. A break point is where the line has fallen by 1 or 3 dB from its undisturbed end."
            ),
            "Pose noise turns each camera too, by 0.1 degrees a millimetre; poses of a clock offset are interpolated between neighboring images; an exposure step darkens the first half of the capture and brightens the second, half each."
                .into(),
            format!("{}; fieldrig {}.", runs.adapter(), env!("CARGO_PKG_VERSION")),
        ],
        charts: charts.collect(),
        tables: vec![
            Table { title: "Break points".into(), head, rows: envelopes.iter().flat_map(Envelope::rows).collect() },
            Table { title: format!("After {length}"), head: level_head, rows: level_rows.collect() },
        ],
        numbers: serde_json::json!({
            "bench": "stability",
            "data": data.path,
            "method": data.only_recipe()?.kind.name(),
            "adapter": runs.adapter(),
            "disturbances": envelopes,
        }),
    };
    let page = findings.write(runs.out())?;
    Ok((findings, page))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::runs::tests::run;

    #[test]
    fn sizes_start_undisturbed_and_keyframes_end_at_what_there_is() {
        assert_eq!(levels(Disturbance::PoseNoise, &[5.0, 2.0, 2.0], 40), [0.0, 2.0, 5.0]);
        assert_eq!(
            levels(Disturbance::Keyframes, Disturbance::Keyframes.usual_levels(), 44),
            [44.0, 20.0, 10.0, 5.0, 3.0]
        );
        assert!(is_clean(Disturbance::Keyframes, 44.0, 44) && !is_clean(Disturbance::Keyframes, 20.0, 44));
        assert!(is_clean(Disturbance::Exposure, 0.0, 44) && !is_clean(Disturbance::Exposure, 0.1, 44));
    }

    #[test]
    fn break_points_follow_the_points() {
        let mut curve = Curve { name: "plain", points: Vec::new(), breaks: Vec::new() };
        for (level, psnr) in [(100.0, 30.0), (25.0, 28.0), (5.0, 20.0)] {
            curve.add(Disturbance::Keyframes, level, vec![run("a", &[(1.0, psnr)], 10)]);
        }
        let [first, second] = &curve.breaks[..] else { panic!("two breaks") };
        assert!(first.level.is_some_and(|level| (level - 50.0).abs() < 1e-9), "{first:?}");
        assert!(second.level.is_some_and(|level| (5.0..25.0).contains(&level)), "{second:?}");
        assert_eq!(curve.line("plain").points[0].x, 5.0, "lines run from left to right");
    }
}
