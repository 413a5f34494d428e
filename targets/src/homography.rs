//! Projective maps of the plane.

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector3};

/// Maps points of one plane to another.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Homography(Matrix3<f64>);

impl Homography {
    /// The homography that maps four points to four other points. `None` if three of the first four
    /// points, or three of the other four points, lie on a line.
    ///
    /// Source: Hartley and Zisserman 2004, section 4.1, with the last element fixed to 1. The image
    /// of the first plane's origin must therefore be finite, so points of the first plane should be
    /// near its origin.
    pub(crate) fn from_corners(from: &[[f64; 2]; 4], to: &[[f64; 2]; 4]) -> Option<Self> {
        let mut matrix = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for (at, ([x, y], [u, v])) in from.iter().zip(to).enumerate() {
            // Each point gives two linear equations. The first is u = (h0 x + h1 y + h2) / (h6 x +
            // h7 y + 1), multiplied by the denominator. The second is the corresponding equation
            // for v.
            let rows = [
                [*x, *y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y],
                [0.0, 0.0, 0.0, *x, *y, 1.0, -v * x, -v * y],
            ];
            for (offset, row) in rows.into_iter().enumerate() {
                matrix.row_mut(2 * at + offset).copy_from_slice(&row);
            }
            (right[2 * at], right[2 * at + 1]) = (*u, *v);
        }
        let solution = matrix.lu().solve(&right)?;
        // Three points on a line make the matrix singular, which rounding may hide from `solve`.
        if !solution.iter().all(|value| value.is_finite()) {
            return None;
        }
        let element = |at: usize| if at < 8 { solution[at] } else { 1.0 };
        Some(Self(Matrix3::from_fn(|row, column| {
            element(3 * row + column)
        })))
    }

    /// The image of a point. It is not finite for points at infinity.
    pub(crate) fn map(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let mapped = self.0 * Vector3::new(x, y, 1.0);
        [mapped.x / mapped.z, mapped.y / mapped.z]
    }

    /// Derivative of the image of a point with respect to the point.
    pub(crate) fn jacobian(&self, [x, y]: [f64; 2]) -> Matrix2<f64> {
        let mapped = self.0 * Vector3::new(x, y, 1.0);
        // This is the quotient rule: d(a / z) = (da - a / z dz) / z.
        let quotient = |row: usize, column: usize| {
            (self.0[(row, column)] - mapped[row] / mapped.z * self.0[(2, column)]) / mapped.z
        };
        Matrix2::from_fn(quotient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_mapped_exactly_and_lines_rejected() {
        let from = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let to = [[100.0, 50.0], [180.0, 60.0], [170.0, 130.0], [90.0, 140.0]];
        let homography = Homography::from_corners(&from, &to).unwrap();
        for (from, to) in from.into_iter().zip(to) {
            let mapped = homography.map(from);
            assert!((mapped[0] - to[0]).abs() < 1e-9 && (mapped[1] - to[1]).abs() < 1e-9);
        }
        const NUDGE: f64 = 1e-6;
        let jacobian = homography.jacobian([0.3, 0.8]);
        for (axis, nudge) in [[NUDGE, 0.0], [0.0, NUDGE]].into_iter().enumerate() {
            let [ahead, behind] = [1.0, -1.0]
                .map(|sign| homography.map([0.3 + sign * nudge[0], 0.8 + sign * nudge[1]]));
            for row in 0..2 {
                let numeric = (ahead[row] - behind[row]) / (2.0 * NUDGE);
                // The derivatives are near 100, and the differences lose ten digits.
                assert!(
                    (jacobian[(row, axis)] - numeric).abs() < 1e-6,
                    "{row} {axis}"
                );
            }
        }
        let line = [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 1.0]];
        assert!(Homography::from_corners(&line, &line).is_none());
    }
}
