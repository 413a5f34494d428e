//! A set of cells of a grid over all space.

use super::{GROUPS_PER_EDIT, MAX_COORD_M, rows};
use crate::nerf::reference::space::contract;
use nalgebra::{Matrix4, Vector3};
use serde::{Deserialize, Serialize};

/// Maximum number of cells along an axis. Indices then have 30 bits, so kernels compute them in
/// `u32`.
const MAX_CELLS: u32 = 1024;
/// Smallest radius of the cube with equal cells, meters. Its inverse times any coordinate is finite
/// in f32.
const MIN_RADIUS_M: f64 = 1e-6;

/// A grid of cells that covers all space: cubes of equal size within a radius, and larger ones
/// outside, as in a contracted neural field (Barron et al. 2022).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellGrid {
    /// Center of the cube with equal cells, in world, meters.
    pub center_m: [f64; 3],
    /// Half the edge of this cube, meters.
    pub radius_m: f64,
    /// Number of cells along an axis. Half of them are inside the cube.
    pub n_cells: u32,
}

impl CellGrid {
    /// Index of the cell that contains a point in world.
    pub fn cell_at(&self, point_m: [f64; 3]) -> u32 {
        let n = f64::from(self.n_cells);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "within the unit cube"
        )]
        let coord =
            contract(self.scaled(point_m)).map(|along| (along * n).clamp(0.0, n - 1.0) as u32);
        self.index(coord)
    }

    /// Number of cells.
    pub(crate) fn n(&self) -> usize {
        (self.n_cells as usize).pow(3)
    }

    /// Width of the cells at a point along the narrower directions, meters.
    pub(crate) fn cell_m(&self, point_m: [f64; 3]) -> f64 {
        // The contracted cube is 4 radii wide. At the distance `largest`, the contraction of Barron
        // et al. 2022 (equation 10) maps to (2 - 1 / largest) / largest times the coordinate.
        // Widths across the ray are divided by this factor; along the ray, cells are wider still.
        let largest = self
            .scaled(point_m)
            .iter()
            .fold(1.0, |largest: f64, along| largest.max(along.abs()));
        4.0 * self.radius_m / f64::from(self.n_cells) * largest * largest / (2.0 * largest - 1.0)
    }

    /// Indices of the cells around a cell, itself excluded.
    pub(crate) fn neighbors(&self, index: u32) -> impl Iterator<Item = u32> + use<> {
        let grid = *self;
        let n = self.n_cells;
        let coord = [index % n, index / n % n, index / (n * n)];
        // Index 13 of the 3 x 3 x 3 block is the cell itself.
        (0..27_u32).filter(|ix| *ix != 13).filter_map(move |ix| {
            let steps = [ix % 3, ix / 3 % 3, ix / 9];
            let moved = |axis: usize| moved_by(coord[axis], steps[axis], n);
            Some(grid.index([moved(0)?, moved(1)?, moved(2)?]))
        })
    }

    fn index(&self, [x, y, z]: [u32; 3]) -> u32 {
        x + self.n_cells * (y + self.n_cells * z)
    }

    /// A point relative to the center, in units of the radius.
    fn scaled(&self, point_m: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| (point_m[axis] - self.center_m[axis]) / self.radius_m)
    }
}

/// A coordinate moved by `step - 1`; `None` outside the grid of `n` cells. Steps are 0 to 2,
/// because coordinates are unsigned.
fn moved_by(along: u32, step: u32, n: u32) -> Option<u32> {
    (along + step).checked_sub(1).filter(|along| *along < n)
}

/// Marks cells of a grid: one bit per cell.
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

/// A set of at least one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellSet {
    /// The grid.
    pub(super) grid: CellGrid,
    /// Disjoint ranges of indices in increasing order: the first index, and the one after the last.
    pub(super) ranges: Vec<[u32; 2]>,
}

impl CellSet {
    /// The set of these cells, in increasing order.
    pub(super) fn new(grid: CellGrid, cells: impl IntoIterator<Item = u32>) -> Self {
        let mut ranges: Vec<[u32; 2]> = Vec::new();
        for cell in cells {
            // Floaters fill runs of cells along x, so ranges take fewer words than cells.
            match ranges.last_mut() {
                Some([_, end]) if *end == cell => *end += 1,
                _ => ranges.push([cell, cell + 1]),
            }
        }
        Self { grid, ranges }
    }

    /// Checks that kernels can compute with the set. The error is a sentence without a period.
    pub(super) fn check(&self) -> Result<(), String> {
        let Self { grid, ranges } = self;
        let CellGrid {
            center_m,
            radius_m,
            n_cells,
        } = grid;
        // The comparisons are written so that NaN fails them.
        let is_near = center_m.iter().all(|along| along.abs() <= MAX_COORD_M);
        if !(is_near
            && (MIN_RADIUS_M..=MAX_COORD_M).contains(radius_m)
            && (1..=MAX_CELLS).contains(n_cells))
        {
            return Err(format!(
                "invalid grid of erased cells: {grid:?}, expected coordinates up to {MAX_COORD_M:e} m, a radius from \
                 {MIN_RADIUS_M:e} m to {MAX_COORD_M:e} m and 1 to {MAX_CELLS} cells"
            ));
        }
        // Kernels search the ranges by bisection, which needs this order.
        let end = n_cells.pow(3);
        let is_ordered = ranges.windows(2).all(|pair| pair[0][1] <= pair[1][0]);
        if ranges.is_empty()
            || !is_ordered
            || ranges
                .iter()
                .any(|[first, after]| first >= after || *after > end)
        {
            return Err(format!(
                "erased cells need at least one range, in increasing order, disjoint and up to {end}"
            ));
        }
        Ok(())
    }

    /// Whether the set contains a point in world.
    pub fn contains(&self, point_m: [f64; 3]) -> bool {
        let cell = self.grid.cell_at(point_m);
        // Only the first range that ends after the cell can contain it.
        let n_before = self.ranges.partition_point(|[_, end]| *end <= cell);
        self.ranges
            .get(n_before)
            .is_some_and(|[first, _]| *first <= cell)
    }

    /// The ranges, two per group of four words.
    pub(super) fn range_words(&self) -> impl Iterator<Item = [u32; 4]> {
        self.ranges.chunks(2).map(|pair| {
            let [a, b] = pair[0];
            let [c, d] = pair.get(1).copied().unwrap_or_default();
            [a, b, c, d]
        })
    }

    /// The data of the set: rows of the transform to units of the radius, number of cells along an
    /// axis, the group where the ranges begin, and their number.
    pub(super) fn words(
        &self,
        world_from_drawn: &Matrix4<f64>,
        first: u32,
    ) -> [[u32; 4]; GROUPS_PER_EDIT] {
        let CellGrid {
            center_m,
            radius_m,
            n_cells,
        } = self.grid;
        let scale = Matrix4::new_scaling(1.0 / radius_m);
        let [x, y, z] =
            rows(&(scale * Matrix4::new_translation(&-Vector3::from(center_m)) * world_from_drawn));
        let n_ranges = u32::try_from(self.ranges.len()).unwrap_or(u32::MAX);
        [x, y, z, [n_cells, 0, 0, first], [0, 0, 0, n_ranges]]
    }
}
