//! The equation `a x camera_from_board = y` of both setups, its residual and derivatives.

use super::Setup;
use crate::least_squares::{BlockSums, Loss};
use kinematics::Transform;
use nalgebra::{Matrix3, Matrix6, SMatrix, UnitQuaternion, Vector3, Vector6};

/// Derivatives of a residual with respect to the twelve parameters of [`Solution::moved`].
pub(super) type Matrix6x12 = SMatrix<f64, 6, 12>;

/// Number of parameters of a solution.
pub(super) const N_PARAMS: usize = 12;

/// Solution of `a_i x camera_from_board_i = y`.
///
/// Eye in hand: `a` is `base_from_flange`, `x` is `flange_from_camera`, `y` is `base_from_board`.
/// Eye to hand: `a` is `flange_from_base`, `x` is `base_from_camera`, `y` is `flange_from_board`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solution {
    pub(super) x: Transform,
    pub(super) y: Transform,
}

impl Solution {
    /// The solution after a rotation and a translation of `x` in camera axes (6 values), and of `y`
    /// in board axes.
    pub(super) fn moved(&self, step: &[f64]) -> Self {
        Self {
            x: self.x * motion(&step[..6]),
            y: self.y * motion(&step[6..]),
        }
    }

    /// `camera_from_board` at the pose `a`.
    pub(super) fn camera_from_board(&self, a: &Transform) -> Transform {
        self.x.inverse() * a.inverse() * self.y
    }
}

/// The transform of a rotation vector followed by a translation.
fn motion(step: &[f64]) -> Transform {
    Transform::new(
        Vector3::new(step[3], step[4], step[5]),
        Vector3::new(step[0], step[1], step[2]),
    )
}

/// `a` of a robot pose.
pub(super) fn a_of(setup: Setup, base_from_flange: &Transform) -> Transform {
    match setup {
        Setup::EyeInHand => *base_from_flange,
        Setup::EyeToHand => base_from_flange.inverse(),
    }
}

/// Rotation (in camera axes, radians) and translation (meters) from the measured to the predicted
/// `camera_from_board`.
pub(super) fn residual(predicted: &Transform, measured: &Transform) -> Vector6<f64> {
    let rotation = (predicted.rotation * measured.rotation.inverse()).scaled_axis();
    let translation = predicted.translation.vector - measured.translation.vector;
    Vector6::new(
        rotation.x,
        rotation.y,
        rotation.z,
        translation.x,
        translation.y,
        translation.z,
    )
}

/// Derivatives of [`residual`] with respect to the parameters of [`Solution::moved`].
pub(super) fn residual_jacobian(predicted: &Transform, residual: &Vector6<f64>) -> Matrix6x12 {
    // The rotation vector of a product changes by the inverse left Jacobian times a small rotation
    // on the left. For small residuals, it is close to the identity.
    let left = inverse_left_jacobian(&residual.fixed_rows::<3>(0).into_owned());
    let rotation = predicted.rotation.to_rotation_matrix().into_inner();
    let mut jacobian = Matrix6x12::zeros();
    for (row, column, block) in [
        (0, 0, -left),
        (0, 6, left * rotation),
        (3, 0, predicted.translation.vector.cross_matrix()),
        (3, 3, -Matrix3::identity()),
        (3, 9, rotation),
    ] {
        jacobian
            .fixed_view_mut::<3, 3>(row, column)
            .copy_from(&block);
    }
    jacobian
}

/// Derivatives of [`residual`] with respect to a small motion of the flange in flange axes: the
/// predicted pose of a flange at `base_from_flange * exp(motion)`; rotation first.
pub(super) fn residual_by_flange(
    setup: Setup,
    solution: &Solution,
    predicted: &Transform,
) -> Matrix6<f64> {
    // For the eye in hand, points at rest move against the flange; for the eye to hand, the board
    // moves with it.
    let (rotation, board_in_flange, sign) = match setup {
        Setup::EyeInHand => (
            solution.x.rotation.inverse(),
            (solution.x * predicted).translation.vector,
            -1.0,
        ),
        Setup::EyeToHand => (
            predicted.rotation * solution.y.rotation.inverse(),
            solution.y.translation.vector,
            1.0,
        ),
    };
    let rotation = rotation.to_rotation_matrix().into_inner() * sign;
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    jacobian
        .fixed_view_mut::<3, 3>(3, 0)
        .copy_from(&(-rotation * board_in_flange.cross_matrix()));
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    jacobian
}

/// Inverse of the left Jacobian of the rotation group (Barfoot 2017, section 7.1.5).
fn inverse_left_jacobian(rotation_vector: &Vector3<f64>) -> Matrix3<f64> {
    const SMALL_RAD: f64 = 1e-4;
    let angle = rotation_vector.norm();
    // The series: the quotient below loses all digits near zero.
    let second = if angle < SMALL_RAD {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle)
    };
    let cross = rotation_vector.cross_matrix();
    Matrix3::identity() - cross * 0.5 + cross * cross * second
}

/// Mean position and mean rotation (least squares over rotation matrices).
pub(super) fn mean(poses: &[Transform]) -> Option<Transform> {
    let translation = poses
        .iter()
        .map(|pose| pose.translation.vector)
        .sum::<Vector3<f64>>()
        / poses.len() as f64;
    let sum: Matrix3<f64> = poses
        .iter()
        .map(|pose| pose.rotation.to_rotation_matrix().into_inner())
        .sum();
    let rotation: UnitQuaternion<f64> = super::closed_form::nearest_rotation(&sum)?;
    Some(Transform::from_parts(translation.into(), rotation))
}

/// Loss of six whitened residuals: 95 % of the samples without a mistake are below the threshold.
pub(super) const SAMPLE_LOSS: Loss = Loss::Huber { threshold: 3.55 };

/// Adds six whitened residuals as one vector.
pub(super) fn add_whitened(
    sums: &mut BlockSums,
    whitening: &Matrix6<f64>,
    residual: &Vector6<f64>,
    jacobian: &Matrix6x12,
) {
    let whitened = whitening * residual;
    // Matrices are stored by columns, so the rows are contiguous in the transpose.
    let rows = (whitening * jacobian).transpose();
    let row = |ix: usize| &rows.as_slice()[N_PARAMS * ix..N_PARAMS * (ix + 1)];
    sums.add(
        whitened.into(),
        [row(0), row(1), row(2), row(3), row(4), row(5)],
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_central_differences() {
        const NUDGE: f64 = 1e-6;
        const CLOSE: f64 = 1e-8;
        let solution = Solution {
            x: Transform::new(Vector3::new(0.05, -0.02, 0.1), Vector3::new(0.3, -1.0, 2.0)),
            y: Transform::new(Vector3::new(0.6, 0.2, 0.1), Vector3::new(2.0, 0.5, -0.3)),
        };
        let measured = Transform::new(Vector3::new(0.1, 0.0, 0.5), Vector3::new(0.2, -0.4, 0.1));
        for setup in [Setup::EyeInHand, Setup::EyeToHand] {
            let base_from_flange =
                Transform::new(Vector3::new(0.4, -0.1, 0.5), Vector3::new(1.0, 2.0, -0.5));
            let at = |solution: &Solution, base_from_flange: &Transform| {
                residual(
                    &solution.camera_from_board(&a_of(setup, base_from_flange)),
                    &measured,
                )
            };
            let value = at(&solution, &base_from_flange);
            let predicted = solution.camera_from_board(&a_of(setup, &base_from_flange));
            let jacobian = residual_jacobian(&predicted, &value);
            for ix in 0..N_PARAMS {
                let moved = |nudge: f64| {
                    let mut step = [0.0; N_PARAMS];
                    step[ix] = nudge;
                    at(&solution.moved(&step), &base_from_flange)
                };
                let numeric = (moved(NUDGE) - moved(-NUDGE)) / (2.0 * NUDGE);
                assert!(
                    (numeric - jacobian.column(ix)).norm() < CLOSE,
                    "{setup:?}, parameter {ix}"
                );
            }
            // Derivatives by the flange are used as weights only; they are exact for small
            // residuals.
            let close = measured_close_to(&predicted);
            let by_flange = residual_by_flange(setup, &solution, &predicted);
            for ix in 0..6 {
                let moved = |nudge: f64| {
                    let mut step = Vector6::zeros();
                    step[ix] = nudge;
                    let motion = Transform::new(
                        step.fixed_rows::<3>(3).into(),
                        step.fixed_rows::<3>(0).into(),
                    );
                    let pose =
                        solution.camera_from_board(&a_of(setup, &(base_from_flange * motion)));
                    residual(&pose, &close)
                };
                let numeric = (moved(NUDGE) - moved(-NUDGE)) / (2.0 * NUDGE);
                assert!(
                    (numeric - by_flange.column(ix)).norm() < CLOSE,
                    "{setup:?}, flange {ix}"
                );
            }
        }
    }

    fn measured_close_to(predicted: &Transform) -> Transform {
        *predicted
    }
}
