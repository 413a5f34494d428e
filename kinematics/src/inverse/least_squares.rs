//! Computes joint changes that give the tip a small motion, by damped least squares.

use nalgebra::{Matrix6, SymmetricEigen, Vector6};

/// Singular value below which a direction is damped, radians per radian. The value is also the
/// damping at a singular value of 0. Because the two are equal, a unit velocity of the tip in a
/// nearly singular direction never needs a joint velocity above 12.5, which is the inverse of this
/// value. In usual configurations of arms, singular values are at least 0.2.
pub(super) const SINGULAR: f64 = 0.08;

/// Joint changes `J^T (J J^T + d^2 1)^-1 e` (Wampler 1986; Nakamura and Hanafusa 1986), which are
/// computed without an inverse for any number of joints. All changes are 0 if the numbers overflow.
///
/// * `columns`: the Jacobian, one column per joint.
/// * `motion`: wanted motion of the tip, `e`.
/// * `damping`: `d^2`, above 0.
/// * `change`: output, one value per joint.
pub fn damped_change(
    columns: &[Vector6<f64>],
    motion: &Vector6<f64>,
    damping: f64,
    change: &mut [f64],
) {
    let square = square(columns.iter()) + Matrix6::identity() * damping;
    // The damped matrix is positive definite unless its elements overflow.
    let multipliers = match square.cholesky() {
        Some(factor) => factor.solve(motion),
        None => Vector6::zeros(),
    };
    for (change, column) in change.iter_mut().zip(columns) {
        *change = column.dot(&multipliers);
    }
}

/// Least squares with damping only in nearly singular directions. Motions in other directions stay
/// exact.
pub(super) struct SelectiveInverse {
    eigen: SymmetricEigen<f64, nalgebra::Const<6>>,
}

impl SelectiveInverse {
    /// * `columns`: the columns of the joints that may move.
    pub(super) fn new<'a>(columns: impl Iterator<Item = &'a Vector6<f64>>) -> Self {
        Self {
            eigen: SymmetricEigen::new(square(columns)),
        }
    }

    /// The factors by which the columns are multiplied (by a dot product) to get the joint changes
    /// for a motion.
    ///
    /// Source: Maciejewski and Klein 1988, "Numerical filtering for the operation of robotic
    /// manipulators through kinematically singular configurations", with the varying damping of
    /// Chiaverini, Siciliano and Egeland 1994, equation 12, for every singular value.
    pub(super) fn multipliers(&self, motion: &Vector6<f64>) -> Vector6<f64> {
        let mut multipliers = Vector6::zeros();
        for (squared, direction) in self.directions() {
            let damping = (SINGULAR * SINGULAR - squared).max(0.0);
            multipliers += direction * (direction.dot(motion) / (squared + damping));
        }
        multipliers
    }

    /// The fraction of a motion that damping removes, 0 to 1.
    pub(super) fn lost_frac(&self, motion: &Vector6<f64>) -> f64 {
        let mut lost = 0.0;
        for (squared, direction) in self.directions() {
            let kept = (squared / (SINGULAR * SINGULAR)).min(1.0);
            lost += ((1.0 - kept) * direction.dot(motion)).powi(2);
        }
        let whole = motion.norm();
        if whole > 0.0 {
            lost.sqrt() / whole
        } else {
            0.0
        }
    }

    /// The squared singular values and their directions.
    fn directions(&self) -> impl Iterator<Item = (f64, Vector6<f64>)> {
        let values = self.eigen.eigenvalues.iter();
        values
            .zip(self.eigen.eigenvectors.column_iter())
            // Rounding can make the smallest eigenvalues negative.
            .map(|(value, direction)| (value.max(0.0), direction.into_owned()))
    }
}

/// `J J^T`.
fn square<'a>(columns: impl Iterator<Item = &'a Vector6<f64>>) -> Matrix6<f64> {
    let mut square = Matrix6::zeros();
    for column in columns {
        square += column * column.transpose();
    }
    square
}
