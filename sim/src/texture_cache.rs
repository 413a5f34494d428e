//! Textures of scenes in a cache folder. Painting, lighting and compressing them takes seconds of
//! computing time, and every process with a simulated scene needs them.

use crate::Error;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Name and PNG file of each texture.
pub(crate) type Textures = Vec<(String, Vec<u8>)>;

static CACHE: OnceLock<Cache> = OnceLock::new();

/// From now on, keeps the textures of scenes in a folder, which need not exist. Without this call,
/// every process creates them.
///
/// * `version`: a text that differs between programs whose textures may differ. Textures of another
///   version are replaced.
pub fn keep_textures_in(folder: &Path, version: &str) {
    // Only the first call has an effect, because a process needs one cache.
    let _ = CACHE.set(Cache {
        folder: folder.to_owned(),
        version: version.to_owned(),
    });
}

/// The textures of a scene, from the cache of this process if it has one. If they are missing or
/// invalid, they are created and kept.
pub(crate) fn textures(
    scene: &str,
    create: impl FnOnce() -> Result<Textures, Error>,
) -> Result<Textures, Error> {
    match CACHE.get() {
        Some(cache) => cache.textures(scene, create),
        None => create(),
    }
}

struct Cache {
    folder: PathBuf,
    version: String,
}

impl Cache {
    fn textures(
        &self,
        scene: &str,
        create: impl FnOnce() -> Result<Textures, Error>,
    ) -> Result<Textures, Error> {
        // The version is in the file and not in its name, so that old versions do not accumulate.
        let path = self.folder.join(format!("{scene}.textures"));
        if let Some(textures) = self.read(&path) {
            return Ok(textures);
        }
        let textures = create()?;
        // Without the file, the next process only takes longer. The folder may be read-only, or
        // another process may write the same file.
        if let Err(error) = self.write(&path, &textures) {
            log::debug!("{}: cannot be written: {error}", path.display());
        }
        Ok(textures)
    }

    fn read(&self, path: &Path) -> Option<Textures> {
        let bytes = files::read(path, files::Budget::RECORD).ok()?;
        from_bytes(&bytes, &self.version)
    }

    fn write(&self, path: &Path, textures: &[(String, Vec<u8>)]) -> std::io::Result<()> {
        std::fs::create_dir_all(&self.folder)?;
        files::write(path, to_bytes(textures, &self.version))
    }
}

/// The contents of a file: the version, then name and PNG file of each texture, then a checksum of
/// all of them. The length comes before each part.
fn to_bytes(textures: &[(String, Vec<u8>)], version: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut add = |part: &[u8]| {
        bytes.extend((part.len() as u64).to_le_bytes());
        bytes.extend(part);
    };
    add(version.as_bytes());
    for (name, png) in textures {
        add(name.as_bytes());
        add(png);
    }
    bytes.extend(checksum(&bytes).to_le_bytes());
    bytes
}

/// The textures in a file. `None` if they are incomplete, damaged, or of another version.
fn from_bytes(bytes: &[u8], version: &str) -> Option<Textures> {
    let (mut rest, sum) = bytes.split_last_chunk()?;
    if checksum(rest) != u64::from_le_bytes(*sum) {
        return None;
    }
    if next_part(&mut rest)? != version.as_bytes() {
        return None;
    }
    let mut textures = Textures::new();
    while !rest.is_empty() {
        let name = String::from_utf8(next_part(&mut rest)?.to_owned()).ok()?;
        textures.push((name, next_part(&mut rest)?.to_owned()));
    }
    Some(textures)
}

/// Removes the first part, and returns it without its length.
fn next_part<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (n_bytes, rest) = bytes.split_first_chunk()?;
    let n_bytes = usize::try_from(u64::from_le_bytes(*n_bytes)).ok()?;
    let (part, rest) = rest.split_at_checked(n_bytes)?;
    *bytes = rest;
    Some(part)
}

/// FNV-1a (Fowler, Noll and Vo). It detects damage, not manipulation.
fn checksum(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |sum, byte| {
        (sum ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

    fn example() -> Textures {
        vec![
            ("wood".to_owned(), vec![1, 2, 3]),
            ("metal".to_owned(), Vec::new()),
        ]
    }

    #[test]
    fn textures_are_created_once_per_version_and_scene() {
        let folder = tempfile::tempdir().expect("a folder");
        let cache = |version: &str| Cache {
            folder: folder.path().join("new/folder"),
            version: version.to_owned(),
        };
        let n_created = Cell::new(0);
        let textures = |cache: &Cache, scene: &str| {
            let create = || {
                n_created.set(n_created.get() + 1);
                Ok(example())
            };
            let textures = cache.textures(scene, create).expect("created or read");
            assert_eq!(textures, example());
            n_created.get()
        };
        assert_eq!(textures(&cache("1"), "lab"), 1);
        assert_eq!(textures(&cache("1"), "lab"), 1);
        assert_eq!(textures(&cache("1"), "cabinet"), 2);
        assert_eq!(textures(&cache("2"), "lab"), 3, "another version");
        assert_eq!(textures(&cache("2"), "lab"), 3);
        assert_eq!(textures(&cache("1"), "lab"), 4, "replaced before");
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_no_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("file");
        std::fs::write(&file, "").expect("written");
        let cache = Cache {
            folder: file,
            version: String::new(),
        };
        let textures = cache.textures("lab", || Ok(example()));
        assert_eq!(textures.expect("created"), example());
    }

    #[test]
    fn damaged_files_are_rejected() {
        let whole = to_bytes(&example(), "1");
        assert_eq!(from_bytes(&whole, "1"), Some(example()));
        for n_bytes in 0..whole.len() {
            assert_eq!(from_bytes(&whole[..n_bytes], "1"), None, "{n_bytes} bytes");
        }
        for ix in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[ix] ^= 0x10;
            assert_eq!(from_bytes(&damaged, "1"), None, "byte {ix}");
        }
        // With a valid checksum, a wrong length is still no reason to panic.
        let mut long = whole[..whole.len() - 8].to_vec();
        long[0] = u8::MAX;
        long.extend(checksum(&long).to_le_bytes());
        assert_eq!(from_bytes(&long, "1"), None);
    }
}
