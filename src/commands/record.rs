//! `fieldrig record`: writes everything that the devices send to a recording.

use crate::exit::{self, Exit};
use crate::number_args::number_in_range;
use crate::permission_args::PermissionArgs;
use crate::{print, signals};
use capture::{RecordPlan, WrittenRecording};
use std::path::PathBuf;

/// Flags of `record`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file: cameras and arm (TOML)
    rig_file: PathBuf,
    /// MCAP file to write; Foxglove and Lichtblick can open it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Simulate all devices of the rig file
    #[arg(long)]
    sim: bool,
    /// Simulate as fast as possible, without loss [default: real time]
    #[arg(long, requires = "sim")]
    lockstep: bool,
    /// Stop after S seconds of device time [default: until Ctrl-C or until the devices end;
    /// required with --lockstep, unless the rig file ends the simulation]
    #[arg(long, value_name = "S", value_parser = number_in_range(0.1..=1e7))]
    seconds: Option<f64>,
    #[command(flatten)]
    pub(crate) permissions: PermissionArgs,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Records, and prints the counts.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let stop = signals::stop_on_signals()?;
    let plan = RecordPlan {
        rig_file: args.rig_file.clone(),
        out: args.out.clone(),
        is_simulated: args.sim,
        is_lockstep: args.lockstep,
        seconds: args.seconds,
    };
    let bar = print::bar(None, "{spinner} {elapsed} {msg}", args.json);
    let written = plan.run(&stop, &mut |recorded| bar.set_message(recorded.summary()));
    bar.finish_and_clear();
    let WrittenRecording {
        recorded,
        data_losses,
    } = written?;
    if args.json {
        print::report_json(&recorded)?;
    } else {
        print::report(format_args!(
            "{:.1} s, {} in {}",
            recorded.seconds,
            recorded.summary(),
            args.out.display()
        ));
    }
    Ok(exit::from_losses(&data_losses))
}
