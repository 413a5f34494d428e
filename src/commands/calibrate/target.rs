//! `fieldrig calibrate target`: writes a calibration target to print.

use super::target_argument;
use crate::print;
use calibrate::PrintedTargetTask;
use messages::EXAMPLE_TARGET;
use std::path::PathBuf;
use targets::TargetSpec;

const TARGET_HELP: &str = "Target to draw: chessboard:9x6:25mm (inner corners, square), charuco:5x7:34mm:26mm:5X5_100 \
     (squares, square, marker, dictionary), aprilgrid:6x6:20mm:0.3 (tags, tag, gap relative to the tag), \
     puzzleboard:12x9:20mm (squares, square) or tag:36h11:5:100mm (family, id, side)";

/// Flags of `calibrate target`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[arg(long, value_name = "SPEC", default_value = EXAMPLE_TARGET, value_parser = target_argument, help = TARGET_HELP)]
    target: TargetSpec,
    /// PDF file to write; must not exist
    #[arg(long, value_name = "FILE.pdf")]
    out: PathBuf,
    /// Paper: a4, a3, a2, a1, a0, letter, or a size such as 300x400mm
    #[arg(long, value_name = "PAPER", default_value = "a4")]
    paper: String,
}

/// Writes the PDF file.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let task = PrintedTargetTask {
        target: args.target.clone(),
        out: args.out.clone(),
        paper: args.paper.clone(),
    };
    Ok(print::line(task.run()?)?)
}
