//! Marks on the cells of a grid.

use model_files::edits::CellGrid;

/// Marks cells of a grid with one bit per cell.
#[derive(Clone, Debug)]
pub(crate) struct CellMask(Vec<u64>);

impl CellMask {
    /// No cell is marked.
    pub(crate) fn none(grid: &CellGrid) -> Self {
        Self(vec![0; grid.n().div_ceil(64)])
    }

    /// Marks a cell.
    pub(crate) fn insert(&mut self, cell: u32) {
        self.0[cell as usize / 64] |= 1 << (cell % 64);
    }

    /// Whether a cell is marked.
    pub(crate) fn contains(&self, cell: u32) -> bool {
        self.0[cell as usize / 64] >> (cell % 64) & 1 == 1
    }

    /// Number of marked cells.
    pub(crate) fn n_marked(&self) -> usize {
        self.0.iter().map(|word| word.count_ones() as usize).sum()
    }

    /// The marked cells, in increasing order.
    pub(crate) fn cells(&self) -> impl Iterator<Item = u32> {
        (0..)
            .step_by(64)
            .zip(&self.0)
            .filter(|(_, word)| **word != 0)
            .flat_map(|(first, word)| {
                (0..64)
                    .filter(move |bit| word >> bit & 1 == 1)
                    .map(move |bit| first + bit)
            })
    }
}

impl Extend<u32> for CellMask {
    fn extend<T: IntoIterator<Item = u32>>(&mut self, cells: T) {
        cells.into_iter().for_each(|cell| self.insert(cell));
    }
}
