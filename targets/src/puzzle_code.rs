//! Code of PuzzleBoards, which determines whether the dot on an edge between squares is black or
//! white.
//!
//! Source: Stelldinger, Schönherr and Biermann 2024, "PuzzleBoard: A new camera calibration pattern
//! with position encoding". The maps come from the authors, by way of the crate
//! `calib-targets-puzzleboard`.

use calib_targets_puzzleboard::code_maps::{horizontal_edge_bit, vertical_edge_bit};

/// Number of columns and rows after which the master pattern repeats.
pub(crate) const PERIOD: u32 = 501;
/// The code of the horizontal or vertical edges repeats after 3 squares along one axis, and after
/// this number of squares along the other axis.
const LONG: u32 = 167;
const SHORT: u32 = 3;
/// Diameter of the dots relative to the square.
pub(crate) const DOT_FRAC: f64 = 1.0 / 3.0;

/// An edge between two squares of the master pattern. It may also be an edge of a part of the
/// pattern whose offset is unknown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Edge {
    /// The square left of or above the edge.
    pub(crate) column: i32,
    pub(crate) row: i32,
    /// Whether the edge is vertical. The other square of a vertical edge is to the right.
    pub(crate) is_vertical: bool,
}

impl Edge {
    /// Whether the dot on this edge of the master pattern is white.
    pub(crate) fn is_white(self) -> bool {
        let bit = if self.is_vertical {
            vertical_edge_bit
        } else {
            horizontal_edge_bit
        };
        bit(self.row, self.column) == 1
    }

    fn shifted(self, columns: u32, rows: u32) -> Self {
        Self {
            column: self.column + columns.cast_signed(),
            row: self.row + rows.cast_signed(),
            ..self
        }
    }
}

/// A position in the master pattern and how well it fits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Position {
    /// Column and row of the master pattern at the observed column 0, row 0.
    pub(crate) offset: [u32; 2],
    pub(crate) n_right: usize,
}

/// Finds the offset at which most observed dots (edge, whether the dot is white) agree with the
/// master pattern. Only possible offsets are considered. `None` if no offset is possible.
///
/// The colors of the horizontal edges depend on the offset modulo 3 along one axis and modulo 167
/// along the other. For the vertical edges, the axes are swapped. The agreement of the two kinds is
/// therefore counted separately and then summed for every offset.
pub(crate) fn locate(
    dots: &[(Edge, bool)],
    is_possible: impl Fn([u32; 2]) -> bool,
) -> Option<Position> {
    // Each table has 501 entries. Comparing all dots at all 251001 offsets would take 250 times as
    // long.
    let vertical = agreement(dots, true, [LONG, SHORT]);
    let horizontal = agreement(dots, false, [SHORT, LONG]);
    let offsets = (0..PERIOD).flat_map(|row| (0..PERIOD).map(move |column| [column, row]));
    let possible = offsets.filter(|&offset| is_possible(offset));
    possible
        .map(|offset| {
            let [column, row] = offset;
            let at_vertical = column % LONG + LONG * (row % SHORT);
            let at_horizontal = column % SHORT + SHORT * (row % LONG);
            Position {
                offset,
                n_right: vertical[at_vertical as usize] + horizontal[at_horizontal as usize],
            }
        })
        .max_by_key(|position| position.n_right)
}

/// Number of dots on edges of one kind that agree with the master pattern, for every offset below
/// these columns and rows, row by row.
fn agreement(dots: &[(Edge, bool)], is_vertical: bool, [columns, rows]: [u32; 2]) -> Vec<usize> {
    let n_right_at = |column: u32, row: u32| {
        dots.iter()
            .filter(|(edge, _)| edge.is_vertical == is_vertical)
            .filter(|(edge, is_white)| edge.shifted(column, row).is_white() == *is_white)
            .count()
    };
    (0..columns * rows)
        .map(|at| n_right_at(at % columns, at / columns))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_located_despite_wrong_dots() {
        let edges = (0..6).flat_map(|row| (0..7).map(move |column| [column, row]));
        let both = edges.flat_map(|[column, row]| {
            [true, false].map(|is_vertical| Edge {
                column,
                row,
                is_vertical,
            })
        });
        let mut dots: Vec<(Edge, bool)> = both
            .map(|edge| (edge, edge.shifted(333, 77).is_white()))
            .collect();
        for wrong in [3, 20, 41, 60] {
            dots[wrong].1 = !dots[wrong].1;
        }
        let expected = Position {
            offset: [333, 77],
            n_right: dots.len() - 4,
        };
        assert_eq!(locate(&dots, |_| true), Some(expected));
        assert_eq!(locate(&dots, |_| false), None);
        assert!(
            locate(&dots, |offset| offset != expected.offset)
                .unwrap()
                .n_right
                < expected.n_right
        );
    }
}
