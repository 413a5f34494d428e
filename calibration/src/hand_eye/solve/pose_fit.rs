//! Generalized least squares over board poses, with noise variances estimated by restricted maximum
//! likelihood.
//!
//! The source of the variance estimate is Patterson and Thompson 1971. The iteration follows Rao
//! and Kleffe 1988, section 8.2, but takes square roots of the update factors. The square roots
//! keep the variances positive and increase the likelihood monotonically.

use super::super::Setup;
use super::super::geometry::{self, Matrix6x12, N_PARAMS, Solution};
use super::super::samples::{Sample, used};
use crate::Error;
use crate::least_squares::{self, BlockSums, Loss};
use kinematics::Transform;
use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, Vector6};

/// Norm of six whitened residuals above which their loss is linear. 95 % of the samples without a
/// mistake are below this norm.
const LOSS_THRESHOLD: f64 = 3.55;

/// Standard deviations of the measurement errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandEyeNoise {
    /// Error of the corners, pixels along each axis. `None` if poses of the board were given. The
    /// value includes errors that the corners of one image share, such as errors of the lens model
    /// and blur. Independent corner errors of this size would have the same effect on the pose of
    /// the board.
    pub corner_px: Option<f64>,
    /// Residual of the corners after a separate fit of each image, pixels along each axis. It is at
    /// most `corner_px`.
    pub residual_px: Option<f64>,
    /// Rotation error about each axis, radians. If corners were given, it is the error of the robot
    /// poses. Otherwise, it is the error of the board poses, which includes the error of the robot.
    pub rotation_rad: f64,
    /// Translation error of the same poses along each axis, meters.
    pub translation_m: f64,
}

impl HandEyeNoise {
    /// No robot or board has smaller errors than these values. The values keep variances positive
    /// and limit the stated accuracy.
    const MIN: Self = Self {
        corner_px: None,
        residual_px: None,
        rotation_rad: 1e-7,
        translation_m: 1e-7,
    };

    /// Variances of rotation, translation and, if there are corners, corners.
    fn variances(&self) -> Vec<f64> {
        let sigmas = [self.rotation_rad, self.translation_m]
            .into_iter()
            .chain(self.corner_px);
        sigmas.map(|sigma| sigma * sigma).collect()
    }

    /// The same corners with robot errors that are smaller by a factor.
    pub(super) fn with_robot_errors(&self, factor: f64) -> Self {
        Self {
            rotation_rad: (factor * self.rotation_rad).max(Self::MIN.rotation_rad),
            translation_m: (factor * self.translation_m).max(Self::MIN.translation_m),
            ..*self
        }
    }

    /// The same kinds of errors with other variances.
    fn with_variances(&self, variances: &[f64]) -> Self {
        let sigma = |ix: usize, min: f64| variances[ix].sqrt().max(min);
        Self {
            rotation_rad: sigma(0, Self::MIN.rotation_rad),
            translation_m: sigma(1, Self::MIN.translation_m),
            corner_px: self
                .corner_px
                .map(|_| sigma(2, self.residual_px.unwrap_or(0.0))),
            residual_px: self.residual_px,
        }
    }
}

/// One sample with the chosen board pose.
#[derive(Clone, Debug)]
pub(crate) struct Measurement {
    /// See [`Sample`].
    stop_ix: usize,
    /// One divided by the number of measurements of the stop. A stop counts once, because its
    /// measurements share the error of the robot pose.
    weight: f64,
    pub(crate) a: Transform,
    pub(crate) camera_from_board: Transform,
    /// Covariance of the pose for corners with an error of one pixel. `None` for given poses.
    pub(crate) unit_covariance: Option<Matrix6<f64>>,
}

impl Measurement {
    /// The only measurement at its stop.
    pub(crate) fn new(
        a: Transform,
        camera_from_board: Transform,
        unit_covariance: Option<Matrix6<f64>>,
    ) -> Self {
        Self {
            stop_ix: usize::MAX,
            weight: 1.0,
            a,
            camera_from_board,
            unit_covariance,
        }
    }

    pub(super) fn of(sample: &Sample) -> Self {
        let chosen = sample.chosen();
        let corners = chosen.corners.as_ref();
        let unit_covariance = corners.map(|corners| corners.unit_covariance);
        Self {
            stop_ix: sample.stop_ix,
            ..Self::new(sample.a, chosen.camera_from_board, unit_covariance)
        }
    }

    /// Residual of a solution, and its derivatives with respect to the parameters of
    /// [`Solution::moved`].
    fn linearized(&self, solution: &Solution) -> (Vector6<f64>, Matrix6x12) {
        let predicted = solution.camera_from_board(&self.a);
        let residual = geometry::residual(&predicted, &self.camera_from_board);
        (residual, geometry::residual_jacobian(&predicted, &residual))
    }
}

/// The used samples, weighted such that each stop counts once.
pub(crate) fn measurements(samples: &[Sample]) -> Vec<Measurement> {
    with_weights(used(samples).map(Measurement::of).collect())
}

/// Weighs measurements such that each stop counts once.
fn with_weights(mut measurements: Vec<Measurement>) -> Vec<Measurement> {
    let mut n_of_stop = std::collections::BTreeMap::<usize, usize>::new();
    for measurement in &measurements {
        *n_of_stop.entry(measurement.stop_ix).or_default() += 1;
    }
    for measurement in &mut measurements {
        measurement.weight = 1.0 / n_of_stop[&measurement.stop_ix] as f64;
    }
    measurements
}

/// Result of [`fit`].
#[derive(Clone, Debug)]
pub(super) struct PoseFit {
    pub(super) solution: Solution,
    pub(super) noise: HandEyeNoise,
    /// Noise that determines the weights.
    pub(super) weighting: HandEyeNoise,
    /// Covariance of the parameters of [`Solution::moved`].
    pub(super) covariance: DMatrix<f64>,
    /// Effective degrees of freedom of the covariance (Satterthwaite 1946).
    pub(super) n_free: f64,
}

/// Fits a solution to the measurements.
///
/// * `knows_noise`: whether the weights follow from the given noise. Otherwise, the noise is
///   estimated.
///
/// # Errors
/// Fails if fewer than three measurements are given.
pub(super) fn fit(
    setup: Setup,
    measurements: &[Measurement],
    initial: Solution,
    noise: HandEyeNoise,
    knows_noise: bool,
) -> Result<PoseFit, Error> {
    // Relative change of the information about the parameters. It is far below the uncertainty of
    // variances that are estimated from tens of samples.
    const CONVERGED: f64 = 1e-3;
    let max_rounds = if knows_noise { 1 } else { 60 };
    let options = least_squares::Options {
        loss: Loss::Huber {
            threshold: LOSS_THRESHOLD,
        },
        max_steps: 30,
        ..least_squares::Options::default()
    };
    // The weights depend on the variances, and the variances depend on the residuals of the
    // solution. Solution and variances are therefore estimated alternately.
    let mut solution = initial;
    let mut noise = noise;
    let mut before: Option<DVector<f64>> = None;
    let mut n_rounds = 0;
    loop {
        n_rounds += 1;
        let problem = Whitened::new(setup, measurements, &solution, &noise);
        let fit = least_squares::minimize(&problem, solution, &options)?;
        solution = fit.state;
        let update = update_variances(setup, measurements, &solution, &noise, &fit.information);
        noise = update.noise;
        let diagonal = fit.information.diagonal();
        let is_settled = before.as_ref().is_some_and(|before| {
            let mut changes = diagonal.iter().zip(before);
            changes.all(|(now, before)| (now / before - 1.0).abs() < CONVERGED)
        });
        if is_settled || n_rounds == max_rounds {
            // The whitened residuals have unit variance by construction.
            let covariance = fit.information.try_inverse().unwrap_or(fit.covariance);
            return Ok(PoseFit {
                solution,
                noise,
                weighting: noise,
                covariance,
                n_free: update.n_free,
            });
        }
        before = Some(diagonal);
    }
}

/// Largest number of fits of a cross-validation. With more measurements than this, each fit leaves
/// out several measurements. Otherwise, the time would grow with the square of their number.
/// Leaving out even one of 60 measurements changes a solution very little.
pub const MAX_FOLDS: usize = 60;

/// For each measurement, the solution from the other measurements. Stops are left out one by one.
/// If there are many stops, they are left out in [`MAX_FOLDS`] interleaved folds.
///
/// * `knows_noise`: keeps the given noise. This is faster than estimating the noise again without
///   the measurement.
pub(crate) fn held_out_solutions(
    setup: Setup,
    measurements: &[Measurement],
    solution: Solution,
    noise: HandEyeNoise,
    knows_noise: bool,
) -> Vec<Option<Solution>> {
    // Measurements at one stop share the error of the robot pose, so they are left out together.
    let mut stops: Vec<usize> = measurements
        .iter()
        .map(|measurement| measurement.stop_ix)
        .collect();
    stops.sort_unstable();
    stops.dedup();
    let n_folds = stops.len().min(MAX_FOLDS);
    let fold_of = |measurement: &Measurement| {
        stops.partition_point(|stop| *stop < measurement.stop_ix) % n_folds
    };
    let n_left_out = stops.len().div_ceil(n_folds.max(1));
    // The others must be at three stops at least.
    let is_possible = stops.len() >= n_left_out + 3;
    let folds: Vec<Option<Solution>> = (0..n_folds)
        .map(|fold| {
            is_possible.then_some(())?;
            let others: Vec<Measurement> = measurements
                .iter()
                .filter(|other| fold_of(other) != fold)
                .cloned()
                .collect();
            let held_out = fit(setup, &others, solution, noise, knows_noise);
            Some(held_out.ok()?.solution)
        })
        .collect();
    measurements
        .iter()
        .map(|measurement| folds[fold_of(measurement)])
        .collect()
}

/// Covariance of the parameters of a fit whose weights follow from `weighting`, if the true noise
/// is `noise` (Huber 1967).
pub(super) fn sandwich_covariance(
    setup: Setup,
    measurements: &[Measurement],
    solution: &Solution,
    weighting: &HandEyeNoise,
    noise: &HandEyeNoise,
) -> Option<DMatrix<f64>> {
    let mut information = SMatrix::<f64, 12, 12>::zeros();
    let mut scatter = SMatrix::<f64, 12, 12>::zeros();
    for measurement in measurements {
        let (_, jacobian) = measurement.linearized(solution);
        let weighted = covariance(setup, measurement, solution, weighting)
            .cholesky()?
            .inverse()
            * jacobian;
        information += jacobian.transpose() * weighted * measurement.weight;
        // The errors at one stop are taken as equal.
        scatter += weighted.transpose()
            * covariance(setup, measurement, solution, noise)
            * weighted
            * measurement.weight;
    }
    let inverse = information.try_inverse()?;
    let covariance = inverse * scatter * inverse;
    Some(DMatrix::from_fn(N_PARAMS, N_PARAMS, |row, column| {
        covariance[(row, column)]
    }))
}

/// Noise that is consistent with an initial solution, computed from medians of the residuals.
pub(super) fn initial_noise(
    measurements: &[Measurement],
    solution: &Solution,
    corner_px: Option<f64>,
) -> HandEyeNoise {
    let residuals = measurements.iter().map(|m| m.linearized(solution).0);
    let residuals: Vec<Vector6<f64>> = residuals.collect();
    HandEyeNoise {
        corner_px,
        residual_px: corner_px,
        rotation_rad: median_sigma(&residuals, 0),
        translation_m: median_sigma(&residuals, 3),
    }
}

/// Standard deviation of three components of residuals, starting with `first`, from the median of
/// their norms.
fn median_sigma(residuals: &[Vector6<f64>], first: usize) -> f64 {
    /// Median of the norm of three normal numbers with deviation 1.
    const MEDIAN_OF_NORM: f64 = 1.538;
    /// Exact samples of a simulation have residuals of zero, which would give infinite weights.
    const MIN: f64 = 1e-6;
    let norms: Vec<f64> = residuals
        .iter()
        .map(|residual| residual.fixed_rows::<3>(first).norm())
        .collect();
    (numbers::quantile::median(&norms).unwrap_or(0.0) / MEDIAN_OF_NORM).max(MIN)
}

/// Derivatives of the covariance of a residual with respect to the variances, in the order of
/// [`HandEyeNoise::variances`].
fn covariance_parts(
    setup: Setup,
    measurement: &Measurement,
    solution: &Solution,
    noise: &HandEyeNoise,
) -> Vec<Matrix6<f64>> {
    match (&measurement.unit_covariance, noise.corner_px) {
        // With corners, errors of the robot pose have the same effect on the board as a motion of
        // the flange. Their components are correlated, because a rotation of the flange also moves
        // the board.
        (Some(unit), Some(_)) => {
            let predicted = solution.camera_from_board(&measurement.a);
            let by_flange = geometry::residual_by_flange(setup, solution, &predicted);
            let part = |first: usize| {
                let columns = by_flange.fixed_columns::<3>(first);
                columns * columns.transpose()
            };
            vec![part(0), part(3), *unit]
        }
        // For given poses, rotation and translation have independent errors of unknown origin.
        _ => {
            let block = |first: usize| {
                Matrix6::from_diagonal(&Vector6::from_fn(|ix, _| {
                    f64::from(u8::from(ix / 3 == first))
                }))
            };
            vec![block(0), block(1)]
        }
    }
}

/// Sum of the parts, times their variances.
fn total(parts: &[Matrix6<f64>], variances: &[f64]) -> Matrix6<f64> {
    parts
        .iter()
        .zip(variances)
        .map(|(part, variance)| part * *variance)
        .sum()
}

/// Covariance of the residual of a measurement.
pub(crate) fn covariance(
    setup: Setup,
    measurement: &Measurement,
    solution: &Solution,
    noise: &HandEyeNoise,
) -> Matrix6<f64> {
    total(
        &covariance_parts(setup, measurement, solution, noise),
        &noise.variances(),
    )
}

/// Squared Mahalanobis distance of a measurement, with six degrees of freedom.
///
/// * `fit`: a fit with or without the measurement. Without it, the uncertainty of the prediction
///   also counts.
pub(super) fn squared_distance(
    setup: Setup,
    measurement: &Measurement,
    fit: &PoseFit,
    is_used: bool,
) -> f64 {
    let predicted = fit.solution.camera_from_board(&measurement.a);
    let residual = geometry::residual(&predicted, &measurement.camera_from_board);
    let mut total = covariance(setup, measurement, &fit.solution, &fit.noise);
    if !is_used {
        let jacobian = geometry::residual_jacobian(&predicted, &Vector6::zeros());
        total +=
            jacobian * fit.covariance.fixed_view::<N_PARAMS, N_PARAMS>(0, 0) * jacobian.transpose();
    }
    match total.cholesky() {
        Some(factor) => residual.dot(&factor.solve(&residual)),
        None => f64::INFINITY,
    }
}

/// Least squares over residuals that are whitened with fixed covariances.
struct Whitened<'a> {
    measurements: &'a [Measurement],
    whitening: Vec<Matrix6<f64>>,
    lever_m: f64,
}

impl<'a> Whitened<'a> {
    fn new(
        setup: Setup,
        measurements: &'a [Measurement],
        solution: &Solution,
        noise: &HandEyeNoise,
    ) -> Self {
        let whitening = measurements
            .iter()
            .map(|measurement| whitening(setup, measurement, solution, noise))
            .collect();
        let lever_m = measurements
            .iter()
            .map(|m| m.camera_from_board.translation.vector.norm())
            .fold(0.01, f64::max);
        Self {
            measurements,
            whitening,
            lever_m,
        }
    }
}

/// The matrix that turns the residual of a measurement into six independent residuals with unit
/// variance. If no such matrix exists, returns zero, so that the measurement has no influence.
fn whitening(
    setup: Setup,
    measurement: &Measurement,
    solution: &Solution,
    noise: &HandEyeNoise,
) -> Matrix6<f64> {
    let factor = covariance(setup, measurement, solution, noise).cholesky();
    let whitening = factor
        .and_then(|factor| factor.l().try_inverse())
        .unwrap_or_else(Matrix6::zeros);
    whitening * measurement.weight.sqrt()
}

impl least_squares::Problem for Whitened<'_> {
    type State = Solution;

    fn scales(&self) -> DVector<f64> {
        DVector::from_fn(
            N_PARAMS,
            |ix, _| if ix % 6 < 3 { 1.0 } else { self.lever_m },
        )
    }

    fn n_blocks(&self) -> usize {
        self.measurements.len()
    }

    fn n_local(&self, _block_ix: usize) -> usize {
        0
    }

    fn evaluate(&self, solution: &Solution, block_ix: usize, sums: &mut BlockSums) -> Option<()> {
        let measurement = &self.measurements[block_ix];
        let (residual, jacobian) = measurement.linearized(solution);
        let whitening = &self.whitening[block_ix];
        // Matrices are stored by columns, so the rows are contiguous in the transpose.
        let rows = (whitening * jacobian).transpose();
        let row = |ix: usize| &rows.as_slice()[N_PARAMS * ix..N_PARAMS * (ix + 1)];
        sums.add((whitening * residual).into(), [0, 1, 2, 3, 4, 5].map(row));
        Some(())
    }

    fn moved(
        &self,
        solution: &Solution,
        shared: &DVector<f64>,
        _local: &[DVector<f64>],
    ) -> Solution {
        solution.moved(shared.as_slice())
    }
}

/// Variances after one step, and the degrees of freedom of the covariance that follows from them.
struct Update {
    noise: HandEyeNoise,
    n_free: f64,
}

/// One step of restricted maximum likelihood for the variances.
fn update_variances(
    setup: Setup,
    measurements: &[Measurement],
    solution: &Solution,
    noise: &HandEyeNoise,
    information: &DMatrix<f64>,
) -> Update {
    let variances = noise.variances();
    let n_variances = variances.len();
    let inverse = information
        .clone()
        .try_inverse()
        .unwrap_or_else(|| DMatrix::zeros(N_PARAMS, N_PARAMS));
    let x_information = inverse.view((0, 0), (6, 6)).into_owned().try_inverse();
    // There are two sums for each variance: the part of the squared residuals that this variance
    // explains, and the expected value of this part with the current variances. The expected value
    // takes into account that the parameters were fitted to the same residuals.
    let mut squares = vec![0.0; n_variances];
    let mut expected = vec![0.0; n_variances];
    // The first matrix is the Fisher information about the variances. The vector is the derivative
    // of the logarithm of the hand-eye covariance, averaged over its six parameters. The degrees of
    // freedom follow from both.
    let mut fisher = DMatrix::<f64>::zeros(n_variances, n_variances);
    let mut log_volume_by_variance = DVector::<f64>::zeros(n_variances);
    for measurement in measurements {
        let count = measurement.weight;
        let parts = covariance_parts(setup, measurement, solution, noise);
        let Some(weight) = total(&parts, &variances)
            .cholesky()
            .map(|factor| factor.inverse())
        else {
            continue;
        };
        let (residual, jacobian) = measurement.linearized(solution);
        let weighted = weight * residual;
        let robust = robust_weight(residual.dot(&weighted));
        let projected = &inverse * (jacobian.transpose() * weight);
        let remaining = weight - weight * jacobian * &projected;
        for (k, part) in parts.iter().enumerate() {
            squares[k] += count * robust * weighted.dot(&(part * weighted));
            expected[k] += count * (remaining * part).trace();
            let weighted_part = weight * part * weight;
            for (l, other) in parts.iter().enumerate() {
                fisher[(k, l)] += count * 0.5 * (weighted_part * other).trace();
            }
            if let Some(x_information) = &x_information {
                let change = &projected * *part * projected.transpose();
                log_volume_by_variance[k] +=
                    count * (x_information * change.view((0, 0), (6, 6))).trace() / 6.0;
            }
        }
    }
    // A part of the residuals' information is spent on the parameters.
    let n_scalars = 6.0 * measurements.iter().map(|m| m.weight).sum::<f64>();
    fisher *= ((n_scalars - N_PARAMS as f64) / n_scalars).max(0.05);
    // The update is limited, because the first steps may be wrong by a large factor, and a variance
    // of zero would stay zero.
    let updated = (0..n_variances).map(|k| {
        let factor: f64 = f64::sqrt(squares[k] / expected[k]);
        let is_valid = factor.is_finite();
        variances[k]
            * if is_valid {
                factor.clamp(0.2, 5.0)
            } else {
                1.0
            }
    });
    let updated: Vec<f64> = updated.collect();
    // Satterthwaite 1946: a variance with `n` degrees of freedom has a relative variance of `2 /
    // n`.
    let relative_variance = fisher.try_inverse().map_or(f64::INFINITY, |covariance| {
        log_volume_by_variance.dot(&(covariance * &log_volume_by_variance))
    });
    let n_free = if relative_variance > 0.0 {
        (2.0 / relative_variance).clamp(1.0, 1e6)
    } else {
        1e6
    };
    Update {
        noise: noise.with_variances(&updated),
        n_free,
    }
}

/// Weight of six whitened residuals, divided by its mean for normal residuals.
fn robust_weight(squared_norm: f64) -> f64 {
    // Mean of the weighted squared norm, divided by six. Without this factor, variances of normal
    // residuals would be 1 % too small.
    const MEAN: f64 = 0.99;
    (LOSS_THRESHOLD / squared_norm.sqrt()).min(1.0) / MEAN
}
