//! `fieldrig export`: converts models and recordings to formats of other programs.

use anyhow::{ensure, Context};
use capture::{open, Join, SampleUse, Stations};
use capture::config::Override;
use crate::signals;
use crate::exit::{self, BadArgument, Exit};
use crate::open_gpu::open_gpu;
use crate::print::{self, counted};
use keyframe::{counted, KeyframeList};
use session::{run_folder, write_nerfstudio, Written};
use session::partial::{self, Partial};
use std::path::{Path, PathBuf};
use trainer::{splat_file, ModelKind};
use trainer::tsdf::TsdfModel;
use trainer::tsdf::mesh::{write_glb, write_ply, Mesh};

/// Flags of `export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A model folder, a splat file (.ply, .spz), or a recording (MCAP)
    #[arg(value_name = "MODEL|REC")]
    from: PathBuf,
    /// Output format
    #[arg(long, value_enum)]
    to: Format,
    /// File (ply, spz, glb) or folder (nerfstudio) to write; must not exist
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Simplify the mesh of a distance field to one vertex per cell of this width, meters
    #[arg(long, value_name = "M", value_parser = parse_cell_width)]
    cell_m: Option<f64>,
    /// Export exactly the keyframes of a recording that this `keyframes.txt` lists [default: those that a run would
    /// accept]
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
}

/// Output formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// From a model: its splats, or the mesh of a distance field, as .ply
    Ply,
    /// From a model: its splats as .spz, a tenth of the size of .ply; values are rounded
    Spz,
    /// From a distance field: its mesh as .glb, y up
    Glb,
    /// From a recording: a folder with PNG photos, 16-bit depth, and transforms.json with poses and split lists
    Nerfstudio,
}

impl Format {
    /// The file extension; `None` for a folder.
    fn extension(self) -> Option<&'static str> {
        match self {
            Self::Ply => Some("ply"),
            Self::Spz => Some("spz"),
            Self::Glb => Some("glb"),
            Self::Nerfstudio => None,
        }
    }
}

fn parse_cell_width(text: &str) -> Result<f64, String> {
    let width_m = text.parse().ok().filter(|width_m: &f64| *width_m > 0.0 && width_m.is_finite());
    width_m.ok_or_else(|| "expected a number above 0".to_owned())
}

/// What the input contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Contents {
    Splats,
    DistanceField,
    NeuralField,
    Recording,
}

/// Converts the model or recording and prints what was written. A truncated recording is a loss.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let contents = contents(&args.from)?;
    if args.cell_m.is_some() && contents != Contents::DistanceField {
        return Err(BadArgument(format!("--cell-m: {} has no mesh", args.from.display())).into());
    }
    check_file(args)?;
    signals::remove_partial_files_on_signals()?;
    match (args.to, contents) {
        (Format::Ply, Contents::Splats) => export_splats(&args.from, splat_file::Format::Ply, &args.out),
        (Format::Spz, Contents::Splats) => export_splats(&args.from, splat_file::Format::Spz, &args.out),
        (Format::Ply | Format::Glb, Contents::DistanceField) => export_mesh(args),
        (Format::Nerfstudio, Contents::Recording) => export_recording(args),
        (Format::Glb, Contents::Splats) => Err(unsupported("splats have no mesh; glb needs a distance field", args)),
        (Format::Spz, Contents::DistanceField) => {
            Err(unsupported("a distance field has no splats; export its mesh as ply or glb", args))
        }
        (_, Contents::NeuralField) => Err(unsupported("a neural field has neither splats nor a mesh", args)),
        (Format::Ply | Format::Spz | Format::Glb, Contents::Recording) => {
            Err(unsupported("this is a recording; splats and meshes are exported from a model", args))
        }
        (Format::Nerfstudio, _) => Err(unsupported("this is a model; nerfstudio is exported from a recording", args)),
    }
}

fn contents(path: &Path) -> anyhow::Result<Contents> {
    ensure!(path.exists(), BadArgument(format!("{} does not exist", path.display())));
    match trainer::kind_in(path)? {
        Some(ModelKind::Tsdf) => return Ok(Contents::DistanceField),
        Some(ModelKind::Nerf) => return Ok(Contents::NeuralField),
        Some(ModelKind::Splat) | None => {}
    }
    if splat_file::is_splat_file(path) {
        run_folder::expect_model(path)?;
        return Ok(Contents::Splats);
    }
    let sentence = "not a model folder, a splat file or a recording";
    ensure!(path.is_file(), BadArgument(format!("{}: {sentence}", path.display())));
    Ok(Contents::Recording)
}

/// Rejects an output file that exists or has the wrong extension.
fn check_file(args: &Args) -> Result<(), BadArgument> {
    let Some(extension) = args.to.extension() else { return Ok(()) };
    let out = args.out.display();
    if !args.out.extension().is_some_and(|actual| actual.eq_ignore_ascii_case(extension)) {
        return Err(BadArgument(format!("--out {out}: the file name must end in .{extension}")));
    }
    if args.out.exists() {
        return Err(BadArgument(format!("--out {out}: the file exists; choose another name")));
    }
    Ok(())
}

fn unsupported(sentence: &str, args: &Args) -> anyhow::Error {
    BadArgument(format!("{}: {sentence}", args.from.display())).into()
}

/// Exports the splats after validating them.
fn export_splats(model: &Path, format: splat_file::Format, out: &Path) -> anyhow::Result<Exit> {
    let splats = splat_file::read(model)?;
    let partial = Partial::file(out);
    splat_file::write(out, format, &splats)?;
    partial.keep();
    let n_splats = counted(splats.n_splats() as u64, "splat");
    print::report(format!("{n_splats} of color degree {} -> {}", splats.sh_degree, out.display()));
    Ok(Exit::Done)
}

/// Exports the mesh, extracted from the voxels.
fn export_mesh(args: &Args) -> anyhow::Result<Exit> {
    let mesh = TsdfModel::load(open_gpu()?, &args.from)?.mesh()?;
    let coarser = args.cell_m.map(|cell_m| mesh.clustered(cell_m));
    let written = coarser.as_ref().unwrap_or(&mesh);
    if let Some(cell_m) = args.cell_m
        && written.triangles.is_empty()
    {
        return Err(BadArgument(format!(
            "--cell-m {cell_m}: no triangles are left at this cell width; use a smaller one"
        ))
        .into());
    }
    let partial = Partial::file(&args.out);
    match args.to {
        Format::Glb => write_glb(&args.out, written)?,
        _ => write_ply(&args.out, written)?,
    }
    partial.keep();
    let triangles = |mesh: &Mesh| counted(mesh.triangles.len() as u64, "triangle");
    let replaced = if coarser.is_some() { format!(" instead of {}", triangles(&mesh)) } else { String::new() };
    print::report(format!("{}{replaced} -> {}", triangles(written), args.out.display()));
    Ok(Exit::Done)
}

fn export_recording(args: &Args) -> anyhow::Result<Exit> {
    let mut opened = open::recording(&args.from, None, &[Override::new("train.scale", 1.0)])?;
    let mut join = Join::new(&opened.rig)?;
    if let Some(list) = &args.keyframes {
        join = join.taking_only(KeyframeList::load(list)?);
    }
    let bar = print::bar(None, "{spinner} reading {pos} samples", false);
    while let Some(sample) = opened.source.next_sample()? {
        join.push(sample);
        bar.inc(1);
    }
    join.finish();
    bar.finish_and_clear();
    let missing_from_list = join.check_list()?;
    let mut keyframes: Vec<_> = join.keyframes().cloned().collect();
    if let Some(mut stations) = Stations::new(&opened.rig) {
        keyframes = stations.corrected(keyframes);
    }
    let written = write_nerfstudio(&args.out, keyframes.into_iter())
        .with_context(|| format!("cannot export {}", args.from.display()))?;
    log::info!("{}", join.counts());
    print::report(format!("{} -> {}", sentence(written), args.out.display()));
    let mut data_losses = join.counts().data_losses(SampleUse::ProcessedOnly);
    data_losses.extend(opened.damage.get().cloned());
    data_losses.extend(missing_from_list);
    Ok(exit::from_losses(&data_losses))
}

fn sentence(written: Written) -> String {
    let Written { n_images, n_depth, n_depth_skipped } = written;
    let skipped = match n_depth_skipped as u64 {
        0 => String::new(),
        n => format!(", {} skipped: their lens differs from that of their photo", counted(n, "depth image")),
    };
    format!("{}, {n_depth} of them with depth{skipped}", counted(n_images as u64, "photo"))
}
