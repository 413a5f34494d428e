//! `fieldrig bench`: how fast, how good after how long, how large for how good, and how sturdy.

mod ablation;
mod budget;
mod curve;
mod field;
mod kernels;
mod memory;
mod stability;
mod stamps;

use crate::exit::Exit;
use clap::{Parser, Subcommand};
use trainer::gpu::PassTiming;

/// What to measure.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    /// Time of a picture and of a training step on a synthetic cloud of splats, by size and count
    Kernels(kernels::Args),
    /// Time of a training step of a neural field on synthetic rays, by number of samples
    Field(field::Args),
    /// PSNR of held-out images over seconds of training, several seeds each; peers' figures can be drawn in
    Curve(curve::Args),
    /// PSNR of held-out images over the number of splats, and what the trainer takes by itself
    Budget(budget::Args),
    /// What each part of the method brings, by training without it
    Ablation(ablation::Args),
    /// PSNR of held-out images over the size of a disturbance of the training images, and where it breaks
    Stability(stability::Args),
    /// How far from the shutter the stamps of images are that come late and by another clock, as a histogram
    Stamps(stamps::Args),
    /// Memory use of a long run by component, and its growth rate once the keyframe store is full
    Memory(memory::Args),
}

/// Names and milliseconds of passes, where they are asked for.
fn profile(passes: &[PassTiming], is_requested: bool) -> Vec<(&'static str, f64)> {
    if is_requested { passes.iter().map(|pass| (pass.name, pass.millis)).collect() } else { Vec::new() }
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    match &args.command {
        BenchCommand::Kernels(args) => kernels::run(args).map(|()| Exit::Done),
        BenchCommand::Field(args) => field::run(args).map(|()| Exit::Done),
        BenchCommand::Curve(args) => curve::run(args),
        BenchCommand::Budget(args) => budget::run(args),
        BenchCommand::Ablation(args) => ablation::run(args),
        BenchCommand::Stability(args) => stability::run(args),
        BenchCommand::Stamps(args) => stamps::run(args),
        BenchCommand::Memory(args) => memory::run(args),
    }
}
