//! `fieldrig calibrate`: calibrates cameras, with a printed target or from images of any static scene.

mod scene;

use crate::exit::Exit;
use clap::{Parser, Subcommand};

/// Flags of `calibrate`.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: CalibrateCommand,
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Hand-eye transform, time offset, lens, joint and depth errors of a rig from images of a static scene, without a
    /// target
    Scene(scene::Args),
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    match &args.command {
        CalibrateCommand::Scene(args) => scene::run(args),
    }
}
