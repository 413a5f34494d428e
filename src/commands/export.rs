//! `fieldrig export`: models and recordings in the formats of other programs.

use crate::config::Override;
use crate::exit::{self, BadArgument, Exit};
use crate::export::{Written, write_nerfstudio};
use crate::join::{Join, KeyframeList, Use};
use crate::method::{self, Kind};
use crate::open;
use crate::print::{self, counted};
use crate::splat_file;
use crate::stands::Stands;
use anyhow::{Context, ensure};
use std::path::{Path, PathBuf};

/// Flags of `export`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A model's folder, a file of splats (.ply, .spz), or a recording (MCAP)
    #[arg(value_name = "MODEL|REC")]
    from: PathBuf,
    /// What to write
    #[arg(long, value_enum)]
    to: Format,
    /// File (ply, spz) or new folder (nerfstudio) to write
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Of a recording, export exactly the keyframes this `keyframes.txt` lists [default: those a run would accept]
    #[arg(long, value_name = "FILE")]
    keyframes: Option<PathBuf>,
}

/// Formats there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// Of a model: its splats as a .ply that other viewers open
    Ply,
    /// Of a model: its splats as a .spz, a tenth as large; values are rounded
    Spz,
    /// Of a recording: a folder with PNG photos, 16-bit depth, transforms.json with poses and split lists
    Nerfstudio,
}

/// Writes the model or recording and says what was written; a recording that ends early is a loss.
pub(crate) fn run(args: &Args) -> anyhow::Result<Exit> {
    let is_model = splat_file::is_one(&args.from);
    ensure!(args.from.exists(), BadArgument(format!("{} does not exist", args.from.display())));
    match method::kind_in(&args.from)? {
        Some(Kind::Tsdf) => {
            return Err(wrong_kind(
                "a distance field, which has no splats; its mesh is mesh.ply and mesh.glb there",
                &args.from,
            ));
        }
        Some(Kind::Nerf) => return Err(wrong_kind("a neural field, which has no splats", &args.from)),
        Some(Kind::Splat) | None => {}
    }
    ensure!(is_model || args.from.is_file(), cannot_export(&args.from));
    match (args.to, is_model) {
        (Format::Ply, true) => export_splats(&args.from, splat_file::Format::Ply, &args.out),
        (Format::Spz, true) => export_splats(&args.from, splat_file::Format::Spz, &args.out),
        (Format::Nerfstudio, false) => export_recording(args),
        (Format::Ply | Format::Spz, false) => {
            Err(wrong_kind("splats are written of a model, this is a recording", &args.from))
        }
        (Format::Nerfstudio, true) => {
            Err(wrong_kind("nerfstudio is written of a recording, this is a model", &args.from))
        }
    }
}

fn cannot_export(from: &Path) -> BadArgument {
    BadArgument(format!("{}: neither a folder with splats.ply, nor a file of splats, nor a recording", from.display()))
}

fn wrong_kind(sentence: &str, from: &Path) -> anyhow::Error {
    BadArgument(format!("{}: {sentence}", from.display())).into()
}

/// Checks the splats by reading them before they go out.
fn export_splats(model: &Path, format: splat_file::Format, out: &Path) -> anyhow::Result<Exit> {
    let splats = splat_file::read(model)?;
    splat_file::write(out, format, &splats)?;
    let n_splats = counted(splats.n_splats() as u64, "splat");
    print::line(format!("{n_splats} of colour degree {} -> {}", splats.sh_degree, out.display()))?;
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
    let unlisted = join.check_list()?;
    let mut keyframes: Vec<_> = join.keyframes().cloned().collect();
    if let Some(mut stands) = Stands::new(&opened.rig) {
        keyframes = stands.corrected(keyframes);
    }
    let written = write_nerfstudio(&args.out, keyframes.into_iter())
        .with_context(|| format!("cannot export {}", args.from.display()))?;
    log::info!("{}", join.counts());
    print::line(format!("{} -> {}", sentence(written), args.out.display()))?;
    let mut losses = join.counts().losses(Use::Watched);
    losses.extend(opened.damage.get().cloned());
    losses.extend(unlisted);
    Ok(exit::after(&losses))
}

fn sentence(written: Written) -> String {
    let Written { n_images, n_depth, n_depth_left_out } = written;
    let left_out = match n_depth_left_out as u64 {
        0 => String::new(),
        n => format!(", {} left out: their lens is not that of their photo", counted(n, "depth image")),
    };
    format!("{}, {n_depth} of them with depth{left_out}", counted(n_images as u64, "photo"))
}
