//! Charts and tables of the results.

use super::coverage::Coverage;
use super::method::Method;
use super::speed::Speed;
use super::stability::{Cell, OutlierType, methods};
use super::{CalibrationOptions, Results};
use crate::findings::Findings;
use session::Table;
use session::chart::{Axis, Chart, Line, Point, Scale};

/// Conditions of the sweeps in the charts; each chart varies one of them.
const BASE_SPREAD_DEG: f64 = 20.0;
const BASE_POSES: usize = 12;

pub(super) fn findings(options: &CalibrationOptions, results: &Results) -> Findings {
    let (mut charts, mut tables) = (Vec::new(), Vec::new());
    if !results.coverage.is_empty() {
        charts.push(("-coverage", coverage_chart(&results.coverage)));
        tables.push(coverage_table(&results.coverage));
    }
    if !results.speed.is_empty() {
        charts.push((
            "-time",
            speed_chart(&results.speed, "time, ms", |speed| speed.millis),
        ));
        charts.push((
            "-error",
            speed_chart(&results.speed, "position error, mm", |speed| speed.mm),
        ));
        tables.push(speed_table(&results.speed));
    }
    if !results.stability.is_empty() {
        charts.extend(stability_charts(&results.stability));
        tables.extend([
            limits_table(&results.stability),
            totals_table(&results.stability),
        ]);
    }
    if !results.arm_configurations.is_empty() {
        tables.push(arm_configurations_table(results));
    }
    if !results.rigs.is_empty() {
        charts.push(("-rigs", rigs_chart(results)));
        tables.push(rigs_table(results));
    }
    Findings {
        name: "calibration",
        title: "Calibration".into(),
        sentences: vec![
            format!(
                "Simulated corners of a chessboard of 9 x 6 inner corners at 0.5 m, camera of 1280 x 720 pixels. Coverage: {} calibrations with {} views and {} px of noise per line. Other results: medians of {} scenes.",
                options.coverage.runs, options.coverage.n_poses, options.coverage.corner_px, options.seeds
            ),
            "A result has failed if its error is above 5 mm or 0.5 degrees. Closed-form solvers use board poses from the corners, like \"refined\".".into(),
            format!("fieldrig {}.", env!("CARGO_PKG_VERSION")),
        ],
        charts,
        tables,
        numbers: serde_json::json!({ "bench": "calibration", "results": results }),
    }
}

/// The tables in Markdown.
pub(super) fn markdown(tables: &[Table]) -> String {
    let row = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let table = |table: &Table| {
        let rows: String = table.rows.iter().map(|cells| row(cells)).collect();
        format!(
            "## {}\n\n{}{}\n{rows}\n",
            table.title,
            row(&table.head),
            "|---".repeat(table.head.len()) + "|"
        )
    };
    tables.iter().map(table).collect()
}

fn axis(label: &str, scale: Scale, ticks: Vec<f64>) -> Axis {
    Axis {
        label: label.to_owned(),
        scale,
        ticks,
    }
}

fn point(x: f64, y: f64) -> Point {
    Point {
        x,
        y,
        low: y,
        high: y,
    }
}

fn coverage_chart(results: &[Coverage]) -> Chart {
    const LEVELS: [f64; 10] = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 95.0];
    let line = |coverage: &Coverage| {
        let observed = |level: f64| {
            let n = coverage
                .levels
                .iter()
                .filter(|own| **own <= 0.01 * level)
                .count();
            100.0 * n as f64 / coverage.levels.len().max(1) as f64
        };
        let points = LEVELS.map(|level| point(level, observed(level))).to_vec();
        Line {
            label: coverage.name.to_owned(),
            points,
            is_peer: false,
        }
    };
    let ideal = Line {
        label: "ideal".into(),
        points: LEVELS.map(|level| point(level, level)).into(),
        is_peer: true,
    };
    Chart {
        title: "Coverage of the reported uncertainty".into(),
        subtitle: "fraction of results whose confidence ellipsoid contains the truth".into(),
        x: axis("confidence level, %", Scale::Linear, LEVELS.into()),
        y: axis(
            "results that contain the truth, %",
            Scale::Linear,
            Vec::new(),
        ),
        lines: results.iter().map(line).chain([ideal]).collect(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

fn coverage_table(results: &[Coverage]) -> Table {
    let row = |coverage: &Coverage| {
        let pair = |values: [f64; 2]| {
            let [first, second] = coverage.units;
            format!("{:.3} {first}, {:.4} {second}", values[0], values[1])
        };
        vec![
            coverage.name.to_owned(),
            format!("{:.1} %", 100.0 * coverage.covered_frac),
            pair(coverage.median),
            pair(coverage.p95),
            format!("{} of {}", coverage.n_refused, coverage.n_runs),
        ]
    };
    Table {
        title: "Coverage of the 95 % ellipsoid".into(),
        head: words([
            "calibration",
            "covered",
            "median error",
            "95th percentile",
            "refused",
        ]),
        rows: results.iter().map(row).collect(),
    }
}

fn words<const N: usize>(words: [&str; N]) -> Vec<String> {
    words.map(str::to_owned).to_vec()
}

fn speed_chart(results: &[Speed], label: &str, value: fn(&Speed) -> f64) -> Chart {
    let mut ticks: Vec<f64> = results.iter().map(|speed| speed.n_poses as f64).collect();
    ticks.dedup();
    let line = |method: Method| {
        let own = results
            .iter()
            .filter(|speed| speed.method == method.name() && value(speed).is_finite());
        let points = own
            .map(|speed| point(speed.n_poses as f64, value(speed)))
            .collect();
        Line {
            label: method.name().to_owned(),
            points,
            is_peer: matches!(method, Method::ClosedForm(_)),
        }
    };
    Chart {
        title: format!("Hand-eye calibration: {label}"),
        subtitle: "0.1 px, 0.1 mm and 0.1 mrad of noise; median".into(),
        x: axis("poses", Scale::Log, ticks),
        y: axis(label, Scale::Log, Vec::new()),
        lines: Method::ALL.map(line).into(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

fn speed_table(results: &[Speed]) -> Table {
    let row = |speed: &Speed| {
        vec![
            speed.method.to_owned(),
            speed.n_poses.to_string(),
            format!("{:.1}", speed.millis),
            format!("{:.3}", speed.mm),
            format!("{:.4}", speed.deg),
        ]
    };
    Table {
        title: "Time and error".into(),
        head: words(["method", "poses", "ms", "mm", "degrees"]),
        rows: results.iter().map(row).collect(),
    }
}

/// One quantity that a chart varies.
struct Sweep {
    suffix: &'static str,
    label: &'static str,
    value: fn(&Cell) -> f64,
    is_in: fn(&Cell) -> bool,
}

fn has_base_spread(cell: &Cell) -> bool {
    cell.condition.spread_deg == BASE_SPREAD_DEG
}

fn has_base_poses(cell: &Cell) -> bool {
    cell.condition.n_poses == BASE_POSES
}

fn sweeps() -> [Sweep; 4] {
    [
        Sweep {
            suffix: "-rotation",
            label: "rotation of the flange, degrees (standard deviation per axis)",
            value: |cell| cell.condition.spread_deg,
            is_in: |cell| has_base_poses(cell) && cell.condition.outlier_percent == 0,
        },
        Sweep {
            suffix: "-poses",
            label: "poses",
            value: |cell| cell.condition.n_poses as f64,
            is_in: |cell| has_base_spread(cell) && cell.condition.outlier_percent == 0,
        },
        Sweep {
            suffix: "-outlier-corners",
            label: "outlier corners, %",
            value: |cell| f64::from(cell.condition.outlier_percent),
            is_in: |cell| {
                has_base_spread(cell)
                    && has_base_poses(cell)
                    && cell.condition.outlier_type == OutlierType::Corners
            },
        },
        Sweep {
            suffix: "-outlier-poses",
            label: "outlier robot poses, %",
            value: |cell| f64::from(cell.condition.outlier_percent),
            is_in: |cell| {
                let has_none = cell.condition.outlier_percent == 0;
                let are_poses = cell.condition.outlier_type == OutlierType::RobotPoses;
                has_base_spread(cell) && has_base_poses(cell) && (has_none || are_poses)
            },
        },
    ]
}

fn stability_charts(cells: &[Cell]) -> impl Iterator<Item = (&'static str, Chart)> {
    const FAILED_MM: f64 = 5.0;
    sweeps().into_iter().map(move |sweep| {
        let own: Vec<&Cell> = cells.iter().filter(|cell| (sweep.is_in)(cell)).collect();
        let mut levels: Vec<f64> = own.iter().map(|cell| (sweep.value)(cell)).collect();
        levels.sort_by(f64::total_cmp);
        levels.dedup();
        let line = |method: Method| {
            let of_method = own.iter().filter(|cell| cell.method == method.name());
            let points = of_method.filter_map(|cell| Some(point((sweep.value)(cell), cell.mm?))).collect();
            Line { label: method.name().to_owned(), points, is_peer: matches!(method, Method::ClosedForm(_)) }
        };
        let chart = Chart {
            title: format!("Hand-eye calibration: {}", sweep.label),
            subtitle: format!(
                "median error of the results; no point: all runs refused. Otherwise {BASE_POSES} poses, {BASE_SPREAD_DEG} degrees"
            ),
            x: axis(sweep.label, Scale::Levels(levels), Vec::new()),
            y: axis("position error, mm", Scale::Log, Vec::new()),
            lines: methods().map(line).collect(),
            thresholds: vec![(FAILED_MM, "failed: above 5 mm".into())],
            markers: Vec::new(),
        };
        (sweep.suffix, chart)
    })
}

/// For each sweep and method: refused and failed results at each level.
fn limits_table(cells: &[Cell]) -> Table {
    let mut rows = Vec::new();
    for sweep in sweeps() {
        for method in methods() {
            let own = cells
                .iter()
                .filter(|cell| (sweep.is_in)(cell) && cell.method == method.name());
            let level = |cell: &Cell| {
                let rest = match (cell.n_refused, cell.n_failed) {
                    (0, 0) => "ok".to_owned(),
                    (refused, 0) => format!("{refused} refused"),
                    (0, failed) => format!("{failed} failed"),
                    (refused, failed) => format!("{refused} refused, {failed} failed"),
                };
                format!("{}: {rest}", (sweep.value)(cell))
            };
            let levels: Vec<String> = own.map(level).collect();
            rows.push(vec![
                format!("{}, {}", sweep.label, method.name()),
                levels.join("; "),
            ]);
        }
    }
    let n_runs = cells.first().map_or(0, |cell| cell.n_runs);
    Table {
        title: format!("Failures out of {n_runs} scenes per level"),
        head: words(["condition and method", "results per level"]),
        rows,
    }
}

fn totals_table(cells: &[Cell]) -> Table {
    let row = |method: Method| {
        let sum = |value: fn(&Cell) -> usize| -> usize {
            cells
                .iter()
                .filter(|cell| cell.method == method.name())
                .map(value)
                .sum()
        };
        let n_runs = sum(|cell| cell.n_runs);
        let [refused, failed, outside_region] = [
            sum(|cell| cell.n_refused),
            sum(|cell| cell.n_failed),
            sum(|cell| cell.n_failed_outside_region),
        ];
        let has_uncertainty = !matches!(method, Method::ClosedForm(_));
        let outside_region = if has_uncertainty {
            outside_region.to_string()
        } else {
            "not reported".into()
        };
        vec![
            method.name().to_owned(),
            n_runs.to_string(),
            (n_runs - refused - failed).to_string(),
            refused.to_string(),
            failed.to_string(),
            outside_region,
        ]
    };
    Table {
        title: "All combinations of rotation, poses and outliers".into(),
        head: words([
            "method",
            "runs",
            "usable",
            "refused",
            "failed",
            "failed and outside the 99.99 % confidence region",
        ]),
        rows: methods().map(row).collect(),
    }
}

fn arm_configurations_table(results: &Results) -> Table {
    let percent =
        |frac: Option<f64>| frac.map_or("-".to_owned(), |frac| format!("{:.0} %", 100.0 * frac));
    let number = |value: Option<f64>, digits: usize| {
        value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
    };
    let row = |configuration: &super::ArmConfiguration| {
        vec![
            format!(
                "{} degrees, {}",
                configuration.angle_deg,
                if configuration.estimates_joints {
                    "offsets estimated"
                } else {
                    "offsets ignored"
                }
            ),
            number(configuration.mm, 2),
            number(configuration.deg, 3),
            format!("{} of {}", configuration.n_refused, configuration.n_runs),
            configuration.n_failed.to_string(),
            percent(configuration.observable_frac),
            percent(configuration.within_3_sigma_frac),
        ]
    };
    Table {
        title: "Distance of joint 6 from the wrist singularity, with joint offsets of 4 mrad"
            .into(),
        head: words([
            "arm configuration",
            "mm",
            "degrees",
            "refused",
            "failed",
            "offsets observable",
            "within 3 sigma",
        ]),
        rows: results.arm_configurations.iter().map(row).collect(),
    }
}

fn rigs_chart(results: &Results) -> Chart {
    const GOAL_MM: f64 = 0.2;
    let line = |label: &str, value: &dyn Fn(&super::RigResult) -> Option<f64>| {
        let points = results
            .rigs
            .iter()
            .filter_map(|rig| Some(point(rig.seed as f64, value(rig)?)));
        Line {
            label: label.to_owned(),
            points: points.collect(),
            is_peer: label != "error",
        }
    };
    Chart {
        title: "Calibration without a target: position error".into(),
        subtitle: "hand-eye wrong by 3 degrees and 20 mm in random directions".into(),
        x: axis(
            "rig",
            Scale::Levels(results.rigs.iter().map(|rig| rig.seed as f64).collect()),
            Vec::new(),
        ),
        y: axis("mm", Scale::Log, Vec::new()),
        lines: vec![
            line("error", &|rig| rig.errors.map(|errors| errors.mm)),
            line("reported standard deviation", &|rig| rig.sigma_mm),
        ],
        thresholds: vec![(GOAL_MM, "goal: 0.2 mm".into())],
        markers: Vec::new(),
    }
}

fn rigs_table(results: &Results) -> Table {
    let number = |value: Option<f64>, digits: usize| {
        value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
    };
    let row = |rig: &super::RigResult| {
        vec![
            rig.seed.to_string(),
            rig.n_images.to_string(),
            number(rig.errors.map(|errors| errors.mm), 3),
            number(rig.sigma_mm, 3),
            number(rig.errors.map(|errors| errors.deg), 4),
            number(rig.sigma_deg, 4),
            format!("{:.1}", rig.seconds),
            if rig.reaches_goal() { "yes" } else { "no" }.to_owned(),
        ]
    };
    Table {
        title: "Calibration without a target".into(),
        head: words([
            "rig",
            "images",
            "mm",
            "sigma, mm",
            "degrees",
            "sigma, degrees",
            "s",
            "goal reached",
        ]),
        rows: results.rigs.iter().map(row).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_markdown() {
        let table = Table {
            title: "Sizes".into(),
            head: words(["a", "b"]),
            rows: vec![words(["1", "2"])],
        };
        assert_eq!(
            markdown(&[table]),
            "## Sizes\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n"
        );
    }
}
