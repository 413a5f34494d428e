//! `fieldrig bench steering`: measures how fast steered arms brake, and how well they follow.

use super::runs_args::print_result;
use crate::exit::Exit;
use crate::number_args::number_in_range;
use crate::print;
use anyhow::Context;
use bench::steering::{ArmKind, Fault, FaultRow, Processes, SteeringOptions, ViewOptions};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Flags of `bench steering`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Arms and bases, separated by commas: `simulated` and `base`, or the drivers `franka`, `ur`,
    /// `servos` and `udp-base` with emulated devices [default: all that this program contains]
    #[arg(
        long,
        value_name = "ROBOT,...",
        value_delimiter = ',',
        value_parser = arm_parser(),
        hide_possible_values = true
    )]
    arms: Vec<ArmKind>,
    /// Faults, separated by commas [default: all]
    #[arg(long, value_name = "FAULT,...", value_delimiter = ',', value_parser = fault_parser())]
    faults: Vec<Fault>,
    /// Trials of each fault with each robot; 0 leaves the faults out
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
    /// Goals inside and behind obstacles, and as many free goals, in each simulated scene, on a
    /// simulated clock; 0 leaves them out
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    goals: u32,
    /// Views that the scan never had, to which an operator steers the camera of a run that this
    /// command starts with --views-rig; 0 leaves them out
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1000), requires = "views_rig")]
    views: u32,
    /// Rig file of the run for --views. It is simulated, and needs a GPU for useful figures
    #[arg(long, value_name = "RIG_FILE")]
    views_rig: Option<PathBuf>,
    /// Round trip between the operator and the run for --views, in milliseconds
    #[arg(long, value_name = "MS", default_value_t = 0.0, value_parser = number_in_range(0.0..=2000.0))]
    views_round_trip: f64,
    /// Folder for charts and numbers
    #[arg(long, value_name = "DIR", default_value = "bench-steering")]
    out: PathBuf,
    /// Steer the robot whose emulated device is at an address, and print the address of the server.
    /// The faults that stop this program use it
    #[arg(long, value_name = "ROBOT=ADDRESS", hide = true)]
    serve: Option<String>,
    /// Print JSON, one object per fault and robot
    #[arg(long)]
    json: bool,
}

/// The names of arms and bases.
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
    if let Some(robot) = &args.serve {
        return serve(robot);
    }
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
    print_result(&bench::steering::run(&args.options()?, report)?, args.json)?;
    Ok(Exit::Done)
}

/// Steers a robot until the standard input ends.
#[cfg(all(feature = "sim", target_os = "linux"))]
fn serve(robot: &str) -> anyhow::Result<Exit> {
    let (name, address) = robot.split_once('=').context("expected ROBOT=ADDRESS")?;
    let kind = ArmKind::ALL.into_iter().find(|kind| kind.name() == name);
    let kind = kind.with_context(|| format!("no robot is named {name:?}"))?;
    bench::steering::serve_robot(kind, address, |server| {
        print::line(server.to_string())?;
        let mut input = Vec::new();
        std::io::Read::read_to_end(&mut std::io::stdin(), &mut input)?;
        Ok(())
    })?;
    Ok(Exit::Done)
}

#[cfg(not(all(feature = "sim", target_os = "linux")))]
fn serve(_robot: &str) -> anyhow::Result<Exit> {
    anyhow::bail!("this program contains no emulated devices")
}

/// The run that `--views` steers, without its rig file and its folder.
const STEERED_RUN: &str =
    "fieldrig run --sim --enable-motion --json --listen 127.0.0.1:0 --when-done exit";

/// This program with the arguments of a command line, which are separated by single spaces.
fn this_program(command_line: &str) -> anyhow::Result<Command> {
    let path = std::env::current_exe().context("the path of this program is unknown")?;
    let mut command = Command::new(path);
    command.args(command_line.split(' ').skip(1));
    Ok(command)
}

fn serve_command(kind: ArmKind, address: &str) -> anyhow::Result<Command> {
    let mut command = this_program("fieldrig bench steering")?;
    let robot = format!("{}={address}", kind.name());
    command.args(["--serve", &robot]);
    Ok(command)
}

fn run_command(rig: &Path, out: &Path) -> anyhow::Result<Command> {
    let mut command = this_program(STEERED_RUN)?;
    command.arg(rig).arg("--out").arg(out);
    Ok(command)
}

impl Args {
    fn options(&self) -> anyhow::Result<SteeringOptions> {
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
        Ok(SteeringOptions {
            arms,
            faults,
            n_trials: self.trials,
            tracking_secs: self.tracking_seconds,
            n_poses: self.poses,
            n_grips: self.grips,
            n_goals: self.goals,
            views: self
                .views_rig
                .as_ref()
                .filter(|_| self.views > 0)
                .map(|rig| ViewOptions {
                    rig: rig.clone(),
                    n_views: self.views,
                    round_trip: Duration::from_secs_f64(1e-3 * self.views_round_trip),
                }),
            processes: Some(Processes {
                serve: serve_command,
                run: run_command,
            }),
            out: self.out.clone(),
        })
    }
}
