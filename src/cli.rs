//! The subcommands and their `--help` summaries. The flags of each subcommand are at the top of its
//! own file.

use crate::commands::{
    bench, calibrate, devices, doctor, eval, export, fk, init, metrics, move_arm, preview, record,
    render, run, runs, schema, sim, train, view,
};
use crate::exit::Exit;
use crate::version;
use clap::{ArgAction, Parser, Subcommand};

/// Turns a robot's cameras and joints into a live radiance field.
#[derive(Debug, Parser)]
#[command(
    name = "fieldrig",
    version = version::SHORT,
    long_version = version::LONG,
    arg_required_else_help = true,
    max_term_width = 110,
    after_help = "Results go to stdout; the log and progress bars go to stderr.\n\
                  Exit codes: 0 done, 1 failed, 2 bad arguments, 3 done with loss, 4 insufficient data, 101 bug in fieldrig, \
                  130 interrupted by a second Ctrl-C, 128 + n ended by signal n.\n\
                  A loss is input data that is missing from the result: images that cannot be decoded, a damaged recording, \
                  or images that devices dropped while they were recorded. Without --record, run counts no dropped images, \
                  because later images replace them. Each loss is printed on stderr; train and run also list it in report.json. \
                  Output lines that could not be written count as losses, too."
)]
pub(crate) struct Cli {
    /// Log debug messages on stderr; repeat to log everything
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub(crate) verbose: u8,
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// The subcommand.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Train on live devices, a simulation or a recording; show the scene
    Run(run::Args),
    /// Show live images, the moving robot and the devices of a rig, without training
    Preview(preview::Args),
    /// Record all devices of a rig to an MCAP file
    Record(record::Args),
    /// Train a scene model on a dataset folder or a recording
    Train(train::Args),
    /// Show a saved model or a splat file in the browser
    View(view::Args),
    /// List the folders of runs, or remove them; replay steered runs
    Runs(runs::Args),
    /// Render images of a saved model
    Render(render::Args),
    /// Score a saved model on test images
    Eval(eval::Args),
    /// Compare two images
    Metrics(metrics::Args),
    /// Convert a model or a recording to formats of other programs
    Export(export::Args),
    /// Calibrate cameras: hand-eye, time offset, lens, joints
    Calibrate(calibrate::Args),
    /// Compute the pose of a robot's tip for given joint values
    Fk(fk::Args),
    /// Measure speed, accuracy, robustness and memory; draws charts
    Bench(bench::Args),
    /// Find the devices and the robot, and write a first rig file
    Init(init::Args),
    /// List the connected devices and whether this build can use them
    Devices(devices::Args),
    /// Check GPU, clocks, memory, permissions and devices; print fixes
    Doctor(doctor::Args),
    /// Print the JSON schema of rig files, for editors
    Schema(schema::Args),
    /// Emulate the devices of a rig: Franka, UR, CAN motors, servos, UDP, cameras
    Sim(sim::Args),
    /// Move an arm to joint positions, within its limits and under supervision
    Move(move_arm::Args),
}

impl Command {
    /// Whether only the owner may read the results. This is the default, because the results show
    /// where the robot was.
    pub(crate) fn is_private(&self) -> bool {
        let permissions = match self {
            Self::Run(args) => args.permissions,
            Self::Record(args) => args.permissions,
            Self::Train(args) => args.permissions,
            Self::Export(args) => args.permissions,
            _ => return false,
        };
        !permissions.public_files
    }

    /// Runs the command.
    pub(crate) fn run(self) -> anyhow::Result<Exit> {
        match self {
            Self::Run(args) => run::run(&args),
            Self::Preview(args) => preview::run(&args),
            Self::Record(args) => record::run(&args),
            Self::Train(args) => train::run(&args),
            Self::View(args) => view::run(&args),
            Self::Runs(args) => runs::run(&args),
            Self::Render(args) => render::run(&args),
            Self::Eval(args) => eval::run(&args),
            Self::Metrics(args) => metrics::run(args).map(|()| Exit::Done),
            Self::Export(args) => export::run(&args),
            Self::Calibrate(args) => calibrate::run(&args),
            Self::Fk(args) => fk::run(args).map(|()| Exit::Done),
            Self::Bench(args) => bench::run(&args),
            Self::Init(args) => init::run(&args),
            Self::Devices(args) => devices::run(&args),
            Self::Doctor(args) => doctor::run(&args),
            Self::Schema(args) => schema::run(&args).map(|()| Exit::Done),
            Self::Sim(args) => sim::run(&args),
            Self::Move(args) => move_arm::run(&args),
        }
    }
}
