//! Detection of chessboards.

use super::{Detection, MIN_CORNERS};
use crate::alignment::Printed;
use crate::error::{Counts, NotDetected};
use crate::gray::Plane;
use crate::grid;
use crate::lattice::{Cell, Lattice, Refinement, STEPS};
use crate::saddle::{self, angle_between};
use crate::spec::TargetSpec;

/// Images with more pixels are first searched at half resolution, which has a quarter of the
/// pixels. Corners are always refined in the full image.
const HALVE_ABOVE_PX: usize = 3_000_000;
/// Number of resolutions that are searched. The ring around saddles has a fixed radius. Squares
/// must not be smaller than the ring, and their blur must not be much larger than the ring. Three
/// resolutions cover a factor of four.
const N_LEVELS: usize = 3;
/// A row or column belongs to the board if it has at least this fraction of its corners. False
/// corners next to the board form lines with few corners. If some corners of the board are hidden,
/// most of a line remains.
const MIN_LINE_FRAC: f64 = 0.5;
/// A board is used if at least this percentage of its corners is found. With fewer corners, a wrong
/// grid of the right size is more likely than a board with that many hidden corners.
const MIN_CORNER_PERCENT: usize = 60;

/// Squares are empty.
const REFINEMENT: Refinement = Refinement { clear_frac: 0.5 };

/// Resolutions of an image that are searched, with the size of their pixels.
pub(super) struct Levels {
    planes: Vec<(Plane, f64)>,
}

impl Levels {
    pub(super) fn new(plane: &Plane) -> Self {
        let mut planes = vec![(plane.smoothed(), 1.0)];
        let mut halved = plane.clone();
        while planes.len() < N_LEVELS && halved.can_be_halved() {
            halved = halved.halved();
            let scale = planes[planes.len() - 1].1 * 2.0;
            planes.push((halved.smoothed(), scale));
        }
        let [width, height] = plane.size();
        if width * height > HALVE_ABOVE_PX && planes.len() > 1 {
            planes.swap(0, 1);
        }
        Self { planes }
    }

    /// The largest grid at each resolution, with pixels of the full image.
    pub(super) fn grids(&self) -> impl Iterator<Item = Lattice> {
        self.planes.iter().filter_map(|(plane, scale)| {
            let saddles = saddle::find(plane);
            let mut grid = grid::link(plane, &saddles, MIN_CORNERS)
                .into_iter()
                .next()?;
            grid.corners
                .values_mut()
                .for_each(|pixel| *pixel = pixel.map(|value| value * scale));
            Some(grid)
        })
    }
}

/// Finds a chessboard with `inner` columns and rows of inner corners.
pub(super) fn detect(
    target: &TargetSpec,
    inner: [u32; 2],
    square_m: f64,
    plane: &Plane,
) -> Result<Detection, NotDetected> {
    let smoothed = plane.smoothed();
    let mut failure = NotDetected::Nothing {
        target: target.kind(),
    };
    let mut n_best = 0;
    for mut grid in Levels::new(plane).grids() {
        match matching(&mut grid, inner, &smoothed) {
            Ok(mut lattice) => {
                let surface = target.surface();
                Printed {
                    surface,
                    square_m,
                    first_m: [0.0; 2],
                    side_m: square_m,
                }
                .align(plane, &mut lattice);
                // Cells of the board are not negative after renumbering.
                let id = |cell: Cell| {
                    Some(u32::try_from(cell[1]).ok()? * inner[0] + u32::try_from(cell[0]).ok()?)
                };
                let pixels = lattice
                    .corners
                    .iter()
                    .filter_map(|(&cell, &pixel)| Some((id(cell)?, pixel)));
                return Ok(target.detection(pixels, false));
            }
            // At another resolution, a part of a larger board may look like the board of the
            // target.
            Err(reason @ NotDetected::OtherSize { .. }) if is_complete_and_larger(&grid, inner) => {
                return Err(reason);
            }
            Err(reason) if grid.corners.len() > n_best => {
                n_best = grid.corners.len();
                failure = reason;
            }
            Err(_) => {}
        }
    }
    Err(failure)
}

/// Whether almost all corners of a larger grid were found.
fn is_complete_and_larger(grid: &Lattice, inner: [u32; 2]) -> bool {
    // A grid with gaps may contain corners of the surroundings, so such a grid is no evidence of a
    // larger board.
    const MIN_PERCENT: usize = 95;
    let Some([low, high]) = grid.range() else {
        return false;
    };
    let size = [high[0] - low[0] + 1, high[1] - low[1] + 1].map(i32::cast_unsigned);
    let is_larger = |size: [u32; 2]| size[0] >= inner[0] && size[1] >= inner[1] && size != inner;
    let n = (size[0] * size[1]) as usize;
    (is_larger(size) || is_larger([size[1], size[0]]))
        && grid.corners.len() * 100 >= n * MIN_PERCENT
}

/// Refines a grid, and gives its corners the numbers of the board's corners.
fn matching(lattice: &mut Lattice, inner: [u32; 2], plane: &Plane) -> Result<Lattice, NotDetected> {
    // Lines at the edge of the board may have been missed.
    const GROWN_LINES: i32 = 1;
    // The grid is filled first, so that its size can be checked.
    if let Some([low, high]) = lattice.range() {
        let is_smaller =
            (high[0] - low[0] + 1) * (high[1] - low[1] + 1) < (inner[0] * inner[1]).cast_signed();
        let grown = if is_smaller { GROWN_LINES } else { 0 };
        lattice.complete(
            plane,
            [
                low.map(|value| value - grown),
                high.map(|value| value + grown),
            ],
            REFINEMENT,
        );
    }
    // Corners of the surroundings are removed for three reasons: they are not saddles, they do not
    // fit their neighbors, or their line has too few corners.
    lattice.refine(plane, REFINEMENT);
    lattice.remove_outliers();
    trim(lattice);
    let nothing = NotDetected::Nothing {
        target: "chessboard",
    };
    let [low, high] = lattice.range().ok_or(nothing)?;
    let size = [high[0] - low[0] + 1, high[1] - low[1] + 1].map(i32::cast_unsigned);
    if size != inner && size != [inner[1], inner[0]] {
        return Err(wrong_size(lattice, size, inner, plane));
    }
    let expected = (inner[0] * inner[1]) as usize;
    let min = (expected * MIN_CORNER_PERCENT).div_ceil(100);
    if lattice.corners.len() < min {
        return Err(NotDetected::TooFewCorners {
            found: lattice.corners.len(),
            min,
        });
    }
    oriented(lattice, [low, high], inner).ok_or(NotDetected::Nothing {
        target: "chessboard",
    })
}

/// Chooses one of the rotations that turn a grid with these smallest and largest cells into the
/// board. Returns the renumbered corners.
fn oriented(lattice: &Lattice, [low, high]: [Cell; 2], inner: [u32; 2]) -> Option<Lattice> {
    let size = [high[0] - low[0] + 1, high[1] - low[1] + 1].map(i32::cast_unsigned);
    let is_odd = (inner[0] + inner[1]) % 2 == 1;
    let mut rotations = Vec::new();
    for turns in 0..4 {
        let rotated_size = if turns % 2 == 0 {
            size
        } else {
            [size[1], size[0]]
        };
        if inner != rotated_size {
            continue;
        }
        // The cell that becomes the board's first corner.
        let corner = [
            if turns == 1 || turns == 2 {
                high[0]
            } else {
                low[0]
            },
            if turns >= 2 { high[1] } else { low[1] },
        ];
        // The square at the upper left of the board's first corner is black. Without rotation, this
        // is the upper left square of the grid's first corner, and colors alternate from there.
        // Rotations by 90 degrees select a different square.
        let is_black = (corner[0] + corner[1] + turns).rem_euclid(2) == 0;
        if !is_odd || is_black {
            rotations.push((is_black, renumber(lattice, corner, turns as usize)));
        }
    }
    // A square board with an odd number of corners per side changes colors with every rotation by
    // 90 degrees. If no rotation has a black square there, the board is printed with white corners,
    // and all rotations are kept.
    let has_black = rotations.iter().any(|(is_black, _)| *is_black);
    // The remaining rotations are symmetries of the board. The choice depends on the image, so that
    // the ids are the same in all images of a board that is roughly upright.
    let from_right = |lattice: &Lattice| x_axis_rad(lattice).map_or(f64::INFINITY, f64::abs);
    rotations
        .into_iter()
        .filter(|(is_black, _)| *is_black || !has_black)
        .map(|(_, lattice)| lattice)
        .min_by(|a, b| from_right(a).total_cmp(&from_right(b)))
}

/// Removes outermost rows and columns that have few corners, because they are not part of the
/// board.
pub(super) fn trim(lattice: &mut Lattice) {
    while let Some([low, high]) = lattice.range() {
        // One line is removed at a time, starting with the weakest, because its removal changes the
        // length of the lines across it.
        let lines: [(usize, i32); 4] = [(0, low[0]), (0, high[0]), (1, low[1]), (1, high[1])];
        let weakest = lines
            .into_iter()
            .map(|(axis, at)| {
                let length = high[1 - axis] - low[1 - axis] + 1;
                (line_frac(lattice, axis, at, length), axis, at)
            })
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match weakest {
            Some((frac, axis, at)) if frac < MIN_LINE_FRAC => {
                lattice.corners.retain(|cell, _| cell[axis] != at)
            }
            _ => return,
        }
    }
}

/// The fraction of the corners of a line that exist. The line is column `at` for axis 0 and row
/// `at` for axis 1.
fn line_frac(lattice: &Lattice, axis: usize, at: i32, length: i32) -> f64 {
    let n = lattice
        .corners
        .keys()
        .filter(|cell| cell[axis] == at)
        .count();
    n as f64 / f64::from(length)
}

/// Renumbers the cells relative to a corner, with the x axis along `STEPS[turns]`.
fn renumber(lattice: &Lattice, corner: Cell, turns: usize) -> Lattice {
    let x = STEPS[turns];
    let y = STEPS[(turns + 1) % 4];
    let mut renumbered = Lattice::default();
    for (cell, &pixel) in &lattice.corners {
        let offset = [cell[0] - corner[0], cell[1] - corner[1]];
        let cell = [
            offset[0] * x[0] + offset[1] * x[1],
            offset[0] * y[0] + offset[1] * y[1],
        ];
        renumbered.corners.insert(cell, pixel);
    }
    renumbered
}

/// Direction of the board's x axis in the image. It is the direction of the sum of the vectors
/// between all neighbors along it.
fn x_axis_rad(lattice: &Lattice) -> Option<f64> {
    let mut sum = [0.0; 2];
    for (cell, pixel) in &lattice.corners {
        if let Some(next) = lattice.corners.get(&[cell[0] + 1, cell[1]]) {
            sum = [sum[0] + next[0] - pixel[0], sum[1] + next[1] - pixel[1]];
        }
    }
    (sum != [0.0; 2]).then(|| angle_between(sum[1].atan2(sum[0]), 0.0))
}

/// The reason for a wrong size: the board has another size, or a part of it is outside the image.
fn wrong_size(lattice: &Lattice, size: [u32; 2], inner: [u32; 2], plane: &Plane) -> NotDetected {
    // For the message, columns and rows are swapped such that the longer side is the same side as
    // on the target.
    let is_swapped = (size[0] < size[1]) != (inner[0] < inner[1]);
    let [columns, rows] = if is_swapped { [size[1], size[0]] } else { size };
    let found = Counts { columns, rows };
    let expected = Counts {
        columns: inner[0],
        rows: inner[1],
    };
    // The next corner would be outside the image, or too close to its border to be verified by the
    // ring.
    let is_at_border = lattice.corners.iter().any(|(cell, pixel)| {
        let spacing_px = lattice.spacing_px(*cell).unwrap_or(0.0);
        !plane.contains(*pixel, 1.5 * spacing_px)
    });
    let is_smaller = columns <= inner[0] && rows <= inner[1];
    // Smaller grids than this cannot be specified, so they consist of false corners.
    const MIN_SIDE: u32 = 3;
    if size.iter().any(|&side| side < MIN_SIDE) {
        NotDetected::Nothing {
            target: "chessboard",
        }
    } else if is_smaller && is_at_border {
        NotDetected::Partial { found, expected }
    } else {
        NotDetected::OtherSize { found, expected }
    }
}
