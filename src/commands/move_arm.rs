//! `fieldrig move`: moves an arm to given joint positions, within its limits, under supervision.

use crate::exit::{BadArgument, Exit};
use crate::{print, signals};
use anyhow::{Context, bail};
use capture::config::Rig;
use capture::{Stop, open};
use drivers::motion::{JointTarget, Motion, OnLoss};
use drivers::{Error, MovableArm, clock};
use indicatif::ProgressBar;
use kinematics::{JointState, Stamp};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// A target may exceed the joint range by this much, rad or m.
const TOLERANCE_RAD: f64 = 1e-4;
/// How often Ctrl-C is checked.
const POLL: Duration = Duration::from_millis(50);
/// A movable arm that reports nothing for this long counts as lost.
const MAX_SILENCE: Duration = Duration::from_secs(2);

/// Flags of `move`.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("what").required(true).multiple(true).args(["to", "by", "recover"]))]
pub(crate) struct Args {
    /// Rig file with the arm (TOML); its table [arm.motion] defines how the arm may be moved
    rig_file: PathBuf,
    /// Target positions of all joints in the order of arm.joints, rad or m: 0,-0.5,0,-2.0,0,1.8,0.7
    #[arg(long, value_name = "Q,Q,...", value_delimiter = ',', allow_hyphen_values = true, conflicts_with = "by")]
    to: Option<Vec<f64>>,
    /// Move this joint by this much from its current position, rad or m; can be repeated for other joints
    #[arg(long, value_name = "JOINT=DELTA", value_parser = delta)]
    by: Vec<(String, f64)>,
    /// Recover an arm that has stopped, before any motion; inspect the arm first
    #[arg(long)]
    recover: bool,
    /// Confirm the motion: nobody is within reach of the arm, and a hand is on the emergency stop
    #[arg(long, required = true)]
    enable_motion: bool,
    /// Exit as soon as the arm has arrived, even if its motors then release it or only damp its motion
    #[arg(long)]
    exit_on_arrival: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

fn delta(text: &str) -> Result<(String, f64), String> {
    let parsed = text.split_once('=').and_then(|(joint, delta)| Some((joint.to_owned(), delta.parse().ok()?)));
    parsed
        .filter(|(_, delta): &(String, f64)| delta.is_finite())
        .ok_or_else(|| "expected JOINT=DELTA, such as joint1=0.1".to_owned())
}

/// Report of an arrival.
#[derive(Debug, Serialize)]
struct ArrivedEvent<'a> {
    event: &'static str,
    joints: &'a [String],
    /// Target, and the position that the joints report, rad or m.
    target: &'a [f64],
    position: &'a [f64],
    /// Largest absolute difference between the two.
    error: f64,
    seconds: f64,
}

/// Moves the arm, then holds it if its motors would release it on exit.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let stop = signals::stop_on_signals()?;
    let rig = Rig::load(&args.rig_file, &[])?;
    let Some(motion) = rig.arm.motion.as_ref() else {
        return Err(BadArgument(
            "the rig file has no table [arm.motion], so its arm is only read: see docs/guide/moving-arms.md".to_owned(),
        )
        .into());
    };
    check(args, &rig)?;
    let arm = open::movable_arm(&rig)?;
    let mut offsets = rig.arm.joint_offsets.clone();
    offsets.resize(rig.arm.joints.len(), 0.0);
    let mut mover = Mover { arm, offsets, stop, bar: print::bar(None, "{spinner} {elapsed} {msg}", args.json) };
    if args.recover {
        mover.arm.recover()?;
        log::info!("the arm has recovered");
    }
    let initial = mover.read()?;
    if args.to.is_some() || !args.by.is_empty() {
        let requested = target(args, &rig.arm.joints, &initial);
        check_range(&rig, &requested, &initial)?;
        let target = mover.command(&requested)?;
        for (joint, (requested, accepted)) in rig.arm.joints.iter().zip(requested.position.iter().zip(&target.position))
        {
            if (requested - accepted).abs() > TOLERANCE_RAD {
                log::warn!("joint {joint:?} moves to {accepted:.4}, the limit of its range, instead of {requested:.4}");
            }
        }
        let began = clock::now();
        let last = mover.follow(&target).inspect_err(|error| {
            if args.json {
                // Output errors are ignored: the arm's error is returned.
                let _ = print::report_json(&serde_json::json!({ "event": "stopped", "reason": format!("{error:#}") }));
            }
        })?;
        report_arrival(args, &rig.arm.joints, &target, &last, began)?;
    }
    if motion.on_loss != OnLoss::Hold && !args.exit_on_arrival {
        log::info!("holding the arm; support it before you press Ctrl-C, because the motors then no longer hold it");
        mover.hold()?;
    }
    mover.bar.finish_and_clear();
    Ok(Exit::Done)
}

/// Checks the arguments against the rig file, before any device is opened.
fn check(args: &Args, rig: &Rig) -> Result<(), BadArgument> {
    let joints = &rig.arm.joints;
    if let Some(to) = args.to.as_ref().filter(|to| to.len() != joints.len()) {
        let (n, names) = (to.len(), joints.join(", "));
        return Err(BadArgument(format!("--to has {n} positions, the arm has {} joints: {names}", joints.len())));
    }
    if let Some((joint, _)) = args.by.iter().find(|(joint, _)| !joints.contains(joint)) {
        let available = if joints.is_empty() { "none".to_owned() } else { joints.join(", ") };
        return Err(BadArgument(format!("--by: unknown joint {joint:?}; joints of the arm: {available}")));
    }
    Ok(())
}

/// Rejects a target outside the joint ranges of the URDF, so that a typing error does not move an arm to its limits. A
/// joint that is already outside its range may stay there.
fn check_range(rig: &Rig, requested: &JointTarget, now: &JointState) -> anyhow::Result<()> {
    let chain = open::chain_of(rig)?;
    for (ix, joint) in rig.arm.joints.iter().enumerate() {
        let Some(joint_ix) = chain.joint_names().iter().position(|known| known == joint) else { continue };
        let (lower, upper) = (chain.limits()[joint_ix].lower, chain.limits()[joint_ix].upper);
        let (requested, now) = (requested.position[ix], now.position[ix]);
        if (requested - now).abs() > TOLERANCE_RAD
            && !(lower - TOLERANCE_RAD..=upper + TOLERANCE_RAD).contains(&requested)
        {
            return Err(BadArgument(format!(
                "joint {joint:?}: target {requested:.4} is outside its range of {lower:.4} to {upper:.4}; the joint is at {now:.4}, and nothing was moved"
            ))
            .into());
        }
    }
    Ok(())
}

fn target(args: &Args, joints: &[String], now: &JointState) -> JointTarget {
    let mut position = args.to.clone().unwrap_or_else(|| now.position.clone());
    for (joint, delta) in &args.by {
        let moved = joints.iter().zip(&mut position).find(|(name, _)| *name == joint);
        if let Some((_, position)) = moved {
            *position += delta;
        }
    }
    JointTarget { position }
}

fn report_arrival(
    args: &Args,
    joints: &[String],
    target: &JointTarget,
    last: &JointState,
    began: Stamp,
) -> anyhow::Result<()> {
    let errors = target.position.iter().zip(&last.position).map(|(target, actual)| (target - actual).abs());
    let (error, seconds) = (errors.fold(0.0, f64::max), clock::now().secs_since(began));
    if args.json {
        let (target, position) = (&target.position[..], &last.position[..]);
        return print::report_json(&ArrivedEvent { event: "done", joints, target, position, error, seconds });
    }
    print::report(format_args!(
        "arrived after {seconds:.1} s at {}, maximum error {error:.5}",
        format_positions(&last.position)
    ));
    Ok(())
}

fn format_positions(position: &[f64]) -> String {
    position.iter().map(|position| format!("{position:.4}")).collect::<Vec<_>>().join(", ")
}

/// The arm and the state for supervising it.
struct Mover {
    arm: Box<dyn MovableArm>,
    /// Joint offsets, added to the reported positions as in all other commands.
    offsets: Vec<f64>,
    stop: Stop,
    bar: ProgressBar,
}

impl Mover {
    /// Reads the next joint state. Fails if the arm has stopped on its own or reports nothing.
    fn read(&mut self) -> anyhow::Result<JointState> {
        let deadline = clock::now().plus_secs(MAX_SILENCE.as_secs_f64());
        loop {
            let state = self.arm.read(POLL);
            if let Motion::Stopped { reason } = self.arm.motion() {
                bail!("the arm stopped: {reason}. Inspect it, then recover it with --recover");
            }
            match state {
                Err(Error::NoJoints { .. }) if clock::now() < deadline => {}
                state => {
                    let mut state = state?;
                    state.position.iter_mut().zip(&self.offsets).for_each(|(position, offset)| *position += offset);
                    return Ok(state);
                }
            }
        }
    }

    /// Sends a target; returns it as clamped to the limits.
    fn command(&mut self, requested: &JointTarget) -> Result<JointTarget, Error> {
        let with_offsets = |target: &JointTarget, sign: f64| JointTarget {
            position: target
                .position
                .iter()
                .zip(&self.offsets)
                .map(|(position, offset)| position + sign * offset)
                .collect(),
        };
        let accepted = self.arm.command(&with_offsets(requested, -1.0))?;
        Ok(with_offsets(&accepted, 1.0))
    }

    /// Waits until the arm arrives. Ctrl-C stops the arm and returns an error.
    fn follow(&mut self, target: &JointTarget) -> anyhow::Result<JointState> {
        loop {
            let state = self.read()?;
            if self.arm.motion() == Motion::Holding {
                return Ok(state);
            }
            self.bar.set_message(format!(
                "at {} of {}",
                format_positions(&state.position),
                format_positions(&target.position)
            ));
            if self.stop.requested() {
                self.arm.stop().context("cannot stop the arm")?;
                while self.arm.motion() == Motion::Moving {
                    self.read()?;
                }
                bail!("stopped before the target, at {}", format_positions(&self.read()?.position));
            }
        }
    }

    /// Holds the arm in place until Ctrl-C.
    fn hold(&mut self) -> anyhow::Result<()> {
        while !self.stop.requested() {
            let state = self.read()?;
            self.bar.set_message(format!("held at {}", format_positions(&state.position)));
        }
        Ok(())
    }
}
