//! `fieldrig export`: converts models and recordings to formats of other programs.

use crate::exit::{self, Exit};
use crate::open_gpu::open_gpu;
use crate::permission_args::PermissionArgs;
use crate::work_lines::WorkLines;
use crate::{print, signals};
use anyhow::{Context, ensure};
use clap::builder::{PossibleValue, PossibleValuesParser};
use messages::{BadInput, Setting, counted, listed};
use session::{RecordingExport, Written, methods, run_folder};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use trainer::ModelKind;
use trainer::method_entry::{Export, ExportRequest, ExportWriter, Exported};

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

/// The output format for recordings: a folder.
const NERFSTUDIO: &str = "nerfstudio";

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

/// What the input contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Contents {
    Model(ModelKind),
    Recording,
}

/// Converts the model or recording and prints what was written. A truncated recording is a loss.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let contents = contents(&args.from)?;
    let has_cells = |kind: ModelKind| kind.entry().exports.iter().any(|export| export.has_cells);
    // A flag without an effect is probably a mistake of the user, so it is an error.
    if args.cell_m.is_some() && !matches!(contents, Contents::Model(kind) if has_cells(kind)) {
        return Err(BadInput(format!("--cell-m: {} has no mesh", args.from.display())).into());
    }
    // This is checked before the model is loaded, because loading may take long.
    check_file(args)?;
    signals::remove_partial_files_on_signals()?;
    match (contents, &*args.to) {
        (Contents::Recording, NERFSTUDIO) => export_recording(args),
        (Contents::Recording, _) => Err(unsupported(
            "this is a recording; splats and meshes are exported from a model",
            args,
        )),
        (Contents::Model(_), NERFSTUDIO) => Err(unsupported(
            "this is a model; nerfstudio is exported from a recording",
            args,
        )),
        (Contents::Model(kind), format) => match kind
            .entry()
            .exports
            .iter()
            .find(|export| export.format == format)
        {
            Some(export) => export_model(export, args),
            None => Err(unsupported(&describe_exports(kind, format), args)),
        },
    }
}

/// Why a model cannot be exported to a format.
fn describe_exports(kind: ModelKind, format: &str) -> String {
    let formats: Vec<&str> = kind
        .entry()
        .exports
        .iter()
        .map(|export| export.format)
        .collect();
    let model = kind.entry().model;
    if formats.is_empty() {
        return format!("{model} cannot be exported");
    }
    format!(
        "{model} cannot be exported as {format}, only as {}",
        listed(&formats, "or")
    )
}

fn contents(path: &Path) -> anyhow::Result<Contents> {
    ensure!(
        path.exists(),
        BadInput(format!("{} does not exist", path.display()))
    );
    if let Some(kind) = methods::kind_of(path)? {
        run_folder::expect_model(path)?;
        return Ok(Contents::Model(kind));
    }
    let sentence = "not a model folder, a splat file or a recording";
    ensure!(
        path.is_file(),
        BadInput(format!("{}: {sentence}", path.display()))
    );
    Ok(Contents::Recording)
}

/// Rejects an output file that exists or has the wrong extension.
fn check_file(args: &Args) -> Result<(), BadInput> {
    let extension = &args.to;
    // This output is a folder.
    if extension == NERFSTUDIO {
        return capture::check_output_folder(Setting::Out, &args.out);
    }
    let out = args.out.display();
    if !args
        .out
        .extension()
        .is_some_and(|actual| actual.eq_ignore_ascii_case(extension))
    {
        return Err(BadInput(format!(
            "--out {out}: the file name must end in .{extension}"
        )));
    }
    if args.out.exists() {
        return Err(BadInput(format!(
            "--out {out}: the file exists; choose another name"
        )));
    }
    capture::check_output_file(Setting::Out, &args.out)
}

fn unsupported(sentence: &str, args: &Args) -> anyhow::Error {
    BadInput(format!("{}: {sentence}", args.from.display())).into()
}

/// Exports a model.
fn export_model(export: &Export, args: &Args) -> anyhow::Result<Exit> {
    let exported = files::create_from(&args.out, |out| write_export(export, args, out));
    let Exported {
        n_items,
        item,
        detail,
    } = exported.with_context(|| format!("cannot write {}", args.out.display()))?;
    let separator = if detail.is_empty() { "" } else { " " };
    print::report(format!(
        "{}{separator}{detail} -> {}",
        counted(n_items, item),
        args.out.display()
    ));
    Ok(Exit::Done)
}

/// Writes a model to the file `out`, which is renamed when it is complete.
fn write_export(export: &Export, args: &Args, out: &Path) -> anyhow::Result<Exported> {
    let request = ExportRequest {
        model: &args.from,
        out,
        cell_m: args.cell_m,
    };
    let exported = match export.write {
        ExportWriter::Cpu(write) => write(&request),
        ExportWriter::Gpu(write) => write(open_gpu()?, &request),
    };
    exported.map_err(|error| match error {
        // The cell width is an argument, so the user can try another width.
        trainer::Error::EmptyMesh { cell_m } => anyhow::Error::new(BadInput(format!(
            "--cell-m {cell_m}: no triangles are left at this cell width; use a smaller one"
        ))),
        error => error.into(),
    })
}

fn export_recording(args: &Args) -> anyhow::Result<Exit> {
    let export = RecordingExport {
        recording: args.from.clone(),
        rig: args.rig.clone(),
        keyframes: args.keyframes.clone(),
        out: args.out.clone(),
    };
    let bar = print::bar(None, "{spinner} reading {pos} samples", false);
    let _lines = bar
        .is_hidden()
        .then(|| WorkLines::new("reading the recording"));
    let exported = export.run(&mut || bar.inc(1));
    bar.finish_and_clear();
    let (written, data_losses) = exported?;
    print::report(format!("{} -> {}", sentence(written), args.out.display()));
    Ok(exit::from_losses(&data_losses))
}

fn sentence(written: Written) -> String {
    let Written {
        n_images,
        n_depth,
        n_depth_skipped,
    } = written;
    let skipped = match n_depth_skipped as u64 {
        0 => String::new(),
        n => format!(
            ", {} skipped: their lens differs from the lens of the photo",
            counted(n, "depth image")
        ),
    };
    format!(
        "{}, {n_depth} of them with depth{skipped}",
        counted(n_images as u64, "photo")
    )
}
