//! Splats on disk: the folder of a saved model, a `.ply` or a `.spz`.

use anyhow::Context;
use std::path::{Path, PathBuf};
use trainer::splat::arrays::SplatArrays;
use trainer::{ply, spz};

/// The splats in a model's folder.
const IN_FOLDER: &str = "splats.ply";

/// Formats of a file of splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    /// Every value as it was learned.
    Ply,
    /// Values rounded to few bits, packed.
    Spz,
}

impl Format {
    /// The format that the ending of a name stands for.
    pub(crate) fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            _ => None,
        }
    }
}

/// Whether this is a folder that holds splats, or a file whose name ends as one of splats.
pub(crate) fn is_splat_file(path: &Path) -> bool {
    path.join(IN_FOLDER).is_file() || (path.is_file() && Format::of(path).is_some())
}

/// Reads the splats of a model's folder or of a file.
pub(crate) fn read(model: &Path) -> anyhow::Result<SplatArrays> {
    let is_file = model.is_file();
    let path: PathBuf = if is_file { model.to_owned() } else { model.join(IN_FOLDER) };
    let splats = match Format::of(&path) {
        Some(Format::Spz) => spz::read(&path),
        Some(Format::Ply) | None => ply::read(&path),
    };
    let hint = if is_file { "; of a saved model name its folder" } else { "" };
    splats.with_context(|| format!("no splats in {}{hint}", model.display()))
}

/// Writes splats to a file.
pub(crate) fn write(path: &Path, format: Format, splats: &SplatArrays) -> Result<(), trainer::Error> {
    match format {
        Format::Ply => ply::write(path, splats),
        Format::Spz => spz::write(path, splats),
    }
}
