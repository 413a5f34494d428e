//! The registry of training methods. No other file lists all methods.

use crate::method_entry::MethodEntry;
use crate::model_metadata::METADATA_FILE;
use crate::{Error, nerf, splat, tsdf};
use std::fmt::{Debug, Formatter};
use std::path::Path;

/// A registered method.
#[derive(Clone, Copy)]
pub struct ModelKind(&'static MethodEntry);

impl ModelKind {
    /// All methods of training. The first method is the default.
    pub const ALL: &'static [Self] = &[
        Self(&splat::ENTRY),
        Self(&tsdf::ENTRY),
        Self(&nerf::ENTRY),
        #[cfg(test)]
        Self(&crate::mean_color::ENTRY),
    ];

    /// The method with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.name() == name)
    }

    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        self.0.name
    }

    /// Everything that the method registers.
    pub fn entry(self) -> &'static MethodEntry {
        self.0
    }

    /// Whether the method has an option of this name.
    pub fn has_option(self, name: &str) -> bool {
        (self.0.default_options)().specific.get(name).is_some()
    }

    /// The method of a saved model. `None` if it cannot be determined. For a folder, it is read
    /// from `model.json`. Without this file, it is derived from the files in the folder. For a
    /// single file, it is derived from the extension.
    ///
    /// # Errors
    ///
    /// Fails if `model.json` is invalid or cannot be read.
    pub fn of_saved(model: &Path) -> Result<Option<Self>, Error> {
        #[derive(serde::Deserialize)]
        struct Metadata {
            method: Option<String>,
        }
        if model.is_file() {
            return Ok(Self::of_single_file(model));
        }
        // Folders of other programs have no `model.json`, so the method is derived from their
        // files.
        let path = model.join(METADATA_FILE);
        let bytes = match files::read(&path, files::Budget::TEXT) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                return Ok(Self::of_files(model));
            }
            read => read.map_err(|source| Error::Read {
                path: path.clone(),
                source,
            })?,
        };
        let metadata: Metadata = serde_json::from_slice(&bytes)
            .map_err(|source| Error::ModelMetadata { path, source })?;
        Ok(metadata
            .method
            .as_deref()
            .and_then(Self::from_name)
            .or_else(|| Self::of_files(model)))
    }

    /// The first method for which the folder contains a complete model.
    fn of_files(folder: &Path) -> Option<Self> {
        Self::ALL
            .iter()
            .copied()
            .find(|kind| kind.is_complete(folder))
    }

    /// Whether a folder contains a complete model of this method. The last file is moved into place
    /// after all others.
    fn is_complete(self, folder: &Path) -> bool {
        self.0
            .files
            .last()
            .is_some_and(|file| folder.join(file).is_file())
    }

    /// The method whose models are single files with the extension of this file, including
    /// extensions that are not supported.
    pub fn of_single_file(file: &Path) -> Option<Self> {
        let extension = file.extension()?.to_str()?.to_ascii_lowercase();
        Self::ALL
            .iter()
            .copied()
            .find(|kind| kind.knows_extension(&extension))
    }

    /// Whether the method has single files with this extension, supported or not.
    fn knows_extension(self, extension: &str) -> bool {
        let single_file = self.0.single_file;
        let mut extensions = single_file
            .into_iter()
            .flat_map(|single| [single.extensions, single.unsupported_extensions])
            .flatten();
        extensions.any(|known| *known == extension)
    }

    /// Names of the model files of all methods, in the order in which the files are moved into
    /// place and hashed.
    pub fn model_files() -> impl Iterator<Item = &'static str> {
        std::iter::once(METADATA_FILE)
            .chain(Self::ALL.iter().flat_map(|kind| kind.0.files).copied())
    }
}

impl Default for ModelKind {
    /// The first method.
    fn default() -> Self {
        Self::ALL[0]
    }
}

impl PartialEq for ModelKind {
    fn eq(&self, other: &Self) -> bool {
        self.0.name == other.0.name
    }
}

impl Eq for ModelKind {}

impl Debug for ModelKind {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(self.0.name)
    }
}

#[cfg(test)]
mod tests;
