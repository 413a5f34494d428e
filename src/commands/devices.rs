//! `fieldrig devices`: lists connected devices, as reported by the kernel, with the values to use
//! in a rig file.

use crate::exit::Exit;
use crate::open_gpu::open_gpu;
use crate::print;
use capture::{DeviceInfo, found_devices};

/// Flags of `devices`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Prints the devices.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    for device in std::iter::once(gpu()).chain(found_devices()) {
        if args.json {
            print::json(&device)?;
        } else {
            let label = if device.usable { "yes" } else { "no " };
            print::line(format_args!(
                "{label}  {:10} {:14} {}",
                device.kind, device.address, device.name
            ))?;
            print::line(format_args!("     {}", device.note))?;
        }
    }
    if !args.json {
        print::line(
            "Arms on the network (Franka's FCI, RTDE of Universal Robots) are not listed: `fieldrig doctor RIG.toml` checks the arm of a rig file.",
        )?;
    }
    Ok(Exit::Done)
}

fn gpu() -> DeviceInfo {
    let (name, usable, note) = match open_gpu() {
        Ok(gpu) if gpu.is_software() => (
            gpu.describe(),
            true,
            "software adapter: works, but slowly".to_owned(),
        ),
        Ok(gpu) => (gpu.describe(), true, "trains and renders".to_owned()),
        Err(error) => ("none".to_owned(), false, error.to_string()),
    };
    DeviceInfo {
        kind: "gpu",
        address: "default".into(),
        name,
        usable,
        note,
    }
}
