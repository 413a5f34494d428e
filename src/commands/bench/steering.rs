//! `fieldrig bench steering`: measures how fast steered arms brake, and how well they follow.

use super::runs_args::print_result;
use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use bench::steering::{ArmKind, Fault, FaultRow, SteeringOptions};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use std::path::PathBuf;

/// Flags of `bench steering`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Arms, separated by commas: `simulated`, or the drivers `franka` and `ur` with emulated
    /// controllers [default: all that this program contains]
    #[arg(
        long,
        value_name = "ARM,...",
        value_delimiter = ',',
        value_parser = arm_parser(),
        hide_possible_values = true
    )]
    arms: Vec<ArmKind>,
    /// Faults, separated by commas [default: all]
    #[arg(long, value_name = "FAULT,...", value_delimiter = ',', value_parser = fault_parser())]
    faults: Vec<Fault>,
    /// Trials of each fault with each arm; 0 leaves the faults out
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    trials: u32,
    /// Duration of the figure of eight that each arm follows, in seconds; 0 leaves it out
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = number_in_range(0.0..=86_400.0))]
    tracking_seconds: f64,
    /// Reachable poses of each robot for inverse kinematics; 0 leaves them out
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(0..=10_000_000))]
    poses: u32,
    /// Grips with the hand anywhere, on a simulated clock; 0 leaves them out
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    grips: u32,
    /// Folder for charts and numbers
    #[arg(long, value_name = "DIR", default_value = "bench-steering")]
    out: PathBuf,
    /// Print JSON, one object per fault and arm
    #[arg(long)]
    json: bool,
}

/// The names of arms.
fn arm_parser() -> impl TypedValueParser<Value = ArmKind> {
    let names = ArmKind::ALL.map(ArmKind::name);
    PossibleValuesParser::new(names).map(|name| {
        let kind = ArmKind::ALL.into_iter().find(|kind| kind.name() == name);
        kind.expect("the parser accepts no other name")
    })
}

/// The names of faults, with descriptions.
fn fault_parser() -> impl TypedValueParser<Value = Fault> {
    let values = Fault::ALL.map(|fault| PossibleValue::new(fault.name()).help(fault.title()));
    PossibleValuesParser::new(values).map(|name| {
        let fault = Fault::ALL.into_iter().find(|fault| fault.name() == name);
        fault.expect("the parser accepts no other name")
    })
}

pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let report = |row: &FaultRow| {
        if args.json {
            return print::report_json(&serde_json::json!({ "event": "fault", "row": row }));
        }
        let problems = row.problems();
        if !problems.is_empty() {
            log::warn!("{}: {}: {}", row.arm.name(), row.title, problems.join("; "));
        }
        Ok(())
    };
    print_result(&bench::steering::run(&args.options(), report)?, args.json)?;
    Ok(Exit::Done)
}

impl Args {
    fn options(&self) -> SteeringOptions {
        let arms = if self.arms.is_empty() {
            ArmKind::available()
        } else {
            self.arms.clone()
        };
        let faults = if self.faults.is_empty() {
            Fault::ALL.to_vec()
        } else {
            self.faults.clone()
        };
        SteeringOptions {
            arms,
            faults,
            n_trials: self.trials,
            tracking_secs: self.tracking_seconds,
            n_poses: self.poses,
            n_grips: self.grips,
            out: self.out.clone(),
        }
    }
}
