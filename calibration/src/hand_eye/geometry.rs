//! The equation `a x camera_from_board = y` of both setups, its residual and derivatives, and the
//! errors of a solution.

use super::Setup;
use crate::BoardPoint;
use kinematics::{Intrinsics, Transform};
use nalgebra::{Matrix3, Matrix6, Point3, Rotation3, SMatrix, UnitQuaternion, Vector3, Vector6};

/// Derivatives of a residual with respect to the twelve parameters of [`Solution::moved`].
pub(crate) type Matrix6x12 = SMatrix<f64, 6, 12>;

/// Number of parameters of a solution.
pub(crate) const N_PARAMS: usize = 12;

/// Solution of `a_i x camera_from_board_i = y`.
///
/// Eye in hand: `a` is `base_from_flange`, `x` is `flange_from_camera`, `y` is `base_from_board`.
/// Eye to hand: `a` is `flange_from_base`, `x` is `base_from_camera`, `y` is `flange_from_board`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Solution {
    pub(crate) x: Transform,
    pub(crate) y: Transform,
}

impl Solution {
    /// The solution after a motion of `x` in camera axes and a motion of `y` in board axes. Each
    /// motion is a rotation and a translation, and has 6 values.
    pub(crate) fn moved(&self, step: &[f64]) -> Self {
        Self {
            x: self.x * motion(&step[..6]),
            y: self.y * motion(&step[6..]),
        }
    }

    /// `camera_from_board` at the pose `a`.
    pub(crate) fn camera_from_board(&self, a: &Transform) -> Transform {
        self.x.inverse() * a.inverse() * self.y
    }

    /// Pose of the board in the base or on the flange according to one measurement.
    pub(crate) fn board(&self, a: &Transform, camera_from_board: &Transform) -> Transform {
        a * self.x * camera_from_board
    }
}

/// The transform of a rotation vector followed by a translation.
pub(crate) fn motion(step: &[f64]) -> Transform {
    Transform::new(
        Vector3::new(step[3], step[4], step[5]),
        Vector3::new(step[0], step[1], step[2]),
    )
}

/// `a` of a robot pose.
pub(crate) fn a_of(setup: Setup, base_from_flange: &Transform) -> Transform {
    match setup {
        Setup::EyeInHand => *base_from_flange,
        Setup::EyeToHand => base_from_flange.inverse(),
    }
}

/// Rotation (in camera axes, radians) and translation (meters) from the measured to the predicted
/// `camera_from_board`.
pub(crate) fn residual(predicted: &Transform, measured: &Transform) -> Vector6<f64> {
    let rotation = (predicted.rotation * measured.rotation.inverse()).scaled_axis();
    let translation = predicted.translation.vector - measured.translation.vector;
    stacked(&rotation, &translation)
}

/// Rotation first, then translation.
pub(crate) fn stacked(rotation: &Vector3<f64>, translation: &Vector3<f64>) -> Vector6<f64> {
    let [x, y, z]: [f64; 3] = (*translation).into();
    Vector6::new(rotation.x, rotation.y, rotation.z, x, y, z)
}

/// Derivatives of [`residual`] with respect to the parameters of [`Solution::moved`].
pub(crate) fn residual_jacobian(predicted: &Transform, residual: &Vector6<f64>) -> Matrix6x12 {
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

/// Derivatives of [`residual`] with respect to a small motion of the flange in flange axes. The
/// motion is a rotation, then a translation. The predicted flange is at `base_from_flange *
/// exp(motion)`.
pub(crate) fn residual_by_flange(
    setup: Setup,
    solution: &Solution,
    predicted: &Transform,
) -> Matrix6<f64> {
    // With the eye in hand, points at rest move in the opposite direction relative to the flange.
    // With the eye to hand, the board moves with the flange.
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
    // The series is used near zero, where the quotient below loses all digits.
    let second = if angle < SMALL_RAD {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle)
    };
    let cross = rotation_vector.cross_matrix();
    Matrix3::identity() - cross * 0.5 + cross * cross * second
}

/// The rotation `r` that maximizes the trace of `r' correlation` (Kabsch 1976). `None` if it is not
/// unique.
pub(crate) fn nearest_rotation(correlation: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    // Minimum ratio of the second to the first singular value. For parallel axes, the ratio is 0.
    const MIN_RATIO: f64 = 1e-9;
    if !correlation.iter().all(|value| value.is_finite()) {
        return None;
    }
    let svd = correlation.svd(true, true);
    if svd.singular_values[1] <= MIN_RATIO * svd.singular_values[0] {
        return None;
    }
    let u = svd.u?;
    let v_t = svd.v_t?;
    // The product of the two orthogonal matrices may be a reflection. In this case, the direction
    // with the smallest singular value is flipped, because this reduces the trace least.
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Some(UnitQuaternion::from_rotation_matrix(
        &Rotation3::from_matrix_unchecked(u * mirror * v_t),
    ))
}

/// Sum of the rotation matrices. The rotation nearest to it is their mean.
pub(crate) fn rotation_sum(poses: &[Transform]) -> Matrix3<f64> {
    poses
        .iter()
        .map(|pose| pose.rotation.to_rotation_matrix().into_inner())
        .sum()
}

/// Mean position and mean rotation (least squares over rotation matrices).
pub(crate) fn mean(poses: &[Transform]) -> Option<Transform> {
    let translations = poses.iter().map(|pose| pose.translation.vector);
    let translation = translations.sum::<Vector3<f64>>() / poses.len() as f64;
    let rotation = nearest_rotation(&rotation_sum(poses))?;
    Some(Transform::from_parts(translation.into(), rotation))
}

/// Median distance of boards from the camera, meters. `None` without boards.
pub(crate) fn median_distance_m<'a>(
    camera_from_board: impl Iterator<Item = &'a Transform>,
) -> Option<f64> {
    let distances: Vec<f64> = camera_from_board
        .map(|pose| pose.translation.vector.norm())
        .collect();
    numbers::quantile::median(&distances)
}

/// Differences between the poses of the board that follow from the samples.
///
/// For each sample, `board_i = base_from_flange_i * flange_from_camera * camera_from_board_i` (eye
/// in hand), or `flange_from_base_i * base_from_camera * camera_from_board_i` (eye to hand). The
/// scatter of the position is the RMS distance of the origin of `board_i` from the mean over the
/// samples. The scatter of the rotation is the RMS angle between the rotation of `board_i` and the
/// mean rotation (least squares over rotation matrices).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scatter {
    /// Position, millimeters.
    pub mm: f64,
    /// Rotation, degrees.
    pub deg: f64,
}

/// Scatter of board poses. `None` without poses.
pub(crate) fn scatter(boards: &[Transform]) -> Option<Scatter> {
    let mean = mean(boards)?;
    let rms = |squares: f64| (squares / boards.len() as f64).sqrt();
    let distances = boards
        .iter()
        .map(|board| (board.translation.vector - mean.translation.vector).norm_squared());
    let angles = boards
        .iter()
        .map(|board| board.rotation.angle_to(&mean.rotation).powi(2));
    Some(Scatter {
        mm: 1e3 * rms(distances.sum()),
        deg: rms(angles.sum()).to_degrees(),
    })
}

/// Sum of squared reprojection errors, square pixels. It is infinite if a point cannot be
/// projected.
pub(crate) fn reprojection_squares(
    camera_from_board: &Transform,
    points: &[BoardPoint],
    intrinsics: &Intrinsics,
) -> f64 {
    let square = |point: &BoardPoint| {
        let in_camera = camera_from_board * Point3::from(point.point_in_board);
        let [u, v] = intrinsics.project(&in_camera.coords)?;
        Some((u - point.pixel[0]).powi(2) + (v - point.pixel[1]).powi(2))
    };
    points
        .iter()
        .map(|point| square(point).unwrap_or(f64::INFINITY))
        .sum()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{central_difference, example, unit_step};
    use super::*;

    #[test]
    fn derivatives_match_central_differences() {
        const CLOSE: f64 = 1e-8;
        let (solution, base_from_flange) = example();
        let measured = Transform::new(Vector3::new(0.1, 0.0, 0.5), Vector3::new(0.2, -0.4, 0.1));
        for setup in [Setup::EyeInHand, Setup::EyeToHand] {
            let a = a_of(setup, &base_from_flange);
            let predicted = solution.camera_from_board(&a);
            let jacobian = residual_jacobian(&predicted, &residual(&predicted, &measured));
            for ix in 0..N_PARAMS {
                let numeric = central_difference(|nudge| {
                    let moved = solution.moved(unit_step::<N_PARAMS>(ix, nudge).as_slice());
                    residual(&moved.camera_from_board(&a), &measured)
                });
                assert!(
                    (numeric - jacobian.column(ix)).norm() < CLOSE,
                    "{setup:?}, parameter {ix}"
                );
            }
            // Derivatives with respect to the flange are used only as weights, and are exact only
            // for small residuals.
            let by_flange = residual_by_flange(setup, &solution, &predicted);
            for ix in 0..6 {
                let numeric = central_difference(|nudge| {
                    let moved = base_from_flange * motion(unit_step::<6>(ix, nudge).as_slice());
                    let pose = solution.camera_from_board(&a_of(setup, &moved));
                    residual(&pose, &predicted)
                });
                assert!(
                    (numeric - by_flange.column(ix)).norm() < CLOSE,
                    "{setup:?}, flange {ix}"
                );
            }
        }
    }
}
