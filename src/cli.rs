//! The commands and what `--help` says of them; each command's flags stand at the head of its own file.

use crate::commands::{
    bench, devices, doctor, eval, export, fk, metrics, move_arm, record, render, run, sim, train, view,
};
use clap::{ArgAction, Parser, Subcommand};

/// Turns a robot's cameras and joints into a live radiance field.
#[derive(Debug, Parser)]
#[command(
    name = "fieldrig",
    version,
    arg_required_else_help = true,
    max_term_width = 110,
    after_help = "Results go to stdout, log and progress to stderr.\n\
                  Exit codes: 0 done, 1 failed, 2 bad arguments, 3 done with loss, 4 refused for lack of evidence.\n\
                  A loss is data that came, or should have come, and is not in the result: images that devices lost or that \
                  do not decode, recordings cut off. Each is named on stderr and, by train and run, in report.json. \
                  Output lines that could not be written are losses, too."
)]
pub(crate) struct Cli {
    /// Say more on stderr; twice for everything
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub(crate) verbose: u8,
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Build a scene model while the robot looks around, and show it in the browser
    Run(run::Args),
    /// Write what a rig's devices say to a recording
    Record(record::Args),
    /// Train a scene model on a dataset folder or a recording
    Train(train::Args),
    /// Show a saved model or a file of splats in the browser
    View(view::Args),
    /// Draw pictures from a saved model
    Render(render::Args),
    /// Score a saved model on test images
    Eval(eval::Args),
    /// Compare two pictures
    Metrics(metrics::Args),
    /// Write a model or a recording in the formats of other programs
    Export(export::Args),
    /// Compute where a robot's tip is for given joint values
    Fk(fk::Args),
    /// Measure speed, accuracy over time and size, and what disturbances cost; draws charts
    Bench(bench::Args),
    /// List what is plugged in and what of it can be used
    Devices(devices::Args),
    /// Check GPU, clocks, memory and permissions, and name the line that mends what is amiss
    Doctor(doctor::Args),
    /// Play a rig's devices on the wire: controller, CAN motors, datagrams, camera files
    Sim(sim::Args),
    /// Move an arm to given joint positions, within its limits, while a person watches
    Move(move_arm::Args),
}
