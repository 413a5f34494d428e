//! Finds the inner corners of ChArUco boards. The search starts next to markers and continues next
//! to corners that were already found.

use crate::alignment::Printed;
use crate::gray::Plane;
use crate::homography::Homography;
use crate::lattice::{Cell, Lattice};
use crate::layout::{self, Fit};
use crate::spec::{Pattern, TargetSpec};
use crate::surface::Surface;
use crate::template::{self, Neighborhood, WINDOW_FRAC};
use nalgebra::Matrix2;
use std::collections::BTreeMap;

/// A pixel and its derivative with respect to the point on the board.
type Predicted = ([f64; 2], Matrix2<f64>);

/// A board in an image.
struct Search<'a> {
    plane: &'a Plane,
    printed: Printed<'a>,
    /// Columns and rows of inner corners.
    inner: [i32; 2],
}

/// Finds the inner corners and returns their ids.
pub(super) fn corners(target: &TargetSpec, plane: &Plane, fit: &Fit) -> Vec<(u32, [f64; 2])> {
    let Pattern::Charuco {
        squares,
        square_m,
        marker_m,
        dictionary,
    } = target.pattern
    else {
        return Vec::new();
    };
    let surface = Surface {
        pattern: &target.pattern,
        is_legacy: fit.layout.is_legacy,
    };
    let inner = squares.map(|count| count.cast_signed() - 1);
    // Around a corner, the pattern is point-symmetric up to the distance that the margins and
    // borders of the markers reach. Within this distance, wrong scales do not displace the corner.
    let symmetric_m = (square_m - marker_m) / 2.0 + marker_m / (dictionary.n_bits() + 2) as f64;
    let side_m = (symmetric_m / WINDOW_FRAC).min(square_m);
    let printed = Printed {
        surface,
        square_m,
        first_m: [square_m; 2],
        side_m,
    };
    let search = Search {
        plane,
        printed,
        inner,
    };
    // A wrong corner next to a marker would displace the predictions of other corners. It is
    // therefore removed before the lattice is completed.
    let mut lattice = search.near_markers(fit);
    lattice.remove_outliers();
    search.complete(&mut lattice);
    // Now every corner has neighbors on several sides. These neighbors give a more accurate scale
    // and shear than a marker, or than neighbors on only one side.
    search.printed.align(plane, &mut lattice);
    lattice.remove_outliers();
    let id = |cell: Cell| (cell[1] * inner[0] + cell[0]).cast_unsigned();
    lattice
        .corners
        .into_iter()
        .map(|(cell, pixel)| (id(cell), pixel))
        .collect()
}

impl Search<'_> {
    /// Finds the corners of the squares that contain markers.
    fn near_markers(&self, fit: &Fit) -> Lattice {
        let mut predictions: BTreeMap<Cell, Vec<Predicted>> = BTreeMap::new();
        for marker in &fit.markers {
            let corners_m = &fit.layout.corners_m[marker.id as usize];
            // `Homography` needs points near the origin.
            let center_m = layout::center(corners_m);
            let centered =
                corners_m.map(|corner| [corner[0] - center_m[0], corner[1] - center_m[1]]);
            let Some(pixel_from_board) = Homography::from_corners(&centered, &marker.corners_px)
            else {
                continue;
            };
            // The corners of the square around the marker are only a margin away from it, so that
            // the homography of the marker predicts them through any lens.
            for [x, y] in [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]] {
                let offset_m = [x * self.printed.square_m, y * self.printed.square_m];
                #[expect(clippy::cast_possible_truncation, reason = "counts of squares")]
                let cell = [0, 1].map(|axis| {
                    ((center_m[axis] + offset_m[axis]) / self.printed.square_m).round() as i32 - 1
                });
                // Squares at the border of the board have corners that are not inner corners.
                if (0..2).all(|axis| (0..self.inner[axis]).contains(&cell[axis])) {
                    let prediction = (
                        pixel_from_board.map(offset_m),
                        pixel_from_board.jacobian(offset_m),
                    );
                    predictions.entry(cell).or_default().push(prediction);
                }
            }
        }
        let mut lattice = Lattice::default();
        for (cell, predictions) in predictions {
            // Most corners touch two squares with markers. The mean of the predictions of both
            // markers has less noise.
            let n = predictions.len() as f64;
            let pixel = [0, 1].map(|axis| {
                predictions
                    .iter()
                    .map(|(pixel, _)| pixel[axis])
                    .sum::<f64>()
                    / n
            });
            let pixel_by_point = predictions
                .iter()
                .map(|(_, jacobian)| jacobian)
                .sum::<Matrix2<f64>>()
                / n;
            lattice.corners.extend(
                self.find(cell, pixel, pixel_by_point)
                    .map(|pixel| (cell, pixel)),
            );
        }
        lattice
    }

    /// Finds missing corners next to others, repeatedly.
    fn complete(&self, lattice: &mut Lattice) {
        // Each pass adds the neighbors of known corners. At most this many passes are needed from
        // one end of the board to the other.
        for _ in 0..self.inner[0] + self.inner[1] {
            let cells = (0..self.inner[1])
                .flat_map(|row| (0..self.inner[0]).map(move |column| [column, row]));
            let missing = cells.filter(|cell| !lattice.corners.contains_key(cell));
            let found: Vec<(Cell, [f64; 2])> = missing
                .filter_map(|cell| {
                    let pixel = lattice.predict(cell)?.pixel;
                    let pixel_by_point =
                        lattice.pixel_by_point(cell, pixel, self.printed.square_m)?;
                    Some((cell, self.find(cell, pixel, pixel_by_point)?))
                })
                .collect();
            if found.is_empty() {
                return;
            }
            lattice.corners.extend(found);
        }
    }

    /// Aligns a predicted corner with the printed pattern.
    fn find(&self, cell: Cell, pixel: [f64; 2], pixel_by_point: Matrix2<f64>) -> Option<[f64; 2]> {
        let Printed {
            surface, side_m, ..
        } = self.printed;
        let point_m = self.printed.point_m(cell);
        let neighborhood = Neighborhood {
            point_m,
            pixel,
            pixel_by_point,
            // The second derivatives are unknown until the corner has neighbors on both sides.
            bend: [[0.0; 2]; 3],
            side_m,
            reach_px: None,
        };
        template::find(self.plane, &surface, &neighborhood)
    }
}
