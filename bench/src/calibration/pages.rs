//! Charts and tables of the results.

use super::coverage::Coverage;
use super::method::Method;
use super::speed::Speed;
use super::stability::{Cell, OutlierType, methods};
use super::{ArmConfiguration, CalibrationOptions, Results, RigResult};
use crate::findings::Findings;
use report::Table;
use report::chart::{Axis, Chart, Line, Point, Scale};

/// Conditions of the sweeps in the charts. Each chart varies one of the conditions.
const BASE_SPREAD_DEG: f64 = 20.0;
const BASE_POSES: usize = 12;

pub(super) fn findings(options: &CalibrationOptions, results: &Results) -> Findings {
    let mut charts = Vec::new();
    let mut tables = Vec::new();
    // Parts that were not requested have no results.
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
    tables.iter().map(markdown_table).collect()
}

fn markdown_table(table: &Table) -> String {
    let rows: String = table.rows.iter().map(|cells| markdown_row(cells)).collect();
    format!(
        "## {}\n\n{}{}\n{rows}\n",
        table.title,
        markdown_row(&table.head),
        "|---".repeat(table.head.len()) + "|"
    )
}

fn markdown_row(cells: &[String]) -> String {
    format!("| {} |\n", cells.join(" | "))
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

/// Confidence levels of the chart, percent.
const LEVELS: [f64; 10] = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 95.0];

/// Percentage of the results whose ellipsoid of a confidence level (in percent) contains the truth.
fn observed_percent(coverage: &Coverage, level: f64) -> f64 {
    let n = coverage
        .levels
        .iter()
        .filter(|own| **own <= 0.01 * level)
        .count();
    100.0 * n as f64 / coverage.levels.len().max(1) as f64
}

fn coverage_line(coverage: &Coverage) -> Line {
    Line {
        label: coverage.name.to_owned(),
        points: LEVELS
            .map(|level| point(level, observed_percent(coverage, level)))
            .to_vec(),
        is_peer: false,
    }
}

fn coverage_chart(results: &[Coverage]) -> Chart {
    // With the right covariance, the ellipsoid of a level contains the truth in that fraction of
    // the results. A measured line below the ideal line shows a covariance that is too small. A
    // measured line above it shows a covariance that is too large.
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
        lines: results.iter().map(coverage_line).chain([ideal]).collect(),
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

fn coverage_row(coverage: &Coverage) -> Vec<String> {
    let [first, second] = coverage.units;
    let pair = |values: [f64; 2]| format!("{:.3} {first}, {:.4} {second}", values[0], values[1]);
    vec![
        coverage.name.to_owned(),
        format!("{:.1} %", 100.0 * coverage.covered_frac),
        pair(coverage.median),
        pair(coverage.p95),
        format!("{} of {}", coverage.n_refused, coverage.n_runs),
    ]
}

fn coverage_table(results: &[Coverage]) -> Table {
    Table {
        title: "Coverage of the 95 % ellipsoid".into(),
        head: words([
            "calibration",
            "covered",
            "median error",
            "95th percentile",
            "refused",
        ]),
        rows: results.iter().map(coverage_row).collect(),
    }
}

fn words<const N: usize>(words: [&str; N]) -> Vec<String> {
    words.map(str::to_owned).to_vec()
}

fn speed_chart(results: &[Speed], label: &str, value: fn(&Speed) -> f64) -> Chart {
    let mut ticks: Vec<f64> = results.iter().map(|speed| speed.n_poses as f64).collect();
    ticks.dedup();
    let mut lines = Vec::new();
    for method in Method::ALL {
        // A method that refused all scenes has no error.
        let own = results
            .iter()
            .filter(|speed| speed.method == method.name() && value(speed).is_finite());
        lines.push(Line {
            label: method.name().to_owned(),
            points: own
                .map(|speed| point(speed.n_poses as f64, value(speed)))
                .collect(),
            is_peer: matches!(method, Method::ClosedForm(_)),
        });
    }
    Chart {
        title: format!("Hand-eye calibration: {label}"),
        subtitle: "0.1 px, 0.1 mm and 0.1 mrad of noise; median".into(),
        x: axis("poses", Scale::Log, ticks),
        y: axis(label, Scale::Log, Vec::new()),
        lines,
        thresholds: Vec::new(),
        markers: Vec::new(),
    }
}

fn speed_row(speed: &Speed) -> Vec<String> {
    vec![
        speed.method.to_owned(),
        speed.n_poses.to_string(),
        format!("{:.1}", speed.millis),
        format!("{:.3}", speed.mm),
        format!("{:.4}", speed.deg),
    ]
}

fn speed_table(results: &[Speed]) -> Table {
    Table {
        title: "Time and error".into(),
        head: words(["method", "poses", "ms", "mm", "degrees"]),
        rows: results.iter().map(speed_row).collect(),
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
    sweeps()
        .into_iter()
        .map(move |sweep| (sweep.suffix, sweep.chart(cells)))
}

impl Sweep {
    /// Position error of each method over the varied quantity.
    fn chart(&self, cells: &[Cell]) -> Chart {
        const FAILED_MM: f64 = 5.0;
        let own: Vec<&Cell> = cells.iter().filter(|cell| (self.is_in)(cell)).collect();
        let mut levels: Vec<f64> = own.iter().map(|cell| (self.value)(cell)).collect();
        levels.sort_by(f64::total_cmp);
        levels.dedup();
        Chart {
            title: format!("Hand-eye calibration: {}", self.label),
            subtitle: format!(
                "median error of the results; no point: all runs refused. Otherwise {BASE_POSES} poses, {BASE_SPREAD_DEG} degrees"
            ),
            x: axis(self.label, Scale::Levels(levels), Vec::new()),
            y: axis("position error, mm", Scale::Log, Vec::new()),
            lines: methods().map(|method| self.line(method, &own)).collect(),
            thresholds: vec![(FAILED_MM, "failed: above 5 mm".into())],
            markers: Vec::new(),
        }
    }

    fn line(&self, method: Method, cells: &[&Cell]) -> Line {
        let of_method = cells.iter().filter(|cell| cell.method == method.name());
        Line {
            label: method.name().to_owned(),
            points: of_method
                .filter_map(|cell| Some(point((self.value)(cell), cell.mm?)))
                .collect(),
            is_peer: matches!(method, Method::ClosedForm(_)),
        }
    }

    /// Describes how many results of a cell were refused or failed.
    fn describe_failures(&self, cell: &Cell) -> String {
        let rest = match (cell.n_refused, cell.n_failed) {
            (0, 0) => "ok".to_owned(),
            (refused, 0) => format!("{refused} refused"),
            (0, failed) => format!("{failed} failed"),
            (refused, failed) => format!("{refused} refused, {failed} failed"),
        };
        format!("{}: {rest}", (self.value)(cell))
    }
}

/// The table of refused and failed results at each level, for each sweep and method.
fn limits_table(cells: &[Cell]) -> Table {
    let mut rows = Vec::new();
    for sweep in sweeps() {
        for method in methods() {
            let own = cells
                .iter()
                .filter(|cell| (sweep.is_in)(cell) && cell.method == method.name());
            let levels: Vec<String> = own.map(|cell| sweep.describe_failures(cell)).collect();
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

/// The table row of a method, which contains sums over all conditions.
fn totals_row(cells: &[Cell], method: Method) -> Vec<String> {
    let own: Vec<&Cell> = cells
        .iter()
        .filter(|cell| cell.method == method.name())
        .collect();
    let n_runs: usize = own.iter().map(|cell| cell.n_runs).sum();
    let n_refused: usize = own.iter().map(|cell| cell.n_refused).sum();
    let n_failed: usize = own.iter().map(|cell| cell.n_failed).sum();
    let n_outside_region: usize = own.iter().map(|cell| cell.n_failed_outside_region).sum();
    // A closed-form solver has no confidence region.
    let outside_region = if matches!(method, Method::ClosedForm(_)) {
        "not reported".into()
    } else {
        n_outside_region.to_string()
    };
    vec![
        method.name().to_owned(),
        n_runs.to_string(),
        (n_runs - n_refused - n_failed).to_string(),
        n_refused.to_string(),
        n_failed.to_string(),
        outside_region,
    ]
}

fn totals_table(cells: &[Cell]) -> Table {
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
        rows: methods().map(|method| totals_row(cells, method)).collect(),
    }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
}

fn percent(frac: Option<f64>) -> String {
    frac.map_or("-".to_owned(), |frac| format!("{:.0} %", 100.0 * frac))
}

fn arm_configuration_row(configuration: &ArmConfiguration) -> Vec<String> {
    let offsets = if configuration.estimates_joints {
        "offsets estimated"
    } else {
        "offsets ignored"
    };
    vec![
        format!("{} degrees, {offsets}", configuration.angle_deg),
        number(configuration.mm, 2),
        number(configuration.deg, 3),
        format!("{} of {}", configuration.n_refused, configuration.n_runs),
        configuration.n_failed.to_string(),
        percent(configuration.observable_frac),
        percent(configuration.within_3_sigma_frac),
    ]
}

fn arm_configurations_table(results: &Results) -> Table {
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
        rows: results
            .arm_configurations
            .iter()
            .map(arm_configuration_row)
            .collect(),
    }
}

fn rigs_line(rigs: &[RigResult], label: &str, value: fn(&RigResult) -> Option<f64>) -> Line {
    // A refused rig has no point.
    let points = rigs
        .iter()
        .filter_map(|rig| Some(point(rig.seed as f64, value(rig)?)));
    Line {
        label: label.to_owned(),
        points: points.collect(),
        is_peer: label != "error",
    }
}

fn rigs_chart(results: &Results) -> Chart {
    const GOAL_MM: f64 = 0.2;
    let line =
        |label: &str, value: fn(&RigResult) -> Option<f64>| rigs_line(&results.rigs, label, value);
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
            line("error", |rig| rig.errors.map(|errors| errors.mm)),
            line("reported standard deviation", |rig| rig.sigma_mm),
        ],
        thresholds: vec![(GOAL_MM, "goal: 0.2 mm".into())],
        markers: Vec::new(),
    }
}

fn rig_row(rig: &RigResult) -> Vec<String> {
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
}

fn rigs_table(results: &Results) -> Table {
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
        rows: results.rigs.iter().map(rig_row).collect(),
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
