//! Mesh files of the robot in a recording, each as a compressed attachment.
//!
//! The name of such an attachment is [`PREFIX`], the name of the file in the robot description, and
//! [`SUFFIX`]. Its contents are one gzip stream (RFC 1952) without a time stamp, so that the same
//! file always gives the same bytes.

use files::Budget;
use flate2::Compression;
use flate2::bufread::MultiGzDecoder;
use flate2::write::GzEncoder;
use std::io::{Error, ErrorKind, Read, Result, Write};

const PREFIX: &str = "meshes/";
const SUFFIX: &str = ".gz";

/// Maximum size of all compressed mesh files of a recording, bytes. The meshes of most public
/// robots have 1 to 20 MB. A recording of one minute has gigabytes.
pub const MAX_MESH_BYTES: u64 = 32 << 20;

/// Name of the attachment with a mesh file.
///
/// * `file`: name of the mesh file in the robot description.
#[must_use]
pub fn mesh_attachment(file: &str) -> String {
    format!("{PREFIX}{file}{SUFFIX}")
}

/// Name of a mesh file in the robot description; `None` if the attachment is no mesh file.
pub(super) fn mesh_file_of(attachment: &str) -> Option<&str> {
    attachment.strip_prefix(PREFIX)?.strip_suffix(SUFFIX)
}

/// Compresses a mesh file for a recording.
#[must_use]
pub fn compress_mesh(contents: &[u8]) -> Vec<u8> {
    // Meshes are compressed while a run starts, so the fastest level is used.
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    let written = encoder.write_all(contents).and_then(|()| encoder.finish());
    written.expect("memory accepts all bytes")
}

/// Contents of a compressed mesh file.
///
/// # Errors
///
/// If the data are damaged, or larger than `budget`. Memory is allocated for decompressed bytes
/// only.
pub fn decompress_mesh(compressed: &[u8], budget: Budget) -> Result<Vec<u8>> {
    let mut contents = Vec::new();
    // Reads at most one byte more than is allowed. If this byte exists, the contents are too large.
    let limit = budget.max_bytes.saturating_add(1);
    MultiGzDecoder::new(compressed)
        .take(limit)
        .read_to_end(&mut contents)?;
    if contents.len() as u64 == limit {
        return Err(Error::new(
            ErrorKind::FileTooLarge,
            format!("it has more than {} bytes", budget.max_bytes),
        ));
    }
    Ok(contents)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "package://arm/meshes/a.stl";

    #[test]
    fn names_of_mesh_files_survive() {
        let attachment = mesh_attachment(FILE);
        assert_eq!(attachment, "meshes/package://arm/meshes/a.stl.gz");
        assert_eq!(mesh_file_of(&attachment), Some(FILE));
        for other in ["rig.toml", "meshes/a.stl", "a.stl.gz", "meshes.gz"] {
            assert_eq!(mesh_file_of(other), None, "{other}");
        }
    }

    #[test]
    fn contents_survive_and_the_bytes_are_reproducible() {
        let contents: Vec<u8> = (0..100_000_u32).flat_map(u32::to_le_bytes).collect();
        let compressed = compress_mesh(&contents);
        assert_eq!(compress_mesh(&contents), compressed);
        assert!(compressed.len() < contents.len());
        let read = decompress_mesh(&compressed, Budget::MESH).expect("whole");
        assert!(read == contents);
    }

    #[test]
    fn damaged_and_oversized_meshes_are_refused() {
        let compressed = compress_mesh(&[7; 1000]);
        let allowing = |max_bytes| Budget {
            max_bytes,
            ..Budget::MESH
        };
        assert!(decompress_mesh(&compressed, allowing(1000)).is_ok());
        let error = decompress_mesh(&compressed, allowing(999)).expect_err("too large");
        assert_eq!(error.kind(), ErrorKind::FileTooLarge);
        assert_eq!(error.to_string(), "it has more than 999 bytes");
        assert!(decompress_mesh(&compressed[..12], Budget::MESH).is_err());
        assert!(decompress_mesh(b"solid", Budget::MESH).is_err());
        let mut damaged = compressed;
        let last = damaged.len() - 1;
        damaged[last - 5] ^= 1;
        assert!(decompress_mesh(&damaged, Budget::MESH).is_err(), "checksum");
    }
}
