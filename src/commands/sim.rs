//! `fieldrig sim`: a rig's devices on the wire, for the drivers of `fieldrig run` or of anyone else.

use super::number_in_range;
use crate::exit::Exit;
use std::path::PathBuf;

/// Flags of `sim`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The rig to play (TOML), or a scene: static-arm or mobile-arm
    ///
    /// Each device is played as the rig file's driver expects it: `franka` as a controller on arm.address, `can` as motors on the
    /// buses of [arm.bus], `udp` as datagrams, `realsense` as a .bag file. Scenes bring rig files of their own.
    rig_or_scene: String,
    /// Folder for the rig file that plays against this, the robot's description and the recordings of cameras [default: sim-NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Seconds to play; then everything stands still until Ctrl-C (60 MB a second of an RGB-D camera of 640x480 at 15 Hz go into the folder)
    #[arg(long, value_name = "S", default_value_t = 60.0, value_parser = number_in_range(0.1..=86_400.0))]
    seconds: f64,
    /// Play this recording of the same rig instead of a simulation
    #[arg(long, value_name = "REC.mcap")]
    from: Option<PathBuf>,
    /// Seconds from when all is ready to when playing begins: time to start the other program
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = number_in_range(0.1..=86_400.0))]
    start_in: f64,
    /// Version of FCI that a Franka controller speaks: 5 (Panda) or 10 (FR3)
    #[arg(long, value_name = "VERSION", default_value = "10", value_parser = ["5", "10"])]
    fci: String,
    /// Print one JSON object a line
    #[arg(long)]
    json: bool,
}

/// Simulates the rig, then plays it until Ctrl-C.
#[cfg(all(feature = "sim", feature = "realsense", target_os = "linux"))]
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    emulation::run(args)
}

/// Simulates the rig, then plays it until Ctrl-C.
#[cfg(not(all(feature = "sim", feature = "realsense", target_os = "linux")))]
pub(crate) fn run(_args: &Args) -> anyhow::Result<Exit> {
    anyhow::bail!(
        "this program was built without the simulator or without RealSense cameras, whose files it plays: install the RealSense SDK, or \
         run scripts/fetch-realsense.sh, and build it on Linux with `cargo build --release --features sim,realsense`"
    )
}

#[cfg(all(feature = "sim", feature = "realsense", target_os = "linux"))]
mod bag;
#[cfg(all(feature = "sim", feature = "realsense", target_os = "linux"))]
mod emulation;
