//! Detection of PuzzleBoards. A PuzzleBoard is a chessboard grid, and the dots on its edges encode
//! its position in a master pattern.

use super::chessboard::{Levels, trim};
use super::{Detection, MIN_CORNERS};
use crate::alignment::Printed;
use crate::error::{Counts, NotDetected};
use crate::gray::Plane;
use crate::lattice::{Cell, Lattice, Refinement, STEPS};
use crate::puzzle_code::{Edge, PERIOD, Position, locate};
use crate::spec::TargetSpec;

/// Largest fraction of dots that may be read wrong. With `n` random dots, the best of a million
/// positions agrees with a fraction of about `0.5 + 2.4 / sqrt(n)` of the dots. This is 0.81 for
/// [`MIN_DOTS`]. A larger value accepts more blur, but is closer to this chance level.
const MAX_WRONG_FRAC: f64 = 0.12;
/// Minimum number of dots. With fewer dots, other positions in the pattern may fit equally well.
/// The pattern has 501 x 501 positions in four rotations, so 20 bits identify a position. The
/// remaining dots correct wrong dots.
const MIN_DOTS: usize = 60;
/// Dots begin at a third of the square from each corner.
const REFINEMENT: Refinement = Refinement { clear_frac: 0.3 };

/// The board to find.
pub(super) struct Board<'a> {
    pub(super) target: &'a TargetSpec,
    /// Columns and rows of squares.
    pub(super) squares: [u32; 2],
    /// Column and row of the first square in the master pattern.
    pub(super) origin: [u32; 2],
    pub(super) square_m: f64,
}

impl Board<'_> {
    /// Finds a part of the board.
    pub(super) fn detect(&self, plane: &Plane) -> Result<Detection, NotDetected> {
        let smoothed = plane.smoothed();
        let mut failure = NotDetected::Nothing {
            target: self.target.kind(),
        };
        // At a wrong resolution, few corners are found. If no grid can be read, the reason for the
        // largest grid is reported.
        let mut n_best = 0;
        for lattice in Levels::new(plane).grids() {
            let n = lattice.corners.len();
            match self.read(plane, &smoothed, lattice) {
                Ok(detection) => return Ok(detection),
                Err(reason) if n > n_best => (n_best, failure) = (n, reason),
                Err(_) => {}
            }
        }
        Err(failure)
    }

    /// Reads the code of a grid and renumbers its corners.
    fn read(
        &self,
        plane: &Plane,
        smoothed: &Plane,
        mut lattice: Lattice,
    ) -> Result<Detection, NotDetected> {
        let Self {
            target,
            squares,
            square_m,
            ..
        } = *self;
        let nothing = NotDetected::Nothing {
            target: target.kind(),
        };
        // Missing corners are completed before reading, because reading a dot requires the corners
        // of both squares next to it.
        let range = lattice.range().ok_or(nothing.clone())?;
        lattice.complete(smoothed, range, REFINEMENT);
        lattice.refine(smoothed, REFINEMENT);
        lattice.remove_outliers();
        let mut trimmed = lattice.clone();
        trim(&mut trimmed);
        let [low, high] = trimmed.range().ok_or(nothing)?;
        let found = Counts {
            columns: (high[0] - low[0] + 1).cast_unsigned(),
            rows: (high[1] - low[1] + 1).cast_unsigned(),
        };
        let dots = dots(plane, &trimmed);
        if dots.len() < MIN_DOTS {
            return Err(NotDetected::TooFewCorners {
                found: trimmed.corners.len(),
                min: MIN_DOTS / 2,
            });
        }
        let (turns, offset) = self.located(&dots, [low, high], found)?;
        let inner = squares.map(|count| count.cast_signed() - 1);
        let is_on_board = |cell: Cell| (0..2).all(|axis| cell[axis] < inner[axis]);
        let placed = trimmed
            .corners
            .iter()
            .map(|(&cell, &pixel)| (self.place(turn(cell, turns), offset), pixel));
        let mut on_board = Lattice {
            corners: placed.filter(|(cell, _)| is_on_board(*cell)).collect(),
        };
        let surface = target.surface();
        let printed = Printed {
            surface,
            square_m,
            first_m: [0.0; 2],
            side_m: square_m,
        };
        // Dots displace the corners found so far. In the second round, the distances of the dots
        // are correct.
        printed.align_strictly(plane, &mut on_board);
        printed.align_strictly(plane, &mut on_board);
        if on_board.corners.len() < MIN_CORNERS {
            return Err(NotDetected::TooFewCorners {
                found: on_board.corners.len(),
                min: MIN_CORNERS,
            });
        }
        let id = |cell: Cell| (cell[1] * inner[0] + cell[0]).cast_unsigned();
        Ok(target.detection(
            on_board
                .corners
                .iter()
                .map(|(&cell, &pixel)| (id(cell), pixel)),
            false,
        ))
    }
}

impl Board<'_> {
    /// Determines the quarter turns of a lattice and its offset in the master pattern from its
    /// dots.
    ///
    /// `found` contains the counts of the lattice, for messages.
    fn located(
        &self,
        dots: &[Dot],
        range: [Cell; 2],
        found: Counts,
    ) -> Result<(usize, [u32; 2]), NotDetected> {
        // A grid has no upright direction, so the code is searched in all four rotations.
        let located = (0..4).filter_map(|turns| {
            let is_possible = |offset: [u32; 2]| self.is_possible(range, turns, offset);
            Some((turns, locate(&rotated(dots, turns), is_possible)?))
        });
        let Some((turns, Position { offset, n_right })) =
            located.max_by_key(|(_, position)| position.n_right)
        else {
            let [columns, rows] = self.squares.map(|count| count - 1);
            let expected = Counts { columns, rows };
            return Err(NotDetected::OtherSize { found, expected });
        };
        // A different pattern also has a best position, but too few of its dots agree there.
        let wrong_frac = 1.0 - n_right as f64 / dots.len() as f64;
        if wrong_frac > MAX_WRONG_FRAC {
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a percentage"
            )]
            let wrong_percent = (100.0 * wrong_frac).round() as u32;
            return Err(NotDetected::Code {
                found,
                wrong_percent,
            });
        }
        Ok((turns, offset))
    }

    /// Column and row on the board of a corner of the lattice, if the lattice is at `offset` in the
    /// master pattern. Corner (0, 0) of the board is the lower right corner of its first square.
    fn place(&self, cell: Cell, offset: [u32; 2]) -> Cell {
        [0, 1].map(|axis| {
            (cell[axis] + offset[axis].cast_signed() - self.origin[axis].cast_signed())
                .rem_euclid(PERIOD.cast_signed())
        })
    }

    /// Whether a lattice with this range of cells lies on the board.
    fn is_possible(&self, range: [Cell; 2], turns: usize, offset: [u32; 2]) -> bool {
        let ends = range.map(|cell| turn(cell, turns));
        let first = [0, 1].map(|axis| ends[0][axis].min(ends[1][axis]));
        let last = [0, 1].map(|axis| ends[0][axis].max(ends[1][axis]));
        // One line next to the board may have been taken for a part of it.
        let at = self
            .place([first[0] + 1, first[1] + 1], offset)
            .map(|value| value - 1);
        (0..2).all(|axis| at[axis] + last[axis] - first[axis] < self.squares[axis].cast_signed())
    }
}

/// An edge between two corners of the lattice: the first corner, the direction to the second
/// corner, and the dot's color.
type Dot = (Cell, Cell, bool);

/// Reads the dots on all edges with squares on both sides that are bounded by corners.
fn dots(plane: &Plane, lattice: &Lattice) -> Vec<Dot> {
    let mut dots = Vec::new();
    for (&cell, &here) in &lattice.corners {
        for at in [0, 1] {
            let step = STEPS[at];
            let side = STEPS[1 - at];
            let corner = |cell: Cell| lattice.corners.get(&cell).copied();
            let end = shifted(cell, step, 1);
            let squares = [-1, 1].map(|n| {
                Some([
                    corner(shifted(cell, side, n))?,
                    corner(shifted(end, side, n))?,
                ])
            });
            let (Some(there), [Some(a), Some(b)]) = (corner(end), squares) else {
                continue;
            };
            // One of the two squares is black, the other white. The mean of their gray values is a
            // threshold that adapts to shadows and vignetting.
            let [value_a, value_b] =
                [a, b].map(|[c, d]| f64::from(plane.sample(middle([here, there, c, d]))));
            let value = f64::from(plane.sample(middle([here, there, here, there])));
            dots.push((cell, step, value > (value_a + value_b) / 2.0));
        }
    }
    dots
}

/// A cell `n` steps away.
fn shifted(cell: Cell, step: Cell, n: i32) -> Cell {
    [cell[0] + n * step[0], cell[1] + n * step[1]]
}

/// The mean of four points.
fn middle(points: [[f64; 2]; 4]) -> [f64; 2] {
    [0, 1].map(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / 4.0)
}

/// A cell after quarter turns of the lattice, clockwise as seen on the board.
fn turn([x, y]: Cell, turns: usize) -> Cell {
    match turns {
        0 => [x, y],
        1 => [-y, x],
        2 => [-x, -y],
        _ => [y, -x],
    }
}

/// The dots as edges of the master pattern, if the lattice is rotated by quarter turns.
///
/// Corner `(x, y)` is the lower right corner of square `(x, y)`, so the edge from the corner to the
/// right is the horizontal edge below square `(x + 1, y)`. The edge from the corner downwards is
/// the vertical edge to the right of square `(x, y + 1)`.
fn rotated(dots: &[Dot], turns: usize) -> Vec<(Edge, bool)> {
    dots.iter()
        .map(|&(cell, step, is_white)| {
            let from = turn(cell, turns);
            let to = turn(shifted(cell, step, 1), turns);
            let edge = Edge {
                column: from[0].max(to[0]),
                row: from[1].max(to[1]),
                is_vertical: from[0] == to[0],
            };
            (edge, is_white)
        })
        .collect()
}
