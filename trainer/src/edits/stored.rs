//! The form of edits in files. `docs/reference/files.md` describes it.

use super::cells::{CellGrid, CellSet, MAX_CELLS};
use super::{Edit, Edits, MAX_EDITS};
use crate::Aabb;
use kinematics::transform::{from_rows, to_rows};
use serde::{Deserialize, Serialize};

/// An edit in a file.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum StoredEdit {
    Box { world_from_box: [f64; 16], min_m: [f64; 3], max_m: [f64; 3] },
    Cells { grid: CellGrid, ranges: Vec<[u32; 2]> },
}

impl From<Edits> for Vec<StoredEdit> {
    fn from(edits: Edits) -> Self {
        let stored = |edit| match edit {
            Edit::Box(Aabb { world_from_box, min_m, max_m }) => {
                StoredEdit::Box { world_from_box: to_rows(&world_from_box), min_m, max_m }
            }
            Edit::Cells(CellSet { grid, ranges }) => StoredEdit::Cells { grid, ranges },
        };
        edits.0.into_iter().map(stored).collect()
    }
}

impl TryFrom<Vec<StoredEdit>> for Edits {
    type Error = String;

    fn try_from(stored: Vec<StoredEdit>) -> Result<Self, String> {
        if stored.len() > MAX_EDITS {
            return Err(format!("{} edits, expected at most {MAX_EDITS}", stored.len()));
        }
        stored.into_iter().map(Edit::try_from).collect::<Result<_, _>>().map(Self)
    }
}

impl TryFrom<StoredEdit> for Edit {
    type Error = String;

    fn try_from(stored: StoredEdit) -> Result<Self, String> {
        match stored {
            StoredEdit::Box { world_from_box, min_m, max_m } => {
                let world_from_box = from_rows(&world_from_box).map_err(|error| error.to_string())?;
                let is_valid = (0..3).all(|axis| min_m[axis] < max_m[axis]);
                if !is_valid {
                    return Err(format!("an erased box from {min_m:?} to {max_m:?}, expected increasing corners"));
                }
                Ok(Self::Box(Aabb { world_from_box, min_m, max_m }))
            }
            StoredEdit::Cells { grid, ranges } => {
                check_cells(&grid, &ranges)?;
                Ok(Self::Cells(CellSet { grid, ranges }))
            }
        }
    }
}

fn check_cells(grid: &CellGrid, ranges: &[[u32; 2]]) -> Result<(), String> {
    let CellGrid { center_m, radius_m, n_cells } = grid;
    let is_finite = center_m.iter().all(|along| along.is_finite()) && radius_m.is_finite() && *radius_m > 0.0;
    if !is_finite || !(1..=MAX_CELLS).contains(n_cells) {
        return Err(format!("invalid grid of erased cells: {grid:?}"));
    }
    let end = n_cells.pow(3);
    let is_ordered = ranges.windows(2).all(|pair| pair[0][1] <= pair[1][0]);
    if ranges.is_empty() || !is_ordered || ranges.iter().any(|[first, after]| first >= after || *after > end) {
        return Err(format!("erased cells need at least one range, in increasing order, disjoint and up to {end}"));
    }
    Ok(())
}
