//! Normal equations of shared and local parameters. The local parameters are eliminated by a Schur
//! complement.

use super::loss::Loss;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SymmetricEigen};

/// Residuals of one block and their derivatives. [`super::Problem::evaluate`] adds them.
#[derive(Clone, Debug)]
pub struct BlockSums {
    loss: Loss,
    n_shared: usize,
    n_local: usize,
    /// Derivatives of the residuals times the roots of their weights, with one column per scalar
    /// residual. They are stored until [`Self::summed`], because one product of the whole matrix is
    /// several times faster than one update per residual.
    weighted_derivatives: Vec<f64>,
    /// Weighted products of the derivatives with respect to all parameters. Shared parameters come
    /// first.
    products: DMatrix<f64>,
    /// Gradient of half the sum of the losses.
    gradient: DVector<f64>,
    pub(super) totals: Totals,
}

/// Sums over residuals. Their size does not depend on the number of parameters.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Totals {
    /// Sum of the loss.
    pub(super) loss: f64,
    /// Number of scalar residuals and of residual vectors.
    pub(super) n_scalars: usize,
    pub(super) n_vectors: usize,
    /// Sum of the squared norms of the weighted residual vectors.
    pub(super) weighted_squares: f64,
    /// Sum of the weights.
    pub(super) weights: f64,
    /// Sum over residual vectors of the mean derivative of the weighted residual with respect to
    /// the residual.
    pub(super) influence_derivatives: f64,
}

impl Totals {
    pub(super) fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        self.n_scalars += other.n_scalars;
        self.n_vectors += other.n_vectors;
        self.weighted_squares += other.weighted_squares;
        self.weights += other.weights;
        self.influence_derivatives += other.influence_derivatives;
    }
}

impl BlockSums {
    pub(crate) fn new(loss: Loss, n_shared: usize, n_local: usize) -> Self {
        let n = n_shared + n_local;
        Self {
            loss,
            n_shared,
            n_local,
            weighted_derivatives: Vec::new(),
            products: DMatrix::zeros(n, n),
            gradient: DVector::zeros(n),
            totals: Totals::default(),
        }
    }

    /// Adds one residual vector with `D` components. The robust loss depends on its norm.
    ///
    /// * `derivatives`: per component, derivatives with respect to the shared parameters, then
    ///   derivatives with respect to the block's local parameters.
    ///
    /// # Panics
    /// Panics if a row has another length.
    pub fn add<const D: usize>(&mut self, residual: [f64; D], derivatives: [&[f64]; D]) {
        let n = self.n_shared + self.n_local;
        let squared_norm = residual.iter().map(|value| value * value).sum::<f64>();
        let loss = self.loss.at(squared_norm);
        let root_weight = loss.weight.sqrt();
        for (value, row) in residual.into_iter().zip(derivatives) {
            assert_eq!(
                row.len(),
                n,
                "one derivative per shared and local parameter"
            );
            let weighted = loss.weight * value;
            for (sum, derivative) in self.gradient.as_mut_slice().iter_mut().zip(row) {
                *sum += weighted * derivative;
            }
            self.weighted_derivatives
                .extend(row.iter().map(|derivative| root_weight * derivative));
        }
        // A change along the residual also changes the weight. Changes in the other `D - 1`
        // directions only rotate the residual.
        let dims = D as f64;
        self.totals.add(&Totals {
            loss: loss.value,
            n_scalars: D,
            n_vectors: 1,
            weighted_squares: loss.weight * loss.weight * squared_norm,
            weights: loss.weight,
            influence_derivatives: ((dims - 1.0) * loss.weight + loss.radial_derivative) / dims,
        });
    }

    /// Computes the products after all residuals were added.
    pub(super) fn summed(mut self) -> Self {
        let n = self.n_shared + self.n_local;
        if n > 0 {
            let derivatives = std::mem::take(&mut self.weighted_derivatives);
            let derivatives = DMatrix::from_vec(n, derivatives.len() / n, derivatives);
            self.products
                .gemm(1.0, &derivatives, &derivatives.transpose(), 0.0);
        }
        self
    }

    /// Number of local parameters.
    pub fn n_local(&self) -> usize {
        self.n_local
    }

    /// Gradient of half the sum of the losses.
    #[cfg(test)]
    pub(crate) fn gradient(&self) -> &DVector<f64> {
        &self.gradient
    }

    /// Cholesky factor of the damped local part. `None` if this part is not positive definite.
    fn local_factor(&self, damping: f64) -> Option<Cholesky<f64, Dyn>> {
        let first = self.n_shared;
        let n = self.n_local;
        let mut local = self.products.view((first, first), (n, n)).into_owned();
        damp(&mut local, damping);
        Cholesky::new(local)
    }
}

/// Adds Marquardt's damping, which is a fraction of the diagonal, to the diagonal.
fn damp(matrix: &mut DMatrix<f64>, damping: f64) {
    for ix in 0..matrix.nrows() {
        matrix[(ix, ix)] *= 1.0 + damping;
    }
}

/// A step of all parameters.
pub(super) struct Step {
    pub(super) shared: DVector<f64>,
    pub(super) local: Vec<DVector<f64>>,
    /// Decrease of the cost that the quadratic model predicts.
    pub(super) predicted: f64,
}

/// The damped step that minimizes the quadratic model of the cost. `None` if a matrix is not
/// positive definite.
pub(super) fn step(blocks: &[BlockSums], n_shared: usize, damping: f64) -> Option<Step> {
    let reduced = Reduced::new(blocks, n_shared, damping)?;
    let shared = -if n_shared == 0 {
        DVector::zeros(0)
    } else {
        Cholesky::new(reduced.matrix)?.solve(&reduced.gradient)
    };
    // Back-substitution gives the local step of each block from the shared step.
    let mut local = Vec::with_capacity(blocks.len());
    let mut predicted = 0.0;
    for (block, factor) in blocks.iter().zip(&reduced.factors) {
        let step = match factor {
            Some(factor) => {
                let cross = block
                    .products
                    .view((n_shared, 0), (block.n_local, n_shared));
                -factor.solve(&(block.gradient.rows(n_shared, block.n_local) + cross * &shared))
            }
            None => DVector::zeros(0),
        };
        // With the diagonal damping `D`, the model predicts a decrease of
        // `0.5 step' (D step - gradient)`.
        for (ix, value) in shared.iter().chain(&step).enumerate() {
            predicted +=
                0.5 * value * (damping * block.products[(ix, ix)] * value - block.gradient[ix]);
        }
        local.push(step);
    }
    let is_finite = shared
        .iter()
        .chain(local.iter().flatten())
        .all(|value| value.is_finite());
    is_finite.then_some(Step {
        shared,
        local,
        predicted,
    })
}

/// Information about the shared parameters if the local parameters are free. It is the Schur
/// complement, which is symmetric. Directions of local parameters without information are left out.
pub(super) fn information(blocks: &[BlockSums], n_shared: usize) -> DMatrix<f64> {
    // Blocks may not determine their local parameters. Because of the tiny damping, such blocks do
    // not remove the information of other blocks.
    const DAMPING: f64 = 1e-12;
    match Reduced::new(blocks, n_shared, DAMPING) {
        Some(reduced) => {
            let mut matrix = reduced.matrix;
            matrix.fill_upper_triangle_with_lower_triangle();
            matrix
        }
        None => DMatrix::zeros(n_shared, n_shared),
    }
}

/// Ratio between the scatter of the blocks' gradients and the scatter that independent residuals of
/// this variance would cause. The ratio is about 1 for independent residuals, and larger if the
/// residuals of a block share errors. It is 1 if there are not enough blocks.
///
/// Let `g_b` and `S_b` be the gradient and the information of block b after elimination of its
/// local parameters, `S` the sum of all `S_b`, and `P_b = inverse(S) S_b`. The ratio is the sum of
/// `g_b' inverse(S) g_b`, divided by its expectation, which is the variance times the sum of
/// `trace(P_b - P_b P_b)`.
///
/// Source: Wedderburn 1974 (dispersion of quasi-likelihoods), with gradients of blocks as in the
/// sandwich estimator (White 1980).
pub(super) fn dispersion(blocks: &[BlockSums], n_shared: usize, variance: f64) -> f64 {
    const DAMPING: f64 = 1e-12;
    // With fewer degrees of freedom between blocks, the ratio would be mostly noise.
    const MIN_EXPECTED: f64 = 1.0;
    let reduced: Option<Vec<Reduced>> = blocks
        .iter()
        .map(|block| Reduced::new(std::slice::from_ref(block), n_shared, DAMPING))
        .collect();
    let Some(reduced) = reduced.filter(|_| n_shared > 0) else {
        return 1.0;
    };
    let sum = reduced
        .iter()
        .fold(DMatrix::zeros(n_shared, n_shared), |sum, block| {
            sum + &block.matrix
        });
    let Some(factor) = Cholesky::new(sum) else {
        return 1.0;
    };
    let mut scatter = 0.0;
    let mut expected = 0.0;
    for block in &reduced {
        scatter += block.gradient.dot(&factor.solve(&block.gradient));
        let mut matrix = block.matrix.clone();
        matrix.fill_upper_triangle_with_lower_triangle();
        // `P_b` above.
        let share = factor.solve(&matrix);
        expected += share.trace() - share.transpose().dot(&share);
    }
    if expected < MIN_EXPECTED {
        1.0
    } else {
        scatter / (expected * variance)
    }
}

/// The jackknife estimate of the covariance of the shared parameters. It follows from the changes
/// of the solution, to first order, when one block is left out. Residuals of a block may share
/// errors, which have a different effect on each parameter. `None` if the number of blocks is below
/// 1.5 times the number of parameters, or if the blocks do not determine the parameters.
///
/// With the symbols of [`dispersion`], leaving out block b changes the solution by `inverse(S -
/// S_b) g_b = inverse(S) inverse(1 - S_b inverse(S)) g_b`. Blocks that determine a direction almost
/// alone would give very large changes, so the eigenvalues of the inner inverse are limited.
pub(super) fn jackknife(blocks: &[BlockSums], n_shared: usize) -> Option<DMatrix<f64>> {
    // Source: MacKinnon and White 1985 (HC3), with blocks as in Bell and McCaffrey 2002.
    const DAMPING: f64 = 1e-12;
    // This limit is reached by a block with 95 % of the information about a direction.
    const MIN_REST: f64 = 0.05;
    // With 10 blocks and 9 parameters, each block is indispensable for some direction. For
    // directions that are hardly determined, the estimated variances then become twice as large as
    // the true variances.
    if n_shared == 0 || 2 * blocks.len() <= 3 * n_shared {
        return None;
    }
    let reduced: Vec<Reduced> = blocks
        .iter()
        .map(|block| Reduced::new(std::slice::from_ref(block), n_shared, DAMPING))
        .collect::<Option<_>>()?;
    let sum = reduced
        .iter()
        .fold(DMatrix::zeros(n_shared, n_shared), |sum, block| {
            sum + &block.matrix
        });
    let factor = Cholesky::new(sum)?;
    let lower = factor.l();
    let mut covariance = DMatrix::zeros(n_shared, n_shared);
    for block in &reduced {
        let mut matrix = block.matrix.clone();
        matrix.fill_upper_triangle_with_lower_triangle();
        // With S = L L', the share of the block is inverse(L) S_b inverse(L)', which is symmetric.
        let half = lower.solve_lower_triangular(&matrix)?;
        let share = lower.solve_lower_triangular(&half.transpose())?;
        // For a block that determines almost nothing, rounding may give values that are not finite.
        // The decomposition of such a matrix would not end.
        if !share.iter().all(|value| value.is_finite()) {
            return None;
        }
        let eigen = SymmetricEigen::new(share);
        let whitened = lower.solve_lower_triangular(&block.gradient)?;
        let mut along = eigen.eigenvectors.tr_mul(&whitened);
        for (value, share) in along.iter_mut().zip(eigen.eigenvalues.iter()) {
            *value /= (1.0 - share).max(MIN_REST);
        }
        let change = lower.tr_solve_lower_triangular(&(&eigen.eigenvectors * along))?;
        covariance.ger(1.0, &change, &change, 1.0);
    }
    Some(covariance)
}

/// The normal equations of the shared parameters after elimination of the local parameters.
struct Reduced {
    /// Lower triangle.
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Factors of the local parts. `None` for blocks without local parameters.
    factors: Vec<Option<Cholesky<f64, Dyn>>>,
}

impl Reduced {
    fn new(blocks: &[BlockSums], n_shared: usize, damping: f64) -> Option<Self> {
        let mut matrix = DMatrix::zeros(n_shared, n_shared);
        let mut gradient = DVector::zeros(n_shared);
        let mut factors = Vec::with_capacity(blocks.len());
        for block in blocks {
            matrix += block.products.view((0, 0), (n_shared, n_shared));
            gradient += block.gradient.rows(0, n_shared);
        }
        // The damping is added before elimination, as for a system that is solved as a whole.
        damp(&mut matrix, damping);
        for block in blocks {
            if block.n_local == 0 {
                factors.push(None);
                continue;
            }
            let factor = block.local_factor(damping)?;
            // With C = L L': B' inverse(C) B = (inverse(L) B)' (inverse(L) B).
            let mut cross = block
                .products
                .view((n_shared, 0), (block.n_local, n_shared))
                .into_owned();
            let mut local_gradient = block.gradient.rows(n_shared, block.n_local).into_owned();
            let lower = factor.l_dirty();
            if !lower.solve_lower_triangular_mut(&mut cross)
                || !lower.solve_lower_triangular_mut(&mut local_gradient)
            {
                return None;
            }
            matrix.gemm_tr(-1.0, &cross, &cross, 1.0);
            gradient.gemv_tr(-1.0, &cross, &local_gradient, 1.0);
            factors.push(Some(factor));
        }
        Some(Self {
            matrix,
            gradient,
            factors,
        })
    }
}
