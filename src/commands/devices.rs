//! `fieldrig devices`: lists connected devices, as reported by the kernel, with the values to use
//! in a rig file.

use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::{print, signals};
use capture::{DeviceInfo, DeviceWatch, found_devices};
use session::gpu_device;
use std::time::Duration;

/// Time between two looks at the kernel's lists of devices, which takes less than a millisecond. A
/// change is printed within two intervals.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);

/// Flags of `devices`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Keep running, and print a line for every device that is connected or disconnected, until
    /// Ctrl-C
    #[arg(
        long,
        long_help = "Keep running, and print a line for every device that is connected or disconnected, until Ctrl-C. With \
                     --json, each line has the key \"change\", \"connected\" or \"disconnected\", in addition to those of the \
                     device. Serial ports are searched for servos only when they appear"
    )]
    watch: bool,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Prints the devices, and then the changes if they are watched.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    if args.watch {
        let mut watch = DeviceWatch::start();
        print_devices(watch.known(), args)?;
        print_changes(&mut watch, args.json)?;
    } else {
        print_devices(&found_devices(), args)?;
    }
    Ok(Exit::Done)
}

fn print_devices(devices: &[DeviceInfo], args: &Args) -> anyhow::Result<()> {
    for device in std::iter::once(&gpu_device(open_gpu)).chain(devices) {
        print::json_or_lines(args.json, device, device.lines())?;
    }
    if !args.json {
        print::line(
            "Arms on the network (Franka's FCI, RTDE of Universal Robots) are not listed: `fieldrig doctor RIG.toml` checks the arm of a rig file.",
        )?;
    }
    Ok(())
}

/// Prints devices that appear or disappear until a signal requests a stop or the output is closed.
fn print_changes(watch: &mut DeviceWatch, as_json: bool) -> anyhow::Result<()> {
    let stop = signals::stop_on_signals_logging("stopping")?;
    signals::stop_when_output_closes(&stop)?;
    // This goes to stderr, so that stdout has only devices.
    print::notice("watching for devices that are connected or disconnected; Ctrl-C ends");
    while !stop.requested() {
        std::thread::sleep(LOOK_INTERVAL);
        for change in watch.look() {
            print::json_or_lines(as_json, &change, [&change])?;
        }
    }
    Ok(())
}
