//! Poses of a robot's tip for joint values in a file.

use crate::known_robots::KnownRobot;
use crate::nearest_name::nearest_name;
use anyhow::{Context, bail, ensure};
use kinematics::urdf::{JointKind, Robot};
use kinematics::{Chain, transform};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// A robot, two of its links, and joint values.
#[derive(Clone, Debug)]
pub struct TipPoses {
    /// Robot description (URDF), or `builtin:NAME`.
    pub urdf: PathBuf,
    /// Link whose pose is computed.
    pub tip: String,
    /// Link in whose frame the poses are given; `None` for the root link.
    pub base: Option<String>,
    /// File with joint values (JSON).
    pub joints: PathBuf,
}

/// Contents of the joints file.
#[derive(Debug, Deserialize)]
struct JointsFile {
    joint_names: Vec<String>,
    configurations: Vec<Vec<f64>>,
}

impl TipPoses {
    /// The poses `base_from_tip` of all configurations, row major. Joint values outside of their
    /// limits only cause a warning.
    ///
    /// # Errors
    /// Fails if a file cannot be read, or if the robot has no such links or joints.
    pub fn compute(&self) -> anyhow::Result<Vec<[f64; 16]>> {
        let urdf = read_urdf(&self.urdf)?;
        let robot = Robot::parse(&urdf).with_context(|| self.urdf.display().to_string())?;
        let chain = self
            .chain(&robot)
            .with_context(|| self.urdf.display().to_string())?;
        for note in robot.notes() {
            log::warn!("{}: {note}", self.urdf.display());
        }
        let joints = read(&self.joints)?;
        poses(&robot, &chain, &joints).with_context(|| self.joints.display().to_string())
    }

    fn chain(&self, robot: &Robot) -> Result<Chain, kinematics::Error> {
        match &self.base {
            Some(base) => Chain::new(robot, base, &self.tip),
            None => Chain::new(robot, robot.root()?, &self.tip),
        }
    }
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
            let nearest = nearest_name(name, moving.map(|joint| joint.name.as_str()));
            let hint = nearest
                .map(|joint| format!("; did you mean {joint:?}?"))
                .unwrap_or_default();
            bail!("joint {name:?} is not in the URDF{hint}");
        }
    }
    Ok(())
}
