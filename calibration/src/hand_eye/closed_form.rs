//! Closed-form solutions of `a x = x b`: Park and Martin 1994, Daniilidis 1999, Tsai and Lenz 1989.
//!
//! `a` is the motion of the flange between two samples, `b` the motion of the camera, and `x` is
//! `flange_from_camera`.

use kinematics::Transform;
use nalgebra::{
    DMatrix, DVector, Matrix3, Quaternion, Rotation3, SMatrix, SVector, SymmetricEigen,
    Translation3, UnitQuaternion, Vector3,
};

/// Motions with a smaller rotation, in radians, have no usable rotation axis: the errors of their
/// rotations may be as large.
const MIN_ROTATION_RAD: f64 = 1e-3;

/// Maximum number of pairs of samples in a solution: all pairs of 63 samples. It bounds the time
/// for recordings with hundreds of samples; every sample still is in many pairs.
const MAX_MOTIONS: usize = 2000;

/// A closed-form solver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClosedForm {
    /// Rotation from rotation vectors, then translation (Park and Martin 1994, sections III and
    /// IV).
    ParkMartin,
    /// Rotation and translation from dual quaternions (Daniilidis 1999, section 4).
    Daniilidis,
    /// Rotation from modified Rodrigues vectors, then translation (Tsai and Lenz 1989, section II).
    TsaiLenz,
}

impl ClosedForm {
    /// All solvers.
    pub const ALL: [Self; 3] = [Self::ParkMartin, Self::Daniilidis, Self::TsaiLenz];

    /// Pose of the camera on the flange from pairs `(base_from_flange, camera_from_board)`. All
    /// pairs have the same weight, so a wrong one spoils the result. `None` if the rotation axes of
    /// the motions are parallel.
    pub fn flange_from_camera(self, pairs: &[(Transform, Transform)]) -> Option<Transform> {
        self.solve(&motions(pairs))
    }

    /// Solves `a x = x b` for all motions. `None` if the rotation axes of the motions are parallel.
    pub(super) fn solve(self, motions: &[Motion]) -> Option<Transform> {
        let x = match self {
            Self::ParkMartin => with_translation(motions, park_martin_rotation(motions)?),
            Self::TsaiLenz => with_translation(motions, tsai_lenz_rotation(motions)?),
            Self::Daniilidis => daniilidis(motions),
        }?;
        kinematics::transform::is_finite(&x).then_some(x)
    }
}

/// A pair of corresponding motions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Motion {
    pub(super) a: Transform,
    pub(super) b: Transform,
}

/// Motions between all pairs of samples, or between evenly distributed pairs if there are many.
///
/// * `pairs`: `a` and `camera_from_board` of each sample, where `a x camera_from_board` is
///   constant.
pub(super) fn motions(pairs: &[(Transform, Transform)]) -> Vec<Motion> {
    let n = pairs.len();
    // Numbers of pairs grow with the square of the number of samples.
    let stride = (n * n.saturating_sub(1) / 2).div_ceil(MAX_MOTIONS).max(1);
    let all = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    all.step_by(stride)
        .map(|(i, j)| Motion {
            a: pairs[j].0.inverse() * pairs[i].0,
            b: pairs[j].1 * pairs[i].1.inverse(),
        })
        .collect()
}

/// Rotation with the least squared distance between the rotation vectors of `a` and the rotated
/// ones of `b`.
fn park_martin_rotation(motions: &[Motion]) -> Option<UnitQuaternion<f64>> {
    let mut correlation = Matrix3::zeros();
    for motion in motions {
        correlation +=
            motion.a.rotation.scaled_axis() * motion.b.rotation.scaled_axis().transpose();
    }
    nearest_rotation(&correlation)
}

/// The rotation `r` that maximizes the trace of `r' correlation` (Kabsch 1976). `None` if it is not
/// unique.
pub(crate) fn nearest_rotation(correlation: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    // Of the second to the first singular value; parallel axes have 0.
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
    // If the product of the two orthogonal matrices is a reflection, the direction with the
    // smallest singular value is flipped, which costs the least.
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Some(UnitQuaternion::from_rotation_matrix(
        &Rotation3::from_matrix_unchecked(u * mirror * v_t),
    ))
}

fn tsai_lenz_rotation(motions: &[Motion]) -> Option<UnitQuaternion<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for motion in motions {
        let p_a = modified_rodrigues(&motion.a);
        let p_b = modified_rodrigues(&motion.b);
        // skew(p_a + p_b) x = p_b - p_a.
        let skew = (p_a + p_b).cross_matrix();
        normal += skew.transpose() * skew;
        right += skew.transpose() * (p_b - p_a);
    }
    let tangent = solve(&normal, &right)?;
    // The vector is the axis times the tangent of half the angle.
    let half_cosine = 1.0 / (1.0 + tangent.norm_squared()).sqrt();
    Some(UnitQuaternion::from_quaternion(Quaternion::from_parts(
        half_cosine,
        tangent * half_cosine,
    )))
}

/// Rotation axis times twice the sine of half the angle.
fn modified_rodrigues(motion: &Transform) -> Vector3<f64> {
    let q = positive(motion.rotation);
    2.0 * q.imag()
}

/// The quaternion of the two that represent the rotation whose scalar part is not negative.
fn positive(rotation: UnitQuaternion<f64>) -> Quaternion<f64> {
    let q = rotation.into_inner();
    if q.scalar() < 0.0 { -q } else { q }
}

fn solve(normal: &Matrix3<f64>, right: &Vector3<f64>) -> Option<Vector3<f64>> {
    // Of eigenvalues, which are squares of singular values.
    const MIN_RATIO: f64 = 1e-12;
    let eigen = SymmetricEigen::new(*normal);
    (eigen.eigenvalues.min() > MIN_RATIO * eigen.eigenvalues.max()).then_some(())?;
    normal.cholesky().map(|factor| factor.solve(right))
}

/// Solves `(R_a - 1) t = R t_b - t_a` by least squares.
fn with_translation(motions: &[Motion], rotation: UnitQuaternion<f64>) -> Option<Transform> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for motion in motions {
        let factor = motion.a.rotation.to_rotation_matrix().into_inner() - Matrix3::identity();
        normal += factor.transpose() * factor;
        right += factor.transpose()
            * (rotation * motion.b.translation.vector - motion.a.translation.vector);
    }
    Some(Transform::from_parts(
        Translation3::from(solve(&normal, &right)?),
        rotation,
    ))
}

/// Scale of the translations of `b` relative to those of `a`, estimated together with the
/// translation, and its standard deviation. 1 if both have the same unit; 1000 if only those of `a`
/// are in millimeters.
pub(super) fn relative_scale(
    motions: &[Motion],
    rotation: UnitQuaternion<f64>,
) -> Option<(f64, f64)> {
    let rows = 3 * motions.len();
    (rows > 4).then_some(())?;
    let mut matrix = DMatrix::zeros(rows, 4);
    let mut right = DVector::zeros(rows);
    // (R_a - 1) t - s R t_b = -t_a: the equation of `with_translation`, with the scale as the
    // fourth unknown.
    for (ix, motion) in motions.iter().enumerate() {
        let factor = motion.a.rotation.to_rotation_matrix().into_inner() - Matrix3::identity();
        matrix.fixed_view_mut::<3, 3>(3 * ix, 0).copy_from(&factor);
        matrix
            .fixed_view_mut::<3, 1>(3 * ix, 3)
            .copy_from(&-(rotation * motion.b.translation.vector));
        right
            .fixed_rows_mut::<3>(3 * ix)
            .copy_from(&-motion.a.translation.vector);
    }
    let inverse = (matrix.transpose() * &matrix).try_inverse()?;
    let solution = &inverse * matrix.transpose() * &right;
    let variance = (&matrix * &solution - right).norm_squared() / (rows - 4) as f64;
    // The motions between all pairs of n samples contain n - 1 independent ones; with n (n - 1) / 2
    // pairs, n is:
    let n_samples = 0.5 + (0.25 + 2.0 * motions.len() as f64).sqrt();
    let repetition = motions.len() as f64 / (n_samples - 1.0);
    Some((
        solution[3],
        (variance * inverse[(3, 3)] * repetition).max(0.0).sqrt(),
    ))
}

fn daniilidis(motions: &[Motion]) -> Option<Transform> {
    // Six linear equations per motion for the eight elements of the dual quaternion. The scalar
    // parts of `a` and `b` are equal, so only the vector parts give equations.
    let mut normal = SMatrix::<f64, 8, 8>::zeros();
    for motion in motions {
        if motion.a.rotation.angle() < MIN_ROTATION_RAD {
            continue;
        }
        let (a, a_dual) = dual_quaternion(&motion.a);
        let (b, b_dual) = dual_quaternion(&motion.b);
        let mut rows = SMatrix::<f64, 6, 8>::zeros();
        for (row, column, difference, sum) in [
            (0, 0, a.imag() - b.imag(), a.imag() + b.imag()),
            (
                3,
                0,
                a_dual.imag() - b_dual.imag(),
                a_dual.imag() + b_dual.imag(),
            ),
            (3, 4, a.imag() - b.imag(), a.imag() + b.imag()),
        ] {
            rows.fixed_view_mut::<3, 1>(row, column)
                .copy_from(&difference);
            rows.fixed_view_mut::<3, 3>(row, column + 1)
                .copy_from(&sum.cross_matrix());
        }
        normal += rows.transpose() * rows;
    }
    let eigen = SymmetricEigen::new(normal);
    let mut order: Vec<usize> = (0..8).collect();
    order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
    // With parallel axes, the null space has more than two dimensions.
    const MIN_RATIO: f64 = 1e-12;
    (eigen.eigenvalues[order[2]] > MIN_RATIO * eigen.eigenvalues[order[7]]).then_some(())?;
    let null = [order[0], order[1]].map(|ix| {
        let vector = eigen.eigenvectors.column(ix).into_owned();
        (quaternion_at(&vector, 0), quaternion_at(&vector, 4))
    });
    let (s, t) = coefficients(&null)?;
    let [(u1, v1), (u2, v2)] = &null;
    let real = *u1 * s + *u2 * t;
    let dual = *v1 * s + *v2 * t;
    let norm = real.norm();
    (norm > 0.0).then_some(())?;
    let real = real / norm;
    let dual = dual / norm;
    let translation = (dual * real.conjugate()).imag() * 2.0;
    Some(Transform::from_parts(
        translation.into(),
        UnitQuaternion::from_quaternion(real),
    ))
}

/// The quaternion in four elements of a vector.
fn quaternion_at(vector: &SVector<f64, 8>, first: usize) -> Quaternion<f64> {
    Quaternion::new(
        vector[first],
        vector[first + 1],
        vector[first + 2],
        vector[first + 3],
    )
}

/// Dot product of quaternions as vectors of four numbers.
fn dot(p: &Quaternion<f64>, q: &Quaternion<f64>) -> f64 {
    p.coords.dot(&q.coords)
}

/// The combination of two null vectors, each with real and dual part, that is a dual quaternion of
/// unit length after scaling: its real part is orthogonal to its dual part (Daniilidis 1999,
/// equations 31 to 35).
fn coefficients(null: &[(Quaternion<f64>, Quaternion<f64>); 2]) -> Option<(f64, f64)> {
    let [(u1, v1), (u2, v2)] = null;
    // Orthogonality is a quadratic equation for the ratio of both coefficients.
    let first = dot(u1, v1);
    let middle = dot(u1, v2) + dot(u2, v1);
    let last = dot(u2, v2);
    let candidates: Vec<(f64, f64)> = if first.abs() < f64::EPSILON {
        vec![(1.0, 0.0), (last, -middle)]
    } else {
        let root = (middle * middle - 4.0 * first * last).max(0.0).sqrt();
        [root, -root]
            .map(|root| ((-middle + root) / (2.0 * first), 1.0))
            .to_vec()
    };
    // One of the two solutions has a real part near zero, and is no rotation.
    let squared_norm = |&(s, t): &(f64, f64)| {
        (s * s * dot(u1, u1) + 2.0 * s * t * dot(u1, u2) + t * t * dot(u2, u2)) / (s * s + t * t)
    };
    candidates
        .into_iter()
        .max_by(|p, q| squared_norm(p).total_cmp(&squared_norm(q)))
}

/// Real and dual part (Daniilidis 1999, section 3.2).
fn dual_quaternion(motion: &Transform) -> (Quaternion<f64>, Quaternion<f64>) {
    let real = positive(motion.rotation);
    (
        real,
        Quaternion::from_imag(motion.translation.vector) * real * 0.5,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::random::Random;

    fn pose(random: &mut Random, angle_rad: f64) -> Transform {
        let mut vector = || Vector3::new(random.normal(), random.normal(), random.normal());
        Transform::new(vector(), vector().normalize() * angle_rad)
    }

    fn scene(n: usize) -> (Transform, Vec<(Transform, Transform)>) {
        let mut random = Random::new(3);
        let (x, y) = (pose(&mut random, 2.5), pose(&mut random, 1.0));
        let sample = |_| {
            let a = pose(&mut random, 0.8);
            (a, x.inverse() * a.inverse() * y)
        };
        (x, (0..n).map(sample).collect())
    }

    fn distance(a: &Transform, b: &Transform) -> f64 {
        (a.to_homogeneous() - b.to_homogeneous()).abs().max()
    }

    #[test]
    fn every_solver_finds_exact_solution_from_three_poses() {
        const CLOSE: f64 = 1e-9; // Dual quaternions take the square root of rounding errors of products.
        for n in [3, 10] {
            let (x, pairs) = scene(n);
            for solver in ClosedForm::ALL {
                let found = solver.solve(&motions(&pairs)).unwrap();
                assert!(
                    distance(&found, &x) < CLOSE,
                    "{solver:?}: off by {:e}",
                    distance(&found, &x)
                );
                assert!(distance(&found, &pairs[0].0) > CLOSE);
            }
        }
    }

    #[test]
    fn parallel_axes_have_no_solution() {
        let (x, _) = scene(3);
        let pairs: Vec<_> = (0..6)
            .map(|ix| {
                let a = Transform::new(
                    Vector3::new(0.1 * f64::from(ix), 0.3, 0.0),
                    Vector3::z() * f64::from(ix) * 0.3,
                );
                (a, x.inverse() * a.inverse())
            })
            .collect();
        for solver in [ClosedForm::ParkMartin, ClosedForm::TsaiLenz] {
            assert_eq!(solver.solve(&motions(&pairs)), None, "{solver:?}");
        }
        assert_eq!(ClosedForm::ParkMartin.solve(&motions(&pairs[..1])), None);
        assert_eq!(ClosedForm::Daniilidis.solve(&[]), None);
    }

    #[test]
    fn scale_of_translations_is_found() {
        let (x, mut pairs) = scene(6);
        for pair in &mut pairs {
            pair.0.translation.vector *= 1000.0;
        }
        let (scale, sigma) = relative_scale(&motions(&pairs), x.rotation).unwrap();
        assert!(
            (scale - 1000.0).abs() < 1e-6 && sigma < 1e-6,
            "{scale} +- {sigma}"
        );
    }
}
