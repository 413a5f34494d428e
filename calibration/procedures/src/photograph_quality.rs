//! Whether a photograph of a target is sharp, and whether the target was still.

use calibration::BoardView;
use numbers::quantile::median;
use std::collections::HashMap;

/// Half the side of the square around a corner in which its edges are measured, pixels. The square
/// is larger than the widest accepted edge. If the edges were wider than the square, the image
/// gradients and the contrast inside it would both be smaller, and the computed width would be too
/// small.
const WINDOW_PX: i64 = 8;
/// Corners with a smaller difference between ink and paper are not measured, gray levels.
const MIN_CONTRAST: f64 = 24.0;
/// Minimum number of measured corners.
const MIN_CORNERS: usize = 4;
/// Maximum width of edges, pixels. The corners of wider edges are detected less accurately.
const MAX_EDGE_PX: f64 = 6.0;
/// Maximum width of edges as a fraction of the width of the image. It is needed because the images
/// of cameras with many pixels are not sharper.
const MAX_EDGE_FRAC: f64 = 0.005;

/// Whether the edges of a target are sharp. Returns `false` if the edges cannot be measured.
///
/// * `gray`: gray values, row by row.
pub(crate) fn is_sharp(size_px: [u32; 2], gray: &[u8], view: &BoardView) -> bool {
    let max_px = MAX_EDGE_PX.max(MAX_EDGE_FRAC * f64::from(size_px[0]));
    edge_width_px(size_px, gray, view).is_some_and(|width_px| width_px <= max_px)
}

/// Width of the edges at the corners of a target, pixels. The width at a corner is the difference
/// between ink and paper divided by the largest image gradient, and the result is the median over
/// the corners. For a perfect step, the width is 2, because a central difference spans two pixels.
/// For a large blur, it is 2.5 times the standard deviation of the blur.
fn edge_width_px(size_px: [u32; 2], gray: &[u8], view: &BoardView) -> Option<f64> {
    let widths: Vec<f64> = view
        .points
        .iter()
        .filter_map(|point| edge_width_at(size_px, gray, point.pixel))
        .collect();
    (widths.len() >= MIN_CORNERS).then(|| median(&widths))?
}

/// Width of the edges at one corner. `None` at the border of the image, or without contrast.
fn edge_width_at(size_px: [u32; 2], gray: &[u8], [x, y]: [f64; 2]) -> Option<f64> {
    let [width, height] = size_px.map(i64::from);
    #[expect(
        clippy::cast_possible_truncation,
        reason = "corners are within the image"
    )]
    let (column, row) = (x.floor() as i64, y.floor() as i64);
    // Central differences need one more pixel on each side.
    let margin = WINDOW_PX + 1;
    let is_inside = |at: i64, n: i64| (margin..n - margin).contains(&at);
    if !is_inside(column, width) || !is_inside(row, height) {
        return None;
    }
    let value = |column: i64, row: i64| {
        let ix = usize::try_from(row * width + column).ok()?;
        gray.get(ix).map(|value| f64::from(*value))
    };
    let (mut lowest, mut highest, mut steepest) = (f64::INFINITY, 0.0_f64, 0.0_f64);
    for row in row - WINDOW_PX..=row + WINDOW_PX {
        for column in column - WINDOW_PX..=column + WINDOW_PX {
            let here = value(column, row)?;
            lowest = lowest.min(here);
            highest = highest.max(here);
            let by_x = 0.5 * (value(column + 1, row)? - value(column - 1, row)?);
            let by_y = 0.5 * (value(column, row + 1)? - value(column, row - 1)?);
            steepest = steepest.max(by_x.hypot(by_y));
        }
    }
    let contrast = highest - lowest;
    (contrast >= MIN_CONTRAST && steepest > 0.0).then(|| contrast / steepest)
}

/// Median distance by which the corners have moved between two photographs, pixels. `None` if the
/// photographs share fewer than four corners.
pub(crate) fn motion_px(earlier: &BoardView, later: &BoardView) -> Option<f64> {
    // The position of a corner in the frame of the board has exactly the same bits in all
    // photographs. It therefore identifies the corner.
    let key = |point: &calibration::BoardPoint| {
        [0, 1, 2].map(|axis| point.point_in_board[axis].to_bits())
    };
    let before: HashMap<[u64; 3], [f64; 2]> = earlier
        .points
        .iter()
        .map(|point| (key(point), point.pixel))
        .collect();
    let distances: Vec<f64> = later
        .points
        .iter()
        .filter_map(|point| {
            let [x, y] = before.get(&key(point))?;
            Some((point.pixel[0] - x).hypot(point.pixel[1] - y))
        })
        .collect();
    (distances.len() >= MIN_CORNERS).then(|| median(&distances))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::BoardPoint;
    use nalgebra::Vector3;

    const SIZE_PX: [u32; 2] = [200, 120];
    const SQUARE_PX: f64 = 20.0;

    /// A chessboard, blurred by a Gaussian with this standard deviation, and its corners.
    fn chessboard(sigma_px: f64) -> (Vec<u8>, BoardView) {
        let [width, height] = SIZE_PX.map(f64::from);
        // A chessboard is a product of two square waves, so its blur is a product, too.
        let wave = |at: f64| {
            let n = 33;
            let sum: f64 = (0..n)
                .map(|ix| {
                    let quantile = (f64::from(ix) + 0.5) / f64::from(n);
                    // The logistic distribution approximates the normal distribution.
                    let offset = sigma_px * (quantile / (1.0 - quantile)).ln() / 1.7;
                    ((at + offset) / SQUARE_PX).floor().rem_euclid(2.0) * 2.0 - 1.0
                })
                .sum();
            sum / f64::from(n)
        };
        let mut gray = Vec::new();
        for row in 0..SIZE_PX[1] {
            for column in 0..SIZE_PX[0] {
                let product = wave(f64::from(column) + 0.5) * wave(f64::from(row) + 0.5);
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "between 28 and 228"
                )]
                gray.push((128.0 + 100.0 * product).round() as u8);
            }
        }
        let mut points = Vec::new();
        let mut y = SQUARE_PX;
        while y < height {
            let mut x = SQUARE_PX;
            while x < width {
                points.push(BoardPoint {
                    point_in_board: Vector3::new(x, y, 0.0),
                    pixel: [x, y],
                });
                x += SQUARE_PX;
            }
            y += SQUARE_PX;
        }
        let view = BoardView {
            name: String::new(),
            points,
        };
        (gray, view)
    }

    #[test]
    fn the_width_of_edges_grows_with_the_blur() {
        let of = |sigma_px| {
            let (gray, view) = chessboard(sigma_px);
            edge_width_px(SIZE_PX, &gray, &view).expect("many corners")
        };
        let sharp = of(0.0);
        assert!((1.3..=2.1).contains(&sharp), "{sharp}");
        assert!(
            of(1.0) > sharp && of(2.0) > 1.3 * of(1.0),
            "{} {}",
            of(1.0),
            of(2.0)
        );
        for (sigma_px, expected) in [(0.0, true), (1.0, true), (5.0, false)] {
            let (gray, view) = chessboard(sigma_px);
            assert_eq!(is_sharp(SIZE_PX, &gray, &view), expected, "{sigma_px}");
        }
    }

    #[test]
    fn a_target_without_contrast_is_not_sharp() {
        let (gray, view) = chessboard(0.0);
        let flat: Vec<u8> = gray.iter().map(|value| value / 12).collect();
        assert!(!is_sharp(SIZE_PX, &flat, &view));
        let without_corners = BoardView {
            points: Vec::new(),
            ..view.clone()
        };
        assert!(!is_sharp(SIZE_PX, &gray, &without_corners));
        assert!(!is_sharp(SIZE_PX, &gray[..10], &view), "a truncated image");
    }

    #[test]
    fn motion_is_that_of_the_same_corners() {
        let (_, view) = chessboard(0.0);
        let mut moved = view.clone();
        moved.points.remove(0);
        for point in &mut moved.points {
            point.pixel[0] += 3.0;
            point.pixel[1] -= 4.0;
        }
        assert_eq!(motion_px(&view, &moved), Some(5.0));
        moved.points.truncate(3);
        assert_eq!(motion_px(&view, &moved), None);
    }
}
