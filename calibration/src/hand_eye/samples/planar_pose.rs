//! Pose of a planar board from its corners in one image, with both solutions of the two-fold
//! ambiguity.
//!
//! The initial poses follow from the homography at the center of the board (Collins and Bartoli
//! 2014, "Infinitesimal plane-based pose estimation", section 4.3). Both initial poses are refined
//! by minimizing the reprojection error.

use super::super::geometry::nearest_rotation;
use super::CornerStatistics;
use crate::intrinsics::board_pose::{NormalEquations, moved, residual};
use crate::intrinsics::homography;
use crate::least_squares::{self, BlockSums, Loss};
use crate::{BoardPoint, BoardView};
use kinematics::{Intrinsics, Transform};
use nalgebra::{
    DVector, Matrix2, Matrix2x3, Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector2, Vector3,
};
use numbers::random::Random;

/// Minimum number of corners for a pose. A homography has eight parameters, and a corner has two
/// coordinates.
const MIN_CORNERS: usize = 4;

/// Threshold of the robust loss, pixels. Corners of sharp images are accurate to a tenth of a
/// pixel.
const LOSS_THRESHOLD_PX: f64 = 1.0;

/// A pose of the board and its quality.
#[derive(Clone, Debug)]
pub(crate) struct BoardPose {
    pub(crate) camera_from_board: Transform,
    pub(crate) corners: CornerStatistics,
}

/// The one or two poses that explain the corners, best first. The list is empty if the corners do
/// not determine a pose. Corners beyond the range of the lens model are outliers.
pub(crate) fn board_poses(view: &BoardView, intrinsics: &Intrinsics) -> Vec<BoardPose> {
    // Corners without a ray cannot be used, but keep their place in the list of inliers.
    let ray = |point: &BoardPoint| intrinsics.unproject(point.pixel).map(|ray| ray.xy());
    let rays: Vec<Option<Vector2<f64>>> = view.points.iter().map(ray).collect();
    let seen = view.points.iter().zip(&rays);
    let (points, seen_rays): (Vec<BoardPoint>, Vec<Vector2<f64>>) = seen
        .filter_map(|(point, ray)| Some((*point, (*ray)?)))
        .unzip();
    let mut poses = poses_in_range(&points, &seen_rays, intrinsics);
    for pose in &mut poses {
        let mut of_seen = std::mem::take(&mut pose.corners.is_inlier).into_iter();
        pose.corners.is_inlier = rays
            .iter()
            .map(|ray| ray.is_some() && of_seen.next().unwrap_or(false))
            .collect();
    }
    poses
}

/// [`board_poses`] of corners in the range of the lens model.
fn poses_in_range(
    points: &[BoardPoint],
    rays: &[Vector2<f64>],
    intrinsics: &Intrinsics,
) -> Vec<BoardPose> {
    let Some(plane) = Plane::new(points) else {
        return Vec::new();
    };
    let corners = Corners {
        points,
        plane_from_board: plane.plane_from_board,
        pairs: plane.points.into_iter().zip(rays.iter().copied()).collect(),
        intrinsics,
    };
    // All corners are tried first. Without outliers, this is the fastest way to the best result.
    let n_inliers = |poses: &[BoardPose]| poses.first().map_or(0, |best| best.corners.n_inliers());
    let mut poses = corners.poses(&vec![true; points.len()]);
    if n_inliers(&poses) < points.len()
        && let Some(consensus) = corners.consensus()
    {
        let robust = corners.poses(&consensus);
        if n_inliers(&robust) >= n_inliers(&poses) {
            poses = robust;
        }
    }
    // A near board has only one solution, to which both initial poses converge.
    if poses.len() == 2 && is_same(&poses[0].camera_from_board, &poses[1].camera_from_board) {
        poses.truncate(1);
    }
    poses
}

/// Corners of one board, on the board and in the camera.
struct Corners<'a> {
    points: &'a [BoardPoint],
    plane_from_board: Transform,
    /// Positions in the plane of the board, and on the plane `z = 1` of the camera.
    pairs: Vec<(Vector2<f64>, Vector2<f64>)>,
    intrinsics: &'a Intrinsics,
}

impl Corners<'_> {
    /// The poses that minimize the reprojection error of the selected corners, best first.
    fn poses(&self, is_used: &[bool]) -> Vec<BoardPose> {
        let selected = self.pairs.iter().zip(is_used);
        let pairs: Vec<(Vector2<f64>, Vector2<f64>)> = selected
            .filter(|(_, is_used)| **is_used)
            .map(|(pair, _)| *pair)
            .collect();
        let Some(homography) = homography(&pairs) else {
            return Vec::new();
        };
        let mut poses: Vec<BoardPose> = initial_rotations(&homography)
            .into_iter()
            .filter_map(|rotation| {
                let camera_from_plane = with_translation(rotation, &pairs)?;
                let camera_from_board = camera_from_plane * self.plane_from_board;
                refine(camera_from_board, self.points, self.intrinsics, is_used)
            })
            .collect();
        poses.sort_by(|a, b| a.corners.squares_px2.total_cmp(&b.corners.squares_px2));
        poses
    }

    /// The largest set of corners found that agrees with a homography of four of them (Fischler and
    /// Bolles 1981). `None` if it has fewer than half of the corners.
    fn consensus(&self) -> Option<Vec<bool>> {
        // If half of the corners are wrong, this number of trials finds four good corners with a
        // probability of 99.99 %, because (1 - 0.5^4)^150 = 6e-5.
        const TRIALS: usize = 150;
        // A homography of four noisy corners is inaccurate far from these corners.
        const ALLOWED_PX: f64 = 3.0;
        let n = self.pairs.len();
        // Rays are in units of the focal length.
        let allowed = ALLOWED_PX / self.intrinsics.focal_px[0];
        let mut random = Random::new(1);
        let mut order: Vec<usize> = (0..n).collect();
        let mut best: Vec<bool> = Vec::new();
        let count = |set: &[bool]| set.iter().filter(|is_in| **is_in).count();
        for _ in 0..TRIALS {
            random.shuffle(&mut order);
            let mut picked = order[..MIN_CORNERS].to_vec();
            picked.sort_unstable();
            let picked: Vec<_> = picked.into_iter().map(|ix| self.pairs[ix]).collect();
            let Some(matrix) = homography(&picked) else {
                continue;
            };
            let agrees = |(point, ray): &(Vector2<f64>, Vector2<f64>)| {
                let image = matrix * point.push(1.0);
                image.z > 0.0 && (image.xy() / image.z - ray).norm() < allowed
            };
            let set: Vec<bool> = self.pairs.iter().map(agrees).collect();
            if count(&set) > count(&best) {
                best = set;
            }
        }
        (count(&best) >= MIN_CORNERS.max(n.div_ceil(2))).then_some(best)
    }
}

/// Whether two poses are the same solution.
fn is_same(a: &Transform, b: &Transform) -> bool {
    const SAME_RAD: f64 = 1e-4;
    a.rotation.angle_to(&b.rotation) < SAME_RAD
}

/// Board points in the coordinates of their plane, with the centroid as origin.
struct Plane {
    plane_from_board: Transform,
    points: Vec<Vector2<f64>>,
}

impl Plane {
    /// `None` if the points are too few or on a line.
    fn new(points: &[BoardPoint]) -> Option<Self> {
        // Minimum ratio of the shorter to the longer side. Corners on a line do not determine the
        // rotation about that line.
        const MIN_WIDTH_RATIO: f64 = 1e-3;
        (points.len() >= MIN_CORNERS).then_some(())?;
        let centroid = points
            .iter()
            .map(|point| point.point_in_board)
            .sum::<Vector3<f64>>()
            / points.len() as f64;
        let spread: Matrix3<f64> = points
            .iter()
            .map(|point| {
                (point.point_in_board - centroid) * (point.point_in_board - centroid).transpose()
            })
            .sum();
        if !spread.iter().all(|value| value.is_finite()) {
            return None;
        }
        // The two directions of the largest spread span the plane. The board's own axes are not
        // used, because a target may be given in any frame.
        let eigen = spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
        let [first, second, _] = order;
        (eigen.eigenvalues[second] > MIN_WIDTH_RATIO.powi(2) * eigen.eigenvalues[first])
            .then_some(())?;
        let x = eigen.eigenvectors.column(first).into_owned();
        let y = eigen.eigenvectors.column(second).into_owned();
        let axes = Matrix3::from_rows(&[x.transpose(), y.transpose(), x.cross(&y).transpose()]);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        let plane_from_board = Transform::from_parts((rotation * -centroid).into(), rotation);
        let points_in_plane = points.iter().map(|point| {
            let point_in_board = nalgebra::Point3::from(point.point_in_board);
            (plane_from_board * point_in_board).coords.xy()
        });
        Some(Self {
            plane_from_board,
            points: points_in_plane.collect(),
        })
    }
}

/// Homography from the plane to the plane `z = 1` of the camera, scaled such that the last element
/// is 1. `None` if it is not determined.
fn homography(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>> {
    let matrix = homography::homography(pairs)?;
    let scaled = matrix / matrix[(2, 2)];
    let is_finite = scaled.iter().all(|value| value.is_finite());
    is_finite.then_some(scaled)
}

/// Both rotations that the homography allows at the origin of the plane.
fn initial_rotations(homography: &Matrix3<f64>) -> Vec<UnitQuaternion<f64>> {
    // Position of the origin's image, and the derivative of the image there.
    let h = homography;
    let v = Vector2::new(h[(0, 2)], h[(1, 2)]);
    let jacobian = Matrix2::new(
        h[(0, 0)] - h[(2, 0)] * v.x,
        h[(0, 1)] - h[(2, 1)] * v.x,
        h[(1, 0)] - h[(2, 0)] * v.y,
        h[(1, 1)] - h[(2, 1)] * v.y,
    );
    // In a frame whose z axis is the ray to the origin, the derivative is the upper left part of
    // the rotation, up to scale.
    let to_ray = Rotation3::rotation_between(&Vector3::z(), &v.push(1.0))
        .unwrap_or_else(Rotation3::identity);
    let projection = Matrix2x3::new(1.0, 0.0, -v.x, 0.0, 1.0, -v.y) * to_ray.matrix();
    let Some(inverse) = projection.fixed_view::<2, 2>(0, 0).try_inverse() else {
        return Vec::new();
    };
    let scaled = inverse * jacobian;
    let largest = scaled.singular_values().max();
    if largest.is_nan() || largest <= 0.0 {
        return Vec::new();
    }
    // The scale follows from the unit length of the columns, because the largest singular value of
    // the upper left part of a rotation is 1.
    let upper = scaled / largest;
    let rest = Matrix2::identity() - upper.transpose() * upper;
    // The third row completes the columns to unit length. Its sign is not determined, which gives
    // the two solutions. They tilt the board to opposite sides of the ray.
    let b0 = rest[(0, 0)].max(0.0).sqrt();
    let b1 = rest[(1, 1)].max(0.0).sqrt() * rest[(0, 1)].signum();
    [1.0, -1.0]
        .into_iter()
        .filter_map(|sign| {
            let x = Vector3::new(upper[(0, 0)], upper[(1, 0)], sign * b0);
            let y = Vector3::new(upper[(0, 1)], upper[(1, 1)], sign * b1);
            let rotation = to_ray.matrix() * Matrix3::from_columns(&[x, y, x.cross(&y)]);
            nearest_rotation(&rotation)
        })
        .collect()
}

/// Adds the translation with the least squared algebraic error. `None` if it places the board
/// behind the camera.
fn with_translation(
    rotation: UnitQuaternion<f64>,
    pairs: &[(Vector2<f64>, Vector2<f64>)],
) -> Option<Transform> {
    // The rotated point plus the translation must be parallel to the ray. This gives two linear
    // equations.
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (point, ray) in pairs {
        let rotated = rotation * point.push(0.0);
        let rows = Matrix2x3::new(1.0, 0.0, -ray.x, 0.0, 1.0, -ray.y);
        normal += rows.transpose() * rows;
        right -= rows.transpose() * (rows * rotated);
    }
    let translation = normal.cholesky()?.solve(&right);
    (translation.z > 0.0).then(|| Transform::from_parts(translation.into(), rotation))
}

/// Minimization of the reprojection error over the pose of one board.
struct Reprojection<'a> {
    points: Vec<&'a BoardPoint>,
    intrinsics: &'a Intrinsics,
    distance_m: f64,
}

impl least_squares::Problem for Reprojection<'_> {
    type State = Transform;

    fn scales(&self) -> DVector<f64> {
        DVector::from_fn(6, |ix, _| if ix < 3 { 1.0 } else { self.distance_m })
    }

    fn n_blocks(&self) -> usize {
        1
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        0
    }

    fn evaluate(&self, pose: &Transform, _block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        for point in &self.points {
            let (residual, rows) = residual(self.intrinsics, point, pose)?;
            sums.add(residual, [rows[0].as_slice(), rows[1].as_slice()]);
        }
        Some(())
    }

    fn moved(&self, pose: &Transform, shared: &DVector<f64>, _local: &[DVector<f64>]) -> Transform {
        moved(pose, &shared.fixed_rows::<6>(0).into_owned())
    }
}

/// Minimizes the reprojection error of the selected corners, and evaluates all corners at the
/// result.
fn refine(
    initial: Transform,
    points: &[BoardPoint],
    intrinsics: &Intrinsics,
    is_used: &[bool],
) -> Option<BoardPose> {
    let used = points
        .iter()
        .zip(is_used)
        .filter(|(_, used)| **used)
        .map(|(point, _)| point);
    let problem = Reprojection {
        points: used.collect(),
        intrinsics,
        distance_m: initial.translation.vector.norm(),
    };
    let options = least_squares::Options {
        loss: Loss::Huber {
            threshold: LOSS_THRESHOLD_PX,
        },
        max_steps: 50,
        ..least_squares::Options::default()
    };
    let pose = least_squares::minimize(&problem, initial, &options)
        .ok()?
        .state;
    // All corners are checked and not only the used corners, because a corner outside the initial
    // set may fit the refined pose.
    let errors: Vec<f64> = points
        .iter()
        .map(|point| {
            residual(intrinsics, point, &pose)
                .map_or(f64::INFINITY, |(error, _)| error[0].hypot(error[1]))
        })
        .collect();
    let limit = inlier_limit(&errors);
    let is_inlier: Vec<bool> = errors.iter().map(|error| *error <= limit).collect();
    let inliers = points.iter().zip(&errors).zip(&is_inlier);
    let (inliers, inlier_errors): (Vec<BoardPoint>, Vec<f64>) = inliers
        .filter(|(_, is_inlier)| **is_inlier)
        .map(|((point, error), _)| (*point, *error))
        .unzip();
    let information = NormalEquations::new(intrinsics, &inliers, &pose)?.matrix;
    // Inliers that do not determine the pose give no covariance.
    information.cholesky()?;
    Some(BoardPose {
        camera_from_board: pose,
        corners: CornerStatistics {
            unit_covariance: information.try_inverse()?,
            squares_px2: inlier_errors.iter().map(|error| error * error).sum(),
            is_inlier,
        },
    })
}

/// The pose after one Gauss-Newton step from `predicted`, and the covariance of the step for
/// corners with an error of one pixel. Small tilts of a board that faces the camera change the
/// corners only in second order. For such a board, this step describes the corners better than the
/// pose with the smallest error.
pub(crate) fn stepped(
    predicted: &Transform,
    points: &[BoardPoint],
    intrinsics: &Intrinsics,
) -> Option<(Transform, Matrix6<f64>)> {
    let equations = NormalEquations::new(intrinsics, points, predicted)?;
    let covariance = equations.matrix.try_inverse()?;
    Some((
        moved(predicted, &-(covariance * equations.gradient)),
        covariance,
    ))
}

/// Largest residual that is consistent with the others.
fn inlier_limit(errors: &[f64]) -> f64 {
    /// Median of the norm of two normal numbers with deviation 1.
    const MEDIAN_OF_NORM: f64 = 1.1774;
    /// Of the corners without a mistake, 1 in 20 000 exceeds this limit.
    const DEVIATIONS: f64 = 4.5;
    /// Deviations of corners within an image are not normally distributed. Corners with a smaller
    /// deviation than this never count as wrong.
    const MIN_PX: f64 = 0.5;
    let median = numbers::quantile::median(errors).unwrap_or(0.0);
    (DEVIATIONS * median / MEDIAN_OF_NORM).max(MIN_PX)
}

#[cfg(test)]
mod tests {
    use super::super::super::tests as scene;
    use super::*;

    /// Distance between the positions of a found and a true pose, meters.
    fn off_m(found: &BoardPose, truth: &Transform) -> f64 {
        (found.camera_from_board.translation.vector - truth.translation.vector).norm()
    }

    #[test]
    fn only_the_corner_beyond_the_lens_model_is_dropped() {
        // With this distortion, no point is imaged far from the center.
        let lens = kinematics::Lens::BrownConrady([-0.3, 0.0, 0.0, 0.0, 0.0]);
        let intrinsics = Intrinsics {
            lens,
            ..scene::intrinsics()
        };
        let pose = Transform::new(Vector3::new(-0.05, 0.02, 0.6), Vector3::new(0.4, -0.3, 0.2));
        let image = |point_in_board: Vector3<f64>| {
            let pixel =
                intrinsics.project(&(pose * nalgebra::Point3::from(point_in_board)).coords)?;
            Some(BoardPoint {
                point_in_board,
                pixel,
            })
        };
        let points: Vec<BoardPoint> = scene::board_points()
            .into_iter()
            .filter_map(image)
            .collect();
        let mut view = BoardView {
            name: "view".to_owned(),
            points,
        };
        view.points[7].pixel = [1e4, -2e4];
        assert!(intrinsics.unproject(view.points[7].pixel).is_none());
        let found = &board_poses(&view, &intrinsics)[0];
        assert!(off_m(found, &pose) < 1e-8);
        assert!(
            !found.corners.is_inlier[7] && found.corners.n_inliers() == view.points.len() - 1,
            "{:?}",
            found.corners.is_inlier
        );
    }

    #[test]
    fn exact_corners_give_exact_pose() {
        let intrinsics = scene::intrinsics();
        for rotation in [[0.4, -0.3, 0.2], [3.0, 0.2, -0.4], [-0.2, 0.7, 1.5]] {
            let pose = Transform::new(Vector3::new(-0.05, 0.02, 0.6), rotation.into());
            let view = scene::view(&pose, 0.0, &mut Random::new(1));
            let found = &board_poses(&view, &intrinsics)[0];
            assert!(off_m(found, &pose) < 1e-8);
            assert!(found.camera_from_board.rotation.angle_to(&pose.rotation) < 1e-7);
        }
    }

    #[test]
    fn distant_board_has_two_solutions_and_the_true_one_is_among_them() {
        let intrinsics = scene::intrinsics();
        let pose = Transform::new(Vector3::new(0.1, 0.05, 4.0), Vector3::new(0.3, 0.2, 0.1));
        let view = scene::view(&pose, 0.1, &mut Random::new(2));
        let found = board_poses(&view, &intrinsics);
        assert_eq!(found.len(), 2);
        let [first, second] = [0, 1].map(|ix| found[ix].camera_from_board.rotation);
        let off_rad = [first, second].map(|rotation| rotation.angle_to(&pose.rotation));
        assert!(off_rad[0].min(off_rad[1]) < 0.1);
        assert!(first.angle_to(&second) > 0.2);
    }

    #[test]
    fn wrong_corners_are_excluded() {
        let intrinsics = scene::intrinsics();
        let pose = Transform::new(Vector3::new(-0.05, 0.02, 0.6), Vector3::new(0.4, -0.3, 0.2));
        let mut random = Random::new(5);
        let mut view = scene::view(&pose, 0.1, &mut random);
        for point in view.points.iter_mut().step_by(3) {
            point.pixel = [random.uniform(0.0, 1280.0), random.uniform(0.0, 720.0)];
        }
        let found = &board_poses(&view, &intrinsics)[0];
        assert!(off_m(found, &pose) < 1e-3);
        assert!(
            found
                .corners
                .is_inlier
                .iter()
                .step_by(3)
                .all(|is_inlier| !is_inlier)
        );
    }

    #[test]
    fn corners_on_a_line_and_too_few_corners_give_no_pose() {
        let intrinsics = scene::intrinsics();
        let pose = Transform::new(Vector3::new(-0.05, 0.02, 0.6), Vector3::new(0.4, -0.3, 0.2));
        let mut view = scene::view(&pose, 0.0, &mut Random::new(1));
        let mut line = view.clone();
        line.points.retain(|point| point.point_in_board.y == 0.0);
        assert!(board_poses(&line, &intrinsics).is_empty());
        view.points.truncate(3);
        assert!(board_poses(&view, &intrinsics).is_empty());
    }
}
