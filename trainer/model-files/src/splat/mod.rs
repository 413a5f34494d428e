//! Files of splats, and the arrays that they hold.

pub mod antimatter15;
pub mod arrays;
pub mod cloud;
pub mod file;
pub mod ply;
pub mod spz;

use crate::Error;
use arrays::SplatArrays;
use std::path::Path;

/// Reads a file of splats. `parse` returns the splats and notes on the parts of the file that it
/// does not use, or the reason why the file is invalid. The notes are logged, and splats with
/// invalid numbers are left out.
fn read_with(
    path: &Path,
    parse: impl FnOnce(&[u8]) -> Result<(SplatArrays, Vec<String>), String>,
) -> Result<SplatArrays, Error> {
    let bytes = files::read(path, files::Budget::SPLATS).map_err(|source| Error::Read {
        path: path.to_owned(),
        source,
    })?;
    let (splats, notes) = parse(&bytes).map_err(|reason| Error::SplatFile {
        path: path.to_owned(),
        reason,
    })?;
    for note in notes {
        log::warn!("{}: {note}", path.display());
    }
    splats.without_invalid(path)
}
