//! `fieldrig preview`: shows live images, the moving robot and the devices of a rig.

use crate::exit::Exit;
use crate::page_args::PageArgs;
use crate::signals;
use serde_json::json;
use session::Preview;
use std::path::PathBuf;

const DETAILS: &str = "The page shows the images of every camera that opens, and the robot of the URDF, which moves \
    with its joints. It lists every device with its rate and the age of its newest sample. A device that cannot be \
    opened is listed with the reason, and is opened again every two seconds, so that you can plug it in while the page \
    is open. Nothing is trained, nothing is moved, and nothing is written.\n\n\
    The rig file may be incomplete: a camera without intrinsics or without its pose on the robot is shown as an image \
    only, a rig without an arm shows images only, and a rig without cameras shows the robot only.\n\n\
    Examples:\n  \
    fieldrig preview rig.toml                 devices of a rig, at http://127.0.0.1:7007\n  \
    fieldrig preview rig.toml --sim           the same rig, simulated\n  \
    fieldrig preview rig.toml --share         for other machines, encrypted and with a token";

/// Flags of `preview`.
#[derive(Debug, clap::Args)]
#[command(after_long_help = DETAILS)]
pub(crate) struct Args {
    /// Rig file: cameras and arm (TOML)
    rig_file: PathBuf,
    /// Simulate all devices of the rig file
    #[arg(long)]
    sim: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Print the address of the page as a JSON object
    #[arg(long)]
    json: bool,
}

/// Serves the page until Ctrl-C.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    args.page.check()?;
    let stop = signals::stop_on_signals_logging("closing the devices; Ctrl-C again exits at once")?;
    let preview = Preview::of_rig_file(&args.rig_file, args.sim)?;
    let page = args.page.serve_or_free_port(preview.hub())?;
    args.page.announce(&page, args.json, json!({}))?;
    preview.serve(&stop)?;
    Ok(Exit::Done)
}
