//! `fieldrig export`: converts models and recordings to formats of other programs.

use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::permission_args::PermissionArgs;
use crate::work_lines::WorkLines;
use crate::{print, signals};
use clap::builder::{PossibleValue, PossibleValuesParser};
use session::{CheckedExport, ExportPlan, RecordingExport, Written, export_formats};
use std::path::PathBuf;

/// Flags of `export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A model folder, a splat file (.ply, .spz, .splat), or a recording (MCAP)
    #[arg(value_name = "MODEL|REC")]
    from: PathBuf,
    /// Output format
    #[arg(long, value_parser = format_parser())]
    to: String,
    /// File (ply, spz, glb) or folder (nerfstudio) to write; must not exist
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Simplify the mesh of a distance field to one vertex per cell of this width, meters
    #[arg(long, value_name = "M", value_parser = parse_cell_width)]
    cell_m: Option<f64>,
    /// Export exactly the keyframes that this `keyframes.txt` lists [default: the keyframes that a
    /// run would accept]
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
    /// Use this rig file instead of the rig file in the recording
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) permissions: PermissionArgs,
}

/// The names of the output formats, with descriptions.
fn format_parser() -> PossibleValuesParser {
    let value = |(name, description)| PossibleValue::new(name).help(description);
    PossibleValuesParser::new(export_formats().into_iter().map(value))
}

fn parse_cell_width(text: &str) -> Result<f64, String> {
    let width_m = text
        .parse()
        .ok()
        .filter(|width_m: &f64| *width_m > 0.0 && width_m.is_finite());
    width_m.ok_or_else(|| "expected a number above 0".to_owned())
}

/// Converts the model or recording and prints what was written. A truncated recording is a loss.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let plan = ExportPlan {
        from: args.from.clone(),
        format: args.to.clone(),
        out: args.out.clone(),
        cell_m: args.cell_m,
        keyframes: args.keyframes.clone(),
        rig: args.rig.clone(),
    };
    let checked = plan.check()?;
    signals::remove_partial_files_on_signals()?;
    let (written, data_losses) = match checked {
        CheckedExport::Model(export) => (export.run(open_gpu)?, Vec::new()),
        CheckedExport::Recording(export) => {
            let (written, data_losses) = export_recording(&export)?;
            (written.to_string(), data_losses)
        }
    };
    print::report(format!("{written} -> {}", args.out.display()));
    Ok(exit::from_losses(&data_losses))
}

fn export_recording(export: &RecordingExport) -> anyhow::Result<(Written, Vec<String>)> {
    let bar = print::bar(None, "{spinner} reading {pos} samples", false);
    let _lines = bar
        .is_hidden()
        .then(|| WorkLines::new("reading the recording"));
    let exported = export.run(&mut || bar.inc(1));
    bar.finish_and_clear();
    exported
}
