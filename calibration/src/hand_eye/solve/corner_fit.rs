//! Minimizes the reprojection error over the hand-eye transform, the board pose, the errors of the
//! robot poses and, if requested, intrinsics and joint offsets. Also checks whether the corners
//! contradict the given intrinsics.
//!
//! Each stop of the robot has a small unknown error with an estimated variance. These local
//! parameters are eliminated by the Schur complement of the solver.

use super::super::geometry::{N_PARAMS, Solution, motion, stacked};
use super::super::samples::{Sample, used};
use super::super::{HandEyeInput, Setup};
use super::pose_fit::{HandEyeNoise, PoseFit};
use crate::least_squares::{self, BlockSums, Fit, Loss};
use crate::{BoardPoint, Error};
use kinematics::{Chain, Intrinsics, Transform};
use messages::Setting;
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, Point3, SMatrix, Vector3, Vector6};

/// Threshold of the robust loss, in standard deviations of a corner. Outliers have already been
/// removed, so the loss only limits the influence of the remaining errors.
const LOSS_THRESHOLD: f64 = 3.0;

/// Parameters that are estimated besides the hand-eye transform and the board pose.
#[derive(Clone, Copy)]
pub(super) struct Free {
    pub(super) intrinsics: bool,
    pub(super) joints: bool,
}

impl Free {
    pub(super) const NONE: Self = Self {
        intrinsics: false,
        joints: false,
    };
}

/// Data and initial values of a minimization.
#[derive(Clone, Copy)]
pub(super) struct Start<'a> {
    pub(super) input: &'a HandEyeInput<'a>,
    pub(super) samples: &'a [Sample],
    /// Fit to the board poses of the used samples.
    pub(super) fit: &'a PoseFit,
    pub(super) intrinsics: &'a Intrinsics,
    /// One offset per inner joint, radians or meters. An empty list stands for zeros.
    pub(super) joint_offsets: &'a [f64],
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

impl Start<'_> {
    /// Minimizes the reprojection error of the used samples.
    ///
    /// # Errors
    /// Fails if a corner cannot be projected, or if there are too few corners.
    pub(super) fn minimize(self, free: Free) -> Result<Fit<CornerState>, Error> {
        let chain = self.input.chain.filter(|_| free.joints);
        let n_intrinsics = usize::from(free.intrinsics) * self.intrinsics.params().len();
        let problem = CornerProblem {
            setup: self.input.setup,
            stops: self.stops(chain.is_some()),
            noise: self.fit.weighting,
            n_intrinsics,
            chain,
        };
        let mut joint_offsets = self.joint_offsets.to_vec();
        joint_offsets.resize(problem.n_joints(), 0.0);
        let initial = CornerState {
            solution: self.fit.solution,
            intrinsics: self.intrinsics.clone(),
            joint_offsets,
            pose_errors: vec![Vector6::zeros(); problem.stops.len()],
        };
        let options = least_squares::Options {
            loss: Loss::Huber {
                threshold: LOSS_THRESHOLD,
            },
            max_steps: 40,
            ..least_squares::Options::default()
        };
        least_squares::minimize(&problem, initial, &options)
    }

    /// The images at each stop of the robot. Images at the same stop share the error of the robot
    /// pose.
    fn stops(self, has_joints: bool) -> Vec<Vec<View>> {
        let mut by_stop = std::collections::BTreeMap::<usize, Vec<View>>::new();
        for sample in used(self.samples) {
            let given = &self.input.samples[sample.sample_ix];
            let joints = given.joints.clone().filter(|_| has_joints);
            by_stop.entry(sample.stop_ix).or_default().push(View {
                base_from_flange: given.base_from_flange,
                points: sample.corners(self.input),
                joints: joints.unwrap_or_default(),
            });
        }
        by_stop.into_values().collect()
    }
}

/// Corners of one image and the pose of the robot.
struct View {
    base_from_flange: Transform,
    /// Corners without outliers, in the chosen board frame.
    points: Vec<BoardPoint>,
    /// Joint values. The list is empty if joint offsets are not estimated.
    joints: Vec<f64>,
}

/// The minimization problem.
struct CornerProblem<'a> {
    setup: Setup,
    /// The images at each stop of the robot.
    stops: Vec<Vec<View>>,
    noise: HandEyeNoise,
    /// Number of intrinsics to estimate, which is 0 or the number of all intrinsics.
    n_intrinsics: usize,
    /// The arm, if joint offsets are estimated. The offsets of all joints except the first and the
    /// last are estimated.
    chain: Option<&'a Chain>,
}

impl CornerProblem<'_> {
    fn n_joints(&self) -> usize {
        self.chain
            .map_or(0, |chain| chain.n_joints().saturating_sub(2))
    }

    fn n_shared(&self) -> usize {
        N_PARAMS + self.n_intrinsics + self.n_joints()
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
        // The reported pose may differ from the pose of the chain's tip, because a tool frame may
        // be set in the controller. This difference is kept.
        let corrected = corrected_joints(&view.joints, offsets);
        let tip_from_flange = chain.forward(&view.joints).ok()?.inverse() * view.base_from_flange;
        let twists = chain.tip_twists_by_joint(&corrected).ok()?;
        // An offset of the first joint has the same effect as a motion of the base. An offset of
        // the last joint has the same effect as a motion of the flange. The other parameters
        // already contain both motions.
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
        let n_shared = self.n_shared();
        let corner_px = self.noise.corner_px.unwrap_or(1.0);
        // The shared parameters come first (solution, intrinsics, joint offsets), then the error of
        // the pose.
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
        DVector::from_element(self.n_shared(), 1.0)
    }

    fn n_blocks(&self) -> usize {
        self.stops.len()
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        6
    }

    fn evaluate(&self, state: &CornerState, block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        let error = &state.pose_errors[block_ix];
        let n_shared = self.n_shared();
        for view in &self.stops[block_ix] {
            self.evaluate_view(state, view, error, sums)?;
        }
        // This is the prior of the pose error. All images at a stop share it, so it is added once.
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

/// Maps points of the board to the camera for one view.
struct PointChain {
    setup: Setup,
    camera_from_x: Transform,
    y: Transform,
    base_from_flange: Transform,
    error_motion: Transform,
    error_rad: Vector3<f64>,
}

/// A point in the camera frame and its derivatives.
struct PointAt {
    point_in_camera: Vector3<f64>,
    by_solution: SMatrix<f64, 3, 12>,
    /// Derivatives with respect to a motion of the corrected flange pose, in flange axes.
    by_flange: SMatrix<f64, 3, 6>,
    /// Derivatives with respect to the pose error.
    by_error: SMatrix<f64, 3, 6>,
}

impl PointChain {
    fn new(
        setup: Setup,
        solution: &Solution,
        base_from_flange: &Transform,
        error: &Vector6<f64>,
    ) -> Self {
        Self {
            setup,
            camera_from_x: solution.x.inverse(),
            y: solution.y,
            base_from_flange: *base_from_flange,
            error_motion: motion(error.as_slice()),
            error_rad: error.fixed_rows::<3>(0).into_owned(),
        }
    }

    fn at(&self, point_in_board: &Vector3<f64>) -> PointAt {
        let map =
            |transform: &Transform, point: &Vector3<f64>| (transform * Point3::from(*point)).coords;
        let matrix =
            |rotation: nalgebra::UnitQuaternion<f64>| rotation.to_rotation_matrix().into_inner();
        let point_in_y = map(&self.y, point_in_board);
        // The flange frame without and with the pose error, and the map from the frame with the
        // error to the camera.
        let error_rotation = matrix(self.error_motion.rotation);
        let cross = self.error_rad.cross_matrix();
        let (point_in_camera, camera_from_y, by_flange, by_error) = match self.setup {
            Setup::EyeInHand => {
                // The board is at rest in the base, so the point moves in the opposite direction
                // relative to the flange.
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
                // This is the left Jacobian, also up to first order.
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
        // `x` moves in the axes of the camera, and `y` moves in the axes of the board, see
        // `Solution::moved`. A motion of the camera moves the point in the opposite direction.
        let mut by_solution = SMatrix::<f64, 3, 12>::zeros();
        let camera_from_board = camera_from_y * matrix(self.y.rotation);
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

/// The columns of a rotation, then the columns of a translation.
fn joined(rotation: Matrix3<f64>, translation: Matrix3<f64>) -> SMatrix<f64, 3, 6> {
    let mut both = SMatrix::<f64, 3, 6>::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    both.fixed_view_mut::<3, 3>(0, 3).copy_from(&translation);
    both
}

/// Covariance of the solution due to errors of the other shared parameters of a fit: intrinsics,
/// then joint offsets.
///
/// If the other parameters are fixed at values that are wrong by `e`, the solution moves by `-A e`.
/// `A` is the inverse of the solution's own information times the information that it shares with
/// the others. The covariance of a solution with all parameters free is the sum of this covariance
/// and of the covariance with fixed parameters.
///
/// * `covariance`: covariance of the other parameters. If `None`, the covariance of the fit itself
///   is used.
pub(super) fn propagated(
    free: &Fit<CornerState>,
    covariance: Option<&DMatrix<f64>>,
) -> Option<DMatrix<f64>> {
    let n_others = free.information.nrows() - N_PARAMS;
    let own = free
        .information
        .view((0, 0), (N_PARAMS, N_PARAMS))
        .into_owned();
    let shared = free.information.view((0, N_PARAMS), (N_PARAMS, n_others));
    // This is the matrix `A` of the documentation. Its sign does not matter, because `A` enters
    // squared.
    let by_others = own.cholesky()?.solve(&shared.into_owned());
    let of_fit = free
        .covariance
        .view((N_PARAMS, N_PARAMS), (n_others, n_others))
        .into_owned();
    let covariance = covariance.unwrap_or(&of_fit);
    // The covariance has another size if it belongs to another lens model.
    (covariance.shape() == (n_others, n_others))
        .then(|| &by_others * covariance * by_others.transpose())
}

/// The corners contradict the given intrinsics.
pub(super) struct IntrinsicsDoubt {
    free: Solution,
    by_intrinsics: DMatrix<f64>,
    pub(super) warning: String,
}

impl IntrinsicsDoubt {
    /// Returns `None` if free intrinsics do not fit significantly better, or if the uncertainty of
    /// the given intrinsics explains the difference.
    ///
    /// * `free`: fit with free intrinsics.
    pub(super) fn new(
        start: Start<'_>,
        free: &Fit<CornerState>,
        covariance: Option<&DMatrix<f64>>,
    ) -> Option<Self> {
        let intrinsics = start.intrinsics;
        let fixed = start.minimize(Free::NONE).ok()?;
        // Twice the decrease of the cost has as many degrees of freedom as there are intrinsics.
        // Residuals of real images are not independent. The decrease is therefore scaled by their
        // variance, and the limit is generous.
        let n_params = intrinsics.params().len() as f64;
        let decrease = 2.0 * (fixed.cost - free.cost) / free.variance.max(1.0);
        let limit = n_params + 6.0 * (2.0 * n_params).sqrt();
        (decrease > limit).then_some(())?;
        // The given intrinsics are uncertain themselves. A change within this uncertainty is no
        // contradiction, and the uncertainty is already propagated to the result.
        if covariance.is_some_and(|given| {
            squared_change(intrinsics, free, given).is_some_and(|square| square < limit)
        }) {
            return None;
        }
        let change = fixed.state.solution.x.inverse() * free.state.solution.x;
        let warning = format!(
            "the corners contradict the given intrinsics: with free intrinsics, {}, and the camera moves by {:.1} mm and {:.2} degrees, which is included in the uncertainty; calibrate the intrinsics with calibrate intrinsics, or estimate them together with the pose ({})",
            change_of_intrinsics(intrinsics, &free.state.intrinsics),
            1e3 * change.translation.vector.norm(),
            change.rotation.angle().to_degrees(),
            Setting::WithIntrinsics
        );
        Some(Self {
            free: free.state.solution,
            by_intrinsics: propagated(free, None)?,
            warning,
        })
    }

    /// Covariance to add to the covariance of a solution with the given intrinsics. It consists of
    /// the effect of the uncertainty of free intrinsics, and of the square of the difference.
    pub(super) fn covariance(&self, solution: &Solution) -> DMatrix<f64> {
        let mut shift = DVector::zeros(N_PARAMS);
        for (first, from, to) in [(0, solution.x, self.free.x), (6, solution.y, self.free.y)] {
            let change = from.inverse() * to;
            let step = stacked(&change.rotation.scaled_axis(), &change.translation.vector);
            shift.fixed_rows_mut::<6>(first).copy_from(&step);
        }
        &self.by_intrinsics + &shift * shift.transpose()
    }
}

/// Squared change of the intrinsics relative to the uncertainty of both the given and the free
/// intrinsics. `None` if neither is uncertain.
fn squared_change(
    given: &Intrinsics,
    free: &Fit<CornerState>,
    covariance: &DMatrix<f64>,
) -> Option<f64> {
    let params = given.params();
    let changes = free
        .state
        .intrinsics
        .params()
        .into_iter()
        .zip(&params)
        .map(|(free, given)| free - given);
    let change = DVector::from_iterator(params.len(), changes);
    let n = params.len();
    let of_free = free.covariance.view((N_PARAMS, N_PARAMS), (n, n));
    let total = covariance + of_free;
    Some(change.dot(&total.cholesky()?.solve(&change)))
}

/// The changes of focal length and principal point, the larger change first.
fn change_of_intrinsics(given: &Intrinsics, free: &Intrinsics) -> String {
    let largest = |a: [f64; 2], b: [f64; 2]| f64::max((a[0] - b[0]).abs(), (a[1] - b[1]).abs());
    let [x, y] = [0, 1].map(|axis| free.principal_px[axis] - given.principal_px[axis]);
    let focal = format!(
        "the focal length changes from {:.1} to {:.1} px",
        given.focal_px[0], free.focal_px[0]
    );
    let principal = format!(
        "the principal point moves by ({x:.1}, {y:.1}) px from ({:.1}, {:.1})",
        given.principal_px[0], given.principal_px[1]
    );
    if largest(given.principal_px, free.principal_px) > largest(given.focal_px, free.focal_px) {
        format!("{principal}, {focal}")
    } else {
        format!("{focal}, {principal}")
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::tests::{central_difference, example, unit_step};
    use super::*;

    #[test]
    fn derivatives_match_central_differences() {
        const CLOSE: f64 = 1e-5; // The Jacobian of the pose error's rotation has an error of its square, here 1e-6.
        let (solution, base_from_flange) = example();
        let error = Vector6::new(1e-3, -2e-3, 1e-3, 0.002, 0.001, -0.003);
        let point = Vector3::new(0.1, 0.07, 0.0);
        for setup in [Setup::EyeInHand, Setup::EyeToHand] {
            let chain = |solution: &Solution, pose: &Transform, error: &Vector6<f64>| {
                PointChain::new(setup, solution, pose, error).at(&point)
            };
            let at = chain(&solution, &base_from_flange, &error);
            for ix in 0..N_PARAMS {
                let numeric = central_difference(|nudge| {
                    let moved = solution.moved(unit_step::<N_PARAMS>(ix, nudge).as_slice());
                    chain(&moved, &base_from_flange, &error).point_in_camera
                });
                assert!(
                    (numeric - at.by_solution.column(ix)).norm() < CLOSE,
                    "{setup:?}, parameter {ix}"
                );
            }
            for ix in 0..6 {
                let numeric = central_difference(|nudge| {
                    let error = error + unit_step::<6>(ix, nudge);
                    chain(&solution, &base_from_flange, &error).point_in_camera
                });
                assert!(
                    (numeric - at.by_error.column(ix)).norm() < CLOSE,
                    "{setup:?}, error {ix}"
                );
                let numeric = central_difference(|nudge| {
                    let moved = base_from_flange * motion(unit_step::<6>(ix, nudge).as_slice());
                    chain(&solution, &moved, &error).point_in_camera
                });
                assert!(
                    (numeric - at.by_flange.column(ix)).norm() < CLOSE,
                    "{setup:?}, flange {ix}"
                );
            }
        }
    }
}
