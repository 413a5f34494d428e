//! `fieldrig move`: moves an arm to given joint positions, within its limits, under supervision.

use crate::exit::Exit;
use crate::{print, signals};
use anyhow::bail;
use capture::config::Rig;
use capture::{Arrival, HOLDING, RequestedMotion, Stop, SupervisedArm, format_positions, open};
use drivers::clock;
use drivers::motion::{JointTarget, OnLoss};
use indicatif::ProgressBar;
use kinematics::JointState;
use std::path::PathBuf;

/// Flags of `move`.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("what").required(true).multiple(true).args(["to", "by", "recover"]))]
pub(crate) struct Args {
    /// Rig file with the arm (TOML); its table [arm.motion] defines how the arm may be moved
    rig_file: PathBuf,
    /// Target positions of all joints in the order of arm.joints, rad or m: 0,-0.5,0,-2.0,0,1.8,0.7
    #[arg(
        long,
        value_name = "Q,Q,...",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "by"
    )]
    to: Option<Vec<f64>>,
    /// Move this joint by this much from its current position, rad or m; can be repeated for other
    /// joints
    #[arg(long, value_name = "JOINT=DELTA", value_parser = delta)]
    by: Vec<(String, f64)>,
    /// Recover an arm that has stopped, before any motion. Inspect the arm first
    #[arg(long)]
    recover: bool,
    /// Confirm the motion: nobody is within reach of the arm, and a hand is on the emergency stop
    #[arg(long, required = true)]
    enable_motion: bool,
    /// Exit as soon as the arm has arrived, even if its motors then release it or only damp its
    /// motion
    #[arg(long)]
    exit_on_arrival: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

fn delta(text: &str) -> Result<(String, f64), String> {
    let parsed = text
        .split_once('=')
        .and_then(|(joint, delta)| Some((joint.to_owned(), delta.parse().ok()?)));
    parsed
        .filter(|(_, delta): &(String, f64)| delta.is_finite())
        .ok_or_else(|| "expected JOINT=DELTA, such as joint1=0.1".to_owned())
}

/// Moves the arm, then holds it if its motors would release it on exit.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    // Signals are handled before the arm is enabled, so that Ctrl-C never leaves a moving arm.
    let stop = signals::stop_on_signals_logging(
        "bringing the arm to rest; Ctrl-C again applies on_loss at once",
    )?;
    signals::stop_when_output_closes(&stop)?;
    let rig = Rig::load(&args.rig_file, &[])?;
    let motion = open::motion_of(&rig)?;
    let requested = RequestedMotion {
        to: args.to.clone(),
        by: args.by.clone(),
    };
    requested.check(&rig)?;
    let mut arm = SupervisedArm::new(open::movable_arm(&rig)?, &rig);
    let bar = print::bar(None, "{spinner} {elapsed} {msg}", args.json);
    // An arm with an error accepts no target, so it is recovered first.
    if args.recover {
        arm.recover()?;
        log::info!("the arm has recovered");
    }
    let initial = arm.read()?;
    if !requested.is_empty() {
        let target = requested.start(&mut arm, &rig, &initial)?;
        let began = clock::now();
        let last = follow(&mut arm, &target, &stop, &bar).inspect_err(|error| {
            if args.json {
                // Output errors are ignored: the arm's error is returned.
                let _ = print::report_json(
                    &serde_json::json!({ "event": "stopped", "reason": format!("{error:#}") }),
                );
            }
        })?;
        let arrival = Arrival::new(&rig.arm.joints, &target, &last, began);
        if args.json {
            print::report_json(&arrival)?;
        } else {
            print::report(arrival.line());
        }
    }
    // The arm is held, because the motors would otherwise release it when this program ends.
    if motion.on_loss != OnLoss::Hold && !args.exit_on_arrival {
        log::info!("{HOLDING}");
        arm.hold(&stop, |state| {
            bar.set_message(format!("held at {}", format_positions(&state.position)))
        })?;
    }
    bar.finish_and_clear();
    Ok(Exit::Done)
}

/// Waits until the arm arrives. Ctrl-C stops the arm and returns an error.
fn follow(
    arm: &mut SupervisedArm,
    target: &JointTarget,
    stop: &Stop,
    bar: &ProgressBar,
) -> anyhow::Result<JointState> {
    let target = format_positions(&target.position);
    let end = arm.follow(stop, |state| {
        bar.set_message(format!(
            "at {} of {target}",
            format_positions(&state.position)
        ));
    })?;
    if !end.has_arrived {
        bail!(
            "stopped before the target, at {}",
            format_positions(&end.state.position)
        );
    }
    Ok(end.state)
}
