//! `fieldrig fk`: forward kinematics of a robot.

use crate::print;
use capture::TipPoses;
use serde::Serialize;
use std::path::PathBuf;

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

/// The printed result.
#[derive(Debug, Serialize)]
struct Poses<'a> {
    tip: &'a str,
    /// `base_from_tip`, row major.
    poses: Vec<[f64; 16]>,
}

/// Prints the poses of all configurations as one JSON object.
pub(crate) fn run(args: Args) -> anyhow::Result<()> {
    let robot = TipPoses {
        urdf: args.urdf,
        tip: args.tip,
        base: args.base,
        joints: args.joints,
    };
    let poses = robot.compute()?;
    print::json(&Poses {
        tip: &robot.tip,
        poses,
    })
}
