//! `fieldrig calibrate`: calibrates cameras, with a printed target or from images of any static
//! scene.

mod flags;
mod hand_eye;
mod intrinsics;
mod scene;
mod target;
mod terminal;
mod time_offset;

use crate::exit::Exit;
use clap::{Parser, Subcommand};
use targets::TargetSpec;

/// Flags of `calibrate`.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: CalibrateCommand,
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Write a calibration target to print
    Target(target::Args),
    /// Estimate the lens of a camera from images of a target
    Intrinsics(intrinsics::Args),
    /// Estimate the pose of a camera on a robot from robot poses and images of a target
    HandEye(hand_eye::Args),
    /// Estimate the offset between the clocks of two pose streams, and the transform between their
    /// bodies
    TimeOffset(time_offset::Args),
    /// Estimate hand-eye transforms, time offsets, lenses, joint offsets and depth errors of a rig
    /// from images of a static scene, without a target
    Scene(scene::Args),
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    match &args.command {
        CalibrateCommand::Target(args) => target::run(args).map(|()| Exit::Done),
        CalibrateCommand::Intrinsics(args) => intrinsics::run(args),
        CalibrateCommand::HandEye(args) => hand_eye::run(args),
        CalibrateCommand::TimeOffset(args) => time_offset::run(args),
        CalibrateCommand::Scene(args) => scene::run(args),
    }
}

/// Parses the specification of a target.
fn target_argument(text: &str) -> Result<TargetSpec, String> {
    text.parse()
        .map_err(|error: targets::SpecError| error.to_string())
}
