//! Corners of a board on an integer lattice, with prediction of each corner from its neighbors.
//!
//! Predictions use only neighbors and never the whole board, so they are accurate for any lens.

use crate::gray::Plane;
use crate::saddle;
use nalgebra::Matrix2;
use std::collections::BTreeMap;

/// Column and row.
pub(crate) type Cell = [i32; 2];

/// Image positions of corners by column and row, pixels.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Lattice {
    pub(crate) corners: BTreeMap<Cell, [f64; 2]>,
}

/// Largest deviation from a prediction, relative to the distance between neighbors.
///
/// The nearest wrong saddles belong to dots or to markers, about a third of a square away. With
/// larger values, they would be accepted. With smaller values, corners would be lost where a lens
/// bends the board strongly, because extrapolation is inaccurate there.
const MAX_DEVIATION: f64 = 0.22;
/// Radius of the ring that verifies a corner, relative to the distance between neighbors. With a
/// value clearly below 0.5, the ring crosses no edges of neighboring corners, even in foreshortened
/// squares.
const RING_FRAC: f64 = 0.27;
/// Half the refinement window, relative to the distance between neighbors, and its limits in
/// pixels.
///
/// A larger window averages more noise, but it must not contain the edges of neighboring corners.
/// Beyond 9 pixels, the bending of lines by the lens outweighs the gain.
const WINDOW_FRAC: f64 = 0.38;
const WINDOW_PX: [f64; 2] = [2.0, 9.0];

/// How corners are refined and verified.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Refinement {
    /// Radius around each corner in which only its four edges are visible, as a fraction of the
    /// distance between corners, 0 to 0.5.
    pub(crate) clear_frac: f64,
}

impl Lattice {
    fn at(&self, cell: Cell, step: Cell, n: i32) -> Option<[f64; 2]> {
        self.corners
            .get(&[cell[0] + n * step[0], cell[1] + n * step[1]])
            .copied()
    }

    /// Distance to the nearest neighbor, pixels.
    pub(crate) fn spacing_px(&self, cell: Cell) -> Option<f64> {
        let here = self.corners.get(&cell)?;
        let neighbors = STEPS.iter().filter_map(|&step| self.at(cell, step, 1));
        neighbors
            .map(|near| distance(*here, near))
            .min_by(f64::total_cmp)
    }

    /// Predicts a corner from its neighbors, without using the corner itself. Also returns the
    /// local distance between neighbors.
    ///
    /// The mean of all predictions of the most accurate available kind is used. The kinds, from the
    /// most to the least accurate, are: between two neighbors, extrapolation of a parabola,
    /// completion of a square, and linear extrapolation.
    pub(crate) fn predict(&self, cell: Cell) -> Option<Prediction> {
        // Let `c` be the second difference of the corners (due to lenses and perspective), and `s`
        // the noise of each corner. Each kind of prediction has a systematic error and noise.
        // Between two neighbors, they are approximately c / 2 and 0.7 s. For the parabola, they are
        // the third difference and 4.4 s. For the square, they are the mixed second difference and
        // 1.7 s. For the line, they are c and 2.2 s.
        mean(
            STEPS[..2]
                .iter()
                .filter_map(|&step| self.between(cell, step)),
        )
        .or_else(|| mean(STEPS.iter().filter_map(|&step| self.parabola(cell, step))))
        .or_else(|| mean((0..4).filter_map(|at| self.square(cell, at))))
        .or_else(|| mean(STEPS.iter().filter_map(|&step| self.line(cell, step))))
    }

    /// The middle between the neighbors on both sides.
    fn between(&self, cell: Cell, step: Cell) -> Option<Prediction> {
        let a = self.at(cell, step, 1)?;
        let b = self.at(cell, step, -1)?;
        Some(Prediction {
            pixel: combine(&[(0.5, a), (0.5, b)]),
            spacing_px: distance(a, b) / 2.0,
        })
    }

    /// The fourth corner of the parallelogram on one of the four sides.
    fn square(&self, cell: Cell, at: usize) -> Option<Prediction> {
        let step = STEPS[at];
        let turned = STEPS[(at + 1) % 4];
        let a = self.at(cell, step, 1)?;
        let b = self.at(cell, turned, 1)?;
        let diagonal = self.at([cell[0] + step[0], cell[1] + step[1]], turned, 1)?;
        let spacing_px = distance(a, diagonal).min(distance(b, diagonal));
        Some(Prediction {
            pixel: combine(&[(1.0, a), (1.0, b), (-1.0, diagonal)]),
            spacing_px,
        })
    }

    /// The continuation of the parabola through three corners.
    fn parabola(&self, cell: Cell, step: Cell) -> Option<Prediction> {
        let a = self.at(cell, step, 1)?;
        let b = self.at(cell, step, 2)?;
        let c = self.at(cell, step, 3)?;
        Some(Prediction {
            // The third difference of a parabola is zero.
            pixel: combine(&[(3.0, a), (-3.0, b), (1.0, c)]),
            spacing_px: distance(a, b),
        })
    }

    /// The continuation of the line through two corners.
    fn line(&self, cell: Cell, step: Cell) -> Option<Prediction> {
        let a = self.at(cell, step, 1)?;
        let b = self.at(cell, step, 2)?;
        Some(Prediction {
            pixel: combine(&[(2.0, a), (-1.0, b)]),
            spacing_px: distance(a, b),
        })
    }

    /// Derivative of the pixel with respect to the point on the board (pixels per meter) at a cell
    /// whose corner is at `pixel`, from the cell's neighbors. `None` if the cell has no neighbor
    /// along an axis.
    pub(crate) fn pixel_by_point(
        &self,
        cell: Cell,
        pixel: [f64; 2],
        square_m: f64,
    ) -> Option<Matrix2<f64>> {
        let x = self.pixel_by_step(cell, pixel, STEPS[0])?;
        let y = self.pixel_by_step(cell, pixel, STEPS[1])?;
        Some(Matrix2::new(x[0], y[0], x[1], y[1]) / square_m)
    }

    /// Derivative of the pixel with respect to the number of steps along one axis.
    fn pixel_by_step(&self, cell: Cell, pixel: [f64; 2], step: Cell) -> Option<[f64; 2]> {
        match (self.at(cell, step, -1), self.at(cell, step, 1)) {
            (Some(before), Some(after)) => Some(combine(&[(0.5, after), (-0.5, before)])),
            // In this case, the corner is at the border of the board or next to a missing corner.
            _ => self
                .one_sided(cell, pixel, step, 1)
                .or_else(|| self.one_sided(cell, pixel, step, -1)),
        }
    }

    /// Like [`Self::pixel_by_step`], from the corners on one side. If there are two such corners,
    /// it is the derivative of the parabola through three corners, which is of second order.
    fn one_sided(&self, cell: Cell, pixel: [f64; 2], step: Cell, sign: i32) -> Option<[f64; 2]> {
        let near = self.at(cell, step, sign)?;
        let ahead = match self.at(cell, step, 2 * sign) {
            Some(far) => combine(&[(2.0, near), (-1.5, pixel), (-0.5, far)]),
            None => combine(&[(1.0, near), (-1.0, pixel)]),
        };
        Some(ahead.map(|value| value * f64::from(sign)))
    }

    /// Second derivatives of the pixel with respect to the point on the board, pixels per square
    /// meter, from the neighbors of a cell. The order is: x and x, x and y, y and y. They are zero
    /// if there are too few neighbors.
    pub(crate) fn bend(&self, cell: Cell, pixel: [f64; 2], square_m: f64) -> [[f64; 2]; 3] {
        // At the corners of the board, only one of the four squares exists, which is enough.
        let twists: Vec<[f64; 2]> = [[1, 1], [1, -1], [-1, 1], [-1, -1]]
            .into_iter()
            .filter_map(|diagonal| self.twist(cell, pixel, diagonal))
            .collect();
        let mean_twist = [0, 1].map(|axis| {
            twists.iter().map(|twist| twist[axis]).sum::<f64>() / twists.len().max(1) as f64
        });
        [
            self.curvature(cell, pixel, STEPS[0]).unwrap_or_default(),
            mean_twist,
            self.curvature(cell, pixel, STEPS[1]).unwrap_or_default(),
        ]
        .map(|second| second.map(|value| value / (square_m * square_m)))
    }

    /// Second difference of the pixel along one axis, per step squared.
    fn curvature(&self, cell: Cell, pixel: [f64; 2], step: Cell) -> Option<[f64; 2]> {
        let before = self.at(cell, step, -1)?;
        let after = self.at(cell, step, 1)?;
        Some(combine(&[(1.0, after), (1.0, before), (-2.0, pixel)]))
    }

    /// Mixed second difference of the pixel over one of the four squares at a corner.
    fn twist(&self, cell: Cell, pixel: [f64; 2], [x, y]: [i32; 2]) -> Option<[f64; 2]> {
        let a = self.at(cell, [x, 0], 1)?;
        let b = self.at(cell, [0, y], 1)?;
        let twist = combine(&[
            (1.0, self.at(cell, [x, y], 1)?),
            (1.0, pixel),
            (-1.0, a),
            (-1.0, b),
        ]);
        // Toward the upper right and the lower left, one of the two steps is backward.
        Some(twist.map(|value| value * f64::from(x * y)))
    }

    /// Adds missing corners inside `range`, which is inclusive. A corner is added if a saddle lies
    /// close to its prediction. This is repeated until no corner is added.
    pub(crate) fn complete(&mut self, plane: &Plane, range: [Cell; 2], refinement: Refinement) {
        // Each pass adds the neighbors of known corners. At most this many passes are needed from
        // one end of the board to the other.
        let max_passes = range[1][0] - range[0][0] + range[1][1] - range[0][1] + 2;
        for _ in 0..max_passes {
            // Corners found in this pass are added after it, so that the result does not depend on
            // the order of the cells.
            let mut added = Vec::new();
            for row in range[0][1]..=range[1][1] {
                for column in range[0][0]..=range[1][0] {
                    let cell = [column, row];
                    if self.corners.contains_key(&cell) {
                        continue;
                    }
                    let corner = self
                        .predict(cell)
                        .and_then(|prediction| prediction.find(plane, refinement));
                    added.extend(corner.map(|pixel| (cell, pixel)));
                }
            }
            if added.is_empty() {
                return;
            }
            self.corners.extend(added);
        }
    }

    /// Refines all corners, and removes corners that are not saddles.
    pub(crate) fn refine(&mut self, plane: &Plane, refinement: Refinement) {
        let refined = self.corners.iter().filter_map(|(&cell, &pixel)| {
            let spacing_px = self
                .spacing_px(cell)
                .or_else(|| Some(self.predict(cell)?.spacing_px))?;
            Some((cell, refinement.refine(plane, pixel, spacing_px)?))
        });
        self.corners = refined.collect();
    }

    /// Removes corners that deviate from the predictions of their neighbors, the worst first.
    pub(crate) fn remove_outliers(&mut self) {
        loop {
            // Corners are removed one at a time. A wrong corner also spoils the predictions of its
            // neighbors, which become correct after its removal.
            let worst = self
                .corners
                .iter()
                .filter_map(|(&cell, &pixel)| Some((cell, self.deviation(cell, pixel)?)))
                .max_by(|a, b| a.1.total_cmp(&b.1));
            match worst {
                Some((cell, deviation)) if deviation > MAX_DEVIATION => self.corners.remove(&cell),
                _ => return,
            };
        }
    }

    /// Distance of a corner from its prediction, relative to the distance between neighbors.
    fn deviation(&self, cell: Cell, pixel: [f64; 2]) -> Option<f64> {
        let prediction = self.predict(cell)?;
        Some(distance(pixel, prediction.pixel) / prediction.spacing_px)
    }

    /// Smallest and largest column and row. `None` if there are no corners.
    pub(crate) fn range(&self) -> Option<[Cell; 2]> {
        let mut cells = self.corners.keys();
        let first = *cells.next()?;
        Some(cells.fold([first, first], grown))
    }
}

/// The smallest range that contains another range and a cell.
fn grown([low, high]: [Cell; 2], cell: &Cell) -> [Cell; 2] {
    [
        [low[0].min(cell[0]), low[1].min(cell[1])],
        [high[0].max(cell[0]), high[1].max(cell[1])],
    ]
}

/// A predicted corner.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Prediction {
    pub(crate) pixel: [f64; 2],
    /// Distance between neighbors, pixels.
    pub(crate) spacing_px: f64,
}

impl Prediction {
    /// Finds the saddle at this prediction.
    pub(crate) fn find(&self, plane: &Plane, refinement: Refinement) -> Option<[f64; 2]> {
        let reach_px = (MAX_DEVIATION * self.spacing_px).max(1.0);
        let radius_px = refinement.ring_px(self.spacing_px);
        let saddle = saddle::find_near(plane, self.pixel, reach_px, radius_px)?;
        let pixel = refinement.refine(plane, saddle.pixel, self.spacing_px)?;
        // The search covers whole pixels within the reach. Refinement then moves the position by a
        // fraction of a pixel.
        (distance(pixel, self.pixel) <= reach_px + 0.5).then_some(pixel)
    }
}

impl Refinement {
    fn ring_px(self, spacing_px: f64) -> f64 {
        // With a smaller radius, the samples of the ring would fall into the blur of the corner.
        (spacing_px * RING_FRAC.min(self.clear_frac)).max(1.5)
    }

    /// Refines a corner and checks that it still is a saddle.
    fn refine(self, plane: &Plane, start: [f64; 2], spacing_px: f64) -> Option<[f64; 2]> {
        let half_window_px =
            (spacing_px * WINDOW_FRAC.min(self.clear_frac)).clamp(WINDOW_PX[0], WINDOW_PX[1]);
        let pixel = saddle::refine(plane, start, half_window_px)?;
        saddle::ring(plane, pixel, self.ring_px(spacing_px)).map(|_| pixel)
    }
}

/// Right, down, left, up.
pub(crate) const STEPS: [Cell; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

fn combine(parts: &[(f64, [f64; 2])]) -> [f64; 2] {
    [0, 1].map(|axis| {
        parts
            .iter()
            .map(|(weight, pixel)| weight * pixel[axis])
            .sum()
    })
}

fn mean(predictions: impl Iterator<Item = Prediction>) -> Option<Prediction> {
    let mut sum = [0.0; 2];
    let mut spacing_px = 0.0;
    let mut n = 0.0;
    for prediction in predictions {
        sum = [sum[0] + prediction.pixel[0], sum[1] + prediction.pixel[1]];
        spacing_px += prediction.spacing_px;
        n += 1.0;
    }
    (n > 0.0).then(|| Prediction {
        pixel: sum.map(|sum| sum / n),
        spacing_px: spacing_px / n,
    })
}

pub(crate) fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
