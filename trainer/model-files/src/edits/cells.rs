//! A set of cells of a grid over all space.

use super::MAX_COORD_M;
use crate::contraction::contract;
use serde::{Deserialize, Serialize};

/// Maximum number of cells along an axis. Indices then have 30 bits, so kernels compute them in
/// `u32`.
const MAX_CELLS: u32 = 1024;
/// Smallest radius of the cube with equal cells, meters. Its inverse times any coordinate is finite
/// in f32.
const MIN_RADIUS_M: f64 = 1e-6;

/// A grid of cells that covers all space. Within a radius, the cells are cubes of equal size.
/// Outside, they are larger, as in a contracted neural field (Barron et al. 2022).
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
    pub fn n(&self) -> usize {
        (self.n_cells as usize).pow(3)
    }

    /// Width of the cells at a point along the narrower directions, meters.
    pub fn cell_m(&self, point_m: [f64; 3]) -> f64 {
        // The contracted cube is 4 radii wide. At the distance `largest`, the contraction of Barron
        // et al. 2022 (equation 10) maps to (2 - 1 / largest) / largest times the coordinate.
        // Widths across the ray are divided by this factor. Along the ray, cells are even wider.
        let largest = self
            .scaled(point_m)
            .iter()
            .fold(1.0, |largest: f64, along| largest.max(along.abs()));
        4.0 * self.radius_m / f64::from(self.n_cells) * largest * largest / (2.0 * largest - 1.0)
    }

    /// Indices of the cells around a cell, without the cell itself.
    pub fn neighbors(&self, index: u32) -> impl Iterator<Item = u32> + use<> {
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

/// A coordinate moved by `step - 1`. `None` outside the grid of `n` cells. Steps are 0 to 2,
/// because coordinates are unsigned.
fn moved_by(along: u32, step: u32, n: u32) -> Option<u32> {
    (along + step).checked_sub(1).filter(|along| *along < n)
}

/// A set of at least one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellSet {
    /// The grid.
    pub(super) grid: CellGrid,
    /// Disjoint ranges of indices in increasing order. A range consists of its first index and of
    /// the index after its last index.
    pub(super) ranges: Vec<[u32; 2]>,
}

impl CellSet {
    /// The set of these cells, which are in increasing order.
    pub fn new(grid: CellGrid, cells: impl IntoIterator<Item = u32>) -> Self {
        let mut ranges: Vec<[u32; 2]> = Vec::new();
        for cell in cells {
            // Floaters fill runs of cells along x, so storing ranges takes fewer words than storing
            // cells.
            match ranges.last_mut() {
                Some([_, end]) if *end == cell => *end += 1,
                _ => ranges.push([cell, cell + 1]),
            }
        }
        Self { grid, ranges }
    }

    /// The grid of the cells.
    pub fn grid(&self) -> &CellGrid {
        &self.grid
    }

    /// Disjoint ranges of indices in increasing order. A range consists of its first index and of
    /// the index after its last index.
    pub fn ranges(&self) -> &[[u32; 2]] {
        &self.ranges
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
}
