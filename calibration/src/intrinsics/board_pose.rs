//! Pose of a flat target in one image, for known intrinsics.

use super::homography::{self, homography};
use crate::BoardPoint;
use kinematics::{Intrinsics, Lens, Transform};
use nalgebra::{Matrix3, Matrix6, Point3, Translation3, UnitQuaternion, Vector2, Vector3, Vector6};

/// Pose of a target and its reprojection error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardPose {
    /// Pose of the target in the camera frame.
    pub camera_from_board: Transform,
    /// Root mean square of the distances between detected and projected points, pixels.
    pub rms_px: f64,
}

/// Estimates the pose of a flat target by minimizing the reprojection error.
///
/// The initial value is the pose of a homography. A second pose, whose normal is mirrored at the
/// line of sight, looks almost the same if the target is far away or its tilt is small. The
/// minimization therefore also starts from the mirrored pose, and the better minimum is returned.
///
/// * `points`: at least four points that are not on a line, with the same z coordinate in the frame
///   of the target.
///
/// Returns `None` if the points do not determine a pose, or if the lens cannot image the target at
/// this pose.
pub fn board_pose(intrinsics: &Intrinsics, points: &[BoardPoint]) -> Option<BoardPose> {
    let first = refine(intrinsics, points, initial_pose(intrinsics, points)?)?;
    let mirrored = refine(
        intrinsics,
        points,
        mirrored(&first.camera_from_board, points),
    );
    Some(
        mirrored
            .filter(|mirrored| mirrored.rms_px < first.rms_px)
            .unwrap_or(first),
    )
}

/// The pose of the homography from the target to the plane `z = 1`.
pub(super) fn initial_pose(intrinsics: &Intrinsics, points: &[BoardPoint]) -> Option<Transform> {
    /// Maximum distance of a point from the optical axis in the plane `z = 1`. It corresponds to an
    /// angle of 68 degrees from the axis.
    const MAX_RADIUS: f64 = 2.5;
    /// A homography needs at least four points. Twice this number is required, so that a few wrong
    /// points do not spoil the initial pose.
    const MIN_ACCURATE: usize = 8;
    // Points beyond the lens model are left out.
    let mut pairs = Vec::with_capacity(points.len());
    for point in points {
        if let Some(ray) = unproject(intrinsics, point.pixel) {
            pairs.push((point.point_in_board.xy(), ray));
        }
    }
    // On the plane `z = 1`, errors of directions close to 90 degrees are large.
    let is_accurate = |pair: &(Vector2<f64>, Vector2<f64>)| pair.1.norm() < MAX_RADIUS;
    if pairs.iter().filter(|pair| is_accurate(pair)).count() >= MIN_ACCURATE {
        pairs.retain(is_accurate);
    }
    let camera_from_plane = homography::pose(&homography(&pairs)?)?;
    Some(camera_from_plane * Translation3::new(0.0, 0.0, -points.first()?.point_in_board.z))
}

/// Like [`Intrinsics::unproject`], with a closed form for an equidistant lens.
fn unproject(intrinsics: &Intrinsics, pixel: [f64; 2]) -> Option<Vector2<f64>> {
    let Lens::KannalaBrandt([0.0, 0.0, 0.0, 0.0]) = intrinsics.lens else {
        return intrinsics.unproject(pixel).map(|ray| ray.xy());
    };
    let [x, y] = [0, 1]
        .map(|axis| (pixel[axis] - intrinsics.principal_px[axis]) / intrinsics.focal_px[axis]);
    let angle = x.hypot(y);
    let is_in_front = angle < std::f64::consts::FRAC_PI_2;
    is_in_front.then(|| {
        Vector2::new(x, y)
            * if angle > 0.0 {
                angle.tan() / angle
            } else {
                1.0
            }
    })
}

/// The pose with the normal of the target mirrored at the line of sight to its center.
///
/// Source: Schweighofer and Pinz 2006, section 4.
fn mirrored(camera_from_board: &Transform, points: &[BoardPoint]) -> Transform {
    let center_in_board = points
        .iter()
        .map(|point| point.point_in_board)
        .sum::<Vector3<f64>>()
        / points.len() as f64;
    let center = (camera_from_board * Point3::from(center_in_board)).coords;
    let normal = camera_from_board.rotation * Vector3::z();
    let sight = center.normalize();
    let mirrored_normal = sight * (2.0 * sight.dot(&normal)) - normal;
    let turn = UnitQuaternion::rotation_between(&normal, &mirrored_normal).unwrap_or_default();
    let rotation = turn * camera_from_board.rotation;
    Transform::from_parts(
        Translation3::from(center - rotation * center_in_board),
        rotation,
    )
}

/// Step of a pose: rotation vector in the camera frame about the origin of the target, then
/// translation.
pub(crate) fn moved(camera_from_board: &Transform, step: &Vector6<f64>) -> Transform {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
    let translation =
        camera_from_board.translation.vector + Vector3::new(step[3], step[4], step[5]);
    Transform::from_parts(
        Translation3::from(translation),
        rotation * camera_from_board.rotation,
    )
}

/// Derivative of a point in the camera frame with respect to the rotation part of [`moved`].
pub(super) fn by_rotation(
    camera_from_board: &Transform,
    point_in_board: &Vector3<f64>,
) -> Matrix3<f64> {
    -(camera_from_board.rotation * point_in_board).cross_matrix()
}

/// Minimizes the reprojection error from an initial pose by Levenberg-Marquardt. `None` if the
/// target leaves the range of the lens.
pub(super) fn refine(
    intrinsics: &Intrinsics,
    points: &[BoardPoint],
    initial: Transform,
) -> Option<BoardPose> {
    const MAX_STEPS: usize = 30;
    // The iteration ends when the decrease of the squared error is at most this fraction of the
    // squared error.
    const CONVERGED: f64 = 1e-9;
    let mut at = NormalEquations::new(intrinsics, points, &initial)?;
    let mut pose = initial;
    let mut damping = 1e-4;
    for _ in 0..MAX_STEPS {
        // Marquardt's damping is relative to the diagonal, so that radians and meters need no
        // scales.
        let mut matrix = at.matrix;
        (0..6).for_each(|ix| matrix[(ix, ix)] *= 1.0 + damping);
        let step = -matrix.cholesky()?.solve(&at.gradient);
        let trial_pose = moved(&pose, &step);
        let trial = NormalEquations::new(intrinsics, points, &trial_pose)
            .filter(|trial| trial.squares < at.squares);
        match trial {
            Some(trial) => {
                let converged = at.squares - trial.squares <= CONVERGED * at.squares;
                pose = trial_pose;
                at = trial;
                damping = f64::max(damping * 0.1, 1e-12);
                if converged {
                    break;
                }
            }
            // A step that is so strongly damped changes nothing, so the pose is at a minimum.
            None if damping > 1e6 => break,
            None => damping *= 10.0,
        }
        // The decrease that the linear model predicts.
        if step.dot(&at.gradient).abs() <= CONVERGED * at.squares {
            break;
        }
    }
    Some(BoardPose {
        camera_from_board: pose,
        rms_px: (at.squares / points.len() as f64).sqrt(),
    })
}

/// Reprojection error of a point (projected minus detected), pixels. Also returns its derivatives
/// with respect to the step of [`moved`], with one array per component. `None` if the lens cannot
/// image the point.
pub(crate) fn residual(
    intrinsics: &Intrinsics,
    point: &BoardPoint,
    pose: &Transform,
) -> Option<([f64; 2], [[f64; 6]; 2])> {
    let in_camera = (pose * Point3::from(point.point_in_board)).coords;
    let (pixel, by_point) = intrinsics.project_with_jacobian(&in_camera)?;
    let by_rotation = by_point * by_rotation(pose, &point.point_in_board);
    let rows = [0_usize, 1].map(|axis| {
        let [a, b, c] = [0_usize, 1, 2].map(|ix| by_rotation[(axis, ix)]);
        let [x, y, z] = [0_usize, 1, 2].map(|ix| by_point[(axis, ix)]);
        [a, b, c, x, y, z]
    });
    Some(([0, 1].map(|axis| pixel[axis] - point.pixel[axis]), rows))
}

/// Normal equations of the reprojection error of one image, for the step of [`moved`].
pub(crate) struct NormalEquations {
    /// Information about the pose for corners with an error of one pixel.
    pub(crate) matrix: Matrix6<f64>,
    pub(crate) gradient: Vector6<f64>,
    /// Sum of the squared residuals.
    squares: f64,
}

impl NormalEquations {
    /// `None` if the lens cannot image a point.
    pub(crate) fn new(
        intrinsics: &Intrinsics,
        points: &[BoardPoint],
        pose: &Transform,
    ) -> Option<Self> {
        let mut sums = Self {
            matrix: Matrix6::zeros(),
            gradient: Vector6::zeros(),
            squares: 0.0,
        };
        for point in points {
            let (residual, rows) = residual(intrinsics, point, pose)?;
            for (residual, row) in residual.into_iter().zip(rows) {
                let row = Vector6::from(row);
                sums.matrix.ger(1.0, &row, &row, 1.0);
                sums.gradient.axpy(residual, &row, 1.0);
                sums.squares += residual * residual;
            }
        }
        sums.squares.is_finite().then_some(sums)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{board, brown_conrady_camera, fisheye_camera, observe};
    use super::*;

    #[test]
    fn poses_are_recovered_for_wide_and_narrow_lenses() {
        for camera in [brown_conrady_camera(), fisheye_camera()] {
            for rotation in [[0.5, -0.3, 0.2], [-0.6, 0.1, 3.0], [0.05, 0.02, 1.5]] {
                let truth =
                    Transform::new(Vector3::new(-0.05, -0.08, 0.5), Vector3::from(rotation));
                let points = observe(&camera, &truth, &board());
                assert_eq!(points.len(), board().len());
                let found = board_pose(&camera, &points).unwrap();
                assert!(found.rms_px < 1e-6, "{}", found.rms_px);
                let off =
                    (found.camera_from_board.to_homogeneous() - truth.to_homogeneous()).amax();
                assert!(off < 1e-8, "off by {off}");
            }
        }
    }

    #[test]
    fn small_targets_are_not_mirrored() {
        let camera = brown_conrady_camera();
        let truth = Transform::new(Vector3::new(0.3, -0.2, 1.4), Vector3::new(0.45, 0.3, 0.1));
        let points = observe(&camera, &truth, &board());
        let start = mirrored(&truth, &points);
        let found = refine(&camera, &points, start).unwrap();
        let best = board_pose(&camera, &points).unwrap();
        assert!(
            found.rms_px > 0.01,
            "the mirrored pose is not a minimum here: {}",
            found.rms_px
        );
        assert!(
            best.rms_px < 1e-6
                && (best.camera_from_board.rotation.angle_to(&truth.rotation)) < 1e-8
        );
    }

    #[test]
    fn degenerate_points_have_no_pose() {
        let camera = brown_conrady_camera();
        let points = observe(&camera, &Transform::translation(0.0, 0.0, 0.5), &board());
        assert!(board_pose(&camera, &points[..3]).is_none());
        assert!(board_pose(&camera, &[]).is_none());
        assert!(board_pose(&camera, &vec![points[0]; 20]).is_none());
    }
}
