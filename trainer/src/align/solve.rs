//! One step of the shared terms, how sure it is, and which directions cannot be seen.

use super::pairs::Pair;
use super::sums::PairSums;
use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Residuals of neighbouring spots err together: they say as much as this many times fewer would. Only for damping and for
/// what counts as seen; what is reported is measured, see [`Solved::variance`].
pub(super) const INFLATION: f64 = 10.0;
/// A direction is seen when its standard deviation is below this share of what the term may be.
const SEEN_FRAC: f64 = 0.3;
/// The most a step may change, in shares of what the terms may be.
const LONGEST_STEP: f64 = 2.0;

/// The normal equations, each term in units of what it may be, and their eigenvectors.
#[derive(Debug)]
pub(super) struct Solved {
    scales: DVector<f64>,
    eigen: SymmetricEigen<f64, nalgebra::Dyn>,
    /// Of the eigenvectors, in order.
    is_seen: Vec<bool>,
    /// In units of the terms.
    pub(super) step: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Solved {
    /// Gauss and Newton's step with a pull to zero; directions that are not seen go to zero.
    ///
    /// * `scales`: how large each term may be.
    /// * `values`: what the terms are now.
    pub(super) fn new(scales: DVector<f64>, values: &DVector<f64>, pairs: &[Pair], sums: &[PairSums]) -> Self {
        let n = scales.len();
        let (mut information, mut gradient) = (DMatrix::zeros(n, n), DVector::zeros(n));
        for pair in sums {
            for (row, term) in pair.terms.iter().enumerate() {
                gradient[*term] += scales[*term] * pair.gradient[row];
                for (column, other) in pair.terms.iter().enumerate() {
                    information[(*term, *other)] += scales[*term] * scales[*other] * pair.information[(row, column)];
                }
            }
        }
        let values = values.component_div(&scales);
        let eigen = SymmetricEigen::new(information);
        let is_seen: Vec<bool> =
            eigen.eigenvalues.iter().map(|value| *value > INFLATION / (SEEN_FRAC * SEEN_FRAC)).collect();
        let mut step = DVector::zeros(n);
        for (ix, seen) in is_seen.iter().enumerate() {
            let direction = eigen.eigenvectors.column(ix);
            let length = if *seen {
                (direction.dot(&gradient) - INFLATION * direction.dot(&values)) / (eigen.eigenvalues[ix] + INFLATION)
            } else {
                -direction.dot(&values)
            };
            step += direction * length;
        }
        let longest = step.amax();
        if longest > LONGEST_STEP {
            step *= LONGEST_STEP / longest;
        }
        let mut solved =
            Self { step: step.component_mul(&scales), scales, eigen, is_seen, covariance: DMatrix::zeros(n, n) };
        solved.covariance = solved.covariance(pairs, sums);
        solved
    }

    /// Covariance from the scatter of what the pairs say, in scaled units: pairs that share a frame err together, and each on
    /// its own; where only one of both is so it comes out too large by at most two.
    ///
    /// Source: White 1980 (the sandwich); Aronow, Samii and Assenova 2015 (pairs that share a member).
    fn covariance(&self, pairs: &[Pair], sums: &[PairSums]) -> DMatrix<f64> {
        let n = self.scales.len();
        let n_frames = pairs.iter().map(|pair| pair.from.max(pair.to) + 1).max().unwrap_or(0);
        let mut by_frame = vec![DVector::<f64>::zeros(n); n_frames];
        for (pair, sums) in pairs.iter().zip(sums) {
            for (row, term) in sums.terms.iter().enumerate() {
                by_frame[pair.from][*term] += self.scales[*term] * sums.gradient[row];
                by_frame[pair.to][*term] += self.scales[*term] * sums.gradient[row];
            }
        }
        let mut meat = DMatrix::zeros(n, n);
        let mut n_shown = 0.0f64;
        for score in by_frame.iter().filter(|score| score.norm_squared() > 0.0) {
            meat.ger(1.0, score, score, 1.0);
            n_shown += 1.0;
        }
        let inverse = self.inverse();
        &inverse * meat * &inverse * (n_shown / (n_shown - 1.0).max(1.0))
    }

    /// Inverse of the information over what is seen, in scaled units.
    fn inverse(&self) -> DMatrix<f64> {
        let n = self.scales.len();
        let mut inverse = DMatrix::zeros(n, n);
        for (ix, _) in self.is_seen.iter().enumerate().filter(|(_, seen)| **seen) {
            let direction = self.eigen.eigenvectors.column(ix);
            inverse.ger(1.0 / self.eigen.eigenvalues[ix], &direction, &direction, 1.0);
        }
        inverse
    }

    /// Variance of the sum of the terms, each times its weight.
    pub(super) fn variance(&self, weights: &DVector<f64>) -> f64 {
        let scaled = weights.component_mul(&self.scales);
        (&self.covariance * &scaled).dot(&scaled).max(0.0)
    }

    /// Standard deviation of one term.
    pub(super) fn sigma(&self, term: usize) -> f64 {
        let mut weights = DVector::zeros(self.scales.len());
        weights[term] = 1.0;
        self.variance(&weights).sqrt()
    }

    /// Share of a term that lies in directions that cannot be seen, 0 to 1.
    pub(super) fn unseen_share(&self, term: usize) -> f64 {
        self.unseen_columns().map(|ix| self.eigen.eigenvectors[(term, ix)].powi(2)).sum()
    }

    fn unseen_columns(&self) -> impl Iterator<Item = usize> {
        self.is_seen.iter().enumerate().filter(|(_, seen)| !**seen).map(|(ix, _)| ix)
    }

    /// Directions that cannot be seen, in the units of the terms; of several the ones that move `first` least come first.
    pub(super) fn unseen(&self, first: impl Fn(usize) -> bool) -> Vec<DVector<f64>> {
        let columns: Vec<usize> = self.unseen_columns().collect();
        if columns.is_empty() {
            return Vec::new();
        }
        let n = self.scales.len();
        let basis = DMatrix::from_fn(n, columns.len(), |row, column| self.eigen.eigenvectors[(row, columns[column])]);
        let moves =
            DMatrix::from_fn(n, columns.len(), |row, column| if first(row) { basis[(row, column)] } else { 0.0 });
        let turned = SymmetricEigen::new(moves.tr_mul(&moves));
        let mut order: Vec<usize> = (0..columns.len()).collect();
        order.sort_by(|a, b| turned.eigenvalues[*a].total_cmp(&turned.eigenvalues[*b]));
        let direction = |ix: usize| (&basis * turned.eigenvectors.column(ix)).component_mul(&self.scales);
        order.into_iter().map(direction).collect()
    }

    /// The step in standard deviations, the most over the terms.
    pub(super) fn step_in_sigmas(&self) -> f64 {
        let in_sigmas = |(ix, step): (usize, &f64)| step.abs() / self.sigma(ix).max(f64::MIN_POSITIVE);
        self.step.iter().enumerate().filter(|(ix, _)| self.unseen_share(*ix) < 0.5).map(in_sigmas).fold(0.0, f64::max)
    }
}
