//! A Gauss-Newton step of the shared parameters, its uncertainty, and its unobservable directions.

use super::pairs::Pair;
use super::sums::PairSums;
use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Factor by which the information of the residuals is reduced, because residuals of neighboring
/// samples are correlated. It is used only for damping and observability. Reported uncertainties
/// are computed from the scatter of the pairs, see [`Solution::variance`].
pub(super) const INFLATION: f64 = 10.0;
/// A direction is observable if its standard deviation is below this fraction of the parameters'
/// scales.
const OBSERVABLE_FRAC: f64 = 0.3;
/// Maximum step, relative to the parameters' scales.
const MAX_STEP: f64 = 2.0;

/// The normal equations in units of the parameters' scales, and their eigenvectors.
#[derive(Debug)]
pub(super) struct Solution {
    scales: DVector<f64>,
    eigen: SymmetricEigen<f64, nalgebra::Dyn>,
    /// Whether each eigenvector is observable, in the order of the eigenvectors.
    is_observable: Vec<bool>,
    /// The step in units of the parameters.
    pub(super) step: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Solution {
    /// Computes a Gauss-Newton step that is damped towards zero. Components along unobservable
    /// directions become zero.
    ///
    /// * `scales`: typical magnitude of each parameter.
    /// * `values`: current values of the parameters.
    pub(super) fn new(
        scales: DVector<f64>,
        values: &DVector<f64>,
        pairs: &[Pair],
        sums: &[PairSums],
    ) -> Self {
        let n = scales.len();
        // The information is in units of the scales, so that eigenvalues of meters and radians are
        // comparable.
        let mut information = DMatrix::zeros(n, n);
        let mut gradient = DVector::zeros(n);
        for pair in sums {
            for (row, param) in pair.params.iter().enumerate() {
                gradient[*param] += scales[*param] * pair.gradient[row];
                for (column, other) in pair.params.iter().enumerate() {
                    information[(*param, *other)] +=
                        scales[*param] * scales[*other] * pair.information[(row, column)];
                }
            }
        }
        let values = values.component_div(&scales);
        let eigen = SymmetricEigen::new(information);
        let is_observable: Vec<bool> = eigen
            .eigenvalues
            .iter()
            .map(|value| *value > INFLATION / (OBSERVABLE_FRAC * OBSERVABLE_FRAC))
            .collect();
        let mut step = DVector::zeros(n);
        for (ix, observable) in is_observable.iter().enumerate() {
            let direction = eigen.eigenvectors.column(ix);
            // The prior is at zero with a standard deviation of one scale. Its information is
            // multiplied by `INFLATION`, because the information of the residuals is too large by
            // this factor. Components that the residuals do not determine return to zero. Such
            // components may be nonzero, because other directions were observable in earlier steps.
            let length = if *observable {
                (direction.dot(&gradient) - INFLATION * direction.dot(&values))
                    / (eigen.eigenvalues[ix] + INFLATION)
            } else {
                -direction.dot(&values)
            };
            step += direction * length;
        }
        // A long step of a nearly unobservable direction would leave the range in which the
        // linearization holds.
        let max_component = step.amax();
        if max_component > MAX_STEP {
            step *= MAX_STEP / max_component;
        }
        let mut solution = Self {
            step: step.component_mul(&scales),
            scales,
            eigen,
            is_observable,
            covariance: DMatrix::zeros(n, n),
        };
        solution.covariance = solution.covariance(pairs, sums);
        solution
    }

    /// Covariance from the scatter of the pairs' gradients, in scaled units. Each pair is assumed
    /// to have an independent error. Pairs that share an image are assumed to have a common error
    /// in addition. If only one kind of error exists, the covariance is too large by a factor of at
    /// most two.
    ///
    /// Sources: White 1980 for the sandwich estimator, and Aronow, Samii and Assenova 2015 for
    /// pairs that share a member.
    fn covariance(&self, pairs: &[Pair], sums: &[PairSums]) -> DMatrix<f64> {
        let n = self.scales.len();
        let n_images = pairs
            .iter()
            .map(|pair| pair.from.max(pair.to) + 1)
            .max()
            .unwrap_or(0);
        // Gradients of all pairs of an image add up to its common error.
        let mut by_image = vec![DVector::<f64>::zeros(n); n_images];
        for (pair, sums) in pairs.iter().zip(sums) {
            for (row, param) in sums.params.iter().enumerate() {
                by_image[pair.from][*param] += self.scales[*param] * sums.gradient[row];
                by_image[pair.to][*param] += self.scales[*param] * sums.gradient[row];
            }
        }
        let mut meat = DMatrix::zeros(n, n);
        let mut n_active = 0.0f64;
        for score in by_image.iter().filter(|score| score.norm_squared() > 0.0) {
            meat.ger(1.0, score, score, 1.0);
            n_active += 1.0;
        }
        let inverse = self.inverse();
        &inverse * meat * &inverse * (n_active / (n_active - 1.0).max(1.0))
    }

    /// Adds an error to the covariance that the scatter of the pairs does not contain. The size of
    /// the error, in units of the scales, is known better than its direction. Half of its variance
    /// is therefore along `error`, and half is spread evenly over all observable directions.
    pub(super) fn add_error(&mut self, error: &DVector<f64>) {
        let scaled = error.component_div(&self.scales);
        self.covariance.ger(0.5, &scaled, &scaled, 1.0);
        let observable = || (0..scaled.len()).filter(|ix| self.is_observable[*ix]);
        let variance = scaled.norm_squared() / observable().count().max(1) as f64;
        for ix in observable() {
            let direction = self.eigen.eigenvectors.column(ix);
            self.covariance
                .ger(0.5 * variance, &direction, &direction, 1.0);
        }
    }

    /// Inverse of the information matrix over the observable directions, in scaled units.
    fn inverse(&self) -> DMatrix<f64> {
        let n = self.scales.len();
        let mut inverse = DMatrix::zeros(n, n);
        for (ix, _) in self
            .is_observable
            .iter()
            .enumerate()
            .filter(|(_, observable)| **observable)
        {
            let direction = self.eigen.eigenvectors.column(ix);
            inverse.ger(
                1.0 / self.eigen.eigenvalues[ix],
                &direction,
                &direction,
                1.0,
            );
        }
        inverse
    }

    /// Variance of the weighted sum of the parameters.
    pub(super) fn variance(&self, weights: &DVector<f64>) -> f64 {
        let scaled = weights.component_mul(&self.scales);
        (&self.covariance * &scaled).dot(&scaled).max(0.0)
    }

    /// Standard deviation of one parameter.
    pub(super) fn sigma(&self, param: usize) -> f64 {
        let mut weights = DVector::zeros(self.scales.len());
        weights[param] = 1.0;
        self.variance(&weights).sqrt()
    }

    /// Share of a parameter that lies in unobservable directions, 0 to 1.
    pub(super) fn unobservable_frac(&self, param: usize) -> f64 {
        self.unobservable_columns()
            .map(|ix| self.eigen.eigenvectors[(param, ix)].powi(2))
            .sum()
    }

    /// Indices of the unobservable eigenvectors.
    fn unobservable_columns(&self) -> impl Iterator<Item = usize> {
        self.is_observable
            .iter()
            .enumerate()
            .filter(|(_, observable)| !**observable)
            .map(|(ix, _)| ix)
    }

    /// Unobservable directions in the units of the parameters, ordered by how little they change
    /// the parameters selected by `to_minimize`.
    pub(super) fn unobservable(&self, to_minimize: impl Fn(usize) -> bool) -> Vec<DVector<f64>> {
        let columns: Vec<usize> = self.unobservable_columns().collect();
        if columns.is_empty() {
            return Vec::new();
        }
        let n = self.scales.len();
        let basis = DMatrix::from_fn(n, columns.len(), |row, column| {
            self.eigen.eigenvectors[(row, columns[column])]
        });
        let masked_basis = DMatrix::from_fn(n, columns.len(), |row, column| {
            if to_minimize(row) {
                basis[(row, column)]
            } else {
                0.0
            }
        });
        // Any basis of the unobservable space is equally valid. This basis contains as many vectors
        // as possible that do not change the selected parameters, because such vectors are easier
        // to describe.
        let rotated = SymmetricEigen::new(masked_basis.tr_mul(&masked_basis));
        let mut order: Vec<usize> = (0..columns.len()).collect();
        order.sort_by(|a, b| rotated.eigenvalues[*a].total_cmp(&rotated.eigenvalues[*b]));
        let direction =
            |ix: usize| (&basis * rotated.eigenvectors.column(ix)).component_mul(&self.scales);
        order.into_iter().map(direction).collect()
    }

    /// Largest component of the step in standard deviations, over the observable parameters.
    pub(super) fn step_in_sigmas(&self) -> f64 {
        let in_sigmas =
            |(ix, step): (usize, &f64)| step.abs() / self.sigma(ix).max(f64::MIN_POSITIVE);
        self.step
            .iter()
            .enumerate()
            .filter(|(ix, _)| self.unobservable_frac(*ix) < 0.5)
            .map(in_sigmas)
            .fold(0.0, f64::max)
    }
}
