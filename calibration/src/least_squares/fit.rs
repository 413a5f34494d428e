//! Result of a minimization: parameters, uncertainty and observability.

use super::{Evaluation, Options, Progress, normal_equations};
use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Result of [`super::minimize`].
#[derive(Clone, Debug)]
pub struct Fit<S> {
    /// The parameters.
    pub state: S,
    /// Half the sum of the losses.
    pub cost: f64,
    /// Number of scalar residuals.
    pub n_residuals: usize,
    /// Number of shared and local parameters.
    pub n_params: usize,
    /// Variance of a scalar residual, estimated from the residuals.
    pub variance: f64,
    /// Ratio of the scatter of the blocks' gradients to the scatter that independent residuals
    /// would cause. If the ratio is above 1, residuals of a block share errors. In that case, the
    /// covariance times this ratio is more realistic.
    pub dispersion: f64,
    /// Information about the shared parameters with free local parameters, for residuals of unit
    /// variance.
    pub information: DMatrix<f64>,
    /// Covariance of the shared parameters. Entries of unobservable parameters are very large, but
    /// finite.
    pub covariance: DMatrix<f64>,
    /// Covariance of the shared parameters if the residuals of a block share errors. The more the
    /// solution changes when one block is left out, the larger it is than `covariance`.
    pub covariance_with_shared_errors: DMatrix<f64>,
    /// Orthogonal directions of the shared parameters, the least observable first.
    pub directions: Vec<Direction>,
    /// Whether the last step was negligible.
    pub converged: bool,
    /// Number of steps, including rejected steps.
    pub n_steps: usize,
}

/// An eigenvector of the information about the shared parameters, in units of their scales.
#[derive(Clone, Debug, PartialEq)]
pub struct Direction {
    /// Unit vector. Component `i` is the change of shared parameter `i` divided by its scale.
    pub components: DVector<f64>,
    /// Standard deviation along the vector, as a multiple of the scales. If it is above about 1,
    /// the residuals do not determine this direction.
    pub sigma: f64,
}

impl<S> Fit<S> {
    /// Standard deviation of a shared parameter.
    pub fn sigma(&self, param_ix: usize) -> f64 {
        sigma_of(self.covariance[(param_ix, param_ix)])
    }
}

/// The standard deviation of a variance. It is infinite if the variance is NaN or negative beyond
/// rounding errors.
pub(crate) fn sigma_of(variance: f64) -> f64 {
    // Variances of unobservable parameters are sums of large numbers that cancel.
    const TINY: f64 = 1e-15;
    if variance >= -TINY {
        variance.max(0.0).sqrt()
    } else {
        f64::INFINITY
    }
}

/// Relative size of an eigenvalue that cannot be distinguished from zero.
const ROUNDING: f64 = 1e-15;

/// Summarizes the last state of a minimization.
pub(super) fn fit<S>(
    at: Evaluation<S>,
    scales: &DVector<f64>,
    n_params: usize,
    options: &Options,
    progress: Progress,
) -> Fit<S> {
    let information = normal_equations::information(&at.blocks, scales.len());
    let (variance, covariance_factor) = variances(&at, n_params, options.min_noise);
    // Eigenvectors depend on units, so directions are computed in units of the scales.
    let scaled = DMatrix::from_diagonal(scales) * &information * DMatrix::from_diagonal(scales);
    // An empty matrix has no decomposition.
    let eigen = if scales.is_empty() {
        SymmetricEigen {
            eigenvectors: scaled,
            eigenvalues: DVector::zeros(0),
        }
    } else {
        SymmetricEigen::new(scaled)
    };
    // Because of rounding, unobservable directions have eigenvalues of zero or below. The floor
    // keeps their variance finite.
    let floor = (ROUNDING * eigen.eigenvalues.iter().copied().fold(0.0, f64::max))
        .max(f64::MIN_POSITIVE / ROUNDING);
    let mut directions: Vec<Direction> = eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
        .map(|(value, vector)| Direction {
            components: vector.into_owned(),
            sigma: (covariance_factor / value.max(floor)).sqrt(),
        })
        .collect();
    directions.sort_by(|a, b| b.sigma.total_cmp(&a.sigma));
    let mut covariance = DMatrix::zeros(scales.len(), scales.len());
    for direction in &directions {
        let vector = direction.components.component_mul(scales) * direction.sigma;
        covariance.ger(1.0, &vector, &vector, 1.0);
    }
    let dispersion = normal_equations::dispersion(&at.blocks, scales.len(), variance);
    let jackknife = normal_equations::jackknife(&at.blocks, scales.len());
    Fit {
        covariance_with_shared_errors: with_shared_errors(&covariance, dispersion, jackknife),
        state: at.state,
        cost: 0.5 * at.totals.loss,
        n_residuals: at.totals.n_scalars,
        n_params,
        variance,
        dispersion,
        information,
        covariance,
        directions,
        converged: progress.converged,
        n_steps: progress.n_steps,
    }
}

/// Combines two covariances that allow for shared errors. The first covariance, which is multiplied
/// by the dispersion, is precise. It assumes that shared errors have the same effect on all
/// parameters. The second covariance, the jackknife, does not make this assumption. It is less
/// precise, because it is estimated from as few values as there are blocks. The mean of the two has
/// the right size for both kinds of errors.
fn with_shared_errors(
    covariance: &DMatrix<f64>,
    dispersion: f64,
    jackknife: Option<DMatrix<f64>>,
) -> DMatrix<f64> {
    // A dispersion below 1 is chance.
    let scaled = covariance * dispersion.max(1.0);
    match jackknife {
        Some(jackknife) => (scaled + jackknife) * 0.5,
        None => scaled,
    }
}

/// Variance of a scalar residual, and the factor between the inverse of the weighted information
/// and the covariance. For the squared loss, the two values are equal.
///
/// Source: Huber 1981, section 7.6, equation 6.7 without the factor `K`, which is close to 1.
fn variances<S>(at: &Evaluation<S>, n_params: usize, min_noise: f64) -> (f64, f64) {
    let totals = &at.totals;
    let n_vectors = totals.n_vectors as f64;
    let n_free = (totals.n_scalars - n_params) as f64;
    // With more than 95 % outliers, the derivative would be too small for a division.
    let influence_derivative = (totals.influence_derivatives / n_vectors).max(0.05);
    let mean_weight = (totals.weights / n_vectors).max(f64::MIN_POSITIVE);
    let variance = (totals.weighted_squares / n_free / influence_derivative.powi(2))
        .max(min_noise * min_noise);
    (variance, variance * mean_weight)
}
