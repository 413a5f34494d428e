//! The fault matrix: how fast an arm brakes after each fault, over many trials.

use super::arms::ArmKind;
use super::braking::Braking;
use super::faults::Fault;
use super::operator::Operator;
use super::rig::SteeredRig;
use super::trace::Excess;
use super::trial::{self, Outcome};
use anyhow::Result;
use numbers::quantile::{Rank, median, quantile};
use numbers::random::Random;
use report::Table;
use report::chart::{Axis, Chart, Line, Point, Scale};
use serde::Serialize;

/// How often a trial is repeated in which the arm stopped before the event, per trial that counts.
const MAX_REPEATS: u32 = 3;
/// The way that every fault of the matrix takes.
const PATH: &str = "client, server, decisions and arm in real time";
/// The way of faults that end the program.
const PATH_OF_PROCESSES: &str = "client, another process with server, decisions and driver, device";
/// Rounding to cycles by which an arm may be at rest later than predicted, milliseconds: the
/// beginning and the end of a brake, and the delay of a setpoint on its way to a controller.
const MAX_LATE_MILLIS: f64 = 5.0;
/// The same in cycles of a robot whose cycles are longer.
const N_LATE_CYCLES: f64 = 2.25;

/// Results of all trials of a fault with an arm.
#[derive(Clone, Debug, Serialize)]
pub struct FaultRow {
    /// The arm.
    pub arm: ArmKind,
    /// The fault.
    pub fault: Fault,
    /// Description of the fault.
    pub title: &'static str,
    /// Trials that count.
    pub n_trials: u32,
    /// Trials in which the arm stopped before the event, and which were repeated.
    pub n_repeated: u32,
    /// Time from the event to the beginning of the brake.
    pub begins: Spread,
    /// Maximum of `begins` that the fault allows, milliseconds.
    pub goal_millis: f64,
    /// Time from the event until the arm is at rest.
    pub rests: Spread,
    /// The same time as predicted from the limits of braking.
    pub predicted: Spread,
    /// The most by which an arm was at rest later than predicted, milliseconds.
    pub late_millis: Option<f64>,
    /// Trials in which the arm did not come to rest.
    pub n_not_at_rest: u32,
    /// Trials in which a limit was exceeded in any cycle.
    pub n_exceeded: u32,
    /// The first such excess.
    pub excess: Option<Excess>,
    /// Trials in which the arm stopped because the arm itself reported a fault.
    pub n_stopped: u32,
    /// The first reason of such a stop.
    pub stopped: Option<String>,
    /// How often the arm braked during the fault, before the operator released the switch.
    pub n_own_brakes: u32,
}

/// Median and largest of times, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Median; `None` without values.
    pub p50_millis: Option<f64>,
    /// Largest value.
    pub worst_millis: Option<f64>,
}

impl Spread {
    fn of(secs: impl Iterator<Item = f64>) -> Self {
        let mut millis: Vec<f64> = secs.map(|secs| 1e3 * secs).collect();
        Self {
            p50_millis: median(&millis),
            worst_millis: quantile(&mut millis, 1.0, Rank::Lower),
        }
    }

    fn cells(&self) -> [String; 2] {
        [self.p50_millis, self.worst_millis].map(cell)
    }
}

/// Tries a fault many times.
///
/// # Errors
///
/// If the arm cannot be steered.
pub(super) fn measure(rig: &SteeredRig, fault: Fault, n_trials: u32) -> Result<FaultRow> {
    let mut operator = Operator::connect(rig)?;
    let other = rig.connect()?;
    let mut random = Random::new(u64::from(n_trials));
    let mut outcomes = Vec::new();
    let mut n_repeated = 0;
    let max_repeated = MAX_REPEATS * n_trials;
    while outcomes.len() < n_trials as usize && n_repeated <= max_repeated {
        match trial::run(&mut operator, &other, fault, &mut random)? {
            Some(outcome) => outcomes.push(outcome),
            None => n_repeated += 1,
        }
    }
    Ok(FaultRow::of(rig.robot.kind, fault, n_repeated, &outcomes))
}

impl FaultRow {
    /// * `n_repeated`: trials in which the robot stopped before the event.
    pub(super) fn of(arm: ArmKind, fault: Fault, n_repeated: u32, outcomes: &[Outcome]) -> Self {
        let brakes = || outcomes.iter().filter_map(|outcome| outcome.braking);
        let count = |is_counted: &dyn Fn(&Outcome) -> bool| {
            outcomes
                .iter()
                .map(|outcome| u32::from(is_counted(outcome)))
                .sum()
        };
        let late_secs = |brake: Braking| Some(brake.rests_secs - brake.predicted_secs?);
        let late = Spread::of(brakes().filter_map(late_secs));
        Self {
            arm,
            fault,
            title: fault.title(),
            n_trials: count(&|_| true),
            n_repeated,
            begins: Spread::of(brakes().map(|brake| brake.begins_secs)),
            goal_millis: fault.goal_millis(),
            rests: Spread::of(brakes().map(|brake| brake.rests_secs)),
            predicted: Spread::of(brakes().filter_map(|brake| brake.predicted_secs)),
            late_millis: late.worst_millis,
            n_not_at_rest: count(&|outcome| outcome.braking.is_none()),
            n_exceeded: count(&|outcome| outcome.excess.is_some()),
            excess: outcomes.iter().find_map(|outcome| outcome.excess),
            n_stopped: count(&|outcome| outcome.stopped.is_some()),
            stopped: outcomes.iter().find_map(|outcome| outcome.stopped.clone()),
            n_own_brakes: outcomes.iter().map(|outcome| outcome.n_own_brakes).sum(),
        }
    }

    /// Missed goals, in words; empty if there are none.
    #[must_use]
    pub fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if self.n_trials == 0 {
            problems.push("the arm never followed the hand".to_owned());
        }
        let is_late = self
            .begins
            .worst_millis
            .is_some_and(|worst| worst > self.goal_millis);
        if is_late {
            problems.push(format!("brakes after more than {} ms", self.goal_millis));
        }
        let max_late_millis = MAX_LATE_MILLIS.max(N_LATE_CYCLES * self.arm.cycle_millis());
        if self.late_millis.is_some_and(|late| late > max_late_millis) {
            problems.push("at rest later than predicted".to_owned());
        }
        for (n, what) in [
            (self.n_not_at_rest, "without rest"),
            (self.n_exceeded, "beyond a limit"),
            (self.n_stopped, "with a fault of the arm"),
        ] {
            if n > 0 {
                problems.push(format!("{n} {what}"));
            }
        }
        problems
    }

    fn cells(&self) -> Vec<String> {
        let mut cells = vec![
            self.arm.name().to_owned(),
            self.title.to_owned(),
            if self.fault.ends_program() {
                PATH_OF_PROCESSES
            } else {
                PATH
            }
            .to_owned(),
            self.n_trials.to_string(),
        ];
        cells.extend(self.begins.cells());
        cells.push(format!("{:.0}", self.goal_millis));
        cells.extend(self.rests.cells());
        cells.extend(self.predicted.cells());
        cells.push(cell(self.late_millis));
        cells.push(if self.fault.ends_program() {
            // The device brakes by its own rules.
            "-".to_owned()
        } else {
            self.n_exceeded.to_string()
        });
        cells.push(self.n_own_brakes.to_string());
        cells.push(self.n_repeated.to_string());
        let problems = self.problems();
        cells.push(if problems.is_empty() {
            "none".to_owned()
        } else {
            problems.join("; ")
        });
        cells
    }
}

fn cell(millis: Option<f64>) -> String {
    millis.map_or_else(|| "-".to_owned(), |millis| format!("{millis:.1}"))
}

/// The table of all faults.
pub(super) fn table(rows: &[FaultRow]) -> Table {
    let head = [
        "robot",
        "fault",
        "path",
        "trials",
        "brake begins p50, ms",
        "worst",
        "goal",
        "at rest p50, ms",
        "worst",
        "predicted p50, ms",
        "worst",
        "later than predicted, ms",
        "limits exceeded",
        "own brakes",
        "repeated",
        "problems",
    ];
    Table {
        title: "Faults".to_owned(),
        head: head.map(str::to_owned).to_vec(),
        rows: rows.iter().map(FaultRow::cells).collect(),
    }
}

/// The chart of all faults: for each arm, the beginning of the brake and the rest, from the median
/// to the worst.
pub(super) fn chart(rows: &[FaultRow]) -> Chart {
    let arms: std::collections::BTreeSet<ArmKind> = rows.iter().map(|row| row.arm).collect();
    let faults: std::collections::BTreeSet<Fault> = rows.iter().map(|row| row.fault).collect();
    let numbers: Vec<f64> = faults.iter().map(|fault| number(*fault)).collect();
    let line = |arm: ArmKind, what: &str, spread: fn(&FaultRow) -> Spread| Line {
        label: format!("{}: {what}", arm.name()),
        points: rows
            .iter()
            .filter(|row| row.arm == arm)
            .filter_map(|row| point(row.fault, spread(row)))
            .collect(),
        is_peer: false,
    };
    let lines = arms.iter().flat_map(|arm| {
        [
            line(*arm, "brake begins", |row| row.begins),
            line(*arm, "at rest", |row| row.rests),
        ]
    });
    Chart {
        title: "Time from a fault to the brake and to rest".to_owned(),
        subtitle: "median, and band to the worst trial; faults in the order of the table"
            .to_owned(),
        x: Axis {
            label: "number of the fault".to_owned(),
            scale: Scale::Linear,
            ticks: numbers,
        },
        y: Axis {
            label: "ms".to_owned(),
            scale: Scale::Linear,
            ticks: Vec::new(),
        },
        lines: lines.collect(),
        thresholds: vec![(100.0, "release".to_owned()), (150.0, "silence".to_owned())],
        markers: Vec::new(),
    }
}

/// The number of a fault, from 1.
fn number(fault: Fault) -> f64 {
    let ix = Fault::ALL.iter().position(|listed| *listed == fault);
    1.0 + ix.unwrap_or_default() as f64
}

fn point(fault: Fault, spread: Spread) -> Option<Point> {
    let y = spread.p50_millis?;
    Some(Point {
        x: number(fault),
        y,
        low: y,
        high: spread.worst_millis?,
    })
}

#[cfg(test)]
mod tests {
    use super::super::braking::Braking;
    use super::super::trace::LimitKind;
    use super::*;

    fn outcome(begins_secs: f64, rests_secs: f64) -> Outcome {
        Outcome {
            braking: Some(Braking {
                begins_secs,
                rests_secs,
                predicted_secs: Some(begins_secs + 0.2),
            }),
            excess: None,
            stopped: None,
            n_own_brakes: 0,
        }
    }

    fn row(outcomes: &[Outcome]) -> FaultRow {
        FaultRow::of(ArmKind::Simulated, Fault::Released, 0, outcomes)
    }

    #[test]
    fn prompt_brakes_have_no_problems_and_the_worst_trial_is_shown() {
        let row = row(&[
            outcome(0.010, 0.21),
            outcome(0.020, 0.22),
            outcome(0.060, 0.26),
        ]);
        assert_eq!(row.problems(), Vec::<String>::new());
        assert_eq!(row.begins.cells(), ["20.0", "60.0"]);
        assert_eq!(row.rests.cells(), ["220.0", "260.0"]);
        assert_eq!(
            table(&[row]).rows[0].last().map(String::as_str),
            Some("none")
        );
    }

    #[test]
    fn late_slow_and_faulty_brakes_are_named() {
        let late = row(&[outcome(0.010, 0.21), outcome(0.101, 0.301)]);
        assert_eq!(late.problems(), ["brakes after more than 100 ms"]);
        let slow = row(&[outcome(0.010, 0.41)]);
        assert_eq!(slow.problems(), ["at rest later than predicted"]);
        let excess = Excess {
            kind: LimitKind::Jerk,
            joint_ix: 2,
            value: 50.0,
            limit: 40.0,
        };
        let faulty = Outcome {
            braking: None,
            excess: Some(excess),
            stopped: Some("a reflex".to_owned()),
            n_own_brakes: 3,
        };
        let row = row(&[faulty]);
        assert_eq!(
            row.problems(),
            [
                "1 without rest",
                "1 beyond a limit",
                "1 with a fault of the arm"
            ]
        );
        assert_eq!((row.excess, row.n_own_brakes), (Some(excess), 3));
        assert_eq!(row.begins.cells(), ["-", "-"]);
    }

    #[test]
    fn the_chart_has_a_point_for_each_fault_of_each_arm() {
        let rows = [row(&[outcome(0.010, 0.21)]), row(&[])];
        let chart = chart(&rows);
        assert_eq!(chart.lines.len(), 2);
        assert_eq!(
            chart.lines[0].points.len(),
            1,
            "a row without a brake has none"
        );
        assert_eq!(chart.lines[1].points[0].y, 210.0);
    }
}
