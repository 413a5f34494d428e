//! `fieldrig fk`: forward kinematics of a robot.

use crate::print;
use anyhow::{Context, bail, ensure};
use capture::known_robots::KnownRobot;
use kinematics::urdf::{JointKind, Robot};
use kinematics::{Chain, transform};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Flags of `fk`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Robot description (URDF, already expanded from xacro; meshes are not read), or builtin:NAME
    urdf: PathBuf,
    /// Link whose pose is computed
    #[arg(long, value_name = "LINK")]
    tip: String,
    /// Link in whose frame the poses are given [default: the root link]
    #[arg(long, value_name = "LINK")]
    base: Option<String>,
    /// Joint values as JSON, `{"joint_names": ["j1", ...], "configurations": [[0.1, ...], ...]}`
    ///
    /// Values are in radians for revolute joints, and in meters for prismatic joints. The names may
    /// be in any order. Joints that do not move the tip, and joints that mimic others, may be
    /// included, but have no effect.
    #[arg(long, value_name = "FILE.json")]
    joints: PathBuf,
}

/// Contents of the joints file.
#[derive(Debug, Deserialize)]
struct JointsFile {
    joint_names: Vec<String>,
    configurations: Vec<Vec<f64>>,
}

/// The printed result.
#[derive(Debug, Serialize)]
struct Poses<'a> {
    tip: &'a str,
    /// `base_from_tip`, row major.
    poses: Vec<[f64; 16]>,
}

/// Prints the poses of all configurations as one JSON object.
pub(crate) fn run(args: Args) -> anyhow::Result<()> {
    let urdf = read_urdf(&args.urdf)?;
    let robot = Robot::parse(&urdf).with_context(|| args.urdf.display().to_string())?;
    let chain = chain(&robot, &args).with_context(|| args.urdf.display().to_string())?;
    for note in robot.notes() {
        log::warn!("{}: {note}", args.urdf.display());
    }
    let joints = read(&args.joints)?;
    let poses =
        poses(&robot, &chain, &joints).with_context(|| args.joints.display().to_string())?;
    print::json(&Poses {
        tip: &args.tip,
        poses,
    })
}

/// The text of a URDF file, or of a known robot that is named as in rig files.
fn read_urdf(urdf: &Path) -> anyhow::Result<String> {
    match KnownRobot::named_by(&urdf.to_string_lossy())? {
        Some(robot) => Ok(robot.urdf.to_owned()),
        None => read(urdf),
    }
}

fn read(path: &Path) -> anyhow::Result<String> {
    files::read_text(path).with_context(|| format!("cannot read {}", path.display()))
}

fn chain(robot: &Robot, args: &Args) -> Result<Chain, kinematics::Error> {
    match &args.base {
        Some(base) => Chain::new(robot, base, &args.tip),
        None => Chain::new(robot, robot.root()?, &args.tip),
    }
}

fn poses(robot: &Robot, chain: &Chain, joints: &str) -> anyhow::Result<Vec<[f64; 16]>> {
    let joints: JointsFile = serde_json::from_str(joints)?;
    check_names(robot, &joints.joint_names)?;
    let order = chain.order_in(&joints.joint_names)?;
    let n_names = joints.joint_names.len();
    let poses = joints
        .configurations
        .iter()
        .enumerate()
        .map(|(at, values)| {
            ensure!(
                values.len() == n_names,
                "configuration {at} (from 0) has {} values, joint_names has {n_names}",
                values.len()
            );
            let q: Vec<f64> = order.iter().map(|&column| values[column]).collect();
            let base_from_tip = chain
                .forward(&q)
                .with_context(|| format!("configuration {at} (from 0)"))?;
            Ok(transform::to_rows(&base_from_tip))
        })
        .collect::<anyhow::Result<_>>()?;
    // If there is an error, the warning is not needed. The warning therefore comes after all poses
    // are computed.
    warn_outside_limits(robot, &joints);
    Ok(poses)
}

/// Warns about the first value outside the limits of its joint, because it may be in degrees.
fn warn_outside_limits(robot: &Robot, joints: &JointsFile) {
    for (at, values) in joints.configurations.iter().enumerate() {
        for (name, value) in joints.joint_names.iter().zip(values) {
            // The names were checked before.
            let Some(limits) = robot.joint(name).map(|joint| joint.limits) else {
                continue;
            };
            if !(limits.lower..=limits.upper).contains(value) {
                let lower = limits.lower;
                let upper = limits.upper;
                log::warn!(
                    "configuration {at} (from 0): {name} is {value}, outside its limits {lower} to {upper} (radians or meters)"
                );
                return;
            }
        }
    }
}

fn check_names(robot: &Robot, names: &[String]) -> anyhow::Result<()> {
    for (at, name) in names.iter().enumerate() {
        // The name occurs twice, but only one of the two values could be used.
        ensure!(
            !names[..at].contains(name),
            "joint {name:?} is listed twice in joint_names"
        );
        if robot.joint(name).is_none() {
            let moving = robot
                .joints()
                .iter()
                .filter(|joint| joint.kind != JointKind::Fixed);
            let nearest = capture::nearest_name(name, moving.map(|joint| joint.name.as_str()));
            let hint = nearest
                .map(|joint| format!("; did you mean {joint:?}?"))
                .unwrap_or_default();
            bail!("joint {name:?} is not in the URDF{hint}");
        }
    }
    Ok(())
}
