//! Minimization of the reprojection error over hand-eye, board pose, robot pose errors and, when
//! asked, intrinsics and joint offsets.
//!
//! Each stop of the robot has a small unknown error with an estimated variance. These local
//! parameters are eliminated by the Schur complement of the solver.

use super::geometry::{N_PARAMS, Solution};
use super::{HandEyeNoise, Setup};
use crate::least_squares::{self, BlockSums, Fit, Loss};
use crate::{BoardPoint, Error};
use kinematics::{Chain, Intrinsics, Transform};
use nalgebra::{DVector, Isometry3, Matrix2x3, Matrix3, Point3, SMatrix, Vector3, Vector6};

/// Threshold of the robust loss, in standard deviations of a corner. Outliers were removed before,
/// so it only limits the influence of what remains.
const LOSS_THRESHOLD: f64 = 3.0;

/// Corners of one image and the pose of the robot.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) base_from_flange: Transform,
    /// Corners without outliers, in the chosen board frame.
    pub(super) points: Vec<BoardPoint>,
    /// Joint values; empty if joint offsets are not estimated.
    pub(super) joints: Vec<f64>,
}

/// The minimization problem.
pub(super) struct CornerProblem<'a> {
    pub(super) setup: Setup,
    /// The images at each stop of the robot.
    pub(super) stops: &'a [Vec<View>],
    pub(super) noise: HandEyeNoise,
    /// Number of intrinsics to estimate: all, or 0.
    pub(super) n_intrinsics: usize,
    /// The arm, if joint offsets are estimated: those of all joints but the first and the last.
    pub(super) chain: Option<&'a Chain>,
}

/// Values of all parameters.
#[derive(Clone, Debug)]
pub(super) struct CornerState {
    pub(super) solution: Solution,
    pub(super) intrinsics: Intrinsics,
    /// One per inner joint, radians or meters.
    pub(super) joint_offsets: Vec<f64>,
    /// Error of the robot pose at each stop: rotation vector and translation in flange axes.
    pub(super) pose_errors: Vec<Vector6<f64>>,
}

impl CornerProblem<'_> {
    /// Minimizes the reprojection error.
    ///
    /// # Errors
    /// If a corner cannot be projected, or if there are too few corners.
    pub(super) fn minimize(&self, initial: CornerState) -> Result<Fit<CornerState>, Error> {
        let options = least_squares::Options {
            loss: Loss::Huber {
                threshold: LOSS_THRESHOLD,
            },
            max_steps: 40,
            ..least_squares::Options::default()
        };
        least_squares::minimize(self, initial, &options)
    }

    fn n_joints(&self) -> usize {
        self.chain
            .map_or(0, |chain| chain.n_joints().saturating_sub(2))
    }

    /// Pose of the flange of a view with corrected joints, and the velocity of the flange for each
    /// inner joint.
    fn corrected_pose(
        &self,
        view: &View,
        offsets: &[f64],
    ) -> Option<(Transform, Vec<kinematics::Twist>)> {
        let Some(chain) = self.chain else {
            return Some((view.base_from_flange, Vec::new()));
        };
        // The reported pose need not be that of the chain's tip: a tool frame may be set in the
        // controller. The difference is kept.
        let corrected = corrected_joints(&view.joints, offsets);
        let tip_from_flange = chain.forward(&view.joints).ok()?.inverse() * view.base_from_flange;
        let twists = chain.tip_twists_by_joint(&corrected).ok()?;
        // The first joint's offset is the same as a motion of the base, the last one's as a motion
        // of the flange; both are contained in the other parameters.
        let inner = twists[1..twists.len() - 1]
            .iter()
            .map(|twist| twist.of_attached(&tip_from_flange))
            .collect();
        Some((chain.forward(&corrected).ok()? * tip_from_flange, inner))
    }

    /// Adds the residuals of one image.
    fn evaluate_view(
        &self,
        state: &CornerState,
        view: &View,
        error: &Vector6<f64>,
        sums: &mut BlockSums,
    ) -> Option<()> {
        let (base_from_flange, joint_twists) = self.corrected_pose(view, &state.joint_offsets)?;
        let chain = PointChain::new(self.setup, &state.solution, &base_from_flange, error);
        let n_intrinsics = self.n_intrinsics;
        let n_shared = N_PARAMS + n_intrinsics + self.n_joints();
        let corner_px = self.noise.corner_px.unwrap_or(1.0);
        // Shared parameters first (solution, intrinsics, joint offsets), then the error of the
        // pose.
        let mut rows = [vec![0.0; n_shared + 6], vec![0.0; n_shared + 6]];
        for point in &view.points {
            let at = chain.at(&point.point_in_board);
            let projection = state
                .intrinsics
                .project_with_derivatives(&at.point_in_camera)?;
            let by_point: Matrix2x3<f64> = projection.by_point / corner_px;
            let by_solution = by_point * at.by_solution;
            let by_flange = by_point * at.by_flange;
            let by_error = by_point * at.by_error;
            for (axis, row) in rows.iter_mut().enumerate() {
                for ix in 0..N_PARAMS {
                    row[ix] = by_solution[(axis, ix)];
                }
                for ix in 0..n_intrinsics {
                    row[N_PARAMS + ix] = projection.by_intrinsics[(axis, ix)] / corner_px;
                }
                for (ix, twist) in joint_twists.iter().enumerate() {
                    let motion = stacked(&twist.angular_rad_s, &twist.linear_m_s);
                    row[N_PARAMS + n_intrinsics + ix] = (by_flange.row(axis) * motion)[0];
                }
                for ix in 0..6 {
                    row[n_shared + ix] = by_error[(axis, ix)];
                }
            }
            let residual =
                [0, 1].map(|axis| (projection.pixel[axis] - point.pixel[axis]) / corner_px);
            sums.add(residual, [rows[0].as_slice(), rows[1].as_slice()]);
        }
        Some(())
    }
}

/// Joint values plus the offsets of the inner joints.
pub(super) fn corrected_joints(joints: &[f64], offsets: &[f64]) -> Vec<f64> {
    let mut corrected = joints.to_vec();
    for (joint, offset) in corrected.iter_mut().skip(1).zip(offsets) {
        *joint += offset;
    }
    corrected
}

impl least_squares::Problem for CornerProblem<'_> {
    type State = CornerState;

    fn scales(&self) -> DVector<f64> {
        DVector::from_element(N_PARAMS + self.n_intrinsics + self.n_joints(), 1.0)
    }

    fn n_blocks(&self) -> usize {
        self.stops.len()
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        6
    }

    fn evaluate(&self, state: &CornerState, block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        let error = &state.pose_errors[block_ix];
        let n_shared = N_PARAMS + self.n_intrinsics + self.n_joints();
        for view in &self.stops[block_ix] {
            self.evaluate_view(state, view, error, sums)?;
        }
        // The prior of the pose error. All images at a stop share it, so it is added once.
        for (first, sigma) in [(0, self.noise.rotation_rad), (3, self.noise.translation_m)] {
            for ix in first..first + 3 {
                let mut row = vec![0.0; n_shared + 6];
                row[n_shared + ix] = 1.0 / sigma;
                sums.add([error[ix] / sigma], [row.as_slice()]);
            }
        }
        Some(())
    }

    fn moved(
        &self,
        state: &CornerState,
        shared: &DVector<f64>,
        local: &[DVector<f64>],
    ) -> CornerState {
        let n_intrinsics = self.n_intrinsics;
        let steps = shared.as_slice();
        let intrinsics = if n_intrinsics > 0 {
            let params = state.intrinsics.params();
            let moved: Vec<f64> = params
                .iter()
                .zip(&steps[N_PARAMS..])
                .map(|(param, step)| param + step)
                .collect();
            state.intrinsics.with_params(&moved)
        } else {
            state.intrinsics.clone()
        };
        let offsets = state
            .joint_offsets
            .iter()
            .zip(&steps[N_PARAMS + n_intrinsics..]);
        CornerState {
            solution: state.solution.moved(steps),
            intrinsics,
            joint_offsets: offsets.map(|(offset, step)| offset + step).collect(),
            pose_errors: state
                .pose_errors
                .iter()
                .zip(local)
                .map(|(error, step)| error + step.fixed_rows::<6>(0))
                .collect(),
        }
    }
}

/// Rotation first, then translation.
fn stacked(rotation: &Vector3<f64>, translation: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(
        rotation.x,
        rotation.y,
        rotation.z,
        translation.x,
        translation.y,
        translation.z,
    )
}

/// Maps points of the board to the camera for one view.
struct PointChain {
    setup: Setup,
    camera_from_x: Transform,
    y: Transform,
    base_from_flange: Transform,
    error_motion: Transform,
    error_rad: Vector3<f64>,
    y_rotation: Matrix3<f64>,
}

/// A point in the camera frame and its derivatives.
struct PointAt {
    point_in_camera: Vector3<f64>,
    by_solution: SMatrix<f64, 3, 12>,
    /// By a motion of the corrected flange pose, in flange axes.
    by_flange: SMatrix<f64, 3, 6>,
    /// By the pose error.
    by_error: SMatrix<f64, 3, 6>,
}

impl PointChain {
    fn new(
        setup: Setup,
        solution: &Solution,
        base_from_flange: &Transform,
        error: &Vector6<f64>,
    ) -> Self {
        let error_rad: Vector3<f64> = error.fixed_rows::<3>(0).into_owned();
        Self {
            setup,
            camera_from_x: solution.x.inverse(),
            y: solution.y,
            base_from_flange: *base_from_flange,
            error_motion: Isometry3::new(error.fixed_rows::<3>(3).into_owned(), error_rad),
            error_rad,
            y_rotation: solution.y.rotation.to_rotation_matrix().into_inner(),
        }
    }

    fn at(&self, point_in_board: &Vector3<f64>) -> PointAt {
        let map =
            |transform: &Transform, point: &Vector3<f64>| (transform * Point3::from(*point)).coords;
        let matrix =
            |rotation: nalgebra::UnitQuaternion<f64>| rotation.to_rotation_matrix().into_inner();
        let point_in_y = map(&self.y, point_in_board);
        // The flange frame without and with the pose error, and the map of the last to the camera.
        let error_rotation = matrix(self.error_motion.rotation);
        let cross = self.error_rad.cross_matrix();
        let (point_in_camera, camera_from_y, by_flange, by_error) = match self.setup {
            Setup::EyeInHand => {
                // The board is at rest in the base; the point moves against the flange.
                let point_in_flange = map(&self.base_from_flange.inverse(), &point_in_y);
                let point = map(&self.error_motion.inverse(), &point_in_flange);
                let rotation = matrix(self.camera_from_x.rotation);
                let corrected = rotation * error_rotation.transpose();
                let by_flange = joined(corrected * point_in_flange.cross_matrix(), -corrected);
                // The right Jacobian of the rotation group, up to first order.
                let right = Matrix3::identity() - cross * 0.5;
                let by_error = joined(rotation * point.cross_matrix() * right, -corrected);
                let camera_from_y = corrected * matrix(self.base_from_flange.rotation).transpose();
                (
                    map(&self.camera_from_x, &point),
                    camera_from_y,
                    by_flange,
                    by_error,
                )
            }
            Setup::EyeToHand => {
                // The board moves with the flange.
                let rotated = self.error_motion.rotation * point_in_y;
                let point = rotated + self.error_motion.translation.vector;
                let camera_from_flange = self.camera_from_x * self.base_from_flange;
                let rotation = matrix(camera_from_flange.rotation);
                let by_flange = joined(-rotation * point.cross_matrix(), rotation);
                // The left Jacobian, likewise.
                let left = Matrix3::identity() + cross * 0.5;
                let by_error = joined(-rotation * rotated.cross_matrix() * left, rotation);
                (
                    map(&camera_from_flange, &point),
                    rotation * error_rotation,
                    by_flange,
                    by_error,
                )
            }
        };
        // `x` and `y` move in the axes of camera and board: see `Solution::moved`. A motion of the
        // camera moves the point in the opposite direction.
        let mut by_solution = SMatrix::<f64, 3, 12>::zeros();
        let camera_from_board = camera_from_y * self.y_rotation;
        for (column, block) in [
            (0, point_in_camera.cross_matrix()),
            (3, -Matrix3::identity()),
            (6, -camera_from_board * point_in_board.cross_matrix()),
            (9, camera_from_board),
        ] {
            by_solution
                .fixed_view_mut::<3, 3>(0, column)
                .copy_from(&block);
        }
        PointAt {
            point_in_camera,
            by_solution,
            by_flange,
            by_error,
        }
    }
}

/// The columns of a rotation, then those of a translation.
fn joined(rotation: Matrix3<f64>, translation: Matrix3<f64>) -> SMatrix<f64, 3, 6> {
    let mut both = SMatrix::<f64, 3, 6>::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    both.fixed_view_mut::<3, 3>(0, 3).copy_from(&translation);
    both
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_match_central_differences() {
        const NUDGE: f64 = 1e-6;
        const CLOSE: f64 = 1e-5; // The Jacobian of the pose error's rotation has an error of its square, here 1e-6.
        let solution = Solution {
            x: Transform::new(Vector3::new(0.05, -0.02, 0.1), Vector3::new(0.3, -1.0, 2.0)),
            y: Transform::new(Vector3::new(0.6, 0.2, 0.1), Vector3::new(2.0, 0.5, -0.3)),
        };
        let base_from_flange =
            Transform::new(Vector3::new(0.4, -0.1, 0.5), Vector3::new(1.0, 2.0, -0.5));
        let error = Vector6::new(1e-3, -2e-3, 1e-3, 0.002, 0.001, -0.003);
        let point = Vector3::new(0.1, 0.07, 0.0);
        for setup in [Setup::EyeInHand, Setup::EyeToHand] {
            let chain = |solution: &Solution, pose: &Transform, error: &Vector6<f64>| {
                PointChain::new(setup, solution, pose, error).at(&point)
            };
            let at = chain(&solution, &base_from_flange, &error);
            let numeric = |moved: &dyn Fn(f64) -> PointAt| {
                (moved(NUDGE).point_in_camera - moved(-NUDGE).point_in_camera) / (2.0 * NUDGE)
            };
            for ix in 0..N_PARAMS {
                let moved = |nudge: f64| {
                    let mut step = [0.0; N_PARAMS];
                    step[ix] = nudge;
                    chain(&solution.moved(&step), &base_from_flange, &error)
                };
                assert!(
                    (numeric(&moved) - at.by_solution.column(ix)).norm() < CLOSE,
                    "{setup:?}, parameter {ix}"
                );
            }
            for ix in 0..6 {
                let step =
                    |nudge: f64| Vector6::from_fn(|row, _| if row == ix { nudge } else { 0.0 });
                let moved =
                    |nudge: f64| chain(&solution, &base_from_flange, &(error + step(nudge)));
                assert!(
                    (numeric(&moved) - at.by_error.column(ix)).norm() < CLOSE,
                    "{setup:?}, error {ix}"
                );
                let moved = |nudge: f64| {
                    let step = step(nudge);
                    let motion = Transform::new(
                        step.fixed_rows::<3>(3).into(),
                        step.fixed_rows::<3>(0).into(),
                    );
                    chain(&solution, &(base_from_flange * motion), &error)
                };
                assert!(
                    (numeric(&moved) - at.by_flange.column(ix)).norm() < CLOSE,
                    "{setup:?}, flange {ix}"
                );
            }
        }
    }
}
