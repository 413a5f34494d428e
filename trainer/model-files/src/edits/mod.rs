//! Edits of a model, which are regions of space that an operator has erased.
//!
//! Edits do not change the model. Erased space is left out of pictures, chunks and exports, and
//! undoing an edit shows it again.

mod cells;
mod stored;

pub use cells::{CellGrid, CellSet};

use crate::{Aabb, Error};
use serde::{Deserialize, Serialize};
use std::io::ErrorKind;
use std::path::Path;
use stored::StoredEdit;

/// Maximum number of edits of a model. Kernels test every point against every edit, so a larger
/// number makes renders slower.
pub const MAX_EDITS: usize = 64;
/// Largest absolute coordinate of an edit, meters. Products of two or three such numbers are finite
/// in f32, whose largest number is 3.4e38.
const MAX_COORD_M: f64 = 1e9;
/// Name of the file in a model folder.
const FILE: &str = "edits.json";

/// One edit.
#[derive(Clone, Debug, PartialEq)]
pub enum Edit {
    /// Erases a box.
    Box(Aabb),
    /// Erases cells.
    Cells(CellSet),
}

impl Edit {
    /// Whether a point in world is erased.
    fn erases(&self, point_m: [f64; 3]) -> bool {
        match self {
            Self::Box(aabb) => aabb.contains(point_m),
            Self::Cells(cells) => cells.contains(point_m),
        }
    }

    /// Checks that kernels can compute with the edit. The error is a sentence without a period.
    fn check(&self) -> Result<(), String> {
        match self {
            Self::Box(aabb) => check_box(aabb),
            Self::Cells(cells) => cells.check(),
        }
    }
}

fn check_box(
    Aabb {
        world_from_box,
        min_m,
        max_m,
    }: &Aabb,
) -> Result<(), String> {
    // The comparisons are written so that NaN fails them.
    let is_increasing = (0..3).all(|axis| min_m[axis] < max_m[axis]);
    if !is_increasing {
        return Err(format!(
            "an erased box from {min_m:?} to {max_m:?}, expected increasing corners"
        ));
    }
    let origin_m: [f64; 3] = world_from_box.translation.vector.into();
    let is_near = [&origin_m, min_m, max_m]
        .into_iter()
        .flatten()
        .all(|along| along.abs() <= MAX_COORD_M);
    if !is_near {
        return Err(format!(
            "an erased box at {origin_m:?} from {min_m:?} to {max_m:?} m, expected coordinates up to {MAX_COORD_M:e} m"
        ));
    }
    Ok(())
}

/// The edits of a model, oldest first. Edits that were undone are kept in memory, but they are
/// neither saved nor compared.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(try_from = "Vec<StoredEdit>", into = "Vec<StoredEdit>")]
pub struct Edits {
    made: Vec<Edit>,
    /// The edit that was undone last is at the end.
    undone: Vec<Edit>,
}

impl PartialEq for Edits {
    fn eq(&self, other: &Self) -> bool {
        self.made == other.made
    }
}

/// Content of [`FILE`].
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    edits: Edits,
}

impl Edits {
    /// Adds an edit. After this call, edits that were undone before can no longer be redone.
    ///
    /// # Errors
    ///
    /// Fails if there are already [`MAX_EDITS`] edits, or if the edit is too large or too far away
    /// for the kernels.
    pub fn push(&mut self, edit: Edit) -> Result<(), Error> {
        if self.made.len() >= MAX_EDITS {
            return Err(Error::TooManyEdits {
                max_edits: MAX_EDITS,
            });
        }
        edit.check()
            .map_err(|reason| Error::InvalidEdit { reason })?;
        self.made.push(edit);
        self.undone.clear();
        Ok(())
    }

    /// Removes the newest edit.
    ///
    /// # Errors
    ///
    /// Fails if there is no edit.
    pub fn undo(&mut self) -> Result<(), Error> {
        let edit = self.made.pop().ok_or(Error::NothingToUndo)?;
        self.undone.push(edit);
        Ok(())
    }

    /// Applies the edit that was undone last again.
    ///
    /// # Errors
    ///
    /// Fails if none was undone since the last new edit.
    pub fn redo(&mut self) -> Result<(), Error> {
        let edit = self.undone.pop().ok_or(Error::NothingToRedo)?;
        self.made.push(edit);
        Ok(())
    }

    /// Number of edits that can be made again.
    #[must_use]
    pub fn n_undone(&self) -> usize {
        self.undone.len()
    }

    /// Number of edits.
    #[must_use]
    pub fn len(&self) -> usize {
        self.made.len()
    }

    /// Whether nothing is erased.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.made.is_empty()
    }

    /// The edits, oldest first.
    #[must_use]
    pub fn as_slice(&self) -> &[Edit] {
        &self.made
    }

    /// Whether a point in world, meters, is erased.
    #[must_use]
    pub fn erases(&self, point_m: [f64; 3]) -> bool {
        self.made.iter().any(|edit| edit.erases(point_m))
    }

    /// Whether nothing of a splat remains in pictures. This is the case if a box contains the whole
    /// splat, or if an edit of cells contains its center.
    ///
    /// * `half_axes_m`: half axes in world of the ellipsoid within which the splat is drawn.
    #[must_use]
    pub fn hide_splat(&self, center_m: [f64; 3], half_axes_m: [[f64; 3]; 3]) -> bool {
        self.made.iter().any(|edit| match edit {
            Edit::Box(aabb) => aabb.contains_ellipsoid(center_m, half_axes_m),
            Edit::Cells(cells) => cells.contains(center_m),
        })
    }

    /// Reads the edits in the folder of a saved model. Returns no edits if the folder has no such
    /// file, or if the model is a single file.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read or is damaged.
    pub fn read(model: &Path) -> Result<Self, Error> {
        let path = model.join(FILE);
        // It is an error if the name exists but cannot be read, as with a broken link. Otherwise,
        // erased parts would reappear.
        if let Err(error) = path.symlink_metadata()
            && matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
        {
            return Ok(Self::default());
        }
        let text = files::read_text(&path).map_err(|source| Error::Read {
            path: path.clone(),
            source,
        })?;
        let file: File =
            serde_json::from_str(&text).map_err(|source| Error::EditsFile { path, source })?;
        Ok(file.edits)
    }

    /// Writes the edits into the folder of a saved model. Without edits, removes the file.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be written or removed.
    pub fn write(&self, folder: &Path) -> Result<(), Error> {
        let path = folder.join(FILE);
        // An old file would erase parts again when the model is loaded.
        if self.is_empty() {
            return match std::fs::remove_file(&path) {
                Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                    Err(Error::Write { path, source })
                }
                _ => Ok(()),
            };
        }
        let text = serde_json::to_string(&File {
            edits: self.clone(),
        });
        let text = text.map_err(|error| Error::Write {
            path: path.clone(),
            source: error.into(),
        })?;
        files::write(&path, format!("{text}\n")).map_err(|source| Error::Write { path, source })
    }
}

#[cfg(test)]
mod tests;
