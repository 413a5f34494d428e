//! Finds floaters: small parts of a model that are not connected to its large parts.

mod cell_mask;
mod groups;
#[cfg(test)]
mod tests;

pub(crate) use cell_mask::CellMask;
pub(crate) use groups::Groups;

use crate::pending::Pending;
use model_files::edits::{CellGrid, CellSet};

/// A part with less than this fraction (1 / divisor) of the cells or triangles of the whole is a
/// floater.
///
/// In a room of radius R, this is a patch of surface about 0.16 R wide. Relative to the size of the
/// scene, it is similar to the default of `MeshLab`, which removes isolated pieces with a diameter
/// below 10 % of the scene.
const SIZE_DIVISOR: usize = 500;

/// Whether a part of this size is a floater.
pub(crate) fn is_floater_size(n: usize, n_total: usize) -> bool {
    n * SIZE_DIVISOR < n_total
}

/// Floaters of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Floaters {
    /// The cells that contain them.
    pub cells: CellSet,
    /// Number of erased splats or triangles.
    pub n_erased: u64,
    /// Name of the counted items, in the singular.
    pub item: &'static str,
}

/// A search for floaters.
pub type PendingFloaters = Pending<Floaters>;

/// Cells that contain parts of the model. Cells of floaters are separate from cells of other parts.
#[derive(Debug)]
pub(crate) struct CellLabels {
    /// Cells of large parts.
    pub(crate) kept: CellMask,
    /// Cells of floaters.
    pub(crate) floating: CellMask,
}

impl CellLabels {
    /// No cell contains a part of the model.
    pub(crate) fn none(grid: &CellGrid) -> Self {
        Self {
            kept: CellMask::none(grid),
            floating: CellMask::none(grid),
        }
    }

    /// Divides occupied cells into groups of connected cells. Groups with few cells are floaters.
    pub(crate) fn of_occupied(grid: &CellGrid, occupied: &CellMask, mut groups: Groups) -> Self {
        // Cells that touch only at a corner also count as adjacent, so that a thin slanted surface
        // stays connected.
        for cell in occupied.cells() {
            grid.neighbors(cell)
                .filter(|other| occupied.contains(*other))
                .for_each(|other| groups.join(cell, other));
        }
        // Sizes are known only after all cells are joined, so the labels need a second pass.
        let mut sizes = vec![0; grid.n()];
        for cell in occupied.cells() {
            sizes[groups.representative(cell) as usize] += 1;
        }
        let mut labels = Self::none(grid);
        let n_occupied = occupied.n_marked();
        for cell in occupied.cells() {
            let is_floating =
                is_floater_size(sizes[groups.representative(cell) as usize], n_occupied);
            if is_floating {
                &mut labels.floating
            } else {
                &mut labels.kept
            }
            .insert(cell);
        }
        labels
    }

    /// Also keeps the cells around the cells of large parts.
    pub(crate) fn keep_around(&mut self, grid: &CellGrid) {
        // The neighbors are taken from a copy. Otherwise, cells that were just added would also add
        // their neighbors.
        let inner = self.kept.clone();
        self.kept
            .extend(inner.cells().flat_map(|cell| grid.neighbors(cell)));
    }

    /// The cells to erase. They are the cells of floaters and the cells around them, except for
    /// kept cells. The surrounding cells are included because floaters move during training. `None`
    /// if there are none.
    pub(crate) fn erased(&self, grid: &CellGrid) -> Option<CellSet> {
        let mut erased = self.floating.clone();
        erased.extend(self.floating.cells().flat_map(|cell| grid.neighbors(cell)));
        let mut cells = erased
            .cells()
            .filter(|cell| !self.kept.contains(*cell))
            .peekable();
        cells.peek().is_some().then(|| CellSet::new(*grid, cells))
    }
}
