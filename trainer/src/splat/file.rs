//! Files of splats: a `.ply`, a `.spz`, or the folder of a saved model.

use anyhow::Context;
use std::path::{Path, PathBuf};
use trainer::splat::arrays::SplatArrays;
use trainer::{ply, spz};

/// The file of splats in the folder of a model.
const IN_FOLDER: &str = "splats.ply";

/// Format of a file of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    /// All values at full precision.
    Ply,
    /// Values quantized and compressed.
    Spz,
}

impl Format {
    /// The format for a file name extension.
    pub(crate) fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            _ => None,
        }
    }
}

/// Whether this is a folder with splats, or a file with the extension of a splat format.
pub(crate) fn is_splat_file(path: &Path) -> bool {
    path.join(IN_FOLDER).is_file() || (path.is_file() && Format::of(path).is_some())
}

/// Reads splats from the folder of a model or from a file.
pub(crate) fn read(model: &Path) -> anyhow::Result<SplatArrays> {
    let is_file = model.is_file();
    let path: PathBuf = if is_file { model.to_owned() } else { model.join(IN_FOLDER) };
    let splats = match Format::of(&path) {
        Some(Format::Spz) => spz::read(&path),
        Some(Format::Ply) | None => ply::read(&path),
    };
    let hint = if is_file { "; for a saved model, give its folder" } else { "" };
    splats.with_context(|| format!("no splats in {}{hint}", model.display()))
}

/// Writes splats to a file.
pub(crate) fn write(path: &Path, format: Format, splats: &SplatArrays) -> Result<(), trainer::Error> {
    match format {
        Format::Ply => ply::write(path, splats),
        Format::Spz => spz::write(path, splats),
    }
}
