//! Finds an initial solution that agrees with most samples, and the board pose of each sample that
//! fits this solution best.
//!
//! The method is least trimmed squares over closed-form solutions of three samples (Rousseeuw
//! 1984), with the concentration steps of Rousseeuw and Van Driessen 1999. It resolves the two-fold
//! ambiguity of planar boards and the symmetries of boards. Almost half of the samples may be
//! wrong.
//!
//! The closed forms solve `a x = x b`: Park and Martin 1994, Daniilidis 1999, Tsai and Lenz 1989.
//! `a` is the motion of the flange between two samples, `b` the motion of the camera, and `x` is
//! `flange_from_camera`.

use super::super::geometry::{self, Solution, nearest_rotation};
use super::super::samples::{Sample, used};
use kinematics::Transform;
use nalgebra::{
    DMatrix, DVector, Matrix3, Quaternion, SMatrix, SVector, SymmetricEigen, Translation3,
    UnitQuaternion, Vector3,
};
use numbers::random::Random;

/// An initial solution.
#[derive(Clone, Debug)]
pub(crate) struct Consensus {
    pub(crate) solution: Solution,
    /// Candidate of each sample.
    pub(crate) choice: Vec<usize>,
    /// Distance of each sample from the solution. See [`Metric`].
    distances_m: Vec<f64>,
}

impl Consensus {
    /// Median distance of the samples, meters.
    pub(crate) fn median_m(&self) -> f64 {
        numbers::quantile::median(&self.distances_m).unwrap_or(f64::INFINITY)
    }

    /// Chooses the candidates, and excludes the samples that disagree with the solution.
    pub(super) fn apply_to(&self, samples: &mut [Sample]) {
        /// If two fifths of the samples are wrong, the median of all distances is the 83 % quantile
        /// of the distances of the good samples.
        const MEDIANS: f64 = 4.0;
        const ROUNDING_M: f64 = 1e-9;
        let limit = MEDIANS * self.median_m() + ROUNDING_M;
        for (ix, sample) in samples.iter_mut().enumerate() {
            sample.choice = self.choice[ix];
            sample.is_used = self.distances_m[ix] <= limit;
        }
    }
}

/// Number of samples whose agreement is compared between solutions. For solutions of `p = 3`
/// samples, the value `(n + p + 1) / 2` tolerates the largest number of wrong samples (Rousseeuw
/// 1984).
fn n_deciding(n: usize) -> usize {
    (n + 4).div_ceil(2).min(n)
}

/// Distance between poses, meters. It combines the translation with the rotation angle. The angle
/// is multiplied by the typical distance of the board.
#[derive(Clone, Copy, Debug)]
struct Metric {
    lever_m: f64,
}

impl Metric {
    fn of(samples: &[Sample]) -> Self {
        // In the image, a rotation error moves the board as much as a translation by the angle
        // times the distance of the board.
        let likely = samples
            .iter()
            .map(|sample| &sample.candidates[0].camera_from_board);
        Self {
            lever_m: geometry::median_distance_m(likely).unwrap_or(1.0).max(1e-3),
        }
    }

    fn distance_m(self, predicted: &Transform, measured: &Transform) -> f64 {
        let residual = geometry::residual(predicted, measured);
        let rotation = residual.fixed_rows::<3>(0).norm() * self.lever_m;
        rotation.hypot(residual.fixed_rows::<3>(3).norm())
    }
}

/// The best solution found. `None` if no three samples determine a solution.
pub(crate) fn consensus(samples: &[Sample]) -> Option<Consensus> {
    /// If two fifths of the samples are wrong, this number of trials draws three good samples with
    /// a probability of 99 %. Each sample has four poses, and each draw must also select the right
    /// pose of each sample.
    const TRIALS: usize = 1500;
    /// If each sample has only one pose, this number is sufficient.
    const TRIALS_WITHOUT_CHOICE: usize = 200;
    let metric = Metric::of(samples);
    // The seed is fixed, so that the same samples give the same result.
    let mut random = Random::new(1);
    let mut best: Option<(f64, Solution)> = None;
    let has_choice = samples.iter().any(|sample| sample.candidates.len() > 1);
    let n_trials = if has_choice {
        TRIALS
    } else {
        TRIALS_WITHOUT_CHOICE
    };
    for trial in 0..n_trials {
        let Some(picked) = pick(samples, trial, &mut random) else {
            continue;
        };
        let Some(solution) = solve(&picked, ClosedForm::ParkMartin) else {
            continue;
        };
        let score = trimmed_squares(&distances(samples, &solution, metric).1);
        if best.as_ref().is_none_or(|(least, _)| score < *least) {
            best = Some((score, solution));
        }
    }
    // Concentration steps follow, because solutions of half of the samples are more accurate than
    // solutions of three. Each step decreases the sum of squares until the set of samples no longer
    // changes.
    let (mut least, mut solution) = best?;
    for _ in 0..10 {
        let Some(next) = concentrate(samples, &solution, metric) else {
            break;
        };
        let score = trimmed_squares(&distances(samples, &next, metric).1);
        if score.is_nan() || score >= least {
            break;
        }
        (least, solution) = (score, next);
    }
    let (choice, distances_m) = distances(samples, &solution, metric);
    Some(Consensus {
        solution,
        choice,
        distances_m,
    })
}

/// Three samples with one candidate each. `None` if the rotation angles of their motions disagree.
fn pick(
    samples: &[Sample],
    trial: usize,
    random: &mut Random,
) -> Option<[(Transform, Transform); 3]> {
    // Flange and camera rotate by the same angle. Different angles therefore reveal a wrong sample
    // or candidate before a solution is computed. The limit is far above the errors of good
    // samples.
    const MAX_DIFFERENCE_RAD: f64 = 0.2;
    let n = samples.len();
    (n >= 3).then_some(())?;
    let first = random.below(n);
    let second = (first + 1 + random.below(n - 1)) % n;
    let third = loop {
        let ix = random.below(n);
        if ix != first && ix != second {
            break ix;
        }
    };
    let picked = [first, second, third].map(|ix| {
        let sample = &samples[ix];
        let n_candidates = sample.candidates.len();
        // The first trials use the best poses only.
        let candidate_ix = if trial < 100 {
            0
        } else {
            random.below(n_candidates)
        };
        (sample.a, sample.candidates[candidate_ix].camera_from_board)
    });
    let agrees = motions(&picked).iter().all(|motion| {
        (motion.a.rotation.angle() - motion.b.rotation.angle()).abs() < MAX_DIFFERENCE_RAD
    });
    agrees.then_some(picked)
}

/// Closed-form solution of samples.
fn solve(pairs: &[(Transform, Transform)], solver: ClosedForm) -> Option<Solution> {
    let x = solver.solve(&motions(pairs))?;
    let boards: Vec<Transform> = pairs
        .iter()
        .map(|(a, camera_from_board)| a * x * camera_from_board)
        .collect();
    let y = geometry::mean(&boards)?;
    Some(Solution { x, y })
}

/// The closed-form solution of the used samples with the smallest leave-one-out scatter. `None` if
/// there is none.
pub(super) fn best_closed_form(samples: &[Sample]) -> Option<Solution> {
    let pairs: Vec<(Transform, Transform)> = used(samples)
        .map(|sample| (sample.a, sample.chosen().camera_from_board))
        .collect();
    ClosedForm::ALL
        .into_iter()
        .filter_map(|solver| Some((leave_one_out_mm(&pairs, solver)?, solve(&pairs, solver)?)))
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, solution)| solution)
}

/// Scatter of the positions of the board, millimeters. The position of each pair follows from a
/// closed-form solution of the other pairs.
fn leave_one_out_mm(pairs: &[(Transform, Transform)], solver: ClosedForm) -> Option<f64> {
    /// This number is sufficient to rank three solvers. In each fold, a solver uses all pairs of
    /// the other samples.
    const MAX_FOLDS: usize = 20;
    let stride = pairs.len().div_ceil(MAX_FOLDS).max(1);
    let boards: Option<Vec<Transform>> = (0..pairs.len())
        .step_by(stride)
        .map(|left_out| {
            let mut others = pairs.to_vec();
            let (a, camera_from_board) = others.remove(left_out);
            Some(solve(&others, solver)?.board(&a, &camera_from_board))
        })
        .collect();
    Some(geometry::scatter(&boards?)?.mm)
}

/// For each sample, the candidate that fits best and its distance in meters.
fn distances(samples: &[Sample], solution: &Solution, metric: Metric) -> (Vec<usize>, Vec<f64>) {
    samples
        .iter()
        .map(|sample| nearest(sample, solution, metric))
        .unzip()
}

/// The candidate of a sample that fits best, and its distance in meters.
fn nearest(sample: &Sample, solution: &Solution, metric: Metric) -> (usize, f64) {
    let predicted = solution.camera_from_board(&sample.a);
    sample
        .candidates
        .iter()
        .map(|candidate| metric.distance_m(&predicted, &candidate.camera_from_board))
        .enumerate()
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap_or((0, f64::INFINITY))
}

/// Chooses the candidate of each sample that fits a solution best. Returns whether a choice has
/// changed.
pub(super) fn choose(samples: &mut [Sample], solution: &Solution) -> bool {
    let metric = Metric::of(samples);
    let mut has_changed = false;
    for sample in samples {
        let (choice, _) = nearest(sample, solution, metric);
        has_changed |= choice != sample.choice;
        sample.choice = choice;
    }
    has_changed
}

/// Sum of the squares of the smallest distances. The other samples may be arbitrarily wrong.
fn trimmed_squares(distances_m: &[f64]) -> f64 {
    let mut sorted = distances_m.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted
        .iter()
        .take(n_deciding(sorted.len()))
        .map(|distance| distance * distance)
        .sum()
}

/// Solution of the samples with the smallest distances.
fn concentrate(samples: &[Sample], solution: &Solution, metric: Metric) -> Option<Solution> {
    let (choice, distances_m) = distances(samples, solution, metric);
    let mut order: Vec<usize> = (0..samples.len()).collect();
    order.sort_by(|&i, &j| distances_m[i].total_cmp(&distances_m[j]));
    let pairs: Vec<_> = order
        .into_iter()
        .take(n_deciding(samples.len()))
        .map(|ix| {
            (
                samples[ix].a,
                samples[ix].candidates[choice[ix]].camera_from_board,
            )
        })
        .collect();
    solve(&pairs, ClosedForm::ParkMartin)
}

/// Motions with a smaller rotation, in radians, have no usable rotation axis, because the errors of
/// their rotations may be as large as the rotations.
const MIN_ROTATION_RAD: f64 = 1e-3;

/// Maximum number of pairs of samples in a solution. All pairs of 63 samples are below this limit.
/// The limit bounds the time for recordings with hundreds of samples, in which every sample is
/// still in many pairs.
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
    /// pairs have the same weight, so a single wrong pair makes the result wrong. `None` if the
    /// rotation axes of the motions are parallel.
    pub fn flange_from_camera(self, pairs: &[(Transform, Transform)]) -> Option<Transform> {
        self.solve(&motions(pairs))
    }

    /// Solves `a x = x b` for all motions. `None` if the rotation axes of the motions are parallel.
    pub(crate) fn solve(self, motions: &[Motion]) -> Option<Transform> {
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
pub(crate) struct Motion {
    a: Transform,
    b: Transform,
}

/// Motions between all pairs of samples, or between evenly distributed pairs if there are many.
///
/// * `pairs`: `a` and `camera_from_board` of each sample, where `a x camera_from_board` is
///   constant.
pub(crate) fn motions(pairs: &[(Transform, Transform)]) -> Vec<Motion> {
    let n = pairs.len();
    // The number of pairs grows with the square of the number of samples.
    let stride = (n * n.saturating_sub(1) / 2).div_ceil(MAX_MOTIONS).max(1);
    let all = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    all.step_by(stride)
        .map(|(i, j)| Motion {
            a: pairs[j].0.inverse() * pairs[i].0,
            b: pairs[j].1 * pairs[i].1.inverse(),
        })
        .collect()
}

/// Rotation that minimizes the squared distances between the rotation vectors of `a` and the
/// rotated rotation vectors of `b`.
fn park_martin_rotation(motions: &[Motion]) -> Option<UnitQuaternion<f64>> {
    let mut correlation = Matrix3::zeros();
    for motion in motions {
        correlation +=
            motion.a.rotation.scaled_axis() * motion.b.rotation.scaled_axis().transpose();
    }
    nearest_rotation(&correlation)
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
    let tangent = solve_normal(&normal, &right)?;
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

/// The quaternion of the rotation whose scalar part is not negative. Its negative represents the
/// same rotation.
fn positive(rotation: UnitQuaternion<f64>) -> Quaternion<f64> {
    let q = rotation.into_inner();
    if q.scalar() < 0.0 { -q } else { q }
}

fn solve_normal(normal: &Matrix3<f64>, right: &Vector3<f64>) -> Option<Vector3<f64>> {
    // Minimum ratio of eigenvalues, which are squares of singular values.
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
        Translation3::from(solve_normal(&normal, &right)?),
        rotation,
    ))
}

/// Scale of the translations of `b` relative to the translations of `a`, and the standard deviation
/// of this scale. The scale is estimated together with the translation. The scale is 1 if both have
/// the same unit, and 1000 if only the translations of `a` are in millimeters.
pub(crate) fn relative_scale(
    motions: &[Motion],
    rotation: UnitQuaternion<f64>,
) -> Option<(f64, f64)> {
    let rows = 3 * motions.len();
    (rows > 4).then_some(())?;
    let mut matrix = DMatrix::zeros(rows, 4);
    let mut right = DVector::zeros(rows);
    // The equation of `with_translation` gets the scale as its fourth unknown: (R_a - 1) t
    // - s R t_b = -t_a.
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
    // The motions between all pairs of n samples contain n - 1 independent motions. The number of
    // samples n follows from the number of pairs, n (n - 1) / 2.
    let n_samples = 0.5 + (0.25 + 2.0 * motions.len() as f64).sqrt();
    let repetition = motions.len() as f64 / (n_samples - 1.0);
    Some((
        solution[3],
        (variance * inverse[(3, 3)] * repetition).max(0.0).sqrt(),
    ))
}

fn daniilidis(motions: &[Motion]) -> Option<Transform> {
    // Each motion gives six linear equations for the eight elements of the dual quaternion. The
    // scalar parts of `a` and `b` are equal, so only the vector parts give equations.
    let mut normal = SMatrix::<f64, 8, 8>::zeros();
    for motion in motions {
        if motion.a.rotation.angle() < MIN_ROTATION_RAD {
            continue;
        }
        let (a, a_dual) = dual_quaternion(&motion.a);
        let (b, b_dual) = dual_quaternion(&motion.b);
        let mut rows = SMatrix::<f64, 6, 8>::zeros();
        for (row, column, p, q) in [(0, 0, a, b), (3, 0, a_dual, b_dual), (3, 4, a, b)] {
            rows.fixed_view_mut::<3, 1>(row, column)
                .copy_from(&(p.imag() - q.imag()));
            rows.fixed_view_mut::<3, 3>(row, column + 1)
                .copy_from(&(p.imag() + q.imag()).cross_matrix());
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
    let [w, i, j, k] = [0, 1, 2, 3].map(|ix| vector[first + ix]);
    Quaternion::new(w, i, j, k)
}

/// Dot product of quaternions as vectors of four numbers.
fn dot(p: &Quaternion<f64>, q: &Quaternion<f64>) -> f64 {
    p.coords.dot(&q.coords)
}

/// Coefficients that combine two null vectors to a dual quaternion. After scaling, it has unit
/// length. Each null vector has a real and a dual part. The real part of the combination is
/// orthogonal to its dual part (Daniilidis 1999, equations 31 to 35).
fn coefficients(null: &[(Quaternion<f64>, Quaternion<f64>); 2]) -> Option<(f64, f64)> {
    let [(u1, v1), (u2, v2)] = null;
    // Orthogonality is a quadratic equation for the ratio of the two coefficients.
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
    // The real part of one of the two solutions is near zero, so that solution is not a rotation.
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
