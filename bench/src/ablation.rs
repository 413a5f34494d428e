//! Measures the contribution of each part of the method by training without it.

use crate::findings::{BenchResult, Findings};
use crate::runs::{Host, Job, NamedData, Run, Runs, RunsOptions};
use crate::statistics::sample_std;
use crate::variant::Variant;
use anyhow::Result;
use messages::{BadInput, Setting};
use numbers::quantile::median;
use report::Table;
use serde::Serialize;
use std::collections::HashSet;
use std::path::PathBuf;
use trainer::splat::{CountPolicy, SplatOptions};
use trainer::{MethodOptions, ModelOptions, ModelSpec};

/// Training time of a run if no flag limits it. The twelve variants with several seeds then take
/// minutes. Longer runs are closer to the final quality of a model.
const DEFAULT_SECONDS: f64 = 16.0;
/// Times at which the table lists the PSNR, seconds. Some parts of the method only speed up the
/// beginning, and gain nothing at the end.
const TABLE_SECS: [f64; 2] = [1.0, 4.0];

/// The unchanged method, to which all variants are compared.
const BASELINE: Variant<SplatOptions> = Variant {
    name: "baseline",
    change: |_| (),
};

const VARIANTS: &[Variant<SplatOptions>] = &[
    Variant {
        name: "no seeds from depth",
        change: |model| model.specific.seeds_per_image = Some(0.0),
    },
    Variant {
        name: "no depth loss",
        change: |model| model.specific.depth_per_m = 0.0,
    },
    Variant {
        name: "no structure loss",
        change: |model| model.specific.dssim_frac = 0.0,
    },
    Variant {
        name: "full resolution from the start",
        change: |model| model.specific.coarse_steps = Some([0; 2]),
    },
    Variant {
        name: "black background",
        change: |model| model.specific.random_background = 0.0,
    },
    Variant {
        name: "no opacity and size regularization",
        change: |model| model.specific.cost_images = 0.0,
    },
    Variant {
        name: "no growth",
        change: |model| model.specific.growth_frac = 0.0,
    },
    Variant {
        name: "no position noise",
        change: |model| model.specific.noise = 0.0,
    },
    Variant {
        name: "constant color per splat",
        change: |model| model.specific.sh_degree = 0,
    },
    Variant {
        name: "grown to the cap",
        change: |model| model.specific.count = CountPolicy::ToCap,
    },
    Variant::CAMERAS_AS_GIVEN,
];

/// Options of [`run`].
#[derive(Clone, Debug)]
pub struct AblationOptions {
    /// Folder or recording.
    pub data: PathBuf,
    /// Training time of each run, seconds. Runs without any limit train for 16 s.
    pub seconds: Option<f64>,
    /// Optimizer steps of each run.
    pub steps: Option<u64>,
    /// Runs of each variant, with consecutive seeds.
    pub seeds: u64,
    /// Measures only the variants whose names contain one of these words. If the list is empty,
    /// measures all variants.
    pub only: Vec<String>,
    /// Models, images and folder.
    pub runs: RunsOptions,
}

/// The runs of one variant.
#[derive(Debug, Serialize)]
struct VariantResult {
    name: &'static str,
    /// Medians, dB.
    psnr: f64,
    ssim: Option<f64>,
    lpips: Option<f64>,
    depth_rmse_m: Option<f64>,
    primitives: f64,
    /// Median over the seeds of the PSNR of the baseline minus the PSNR of the variant, dB.
    gain_db: f64,
    /// Standard deviation of these gains. `None` with a single seed.
    gain_std_db: Option<f64>,
    runs: Vec<Run>,
}

/// Trains splats with and without each part of the method.
///
/// # Errors
///
/// Fails if an option is invalid, if the data cannot be read or scored, or if training fails.
pub fn run(options: &AblationOptions, host: &Host<'_>) -> Result<BenchResult> {
    let limits = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?;
    let mut runs = Runs::open(&options.runs, host)?;
    let data = runs.load(&options.data, &mut HashSet::new())?;
    let base_options = data.splats()?;
    let is_selected = |change: &&Variant<SplatOptions>| {
        options.only.is_empty() || options.only.iter().any(|word| change.name.contains(word))
    };
    // A variant may equal the baseline, because the part is already disabled by flags or by the
    // data.
    let changes: Vec<&Variant<SplatOptions>> = VARIANTS
        .iter()
        .filter(|change| is_change(change, &base_options))
        .filter(is_selected)
        .collect();
    if changes.is_empty() {
        let names: Vec<&str> = VARIANTS.iter().map(|change| change.name).collect();
        return Err(BadInput(format!(
            "{}: no variant matches; variants: {}",
            Setting::Only,
            names.join(", ")
        ))
        .into());
    }
    if options.runs.training.count.is_some() {
        let message = format!("{}: this bench sets it; remove the flag", Setting::Count);
        return Err(BadInput(message).into());
    }
    runs.expect((changes.len() as u64 + 1) * options.seeds);
    let mut baseline: Vec<Run> = Vec::new();
    let mut rows: Vec<VariantResult> = Vec::new();
    let mut page = None;
    for change in std::iter::once(&BASELINE).chain(changes) {
        let mut finished = Vec::new();
        let first_seed = base_options.common.seed;
        for seed in first_seed..first_seed.saturating_add(options.seeds) {
            let seeded = base_options.clone().with(|model| model.common.seed = seed);
            finished.push(runs.run(Job {
                name: format!("ablation {} {} seed {seed}", data.name, change.name),
                data: &data,
                model_spec: ModelSpec::of(&change.options(&seeded))?,
                limits,
                disturbed: None,
                variant: Some(change.name.to_owned()),
                keyframes: &|| data.data.keyframes.clone(),
                is_thorough: false,
            })?);
        }
        // The baseline comes first, because every gain is a difference from it.
        if baseline.is_empty() {
            baseline = finished.clone();
        }
        rows.extend(VariantResult::of(change.name, &baseline, finished));
        // The findings are written after every variant, so that an interrupted bench leaves
        // results.
        page = Some(findings(options, &runs, &data, &rows)?);
    }
    BenchResult::of(page, data.data.data_losses)
}

/// Whether the variant changes any of these options.
fn is_change(change: &Variant<SplatOptions>, options: &ModelOptions<SplatOptions>) -> bool {
    change.options(options) != *options
}

impl VariantResult {
    fn of(name: &'static str, baseline: &[Run], runs: Vec<Run>) -> Option<Self> {
        let median_of = |of: &dyn Fn(&Run) -> Option<f64>| {
            median(&runs.iter().filter_map(of).collect::<Vec<_>>())
        };
        // Runs with the same seed are compared. The seed affects both runs in a similar way, so the
        // difference of a pair varies less than the difference of the medians.
        let gain: Vec<f64> = baseline
            .iter()
            .zip(&runs)
            .map(|(baseline, changed)| baseline.psnr() - changed.psnr())
            .collect();
        Some(Self {
            name,
            psnr: median_of(&|run| Some(run.psnr()))?,
            ssim: median_of(&|run| run.end.ssim),
            lpips: median_of(&|run| run.end.lpips),
            depth_rmse_m: median_of(&|run| run.end.depth_rmse_m),
            primitives: median_of(&|run| Some(run.end.primitives as f64))?,
            gain_db: median(&gain)?,
            gain_std_db: sample_std(&gain),
            runs,
        })
    }

    fn row(&self) -> Vec<String> {
        let number = |value: Option<f64>, places: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.places$}"))
        };
        let gain = if self.name == BASELINE.name {
            "-".to_owned()
        } else {
            let spread = self
                .gain_std_db
                .map_or_else(String::new, |std| format!(" (std {std:.2})"));
            format!("{:+.2}{spread}", self.gain_db)
        };
        let mut row = vec![self.name.to_owned()];
        row.extend(TABLE_SECS.map(|secs| number(self.psnr_at(secs), 2)));
        row.extend([
            format!("{:.2}", self.psnr),
            gain,
            number(self.ssim, 4),
            number(self.lpips, 4),
            number(self.depth_rmse_m.map(|meters| 1e3 * meters), 1),
            format!("{:.0}", self.primitives),
        ]);
        row
    }

    /// Median PSNR of the runs at a time of the evaluation schedule, dB.
    fn psnr_at(&self, secs: f64) -> Option<f64> {
        let values: Vec<f64> = self
            .runs
            .iter()
            .filter_map(|run| psnr_near(run, secs))
            .collect();
        median(&values)
    }
}

/// PSNR of a run at a time of the evaluation schedule, dB.
fn psnr_near(run: &Run, secs: f64) -> Option<f64> {
    // An evaluation begins after the step during which it became due, so its time is slightly above
    // the scheduled time. The next evaluation is at twice the scheduled time.
    run.curve()
        .into_iter()
        .find(|(time, _)| (time / secs - 1.0).abs() < 0.1)
        .map(|(_, psnr)| psnr)
}

/// Writes the results of the variants that are finished.
fn findings(
    options: &AblationOptions,
    runs: &Runs<'_>,
    data: &NamedData,
    rows: &[VariantResult],
) -> Result<(Findings, PathBuf)> {
    let length = session::limits(options.seconds, options.steps, DEFAULT_SECONDS)?.describe();
    let mut head = vec!["variant".to_owned()];
    head.extend(TABLE_SECS.map(|secs| format!("at {secs} s, dB")));
    head.extend(
        [
            "at the end, dB",
            "gain, dB",
            "SSIM",
            "LPIPS",
            "depth RMSE, mm",
            "splats",
        ]
        .map(str::to_owned),
    );
    let findings = Findings {
        name: "ablation",
        title: format!("Contribution of each part: {}", data.name),
        sentences: vec![
            format!(
                "Each row is a variant with one part removed or changed, trained for {length} and scored on test images; medians of {} seeds. \
 Gain: PSNR of the baseline minus PSNR of the variant, for the same seed.",
                options.seeds
            ),
            format!(
                "{}; fieldrig {}.",
                runs.adapter(),
                env!("CARGO_PKG_VERSION")
            ),
        ],
        charts: Vec::new(),
        tables: vec![Table {
            title: format!("After {length}"),
            head,
            rows: rows.iter().map(VariantResult::row).collect(),
        }],
        numbers: serde_json::json!({
            "bench": "ablation",
            "data": data.path,
            "method": SplatOptions::METHOD,
            "adapter": runs.adapter(),
            "changes": rows,
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
    fn gains_are_computed_per_seed() {
        let baseline = [
            run("a", &[(1.0, 24.0), (4.0, 26.0)], 900),
            run("b", &[(1.0, 23.0), (4.0, 27.0)], 900),
        ];
        let changed = vec![
            run("a", &[(1.0, 20.0), (4.0, 25.0)], 800),
            run("b", &[(1.0, 21.0), (4.0, 25.0)], 1000),
        ];
        let changed = VariantResult::of("less", &baseline, changed).expect("two runs");
        assert_eq!(
            (changed.psnr, changed.gain_db, changed.primitives),
            (25.0, 1.5, 900.0)
        );
        assert_eq!(
            changed.row()[..5],
            ["less", "20.50", "25.00", "25.00", "+1.50 (std 0.71)"]
        );
    }

    #[test]
    fn variants_without_effect_are_skipped() {
        let options = SplatOptions {
            depth_per_m: 0.0,
            ..SplatOptions::default()
        }
        .into();
        let tried: Vec<&str> = VARIANTS
            .iter()
            .filter(|change| is_change(change, &options))
            .map(|change| change.name)
            .collect();
        assert!(
            !tried.contains(&"no depth loss") && tried.contains(&"no growth"),
            "{tried:?}"
        );
    }
}
