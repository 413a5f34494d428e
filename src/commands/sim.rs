//! `fieldrig sim`: emulates a rig's devices on the wire, for the drivers of `fieldrig run` or of
//! other programs.

use crate::exit::Exit;
use crate::number_args::number_in_range;
use std::path::PathBuf;

/// Flags of `sim`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Rig file to emulate (TOML), or a scene: static-arm or mobile-arm
    ///
    /// Each device is emulated in the way that its driver in the rig file expects: `franka` and
    /// `ur` as a controller at arm.address, `can` as motors on the buses of [arm.bus], `feetech`
    /// and `dynamixel` as servos on a pseudo terminal, `udp` as datagrams, `realsense` as a .bag
    /// file. Scenes include a rig file.
    rig_or_scene: String,
    /// Folder for the rig file to run against the emulated devices, the robot description and the
    /// camera recordings [default: sim-NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Length of the playback in seconds. After it, devices stand still until Ctrl-C. A 640x480
    /// RGB-D camera at 15 Hz writes 60 MB per second into the folder
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = number_in_range(0.1..=86_400.0))]
    seconds: f64,
    /// Play back this recording of the same rig instead of a simulation
    #[arg(long, value_name = "REC.mcap")]
    from: Option<PathBuf>,
    /// Delay before the playback starts, seconds. In this time, you can start the other program
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = number_in_range(0.1..=86_400.0))]
    start_in: f64,
    /// Version of FCI that the emulated Franka controller uses: 5 (Panda) or 10 (FR3)
    #[arg(long, value_name = "VERSION", default_value = "10", value_parser = ["5", "10"])]
    fci: String,
    /// Time for which the emulated Franka controller waits for each command during a motion,
    /// milliseconds. A real controller does not wait. With 15, a busy computer rarely causes a
    /// reflex
    #[arg(long, value_name = "MS", default_value_t = 0.0, value_parser = number_in_range(0.0..=1000.0))]
    answer_wait: f64,
    /// Print JSON, one object per line
    #[arg(long)]
    json: bool,
}

/// Simulates the rig, then emulates its devices until Ctrl-C.
#[cfg(all(feature = "sim", target_os = "linux"))]
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    emulated::run(args)
}

/// Reports that this build lacks the simulator.
#[cfg(not(all(feature = "sim", target_os = "linux")))]
pub(crate) fn run(_args: &Args) -> anyhow::Result<Exit> {
    anyhow::bail!(
        "this program was built without the simulator, which `fieldrig sim` needs: build it on Linux with \
         `cargo build --release --features sim`; for rigs with RealSense cameras, use `--features sim,realsense`"
    )
}

#[cfg(all(feature = "sim", target_os = "linux"))]
mod emulated;
