//! Datasets on disk: posed photos in nerfstudio and TUM RGB-D folders.

mod frame;
pub mod nerfstudio;
pub mod tum;

pub use frame::{DatasetFrame, DepthFile, DepthImage, FrameImages};

use crate::Error;
use std::path::{Path, PathBuf};

/// The usable frames of a folder.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// The folder.
    pub path: PathBuf,
    /// In file-name order (nerfstudio) or in time (TUM); never empty.
    pub frames: Vec<DatasetFrame>,
    /// Frames left out because their image is not there.
    pub n_missing: usize,
    /// Frames left out because their image is not one, or has no pose or depth near it in time.
    pub n_unusable: usize,
    /// What a user should know: one sentence each, with the first names of what was left out.
    pub notes: Vec<String>,
}

/// Reads a dataset folder of either kind; `path` may also name a `transforms.json`.
pub fn read(path: &Path) -> Result<Dataset, Error> {
    if path.is_file() || path.join(nerfstudio::FILE_NAME).is_file() {
        return nerfstudio::read(path);
    }
    if path.join(tum::COLOR_LIST).is_file() {
        return tum::read(path);
    }
    Err(Error::NotADataset { path: path.to_owned() })
}

/// What was left out while reading.
#[derive(Debug, Default)]
struct LeftOut {
    missing: Vec<String>,
    unusable: Vec<(String, String)>,
}

impl LeftOut {
    /// Names told in a note.
    const NAMED: usize = 5;

    /// The dataset, once there is something in it.
    fn dataset(self, path: &Path, frames: Vec<DatasetFrame>, mut notes: Vec<String>) -> Result<Dataset, Error> {
        let (n_missing, n_unusable) = (self.missing.len(), self.unusable.len());
        if frames.is_empty() {
            let first_reason = self.unusable.first().map(|(name, reason)| format!(" ({name}: {reason})"));
            let first_reason = first_reason.unwrap_or_default();
            return Err(Error::EmptyDataset { path: path.to_owned(), n_missing, n_unusable, first_reason });
        }
        if n_missing > 0 {
            notes.push(format!("{n_missing} images are not there: {}", first_names(&self.missing)));
        }
        if n_unusable > 0 {
            let named: Vec<_> = self.unusable.iter().map(|(name, reason)| format!("{name} ({reason})")).collect();
            notes.push(format!("{n_unusable} images cannot be used: {}", first_names(&named)));
        }
        Ok(Dataset { path: path.to_owned(), frames, n_missing, n_unusable, notes })
    }
}

/// The first names, and that there are more.
fn first_names(names: &[String]) -> String {
    let more = if names.len() > LeftOut::NAMED { ", ..." } else { "" };
    format!("{}{more}", names[..names.len().min(LeftOut::NAMED)].join(", "))
}

#[cfg(test)]
mod tests;
