//! Measures the accuracy over the size of a disturbance, and the break points.

use crate::disturb::Disturbance;
use crate::findings::{BenchResult, Findings};
use crate::runs::{Disturbed, Host, Job, NamedData, Run, Runs, RunsOptions};
use crate::statistics::{Interpolation, break_point, extent};
use crate::variant::Variant;
use anyhow::{Result, ensure};
use keyframe::{Keyframe, Split};
use messages::{BadInput, Setting};
use numbers::quantile::median;
use report::Table;
use report::chart::{Axis, Chart, Line, Marker, Point, Scale, compact_number};
use serde::Serialize;
use session::Limits;
use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;
use trainer::{ModelOptions, ModelSpec};

/// Training time of a run if no flag limits it.
const DEFAULT_SECONDS: f64 = 30.0;
/// Losses of PSNR for which the size of the disturbance is reported, dB. A loss of 3 dB is twice
/// the mean squared error.
const BREAKS_DB: [f64; 2] = [1.0, 3.0];
const NANOS_PER_SEC: f64 = 1e9;
/// Difference between consecutive stamps that only count images, nanoseconds.
const NANOS_PER_COUNT: f64 = 1e6;

/// All variants are trained on the same disturbed data. Each variant gives one line per chart.
const VARIANTS: &[Variant] = &[REFINED, Variant::CAMERAS_AS_GIVEN];

/// The cameras are refined as requested. [`name_of`] adds the name of the setting.
const REFINED: Variant = Variant {
    name: "with",
    change: |_| (),
};

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct StabilityOptions {
    /// Folder or recording.
    pub data: PathBuf,
    /// Disturbances to measure, without duplicates.
    pub disturbances: Vec<Disturbance>,
    /// Whether a clock offset is skipped instead of rejected if the images have no times.
    pub can_skip_clock_offset: bool,
    /// Sizes of a single disturbance, in its unit. An empty list selects the defaults.
    pub levels: Vec<f64>,
    /// Images per second, for images without times.
    pub rate_hz: Option<f64>,
    /// Training time of each run, seconds. Runs without any limit train for 30 s.
    pub seconds: Option<f64>,
    /// Optimizer steps of each run.
    pub steps: Option<u64>,
    /// Runs per size, with consecutive seeds.
    pub seeds: u64,
    /// Models, images and folder.
    pub runs: RunsOptions,
}

/// Planned measurements of one disturbance.
struct DisturbancePlan {
    disturbance: Disturbance,
    /// Sizes, starting with the undisturbed data.
    levels: Vec<f64>,
    nanos_per_sec: f64,
    rate_hz: Option<f64>,
}

/// Results of one disturbance.
#[derive(Debug, Serialize)]
struct DisturbanceResult {
    name: &'static str,
    unit: &'static str,
    variants: Vec<Curve>,
    #[serde(skip)]
    disturbance: Disturbance,
}

/// Results of one variant under one disturbance.
#[derive(Clone, Debug, Serialize)]
struct Curve {
    name: String,
    /// Results by size, starting with the undisturbed data.
    points: Vec<Level>,
    breaks: Vec<Break>,
}

#[derive(Clone, Debug, Serialize)]
struct Level {
    level: f64,
    /// Median PSNR, dB.
    psnr: f64,
    psnr_extent: [f64; 2],
    runs: Vec<Run>,
}

/// Size at which the PSNR has fallen by `drop_db` from the undisturbed PSNR. `None` if it does not
/// fall that far.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Break {
    drop_db: f64,
    level: Option<f64>,
}

/// Trains on disturbed images, for every size of every disturbance.
///
/// # Errors
///
/// Fails if an option is invalid, if the data cannot be read or scored, or if training fails.
pub fn run(options: &StabilityOptions, host: &Host<'_>) -> Result<BenchResult> {
    let limits = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?;
    options.check()?;
    let mut runs = Runs::open(&options.runs, host)?;
    let data = runs.load(&options.data, &mut HashSet::new())?;
    let plans = options.plans(&data)?;
    let n_levels: usize = plans.iter().map(|plan| plan.levels.len()).sum();
    let variants = distinguished(&data.single_model_spec()?.options);
    runs.expect((n_levels * variants.len()) as u64 * options.seeds);
    let mut results: Vec<DisturbanceResult> = Vec::new();
    let mut page = None;
    for plan in &plans {
        results.push(DisturbanceResult {
            name: plan.disturbance.name(),
            unit: plan.disturbance.unit(),
            variants: Vec::new(),
            disturbance: plan.disturbance,
        });
        for &variant in &variants {
            let mut curve = Curve {
                name: name_of(variant),
                points: Vec::new(),
                breaks: Vec::new(),
            };
            for level in &plan.levels {
                let finished = measure(options, &mut runs, &data, limits, plan, variant, *level)?;
                curve.add(plan.disturbance, *level, finished);
                // Findings are written after every size, so that an interrupted bench leaves
                // results.
                let variants = &mut results.last_mut().expect("pushed above").variants;
                variants.retain(|earlier| earlier.name != curve.name);
                variants.push(curve.clone());
                page = Some(findings(options, &runs, &data, &results)?);
            }
        }
    }
    BenchResult::of(page, data.data.data_losses)
}

/// The variants that differ for these options. If no camera parameters are refined, there is only
/// one variant.
fn distinguished(options: &ModelOptions) -> Vec<&'static Variant> {
    let mut distinguished: Vec<&Variant> = Vec::new();
    for variant in VARIANTS {
        let changed = variant.options(options);
        if distinguished
            .iter()
            .all(|other| other.options(options) != changed)
        {
            distinguished.push(variant);
        }
    }
    if distinguished.len() < VARIANTS.len() {
        log::warn!(
            "no camera parameters are refined, so only one variant is measured; see {}",
            Setting::Refine
        );
    }
    distinguished
}

/// Name of a variant in results.
fn name_of(variant: &Variant) -> String {
    if variant.name == REFINED.name {
        format!("{} {}", variant.name, Setting::Refine)
    } else {
        variant.name.to_owned()
    }
}

/// Trains with one size of the disturbance, once per seed.
fn measure(
    options: &StabilityOptions,
    runs: &mut Runs<'_>,
    data: &NamedData,
    limits: Limits,
    plan: &DisturbancePlan,
    variant: &Variant,
    level: f64,
) -> Result<Vec<Run>> {
    let disturbance = plan.disturbance;
    let is_undisturbed = is_undisturbed(disturbance, level, n_train(data));
    // All disturbances share the undisturbed run, so that it is trained only once.
    let size = if is_undisturbed {
        "undisturbed".to_owned()
    } else {
        format!("{} {level} {}", disturbance.name(), disturbance.unit())
    };
    let disturbed = (!is_undisturbed).then(|| Disturbed {
        disturbance: disturbance.name().to_owned(),
        level,
        unit: disturbance.unit().to_owned(),
        rate_hz: plan.rate_hz,
    });
    let mut finished = Vec::new();
    let variant_name = name_of(variant);
    let ModelSpec {
        kind,
        options: base_options,
    } = data.single_model_spec()?;
    let first_seed = base_options.common.seed;
    for seed in first_seed..first_seed.saturating_add(options.seeds) {
        let seeded = base_options.clone().with(|model| model.common.seed = seed);
        finished.push(runs.run(Job {
            name: format!("stability {} {variant_name} {size} seed {seed}", data.name),
            data,
            model_spec: ModelSpec {
                kind: *kind,
                options: variant.options(&seeded),
            },
            limits,
            disturbed: disturbed.clone(),
            variant: Some(variant_name.clone()),
            keyframes: &|| disturb(plan, &data.data.keyframes, level, seed, is_undisturbed),
            is_thorough: false,
        })?);
    }
    Ok(finished)
}

fn disturb(
    plan: &DisturbancePlan,
    keyframes: &[Arc<Keyframe>],
    level: f64,
    seed: u64,
    is_undisturbed: bool,
) -> Vec<Arc<Keyframe>> {
    if is_undisturbed {
        keyframes.to_vec()
    } else {
        plan.disturbance
            .apply(keyframes, level, seed, plan.nanos_per_sec)
    }
}

/// Number of training images before any disturbance.
fn n_train(data: &NamedData) -> usize {
    data.data
        .keyframes
        .iter()
        .filter(|keyframe| keyframe.split != Split::Test)
        .count()
}

/// Whether this size leaves the data unchanged.
fn is_undisturbed(disturbance: Disturbance, level: f64, n_train: usize) -> bool {
    if disturbance == Disturbance::Keyframes {
        level >= n_train as f64
    } else {
        level == 0.0
    }
}

impl StabilityOptions {
    fn check(&self) -> Result<()> {
        let selected = &self.disturbances;
        if !self.levels.is_empty() && selected.len() != 1 {
            let message = format!(
                "{}: needs a single disturbance in {}, because units differ",
                Setting::Levels,
                Setting::Disturb
            );
            return Err(BadInput(message).into());
        }
        let min_level = if *selected == [Disturbance::Keyframes] {
            1.0
        } else {
            0.0
        };
        if let Some(level) = self
            .levels
            .iter()
            .find(|level| !level.is_finite() || **level < min_level)
        {
            return Err(BadInput(format!(
                "{} {level}: must be a number of at least {min_level}",
                Setting::Levels
            ))
            .into());
        }
        if self
            .rate_hz
            .is_some_and(|rate| !rate.is_finite() || rate <= 0.0)
        {
            let message = format!("{}: must be a number above 0", Setting::RateHz);
            return Err(BadInput(message).into());
        }
        Ok(())
    }

    /// Plans the measurements. If images have no times, a clock offset is an error, or is skipped
    /// for `all`.
    fn plans(&self, data: &NamedData) -> Result<Vec<DisturbancePlan>> {
        let mut selected = self.disturbances.clone();
        // Stamps of photos only count images. Only a clock offset depends on the time between two
        // such stamps.
        let (nanos_per_sec, rate_hz) = match (data.data.has_times, self.rate_hz) {
            (true, _) => (NANOS_PER_SEC, None),
            (false, Some(rate_hz)) => (NANOS_PER_COUNT * rate_hz, Some(rate_hz)),
            (false, None) => {
                let message = format!(
                    "clock-offset: {}: the images have no times; give their rate with {}",
                    data.path.display(),
                    Setting::RateHz
                );
                if selected.contains(&Disturbance::ClockOffset) {
                    if !self.can_skip_clock_offset {
                        return Err(BadInput(message).into());
                    }
                    log::warn!("skipped: {message}");
                }
                selected.retain(|disturbance| *disturbance != Disturbance::ClockOffset);
                (NANOS_PER_SEC, None)
            }
        };
        ensure!(!selected.is_empty(), "no disturbance is left to measure");
        let mut plans = Vec::new();
        for disturbance in selected {
            let requested = if self.levels.is_empty() {
                disturbance.default_levels()
            } else {
                &self.levels
            };
            plans.push(DisturbancePlan {
                disturbance,
                levels: levels(disturbance, requested, n_train(data)),
                nanos_per_sec,
                // The rate is stored with each run of a clock offset. Other disturbances do not
                // depend on the rate, so their runs stay valid if it changes.
                rate_hz: rate_hz.filter(|_| disturbance == Disturbance::ClockOffset),
            });
        }
        Ok(plans)
    }
}

/// The sizes to measure, from none to the largest.
fn levels(disturbance: Disturbance, requested: &[f64], n_train: usize) -> Vec<f64> {
    let mut levels = requested.to_vec();
    // Undisturbed data come first even if they are not requested, because the other results are
    // compared with them.
    if disturbance == Disturbance::Keyframes {
        levels.iter_mut().for_each(|level| *level = level.round());
        levels.retain(|level| *level < n_train as f64);
        levels.push(n_train as f64);
    } else {
        levels.push(0.0);
    }
    levels.sort_by(f64::total_cmp);
    levels.dedup();
    if disturbance == Disturbance::Keyframes {
        levels.reverse();
    }
    levels
}

impl Curve {
    fn add(&mut self, disturbance: Disturbance, level: f64, runs: Vec<Run>) {
        let ends: Vec<f64> = runs.iter().map(Run::psnr).collect();
        let Some((psnr, psnr_extent)) = median(&ends).zip(extent(&ends)) else {
            return; // There are no runs.
        };
        self.points.push(Level {
            level,
            psnr,
            psnr_extent,
            runs,
        });
        let curve: Vec<(f64, f64)> = self
            .points
            .iter()
            .map(|point| (point.level, point.psnr))
            .collect();
        let break_at = |drop_db| Break {
            drop_db,
            level: break_point(&curve, drop_db, disturbance.interpolation()),
        };
        self.breaks = BREAKS_DB.map(break_at).into();
    }

    fn line(&self, label: &str) -> Line {
        let point = |at: &Level| Point {
            x: at.level,
            y: at.psnr,
            low: at.psnr_extent[0],
            high: at.psnr_extent[1],
        };
        let mut points: Vec<Point> = self.points.iter().map(point).collect();
        points.sort_by(|a, b| a.x.total_cmp(&b.x));
        Line {
            label: label.to_owned(),
            points,
            is_peer: false,
        }
    }
}

impl DisturbanceResult {
    /// `of_one` is the label of the line if there is only one variant.
    fn chart(&self, subtitle: &str, of_one: &str) -> Chart {
        let (scale, ticks) = match self.disturbance.interpolation() {
            Interpolation::Log => (Scale::Log, self.levels()),
            // The levels are evenly spaced. On a linear scale, small levels would be on top of each
            // other. A logarithmic scale would have no 0.
            Interpolation::Linear => (Scale::Levels(self.levels()), Vec::new()),
        };
        let curves = self.variants.iter().enumerate();
        Chart {
            title: format!("PSNR of test images with {}", describe(self.disturbance)),
            subtitle: subtitle.to_owned(),
            x: Axis {
                label: self.disturbance.axis().to_owned(),
                scale,
                ticks,
            },
            y: Axis {
                label: "test PSNR, dB".into(),
                scale: Scale::Linear,
                ticks: Vec::new(),
            },
            lines: self
                .variants
                .iter()
                .map(|curve| {
                    curve.line(if self.variants.len() > 1 {
                        &curve.name
                    } else {
                        of_one
                    })
                })
                .collect(),
            thresholds: Vec::new(),
            markers: curves
                .flat_map(|(ix, curve)| {
                    curve
                        .breaks
                        .iter()
                        .filter_map(move |at| self.marker(ix, at))
                })
                .collect(),
        }
    }

    /// All measured sizes, in ascending order.
    fn levels(&self) -> Vec<f64> {
        let mut levels: Vec<f64> = self
            .variants
            .iter()
            .flat_map(|curve| &curve.points)
            .map(|point| point.level)
            .collect();
        levels.sort_by(f64::total_cmp);
        levels.dedup();
        levels
    }

    /// The marker of a break point. `None` if the break point was not reached.
    fn marker(&self, line_ix: usize, at: &Break) -> Option<Marker> {
        let level = at.level?;
        let label = format!(
            "-{} dB at {} {}",
            at.drop_db,
            significant_digits(level),
            self.unit
        );
        let label = if self.variants.len() > 1 {
            format!("{}: {label}", self.variants[line_ix].name)
        } else {
            label
        };
        Some(Marker {
            x: level,
            label,
            line_ix,
        })
    }

    /// A row for each variant and size.
    fn level_rows(&self) -> Vec<Vec<String>> {
        let mut rows = Vec::new();
        for curve in &self.variants {
            for point in &curve.points {
                rows.push(vec![
                    format!("{}, {}", self.name, curve.name),
                    format!("{} {}", compact_number(point.level), self.unit),
                    format!("{:.2}", point.psnr),
                    format!("{:+.2}", point.psnr - curve.points[0].psnr),
                ]);
            }
        }
        rows
    }

    fn rows(&self) -> impl Iterator<Item = Vec<String>> {
        self.variants.iter().map(|curve| {
            let undisturbed = curve.points.first().map_or(0.0, |point| point.psnr);
            let mut row = vec![
                self.name.to_owned(),
                curve.name.clone(),
                format!("{undisturbed:.2}"),
            ];
            row.extend(curve.breaks.iter().map(|at| match at.level {
                Some(level) => format!("{} {}", significant_digits(level), self.unit),
                None => "not reached".to_owned(),
            }));
            row
        })
    }
}

fn describe(disturbance: Disturbance) -> &'static str {
    match disturbance {
        Disturbance::PoseNoise => "pose noise",
        Disturbance::ClockOffset => "a clock offset",
        Disturbance::Exposure => "an exposure step",
        Disturbance::Keyframes => "few training images",
    }
}

/// Formats a level with few digits, because a break point is not more precise.
fn significant_digits(level: f64) -> String {
    match level {
        level if level >= 10.0 => format!("{level:.0}"),
        level if level >= 1.0 => format!("{level:.1}"),
        level => format!("{level:.2}"),
    }
}

/// Suffix of the file names of a chart.
fn file_suffix(disturbance: Disturbance) -> &'static str {
    match disturbance {
        Disturbance::PoseNoise => "-pose-noise",
        Disturbance::ClockOffset => "-clock-offset",
        Disturbance::Exposure => "-exposure",
        Disturbance::Keyframes => "-keyframes",
    }
}

/// Writes the findings so far.
fn findings(
    options: &StabilityOptions,
    runs: &Runs<'_>,
    data: &NamedData,
    results: &[DisturbanceResult],
) -> Result<(Findings, PathBuf)> {
    let length = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?.describe();
    let spread = if options.seeds > 1 {
        format!(
            "median of {} seeds; band: minimum to maximum",
            options.seeds
        )
    } else {
        "one run per size".to_owned()
    };
    let subtitle = format!("after {length}; {spread}");
    let label = format!("{}, {}", data.name, data.single_model_spec()?.kind.name());
    let charts = results.iter().map(|result| {
        (
            file_suffix(result.disturbance),
            result.chart(&subtitle, &label),
        )
    });
    let head = [
        "disturbance",
        "variant",
        "undisturbed, dB",
        "-1 dB at",
        "-3 dB at",
    ]
    .map(str::to_owned)
    .to_vec();
    let level_rows = results.iter().flat_map(DisturbanceResult::level_rows);
    let level_head = ["disturbance, variant", "size", "PSNR, dB", "change, dB"]
        .map(str::to_owned)
        .to_vec();
    let findings = Findings {
        name: "stability",
        title: format!("Stability: {}", data.name),
        sentences: vec![
            format!(
                "Each point is a model trained for {length} on disturbed images and scored on test images. Only a clock offset and an exposure step also disturb the test images. A break point is the size at which the PSNR has fallen by 1 or 3 dB from the undisturbed PSNR."
            ),
            "Pose noise also rotates each camera, by 0.1 degrees per millimeter. Poses with a clock offset are interpolated between neighboring images. An exposure step darkens the first half of the capture and brightens the second, by half the step each."
                .into(),
            format!("{}; fieldrig {}.", runs.adapter(), env!("CARGO_PKG_VERSION")),
        ],
        charts: charts.collect(),
        tables: vec![
            Table { title: "Break points".into(), head, rows: results.iter().flat_map(DisturbanceResult::rows).collect() },
            Table { title: format!("After {length}"), head: level_head, rows: level_rows.collect() },
        ],
        numbers: serde_json::json!({
            "bench": "stability",
            "data": data.path,
            "method": data.single_model_spec()?.kind.name(),
            "adapter": runs.adapter(),
            "disturbances": results,
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
    fn levels_start_undisturbed_and_clip_to_available_keyframes() {
        assert_eq!(
            levels(Disturbance::PoseNoise, &[5.0, 2.0, 2.0], 40),
            [0.0, 2.0, 5.0]
        );
        assert_eq!(
            levels(
                Disturbance::Keyframes,
                Disturbance::Keyframes.default_levels(),
                44
            ),
            [44.0, 20.0, 10.0, 5.0, 3.0]
        );
        assert!(
            is_undisturbed(Disturbance::Keyframes, 44.0, 44)
                && !is_undisturbed(Disturbance::Keyframes, 20.0, 44)
        );
        assert!(
            is_undisturbed(Disturbance::Exposure, 0.0, 44)
                && !is_undisturbed(Disturbance::Exposure, 0.1, 44)
        );
    }

    #[test]
    fn break_points_are_computed_from_points() {
        let mut curve = Curve {
            name: "plain".into(),
            points: Vec::new(),
            breaks: Vec::new(),
        };
        for (level, psnr) in [(100.0, 30.0), (25.0, 28.0), (5.0, 20.0)] {
            curve.add(
                Disturbance::Keyframes,
                level,
                vec![run("a", &[(1.0, psnr)], 10)],
            );
        }
        let [first, second] = &curve.breaks[..] else {
            panic!("two breaks")
        };
        assert!(
            first.level.is_some_and(|level| (level - 50.0).abs() < 1e-9),
            "{first:?}"
        );
        assert!(
            second
                .level
                .is_some_and(|level| (5.0..25.0).contains(&level)),
            "{second:?}"
        );
        assert_eq!(
            curve.line("plain").points[0].x,
            5.0,
            "lines run from left to right"
        );
    }
}
