//! The mesh files of a robot in a recording. With them, a recording can be replayed on a computer
//! that has no robot description.

use drivers::recording::{Recording, decompress_mesh};
use files::Budget;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Compressed mesh files, by their names in the robot description.
#[derive(Clone, Debug, Default)]
pub struct RecordedMeshes {
    files: Arc<BTreeMap<String, Vec<u8>>>,
    come_first: bool,
}

impl RecordedMeshes {
    /// The mesh files that a recording contains.
    pub(crate) fn of(recording: &Recording) -> Self {
        let files = recording.mesh_files();
        Self::of_compressed(files.map(|(file, data)| (file.to_owned(), data.to_vec())))
    }

    /// Mesh files that are compressed already.
    pub(crate) fn of_compressed(files: impl IntoIterator<Item = (String, Vec<u8>)>) -> Self {
        Self {
            files: Arc::new(files.into_iter().collect()),
            come_first: false,
        }
    }

    /// Compresses mesh files.
    #[cfg(test)]
    pub(crate) fn of_files<'a>(files: impl IntoIterator<Item = (&'a str, &'a [u8])>) -> Self {
        let files = files.into_iter();
        Self::of_compressed(files.map(|(file, bytes)| {
            let compressed = drivers::recording::compress_mesh(bytes);
            (file.to_owned(), compressed)
        }))
    }

    /// Uses these files instead of files on the disk. They belong to the rig of the recording,
    /// whereas files of the same name on this computer may belong to another robot.
    #[must_use]
    pub(crate) fn before_files(self) -> Self {
        Self {
            come_first: true,
            ..self
        }
    }

    /// Whether these files are used instead of files on the disk.
    pub(crate) fn come_first(&self) -> bool {
        self.come_first
    }

    /// Whether a file is among them.
    pub(crate) fn contains(&self, file: &str) -> bool {
        self.files.contains_key(file)
    }

    /// The compressed files by name, in alphabetical order.
    pub(crate) fn compressed(&self) -> impl Iterator<Item = (&str, &[u8])> {
        self.files
            .iter()
            .map(|(file, compressed)| (file.as_str(), compressed.as_slice()))
    }

    /// Contents of a file.
    ///
    /// # Errors
    ///
    /// Why it cannot be read, in one sentence.
    pub(crate) fn read(&self, file: &str, budget: Budget) -> Result<Vec<u8>, String> {
        let compressed = self.files.get(file).ok_or_else(|| self.without())?;
        decompress_mesh(compressed, budget)
            .map_err(|error| format!("cannot read it from the recording: {error}"))
    }

    /// Says that a file is not among them.
    pub(crate) fn without(&self) -> String {
        if self.files.is_empty() {
            "the recording contains no mesh files, like recordings of older versions".to_owned()
        } else {
            "the recording does not contain it".to_owned()
        }
    }
}
