//! Normal equations of shared and local parameters, and elimination of the local ones by a Schur complement.

use super::loss::Loss;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Sums over the residuals of one block. [`super::Problem::evaluate`] adds to them.
#[derive(Clone, Debug)]
pub struct BlockSums {
    loss: Loss,
    n_shared: usize,
    n_local: usize,
    /// Weighted products of the derivatives with respect to all parameters, shared ones first; lower triangle.
    products: DMatrix<f64>,
    /// Half the gradient of the cost.
    gradient: DVector<f64>,
    pub(super) totals: Totals,
}

/// Sums over residuals that do not depend on the parameters' number.
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
    /// Sum over residual vectors of the mean derivative of the weighted residual with respect to the residual.
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
    pub(super) fn new(loss: Loss, n_shared: usize, n_local: usize) -> Self {
        let n = n_shared + n_local;
        let (products, gradient) = (DMatrix::zeros(n, n), DVector::zeros(n));
        Self { loss, n_shared, n_local, products, gradient, totals: Totals::default() }
    }

    /// Adds one residual vector with `D` components. The robust loss depends on its norm.
    ///
    /// * `derivatives`: per component, derivatives with respect to the shared parameters followed by those with respect
    ///   to the block's local parameters.
    ///
    /// # Panics
    /// If a row has another length.
    pub fn add<const D: usize>(&mut self, residual: [f64; D], derivatives: [&[f64]; D]) {
        let n = self.n_shared + self.n_local;
        let squared_norm = residual.iter().map(|value| value * value).sum::<f64>();
        let loss = self.loss.at(squared_norm);
        for (value, row) in residual.into_iter().zip(derivatives) {
            assert_eq!(row.len(), n, "one derivative per shared and local parameter");
            let products = self.products.as_mut_slice();
            for (column, derivative) in row.iter().enumerate() {
                let weighted = loss.weight * derivative;
                self.gradient[column] += weighted * value;
                let sums = &mut products[column * n + column..(column + 1) * n];
                for (sum, other) in sums.iter_mut().zip(&row[column..]) {
                    *sum += weighted * other;
                }
            }
        }
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

    /// Number of local parameters.
    pub fn n_local(&self) -> usize {
        self.n_local
    }

    /// Factor of the local part, damped. `None` if it is not positive definite.
    fn local_factor(&self, damping: f64) -> Option<Cholesky<f64, Dyn>> {
        let (first, n) = (self.n_shared, self.n_local);
        let mut local = self.products.view((first, first), (n, n)).into_owned();
        damp(&mut local, damping);
        Cholesky::new(local)
    }
}

/// Adds Marquardt's damping to the diagonal: a fraction of it.
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

/// The damped step that minimizes the quadratic model of the cost. `None` if a matrix is not positive definite.
pub(super) fn step(blocks: &[BlockSums], n_shared: usize, damping: f64) -> Option<Step> {
    let reduced = Reduced::new(blocks, n_shared, damping)?;
    let shared =
        -if n_shared == 0 { DVector::zeros(0) } else { Cholesky::new(reduced.matrix)?.solve(&reduced.gradient) };
    let (mut local, mut predicted) = (Vec::with_capacity(blocks.len()), 0.0);
    for (block, factor) in blocks.iter().zip(&reduced.factors) {
        let step = match factor {
            Some(factor) => {
                let cross = block.products.view((n_shared, 0), (block.n_local, n_shared));
                -factor.solve(&(block.gradient.rows(n_shared, block.n_local) + cross * &shared))
            }
            None => DVector::zeros(0),
        };
        for (ix, value) in shared.iter().chain(&step).enumerate() {
            predicted += 0.5 * value * (damping * block.products[(ix, ix)] * value - block.gradient[ix]);
        }
        local.push(step);
    }
    let is_finite = shared.iter().chain(local.iter().flatten()).all(|value| value.is_finite());
    is_finite.then_some(Step { shared, local, predicted })
}

/// Information about the shared parameters when the local ones are free: the Schur complement. Symmetric. Directions of
/// local parameters without information are left out.
pub(super) fn information(blocks: &[BlockSums], n_shared: usize) -> DMatrix<f64> {
    // A tiny damping keeps blocks whose local parameters are not determined from removing other blocks' information.
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

/// The normal equations of the shared parameters after elimination of the local ones.
struct Reduced {
    /// Lower triangle.
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Factors of the local parts; `None` for blocks without local parameters.
    factors: Vec<Option<Cholesky<f64, Dyn>>>,
}

impl Reduced {
    fn new(blocks: &[BlockSums], n_shared: usize, damping: f64) -> Option<Self> {
        let (mut matrix, mut gradient) = (DMatrix::zeros(n_shared, n_shared), DVector::zeros(n_shared));
        let mut factors = Vec::with_capacity(blocks.len());
        for block in blocks {
            matrix += block.products.view((0, 0), (n_shared, n_shared));
            gradient += block.gradient.rows(0, n_shared);
        }
        damp(&mut matrix, damping);
        for block in blocks {
            if block.n_local == 0 {
                factors.push(None);
                continue;
            }
            let factor = block.local_factor(damping)?;
            // With C = L L': B' inverse(C) B = (inverse(L) B)' (inverse(L) B).
            let mut cross = block.products.view((n_shared, 0), (block.n_local, n_shared)).into_owned();
            let mut local_gradient = block.gradient.rows(n_shared, block.n_local).into_owned();
            let lower = factor.l_dirty();
            if !lower.solve_lower_triangular_mut(&mut cross) || !lower.solve_lower_triangular_mut(&mut local_gradient) {
                return None;
            }
            matrix.gemm_tr(-1.0, &cross, &cross, 1.0);
            gradient.gemv_tr(-1.0, &cross, &local_gradient, 1.0);
            factors.push(Some(factor));
        }
        Some(Self { matrix, gradient, factors })
    }
}
