//! Cells of an octree around the origin.

use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Number of levels below the root. Ids of the smallest cells have 52 bits, so a page can hold them
/// as JavaScript numbers.
const N_LEVELS: u32 = 17;
/// Edge of the root, meters. The smallest cells have edges of 8 mm. Splats outside of the root
/// belong to the nearest cell.
const ROOT_M: f64 = 1024.0;
/// Maximum number of splats in a cell. They take tens of kilobytes, so that a chunk does not delay
/// pictures for long.
const MAX_SPLATS: usize = 2048;
/// A cell that existed in the last version of the model is divided only if it has more splats than
/// this. If the number were equal to [`MAX_SPLATS`], a cell with about this many splats would be
/// repeatedly divided and merged, and sent each time.
const MAX_SPLATS_KEPT: usize = 2560;
/// Cells that existed in the last version of the model are merged only if they have at most this
/// many splats together.
const MAX_SPLATS_MERGED: usize = 1024;
/// Levels between a cell and its parts.
const PART_LEVELS: u32 = 2;

/// A cell, given by its level and by the location code of the first smallest cell in it. Cells are
/// ordered along the curve of location codes (Morton 1966).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Cell {
    first: u64,
    level: u32,
}

impl Cell {
    const ROOT: Self = Self { first: 0, level: 0 };

    /// A number that differs for all cells of all levels.
    pub(super) fn id(self) -> u64 {
        // A leading one marks the level. Without it, the ids of the first cells of all levels would
        // be 0.
        1 << (3 * self.level) | self.first >> (3 * (N_LEVELS - self.level))
    }

    /// Index of the part of the cell that contains a location.
    pub(super) fn part_of(self, code: u64) -> usize {
        // The smallest cells have no levels below them, so their splats are in few of the possible
        // parts.
        let shift = 3 * N_LEVELS.saturating_sub(self.level + PART_LEVELS);
        usize::try_from(code >> shift & ((1 << (3 * PART_LEVELS)) - 1)).unwrap_or(0)
    }

    /// First location code after the cell.
    fn end(self) -> u64 {
        self.first + (1 << (3 * (N_LEVELS - self.level)))
    }

    fn children(self) -> impl Iterator<Item = Self> {
        let level = self.level + 1;
        (0..8).map(move |ix| Self {
            first: self.first + (ix << (3 * (N_LEVELS - level))),
            level,
        })
    }
}

/// Location codes and indices of these points, sorted.
pub(super) fn location_codes(means: &[[f32; 3]], members: &[u32]) -> Vec<(u64, u32)> {
    let mut codes: Vec<_> = members
        .par_iter()
        .map(|ix| (location_code(means[*ix as usize]), *ix))
        .collect();
    codes.par_sort_unstable();
    codes
}

/// Position of a point along the curve, which consists of the interleaved bits of its coordinates.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 17 bits"
)]
fn location_code(mean: [f32; 3]) -> u64 {
    // The clamp moves splats outside of the root to its border. A NaN becomes 0.
    let n_cells = f64::from(1_u32 << N_LEVELS);
    let along =
        mean.map(|at| ((f64::from(at) / ROOT_M + 0.5) * n_cells).clamp(0.0, n_cells - 1.0) as u64);
    (0..N_LEVELS).fold(0, |code, bit| {
        code | (along[0] >> bit & 1) << (3 * bit)
            | (along[1] >> bit & 1) << (3 * bit + 1)
            | (along[2] >> bit & 1) << (3 * bit + 2)
    })
}

/// Cells that contain splats, and the ranges of their splats in `sorted`. The cells of the last
/// version are preferred.
pub(super) fn leaves<T>(
    sorted: &[(u64, u32)],
    last: &BTreeMap<Cell, T>,
) -> Vec<(Cell, Range<usize>)> {
    let mut leaves = Vec::new();
    divide(Cell::ROOT, 0..sorted.len(), sorted, last, &mut leaves);
    leaves
}

fn divide<T>(
    cell: Cell,
    range: Range<usize>,
    sorted: &[(u64, u32)],
    last: &BTreeMap<Cell, T>,
    leaves: &mut Vec<(Cell, Range<usize>)>,
) {
    // The cells of the last version do not overlap, so the first of them in this cell shows whether
    // this cell was divided.
    let first_last = last
        .range(
            cell..Cell {
                first: cell.end(),
                level: 0,
            },
        )
        .next()
        .map(|(last, _)| *last);
    let max_splats = match first_last {
        Some(last) if last == cell => MAX_SPLATS_KEPT,
        Some(_) => MAX_SPLATS_MERGED,
        None => MAX_SPLATS,
    };
    if range.is_empty() {
        return;
    }
    // Splats at one position cannot be separated by further division.
    if range.len() <= max_splats || cell.level == N_LEVELS {
        leaves.push((cell, range));
        return;
    }
    // The splats are sorted by location code, so the splats of each child are consecutive.
    let mut begin = range.start;
    for child in cell.children() {
        let n = sorted[begin..range.end].partition_point(|(code, _)| *code < child.end());
        divide(child, begin..begin + n, sorted, last, leaves);
        begin += n;
    }
}

#[cfg(test)]
mod tests {
    use super::{
        Cell, MAX_SPLATS, MAX_SPLATS_KEPT, MAX_SPLATS_MERGED, N_LEVELS, leaves, location_codes,
    };
    use numbers::random::Random;
    use std::collections::BTreeMap;

    #[expect(clippy::cast_possible_truncation, reason = "random positions")]
    fn points(n: usize, seed: u64) -> Vec<[f32; 3]> {
        let mut random = Random::new(seed);
        let mut means: Vec<[f32; 3]> = (0..n)
            .map(|_| [0; 3].map(|_| (0.5 * random.normal()) as f32))
            .collect();
        means.extend([[1e6, 0.0, -1e6], [-3000.0, 511.9, 0.001]]);
        means
    }

    fn cells_of(means: &[[f32; 3]], last: &[Cell]) -> Vec<(Cell, Vec<u32>)> {
        let members: Vec<u32> = (0..).take(means.len()).collect();
        let sorted = location_codes(means, &members);
        let last: BTreeMap<Cell, ()> = last.iter().map(|cell| (*cell, ())).collect();
        let members =
            |range: std::ops::Range<usize>| sorted[range].iter().map(|(_, ix)| *ix).collect();
        leaves(&sorted, &last)
            .into_iter()
            .map(|(cell, range)| (cell, members(range)))
            .collect()
    }

    #[test]
    fn each_splat_is_in_one_small_cell() {
        let means = points(30_000, 1);
        let cells = cells_of(&means, &[]);
        let mut all: Vec<u32> = cells
            .iter()
            .flat_map(|(_, members)| members.clone())
            .collect();
        all.sort_unstable();
        assert_eq!(all, (0..).take(means.len()).collect::<Vec<u32>>());
        let mut ids: Vec<u64> = cells.iter().map(|(cell, _)| cell.id()).collect();
        ids.sort_unstable();
        ids.dedup();
        assert!(ids.len() == cells.len() && ids.iter().all(|id| *id < 1 << 53));
        for (cell, members) in &cells {
            assert!(!members.is_empty() && members.len() <= MAX_SPLATS);
            let edge_m = 1024.0 / f64::from(1_u32 << cell.level) * (1.0 + 1e-6);
            let is_inside =
                |ix: &&u32| means[**ix as usize].iter().all(|along| along.abs() < 512.0);
            let extent_m = |axis: usize| {
                let along = members
                    .iter()
                    .filter(is_inside)
                    .map(|ix| f64::from(means[*ix as usize][axis]));
                along.clone().fold(f64::NEG_INFINITY, f64::max)
                    - along.fold(f64::INFINITY, f64::min)
            };
            for extent_m in [0, 1, 2].map(extent_m) {
                assert!(extent_m <= edge_m, "{extent_m} m in a cell of {edge_m} m");
            }
        }
        let coincident = vec![[0.25_f32; 3]; 5000];
        let cells = cells_of(&coincident, &[]);
        assert!(
            cells.len() == 1 && cells[0].0.level == N_LEVELS,
            "they cannot be divided"
        );
    }

    #[test]
    fn cells_persist_while_the_number_of_splats_changes_slightly() {
        let cells = |n: usize, last: &[Cell]| {
            cells_of(&points(n, 2), last)
                .into_iter()
                .map(|(cell, _)| cell)
                .collect::<Vec<_>>()
        };
        let mut last = cells(30_000, &[]);
        let n_first = last.len();
        for n in [31_000, 29_500, 30_500, 29_000] {
            let next = cells(n, &last);
            let n_common = next.iter().filter(|cell| last.contains(cell)).count();
            assert!(
                10 * n_common >= 9 * n_first,
                "{n_common} of {n_first} cells persist"
            );
            last = next;
        }
        const { assert!(MAX_SPLATS_MERGED < MAX_SPLATS && MAX_SPLATS < MAX_SPLATS_KEPT) };
        assert!(cells(500, &last).len() <= 8, "cells are merged");
    }
}
