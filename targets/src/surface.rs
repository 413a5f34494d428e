//! The printed pattern of a target: the color of every point, and the black shapes of which the
//! pattern consists.

use crate::dictionary::Dictionary;
use crate::layout::is_black_square;
use crate::puzzle_code::{DOT_FRAC, Edge};
use crate::spec::{Pattern, TargetSpec};

/// Border of the tags of an AprilGrid, in cells, as printed by Kalibr.
const GRID_TAG_BORDER: usize = 2;
/// Border of single tags and ArUco markers.
const BORDER: usize = 1;

/// A black or white shape in the board frame, meters. Later shapes cover earlier shapes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shape {
    /// Black rectangle, given by its smallest x and y and its largest x and y.
    Rectangle([[f64; 2]; 2]),
    /// Disk with its center and radius.
    Disk {
        center: [f64; 2],
        radius: f64,
        is_black: bool,
    },
}

/// A printed target.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Surface<'a> {
    pub(crate) pattern: &'a Pattern,
    /// ChArUco boards only.
    pub(crate) is_legacy: bool,
}

impl TargetSpec {
    pub(crate) fn surface(&self) -> Surface<'_> {
        Surface {
            pattern: &self.pattern,
            is_legacy: false,
        }
    }
}

impl Surface<'_> {
    /// Whether a point of the board frame (meters) is black. Points outside the pattern are white.
    pub(crate) fn is_black(&self, [x, y]: [f64; 2]) -> bool {
        match self.pattern {
            Pattern::Chessboard { inner, square_m } => {
                let square = square(
                    [x / square_m + 1.0, y / square_m + 1.0],
                    inner.map(|count| count + 1),
                );
                square.is_some_and(|[column, row]| is_black_square(column, row, 1, false))
            }
            Pattern::Charuco {
                squares,
                square_m,
                marker_m,
                dictionary,
            } => {
                let position = [x / square_m, y / square_m];
                let marker_frac = marker_m / square_m;
                self.is_black_on_charuco(*squares, marker_frac, dictionary, position)
            }
            Pattern::Aprilgrid {
                tags,
                tag_m,
                spacing_frac,
            } => {
                let in_tags = [x / tag_m, y / tag_m];
                is_black_on_aprilgrid(*tags, *spacing_frac, in_tags)
            }
            Pattern::Puzzleboard {
                squares,
                square_m,
                origin,
            } => {
                let position = [x / square_m + 1.0, y / square_m + 1.0];
                let Some(cell) = square(position, *squares) else {
                    return false;
                };
                // Dots are printed over the squares.
                let dot = dot_near(position, cell, *squares, *origin);
                dot.unwrap_or_else(|| {
                    is_black_square(cell[0] + origin[0], cell[1] + origin[1], 1, false)
                })
            }
            Pattern::Tag { id, side_m } => is_black_cell(
                &Dictionary::tag36h11(),
                *id,
                BORDER,
                [x / side_m + 0.5, y / side_m + 0.5],
            ),
        }
    }

    /// Whether a ChArUco board is black at a position in squares. `marker_frac` is the side of the
    /// markers relative to the squares.
    fn is_black_on_charuco(
        &self,
        squares: [u32; 2],
        marker_frac: f64,
        dictionary: &Dictionary,
        position: [f64; 2],
    ) -> bool {
        let Some([column, row]) = square(position, squares) else {
            return false;
        };
        if is_black_square(column, row, squares[1], self.is_legacy) {
            return true;
        }
        // The marker is in the middle of the square.
        let in_marker = [
            position[0] - f64::from(column),
            position[1] - f64::from(row),
        ]
        .map(|frac| (frac - 0.5) / marker_frac + 0.5);
        let id = self.charuco_id(squares, column, row);
        is_black_cell(dictionary, id, BORDER, in_marker)
    }

    /// Id of the marker in a white square. Markers are numbered row by row.
    fn charuco_id(&self, squares: [u32; 2], column: u32, row: u32) -> u32 {
        let is_white = |column, row| !is_black_square(column, row, squares[1], self.is_legacy);
        let n_before = |row: u32, n: u32| (n + u32::from(is_white(0, row))) / 2;
        // Two neighboring rows have one marker per column.
        row / 2 * squares[0] + row % 2 * n_before(0, squares[0]) + n_before(row, column)
    }

    /// All shapes, in the order of painting.
    pub(crate) fn shapes(&self) -> Vec<Shape> {
        let mut shapes = Vec::new();
        match *self.pattern {
            Pattern::Chessboard { inner, square_m } => {
                let squares = inner.map(|count| count + 1);
                let is_black = |[column, row]: [u32; 2]| is_black_square(column, row, 1, false);
                black_squares(squares, -square_m, square_m, is_black, &mut shapes);
            }
            Pattern::Charuco {
                squares,
                square_m,
                marker_m,
                dictionary,
            } => {
                let is_black = |[column, row]: [u32; 2]| {
                    is_black_square(column, row, squares[1], self.is_legacy)
                };
                black_squares(squares, 0.0, square_m, is_black, &mut shapes);
                for cell in cells(squares).filter(|&cell| !is_black(cell)) {
                    let corner =
                        cell.map(|count| f64::from(count) * square_m + (square_m - marker_m) / 2.0);
                    let id = self.charuco_id(squares, cell[0], cell[1]);
                    marker(&dictionary, id, BORDER, corner, marker_m, &mut shapes);
                }
            }
            Pattern::Aprilgrid {
                tags,
                tag_m,
                spacing_frac,
            } => {
                aprilgrid_shapes(tags, tag_m, spacing_frac, &mut shapes);
            }
            Pattern::Puzzleboard {
                squares,
                square_m,
                origin,
            } => {
                let is_black = |[column, row]: [u32; 2]| {
                    is_black_square(column + origin[0], row + origin[1], 1, false)
                };
                black_squares(squares, -square_m, square_m, is_black, &mut shapes);
                dots(squares, square_m, origin, &mut shapes);
            }
            Pattern::Tag { id, side_m } => {
                marker(
                    &Dictionary::tag36h11(),
                    id,
                    BORDER,
                    [-side_m / 2.0; 2],
                    side_m,
                    &mut shapes,
                );
            }
        }
        shapes
    }
}

/// Whether an AprilGrid is black at a position in sides of a tag.
fn is_black_on_aprilgrid(tags: [u32; 2], spacing_frac: f64, in_tags: [f64; 2]) -> bool {
    // The board repeats with a pitch of one tag and one gap. Counted from the small square left of
    // and above the first tag, each period begins with the gap.
    let pitch = 1.0 + spacing_frac;
    let position = in_tags.map(|value| (value + spacing_frac) / pitch);
    // There is one more column and one more row, because the last column and the last row consist
    // only of small squares.
    let Some([column, row]) = square(position, tags.map(|count| count + 1)) else {
        return false;
    };
    let in_pitch = [
        (position[0] - f64::from(column)) * pitch,
        (position[1] - f64::from(row)) * pitch,
    ];
    match in_pitch.map(|value| value < spacing_frac) {
        // Small black squares touch the corners of four tags.
        [true, true] => true,
        [false, false] if column < tags[0] && row < tags[1] => {
            let id = grid_tag_id(tags, [column, row]);
            let in_tag = in_pitch.map(|value| value - spacing_frac);
            is_black_cell(&Dictionary::tag36h11(), id, GRID_TAG_BORDER, in_tag)
        }
        _ => false,
    }
}

/// Id of a tag of an AprilGrid. Kalibr counts rows from the bottom.
fn grid_tag_id(tags: [u32; 2], [column, row]: [u32; 2]) -> u32 {
    (tags[1] - 1 - row) * tags[0] + column
}

/// Columns and rows of all cells, row by row.
fn cells(counts: [u32; 2]) -> impl Iterator<Item = [u32; 2]> {
    (0..counts[1]).flat_map(move |row| (0..counts[0]).map(move |column| [column, row]))
}

/// Appends the black squares of a board. `first_m` is the x and y of the upper left corner.
fn black_squares(
    counts: [u32; 2],
    first_m: f64,
    square_m: f64,
    is_black: impl Fn([u32; 2]) -> bool,
    shapes: &mut Vec<Shape>,
) {
    for cell in cells(counts).filter(|&cell| is_black(cell)) {
        let corner = cell.map(|count| first_m + f64::from(count) * square_m);
        shapes.push(Shape::Rectangle([
            corner,
            corner.map(|value| value + square_m),
        ]));
    }
}

/// Appends the small squares and the tags of an AprilGrid.
fn aprilgrid_shapes(tags: [u32; 2], tag_m: f64, spacing_frac: f64, shapes: &mut Vec<Shape>) {
    let gap_m = tag_m * spacing_frac;
    let pitch_m = tag_m * (1.0 + spacing_frac);
    for cell in cells(tags.map(|count| count + 1)) {
        let corner = cell.map(|count| f64::from(count) * pitch_m - gap_m);
        shapes.push(Shape::Rectangle([
            corner,
            corner.map(|value| value + gap_m),
        ]));
    }
    let dictionary = Dictionary::tag36h11();
    for cell in cells(tags) {
        let id = grid_tag_id(tags, cell);
        let corner = cell.map(|count| f64::from(count) * pitch_m);
        marker(&dictionary, id, GRID_TAG_BORDER, corner, tag_m, shapes);
    }
}

/// Appends the dots of a puzzleboard, one per edge between two of its squares.
fn dots(squares: [u32; 2], square_m: f64, origin: [u32; 2], shapes: &mut Vec<Shape>) {
    for [column, row] in cells(squares) {
        for is_vertical in [true, false] {
            // The outermost edges have a square on only one side, and no dot.
            let is_last = if is_vertical {
                column + 1 == squares[0]
            } else {
                row + 1 == squares[1]
            };
            if is_last {
                continue;
            }
            let middle = if is_vertical { [1.0, 0.5] } else { [0.5, 1.0] };
            // The origin of the board is the lower right corner of the first square.
            let center = [
                f64::from(column) + middle[0] - 1.0,
                f64::from(row) + middle[1] - 1.0,
            ];
            shapes.push(Shape::Disk {
                center: center.map(|value| value * square_m),
                radius: square_m * DOT_FRAC / 2.0,
                is_black: !edge([column, row], is_vertical, origin).is_white(),
            });
        }
    }
}

/// Mean of a color over a pixel, from samples at positions 0 to 1 along both axes.
pub(crate) fn pixel_mean(color: impl Fn(f64, f64) -> f64) -> f64 {
    /// Number of samples per pixel, which is a Fibonacci number. The next constant is the ratio of
    /// the previous Fibonacci number to this number.
    const N_SAMPLES: usize = 89;
    const GOLDEN_FRAC: f64 = 55.0 / 89.0;
    const BORDER: [[f64; 2]; 8] = [
        [0.0, 0.0],
        [0.5, 0.0],
        [1.0, 0.0],
        [0.0, 0.5],
        [1.0, 0.5],
        [0.0, 1.0],
        [0.5, 1.0],
        [1.0, 1.0],
    ];
    // Most pixels have a single color, so samples at their corners and sides are sufficient. Only
    // shapes smaller than half a pixel could be missed.
    let first = color(0.5, 0.5);
    if BORDER.into_iter().all(|[x, y]| color(x, y) == first) {
        return first;
    }
    // In this lattice, no two samples share a row or a column, so that edges along rows and columns
    // are also smooth.
    let half = 0.5 / N_SAMPLES as f64;
    let samples = (0..N_SAMPLES).map(|n| {
        let x = n as f64 / N_SAMPLES as f64 + half;
        let y = (n as f64 * GOLDEN_FRAC).fract() + half;
        color(x, y)
    });
    samples.sum::<f64>() / N_SAMPLES as f64
}

/// The square that contains a position in units of squares. `None` outside of all squares.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "checked to be within the counts"
)]
fn square(position: [f64; 2], counts: [u32; 2]) -> Option<[u32; 2]> {
    let is_inside =
        (0..2).all(|axis| position[axis] >= 0.0 && position[axis] < f64::from(counts[axis]));
    is_inside.then(|| position.map(|value| value as u32))
}

/// Whether a point of a marker is black, in a frame in which the side of the marker is 1.
fn is_black_cell(dictionary: &Dictionary, id: u32, border: usize, point: [f64; 2]) -> bool {
    let n_bits = dictionary.n_bits();
    let n = n_bits + 2 * border;
    let Ok(count) = u32::try_from(n) else {
        return false;
    };
    let Some(cell) = square(point.map(|value| value * n as f64), [count; 2]) else {
        return false;
    };
    let [column, row] = cell.map(|value| value as usize);
    // Only the inner cells carry bits.
    let is_inside = |at: usize| (border..border + n_bits).contains(&at);
    !(is_inside(column) && is_inside(row)) || dictionary.is_black(id, row - border, column - border)
}

/// Appends a marker. It has one rectangle per run of black cells in a row, and one rectangle for
/// each part of the border.
fn marker(
    dictionary: &Dictionary,
    id: u32,
    border: usize,
    corner: [f64; 2],
    side_m: f64,
    shapes: &mut Vec<Shape>,
) {
    let n_bits = dictionary.n_bits();
    let n = n_bits + 2 * border;
    let cell_m = side_m / n as f64;
    let point = |column: usize, row: usize| {
        [0, 1].map(|axis| corner[axis] + [column, row][axis] as f64 * cell_m)
    };
    let mut add = |columns: [usize; 2], rows: [usize; 2]| {
        let low = point(columns[0], rows[0]);
        shapes.push(Shape::Rectangle([low, point(columns[1], rows[1])]));
    };
    add([0, n], [0, border]);
    add([0, n], [n - border, n]);
    add([0, border], [border, n - border]);
    add([n - border, n], [border, n - border]);
    // One rectangle per run of black cells gives fewer shapes, and no seams between the cells of a
    // row.
    for row in 0..n_bits {
        let mut column = 0;
        while column < n_bits {
            let end = (column..n_bits)
                .find(|&at| !dictionary.is_black(id, row, at))
                .unwrap_or(n_bits);
            if end > column {
                add(
                    [column + border, end + border],
                    [row + border, row + border + 1],
                );
            }
            column = end + 1;
        }
    }
}

/// The edge right of or below a square of the board, in the master pattern.
fn edge([column, row]: [u32; 2], is_vertical: bool, origin: [u32; 2]) -> Edge {
    let [column, row] = [column + origin[0], row + origin[1]].map(u32::cast_signed);
    Edge {
        column,
        row,
        is_vertical,
    }
}

/// Whether the dot that covers a position in a square of a puzzleboard is black.
fn dot_near(
    position: [f64; 2],
    cell: [u32; 2],
    squares: [u32; 2],
    origin: [u32; 2],
) -> Option<bool> {
    let [column, row] = cell;
    let in_square = [
        position[0] - f64::from(column),
        position[1] - f64::from(row),
    ];
    let reach = DOT_FRAC / 2.0;
    let covers = |x: f64, y: f64| (in_square[0] - x).hypot(in_square[1] - y) <= reach;
    let color =
        |cell: [u32; 2], is_vertical: bool| Some(!edge(cell, is_vertical, origin).is_white());
    // Dots are smaller than half a square, so at most one covers a position.
    if column > 0 && covers(0.0, 0.5) {
        color([column - 1, row], true)
    } else if column + 1 < squares[0] && covers(1.0, 0.5) {
        color(cell, true)
    } else if row > 0 && covers(0.5, 0.0) {
        color([column, row - 1], false)
    } else if row + 1 < squares[1] && covers(0.5, 1.0) {
        color(cell, false)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::layouts;
    use numbers::random::Random;

    fn is_black_in(shapes: &[Shape], point: [f64; 2]) -> bool {
        let covers = |shape: &Shape| match *shape {
            Shape::Rectangle([low, high]) => (0..2)
                .all(|axis| point[axis] >= low[axis] && point[axis] < high[axis])
                .then_some(true),
            Shape::Disk {
                center,
                radius,
                is_black,
            } => ((point[0] - center[0]).hypot(point[1] - center[1]) <= radius).then_some(is_black),
        };
        shapes.iter().rev().find_map(covers).unwrap_or(false)
    }

    #[test]
    fn shapes_and_points_agree() {
        let mut random = Random::new(3);
        for text in [
            "chessboard:9x6:25mm",
            "charuco:5x7:34mm:28mm:6X6_250",
            "charuco:5x8:34mm:28mm:4X4_50",
            "aprilgrid:3x4:88mm:0.3",
            "puzzleboard:12x9:20mm:101x50",
            "tag:36h11:7:100mm",
        ] {
            let target: TargetSpec = text.parse().unwrap();
            for is_legacy in [false, true] {
                let surface = Surface {
                    pattern: &target.pattern,
                    is_legacy,
                };
                let shapes = surface.shapes();
                let [low, high] = target.bounds_m();
                let mut n_black = 0;
                for _ in 0..5000 {
                    let point =
                        [0, 1].map(|axis| random.uniform(low[axis] - 0.01, high[axis] + 0.01));
                    assert_eq!(
                        surface.is_black(point),
                        is_black_in(&shapes, point),
                        "{text} at {point:?}"
                    );
                    n_black += i32::from(surface.is_black(point));
                }
                assert!((1000..4000).contains(&n_black), "{text}: {n_black}");
            }
        }
    }

    #[test]
    fn markers_are_where_the_layouts_say() {
        for text in [
            "charuco:5x7:34mm:28mm:6X6_250",
            "charuco:5x8:34mm:28mm:6X6_250",
            "aprilgrid:3x4:88mm:0.3",
        ] {
            let target: TargetSpec = text.parse().unwrap();
            for layout in layouts(&target.pattern)
                .into_iter()
                .take(2)
                .filter(|layout| text.contains("charuco") || !layout.is_legacy)
            {
                let surface = Surface {
                    pattern: &target.pattern,
                    is_legacy: layout.is_legacy,
                };
                for [first, _, third, _] in &layout.corners_m {
                    // The board is black just inside the marker. Just outside, it is white or
                    // another black square.
                    let inside = [
                        0.99 * first[0] + 0.01 * third[0],
                        0.99 * first[1] + 0.01 * third[1],
                    ];
                    assert!(surface.is_black(inside), "{text} {inside:?}");
                }
            }
        }
    }
}
