//! The form of edits in files. `docs/reference/files.md` describes it.

use super::cells::{CellGrid, CellSet};
use super::{Edit, Edits, MAX_EDITS};
use crate::Aabb;
use kinematics::transform::{from_rows, to_rows};
use serde::{Deserialize, Serialize};

/// An edit in a file.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum StoredEdit {
    Box {
        world_from_box: [f64; 16],
        min_m: [f64; 3],
        max_m: [f64; 3],
    },
    Cells {
        grid: CellGrid,
        ranges: Vec<[u32; 2]>,
    },
}

impl From<Edits> for Vec<StoredEdit> {
    fn from(edits: Edits) -> Self {
        edits.made.into_iter().map(StoredEdit::from).collect()
    }
}

impl From<Edit> for StoredEdit {
    fn from(edit: Edit) -> Self {
        match edit {
            Edit::Box(Aabb {
                world_from_box,
                min_m,
                max_m,
            }) => Self::Box {
                world_from_box: to_rows(&world_from_box),
                min_m,
                max_m,
            },
            Edit::Cells(CellSet { grid, ranges }) => Self::Cells { grid, ranges },
        }
    }
}

impl TryFrom<Vec<StoredEdit>> for Edits {
    type Error = String;

    fn try_from(stored: Vec<StoredEdit>) -> Result<Self, String> {
        // Files come from users, so the edits in them are checked like new edits.
        if stored.len() > MAX_EDITS {
            return Err(format!(
                "{} edits, expected at most {MAX_EDITS}",
                stored.len()
            ));
        }
        let made: Result<Vec<Edit>, String> = stored.into_iter().map(Edit::try_from).collect();
        Ok(Self {
            made: made?,
            undone: Vec::new(),
        })
    }
}

impl TryFrom<StoredEdit> for Edit {
    type Error = String;

    fn try_from(stored: StoredEdit) -> Result<Self, String> {
        let edit = match stored {
            StoredEdit::Box {
                world_from_box,
                min_m,
                max_m,
            } => {
                let world_from_box =
                    from_rows(&world_from_box).map_err(|error| error.to_string())?;
                Self::Box(Aabb {
                    world_from_box,
                    min_m,
                    max_m,
                })
            }
            StoredEdit::Cells { grid, ranges } => Self::Cells(CellSet { grid, ranges }),
        };
        edit.check()?;
        Ok(edit)
    }
}
