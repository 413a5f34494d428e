//! `fieldrig export`: converts models and recordings to formats of other programs.

use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::permission_args::PermissionArgs;
use crate::work_lines::WorkLines;
use crate::{print, signals};
use clap::builder::{PossibleValue, PossibleValuesParser};
use messages::listed;
use session::{CheckedExport, ExportPlan, NERFSTUDIO, RecordingExport, Written};
use std::collections::BTreeMap;
use std::path::PathBuf;
use trainer::ModelKind;
use trainer::method_entry::Export;

/// Flags of `export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A model folder, a splat file (.ply, .spz, .splat), or a recording (MCAP)
    #[arg(value_name = "MODEL|REC")]
    from: PathBuf,
    /// Output format
    #[arg(long, value_parser = PossibleValuesParser::new(formats()))]
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

/// The output formats of all methods and of recordings.
fn formats() -> Vec<PossibleValue> {
    let mut contents: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for export in exports() {
        contents
            .entry(export.format)
            .or_default()
            .push(export.contents);
    }
    let format = |(format, contents): (_, Vec<&str>)| {
        let contents = listed(&contents, "or");
        PossibleValue::new(format).help(format!("From a model: its {contents}, as .{format}"))
    };
    let nerfstudio = PossibleValue::new(NERFSTUDIO).help(
        "From a recording: a folder with PNG photos, 16-bit depth, and transforms.json with poses and split lists",
    );
    contents
        .into_iter()
        .map(format)
        .chain([nerfstudio])
        .collect()
}

/// The output formats of all methods.
fn exports() -> impl Iterator<Item = &'static Export> {
    ModelKind::ALL.iter().flat_map(|kind| kind.entry().exports)
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
