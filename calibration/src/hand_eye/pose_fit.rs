//! Generalized least squares over board poses, with noise variances estimated by restricted maximum
//! likelihood.
//!
//! Source of the variance estimate: Patterson and Thompson 1971; its iteration: Rao and Kleffe
//! 1988, section 8.2, with square roots, which keep the variances positive and increase the
//! likelihood monotonically.

use super::Setup;
use super::geometry::{self, Matrix6x12, N_PARAMS, Solution};
use super::samples::Sample;
use crate::Error;
use crate::least_squares::{self, BlockSums};
use kinematics::Transform;
use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, Vector6};

/// Standard deviations of the measurement errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandEyeNoise {
    /// Error of the corners, pixels along each axis. `None` if poses of the board were given.
    /// Errors of the lens model and blur are common to the corners of one image; they count as if
    /// independent errors of this size caused their effect on the pose of the board.
    pub corner_px: Option<f64>,
    /// Residual of the corners after a separate fit of each image, pixels along each axis. At most
    /// `corner_px`.
    pub residual_px: Option<f64>,
    /// Rotation error about each axis, radians: of the robot poses if corners were given, otherwise
    /// of the board poses including the robot's error.
    pub rotation_rad: f64,
    /// Translation error along each axis, meters; likewise.
    pub translation_m: f64,
}

impl HandEyeNoise {
    /// Errors that no robot or board is below: they keep variances positive and limit the stated
    /// accuracy.
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
pub(super) struct Measurement {
    /// See [`Sample`].
    pub(super) stop_ix: usize,
    /// One divided by the number of measurements of the stop. The error of the robot pose is common
    /// to them, so that a stop counts once.
    pub(super) weight: f64,
    pub(super) a: Transform,
    pub(super) camera_from_board: Transform,
    /// Covariance of the pose for corners with an error of one pixel; `None` for given poses.
    pub(super) unit_covariance: Option<Matrix6<f64>>,
}

/// The chosen candidate of each sample, with weights for all of them.
pub(super) fn measurements(samples: &[Sample], choice: &[usize]) -> Vec<Measurement> {
    let mut measurements = Vec::with_capacity(samples.len());
    for (sample, choice) in samples.iter().zip(choice) {
        let candidate = &sample.candidates[*choice];
        let corners = candidate.corners.as_ref();
        measurements.push(Measurement {
            stop_ix: sample.stop_ix,
            weight: 1.0,
            a: sample.a,
            camera_from_board: candidate.camera_from_board,
            unit_covariance: corners.map(|corners| corners.unit_covariance),
        });
    }
    with_weights(measurements)
}

/// Weighs measurements such that each stop counts once.
pub(super) fn with_weights(mut measurements: Vec<Measurement>) -> Vec<Measurement> {
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
    /// Covariance of the parameters of [`Solution::moved`].
    pub(super) covariance: DMatrix<f64>,
    /// Effective degrees of freedom of the covariance (Satterthwaite 1946).
    pub(super) n_free: f64,
}

/// Fits a solution to the measurements.
///
/// # Errors
/// If fewer than three measurements are given.
pub(super) fn fit(
    setup: Setup,
    measurements: &[Measurement],
    initial: Solution,
    noise: HandEyeNoise,
) -> Result<PoseFit, Error> {
    fit_with(setup, measurements, initial, noise, 60)
}

/// Fits a solution with the given noise.
///
/// # Errors
/// If fewer than three measurements are given.
pub(super) fn fit_with_known_noise(
    setup: Setup,
    measurements: &[Measurement],
    initial: Solution,
    noise: HandEyeNoise,
) -> Result<PoseFit, Error> {
    fit_with(setup, measurements, initial, noise, 1)
}

fn fit_with(
    setup: Setup,
    measurements: &[Measurement],
    initial: Solution,
    noise: HandEyeNoise,
    max_rounds: usize,
) -> Result<PoseFit, Error> {
    // Relative change of the information about the parameters. It is far below the uncertainty of
    // variances that are estimated from tens of samples.
    const CONVERGED: f64 = 1e-3;
    let mut solution = initial;
    let mut noise = noise;
    let options = least_squares::Options {
        loss: geometry::SAMPLE_LOSS,
        max_steps: 30,
        ..least_squares::Options::default()
    };
    // The weights depend on the variances, and those on the residuals of the solution: both are
    // estimated in turns.
    let mut last: Option<(least_squares::Fit<Solution>, f64)> = None;
    for _ in 0..max_rounds {
        let problem = Whitened::new(setup, measurements, &solution, &noise);
        let fit = least_squares::minimize(&problem, solution, &options)?;
        solution = fit.state;
        let update = update_variances(setup, measurements, &solution, &noise, &fit.information);
        noise = update.noise;
        let diagonal = fit.information.diagonal();
        let is_settled = last.as_ref().is_some_and(|(before, _)| {
            let before = before.information.diagonal();
            diagonal
                .iter()
                .zip(&before)
                .all(|(now, before)| (now / before - 1.0).abs() < CONVERGED)
        });
        last = Some((fit, update.n_free));
        if is_settled {
            break;
        }
    }
    let Some((fit, n_free)) = last else {
        return Err(Error::TooFewResiduals {
            n_residuals: 0,
            n_params: N_PARAMS,
        });
    };
    // The whitened residuals have unit variance by construction.
    let covariance = fit
        .information
        .clone()
        .try_inverse()
        .unwrap_or_else(|| fit.covariance.clone());
    Ok(PoseFit {
        solution,
        noise,
        covariance,
        n_free,
    })
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
        let predicted = solution.camera_from_board(&measurement.a);
        let residual = geometry::residual(&predicted, &measurement.camera_from_board);
        let jacobian = geometry::residual_jacobian(&predicted, &residual);
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

/// Noise that is consistent with an initial solution: from medians of the residuals.
pub(super) fn initial_noise(
    measurements: &[Measurement],
    solution: &Solution,
    corner_px: Option<f64>,
) -> HandEyeNoise {
    let residuals: Vec<Vector6<f64>> = measurements
        .iter()
        .map(|m| geometry::residual(&solution.camera_from_board(&m.a), &m.camera_from_board))
        .collect();
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
    (kinematics::quantile::median(&norms).unwrap_or(0.0) / MEDIAN_OF_NORM).max(MIN)
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
        // With corners, errors of the robot pose act on the board as a motion of the flange does.
        // They are correlated: a rotation of the flange also moves the board.
        (Some(unit), Some(_)) => {
            let predicted = solution.camera_from_board(&measurement.a);
            let by_flange = geometry::residual_by_flange(setup, solution, &predicted);
            let part = |first: usize| {
                let columns = by_flange.fixed_columns::<3>(first);
                columns * columns.transpose()
            };
            vec![part(0), part(3), *unit]
        }
        // Given poses: rotation and translation have independent errors of unknown origin.
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
pub(super) fn covariance(
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

/// Squared Mahalanobis distance of a measurement; it has six degrees of freedom.
///
/// * `fit`: a fit with or without the measurement. Without it, the uncertainty of the prediction
///   counts, too.
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
/// variance. Zero, so that the measurement has no influence, if there is none.
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
        let predicted = solution.camera_from_board(&measurement.a);
        let residual = geometry::residual(&predicted, &measurement.camera_from_board);
        let jacobian = geometry::residual_jacobian(&predicted, &residual);
        geometry::add_whitened(sums, &self.whitening[block_ix], &residual, &jacobian);
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
    // Per variance: the part of the squared residuals that it explains, and the part that is
    // expected with the current values, given that the parameters were fitted to the same
    // residuals.
    let mut squares = vec![0.0; n_variances];
    let mut expected = vec![0.0; n_variances];
    // The Fisher information about the variances, and the derivative of the logarithm of the
    // hand-eye covariance (the mean over its six parameters), for the degrees of freedom.
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
        let predicted = solution.camera_from_board(&measurement.a);
        let residual = geometry::residual(&predicted, &measurement.camera_from_board);
        let jacobian: Matrix6x12 = geometry::residual_jacobian(&predicted, &residual);
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
    let n_scalars = 6.0
        * measurements
            .iter()
            .map(|measurement| measurement.weight)
            .sum::<f64>();
    fisher *= ((n_scalars - N_PARAMS as f64) / n_scalars).max(0.05);
    // Limited, because the first steps may be far off, and a variance of zero would stay zero.
    let updated: Vec<f64> = (0..n_variances)
        .map(|k| {
            let factor: f64 = f64::sqrt(squares[k] / expected[k]);
            variances[k]
                * if factor.is_finite() {
                    factor.clamp(0.2, 5.0)
                } else {
                    1.0
                }
        })
        .collect();
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

/// Weight of [`geometry::SAMPLE_LOSS`], divided by its mean for normal residuals.
fn robust_weight(squared_norm: f64) -> f64 {
    const THRESHOLD: f64 = 3.55;
    // The mean of the weighted square relative to six. Without it, variances of normal residuals
    // would be 1 % too small.
    const MEAN: f64 = 0.99;
    (THRESHOLD / squared_norm.sqrt()).min(1.0) / MEAN
}
