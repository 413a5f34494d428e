//! Reads splats from a `.ply`, `.spz` or `.splat` file or the folder of a saved model, and writes
//! `.ply` and `.spz`.

use super::arrays::SplatArrays;
use super::{antimatter15, ply, spz};
use crate::Error;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Name of the splat file in a model folder.
pub const IN_FOLDER: &str = "splats.ply";

/// Extensions of the formats that can be read.
pub const EXTENSIONS: [&str; 3] = ["ply", "spz", "splat"];
/// Extensions of other formats. They are recognized only so that the error can name the format.
pub const UNSUPPORTED: [&str; 2] = ["ksplat", "sog"];

/// Format of a written file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Values at full precision.
    Ply,
    /// Quantized and compressed values.
    Spz,
}

/// Reads splats from a file or from a model folder.
pub fn read(model: &Path) -> Result<SplatArrays, Error> {
    let is_file = model.is_file();
    let path: PathBuf = if is_file {
        model.to_owned()
    } else {
        model.join(IN_FOLDER)
    };
    let splats = read_file(&path);
    // A user who names this file probably means the saved model.
    let is_in_model = is_file && path.file_name().is_some_and(|name| name == IN_FOLDER);
    let hint = if is_in_model {
        "; for a saved model, give its folder"
    } else {
        ""
    };
    splats.map_err(|source| Error::NoSplats {
        path: model.to_owned(),
        hint,
        source: Box::new(source),
    })
}

/// Reads splats from a file. The extension of the file determines the format.
fn read_file(path: &Path) -> Result<SplatArrays, Error> {
    let extension = path
        .extension()
        .and_then(OsStr::to_str)
        .map(str::to_ascii_lowercase);
    match extension.as_deref() {
        Some("spz") => spz::read(path),
        Some("splat") => antimatter15::read(path),
        Some(other) if UNSUPPORTED.contains(&other) => {
            let supported = EXTENSIONS.join(", .");
            let reason = format!(
                "the format .{other} is not supported (supported: .{supported}); convert the file to .ply, for example with \
                 SuperSplat"
            );
            Err(Error::SplatFile {
                path: path.to_owned(),
                reason,
            })
        }
        // This also handles files with unknown extensions, because a PLY header is recognized by
        // its content.
        _ => ply::read(path),
    }
}

/// Writes splats to a file.
pub fn write(path: &Path, format: Format, splats: &SplatArrays) -> Result<(), Error> {
    match format {
        Format::Ply => ply::write(path, splats),
        Format::Spz => spz::write(path, splats),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extension_determines_the_format() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, b"33 bytes that are no splat at all").unwrap();
            read_file(&path).unwrap_err().to_string()
        };
        for (name, reason) in [
            ("a.ply", "it has no PLY header"),
            ("a", "it has no PLY header"),
            (
                "a.SPZ",
                "it begins neither with a gzip stream nor with \"NGSP\"",
            ),
            (
                "a.splat",
                "it has 33 bytes, expected a multiple of 32 above 0",
            ),
            (
                "a.sog",
                "the format .sog is not supported (supported: .ply, .spz, .splat); convert the file to .ply",
            ),
            ("a.KSPLAT", "the format .ksplat is not supported"),
        ] {
            let error = of(name);
            assert!(error.contains(reason), "{name}: {error}");
        }
    }
}
