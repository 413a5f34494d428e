//! Finds floaters: small parts of a model that are not connected to its large parts.

use super::cells::{CellGrid, CellSet};
use super::groups::Groups;
use std::collections::{BTreeMap, BTreeSet};

/// A part with less than this fraction (1 / divisor) of the cells or triangles of the whole is a floater.
///
/// In a room of radius R, this is a patch of surface about 0.16 R wide. Without scale, it resembles the diameter of
/// 10 % of the scene below which `MeshLab` removes isolated pieces by default.
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

/// Cells that contain parts of the model, by whether the part is a floater.
#[derive(Debug, Default)]
pub(crate) struct CellLabels {
    /// Cells of large parts.
    pub(crate) kept: BTreeSet<u32>,
    /// Cells of floaters.
    pub(crate) floating: BTreeSet<u32>,
}

impl CellLabels {
    /// Divides occupied cells into groups, after connecting adjacent ones. Groups with few cells are floaters.
    pub(crate) fn of_occupied(grid: &CellGrid, occupied: &BTreeSet<u32>, mut groups: Groups) -> Self {
        for cell in occupied {
            grid.neighbors(*cell).filter(|other| occupied.contains(other)).for_each(|other| groups.join(*cell, other));
        }
        let mut sizes: BTreeMap<u32, usize> = BTreeMap::new();
        for cell in occupied {
            *sizes.entry(groups.representative(*cell)).or_default() += 1;
        }
        let (floating, kept) =
            occupied.iter().partition(|cell| is_floater_size(sizes[&groups.representative(**cell)], occupied.len()));
        Self { kept, floating }
    }

    /// Also keeps the cells around those of large parts.
    pub(crate) fn keep_around(&mut self, grid: &CellGrid) {
        let around: Vec<u32> = self.kept.iter().flat_map(|cell| grid.neighbors(*cell)).collect();
        self.kept.extend(around);
    }

    /// The cells to erase: those of floaters and, because floaters move in training, the cells around them, except for
    /// kept cells. `None` if there are none.
    pub(crate) fn erased(&self, grid: &CellGrid) -> Option<CellSet> {
        let around = self.floating.iter().flat_map(|cell| grid.neighbors(*cell));
        let cells = self.floating.iter().copied().chain(around).filter(|cell| !self.kept.contains(cell));
        let cells: BTreeSet<u32> = cells.collect();
        (!cells.is_empty()).then(|| CellSet::new(*grid, &cells))
    }
}
