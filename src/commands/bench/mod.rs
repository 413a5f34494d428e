//! `fieldrig bench`: measures speed, accuracy over time and model size, memory use and robustness.

mod ablation;
mod budget;
mod calibration;
mod curve;
mod field;
mod kernels;
mod live;
mod memory;
mod run_flags;
mod runs_args;
mod stability;
mod stamps;
mod steering;

use crate::exit::Exit;
use clap::{Parser, Subcommand};

/// Flags of `bench`.
#[derive(Debug, Parser)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    /// Time of an image and of a training step on a synthetic cloud of splats, by image size and
    /// number of splats
    Kernels(kernels::Args),
    /// Time of a training step of a neural field on synthetic rays, by number of samples
    Field(field::Args),
    /// Test PSNR over training time with several seeds, optionally compared with other trainers
    Curve(curve::Args),
    /// Test PSNR over the number of splats, and the number that the trainer chooses
    Budget(budget::Args),
    /// Contribution of each part of the method, by training without it
    Ablation(ablation::Args),
    /// Test PSNR over the size of a disturbance of the training images, and its break points
    Stability(stability::Args),
    /// Errors of image stamps with jitter and clock drift, as a histogram
    Stamps(stamps::Args),
    /// Time from faults to the brake and to rest of steered arms, tracking of a hand, and rates of
    /// inverse kinematics
    Steering(steering::Args),
    /// Accuracy, reported uncertainty, speed and limits of calibration with and without a target
    Calibration(calibration::Args),
    /// Live runs with viewers: latency of pictures, time from shutter to model, and PSNR over time
    /// with right and wrong calibration
    Live(live::Args),
    /// Memory use of a long run by component, and its growth rate once the keyframe store is full
    Memory(memory::Args),
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
        BenchCommand::Steering(args) => steering::run(args),
        BenchCommand::Calibration(args) => calibration::run(args),
        BenchCommand::Live(args) => live::run(args),
        BenchCommand::Memory(args) => memory::run(args),
    }
}
