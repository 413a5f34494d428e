//! Reads splats from a `.ply` file, a `.spz` file or the folder of a saved model, and writes both file formats.

use super::arrays::SplatArrays;
use super::{ply, spz};
use crate::Error;
use std::path::{Path, PathBuf};

/// Name of the splat file in a model folder.
pub(super) const IN_FOLDER: &str = "splats.ply";

/// Format of a splat file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// Values at full precision.
    Ply,
    /// Quantized and compressed values.
    Spz,
}

impl Format {
    /// The format for a file name extension.
    fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            _ => None,
        }
    }
}

/// Reads splats from a file or from a model folder.
pub(super) fn read(model: &Path) -> Result<SplatArrays, Error> {
    let is_file = model.is_file();
    let path: PathBuf = if is_file { model.to_owned() } else { model.join(IN_FOLDER) };
    let splats = match Format::of(&path) {
        Some(Format::Spz) => spz::read(&path),
        Some(Format::Ply) | None => ply::read(&path),
    };
    let is_in_model = is_file && path.file_name().is_some_and(|name| name == IN_FOLDER);
    let hint = if is_in_model { "; for a saved model, give its folder" } else { "" };
    splats.map_err(|source| Error::NoSplats { path: model.to_owned(), hint, source: Box::new(source) })
}

/// Writes splats to a file.
pub(super) fn write(path: &Path, format: Format, splats: &SplatArrays) -> Result<(), Error> {
    match format {
        Format::Ply => ply::write(path, splats),
        Format::Spz => spz::write(path, splats),
    }
}
