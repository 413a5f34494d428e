//! Robust nonlinear least squares with shared parameters and local parameters per block.
//!
//! The method is Levenberg-Marquardt (Marquardt 1963) with the damping schedule of Nielsen 1999.
//! Robust losses are minimized by iteratively reweighted least squares. Local parameters, such as
//! the pose of one view, are eliminated by a Schur complement (Triggs et al. 2000, section 6.1).
//! The time of a step therefore grows linearly with the number of blocks. Without local parameters,
//! the solver is dense.

mod fit;
mod loss;
mod normal_equations;
#[cfg(test)]
mod tests;

pub(crate) use fit::sigma_of;
pub use fit::{Direction, Fit};
pub use loss::Loss;
pub use normal_equations::BlockSums;

use crate::Error;
use nalgebra::DVector;
use normal_equations::Totals;

/// A least-squares problem. The residuals of a block depend on the shared parameters and on the
/// local parameters of the block.
pub trait Problem {
    /// Values of all parameters.
    type State: Clone;

    /// Typical magnitude of each shared parameter. All values are positive. A change of a parameter
    /// by this value is large. The length of the vector is the number of shared parameters.
    fn scales(&self) -> DVector<f64>;

    /// Number of blocks.
    fn n_blocks(&self) -> usize;

    /// Number of local parameters of a block. It is 0 for residuals that depend only on shared
    /// parameters.
    fn n_local(&self, block_ix: usize) -> usize;

    /// Adds the residuals of a block and their derivatives with respect to a small step from this
    /// state. Returns `None` if a residual is not defined, for example because a point lies behind
    /// the camera.
    fn evaluate(&self, state: &Self::State, block_ix: usize, sums: &mut BlockSums) -> Option<()>;

    /// The state after a step.
    ///
    /// * `local`: one vector per block.
    fn moved(
        &self,
        state: &Self::State,
        shared: &DVector<f64>,
        local: &[DVector<f64>],
    ) -> Self::State;
}

/// Settings of [`minimize`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Loss of the residual vectors.
    pub loss: Loss,
    /// Maximum number of steps, including rejected steps.
    pub max_steps: usize,
    /// The minimization ends if a step is predicted to decrease the cost by less than this
    /// fraction.
    pub tolerance: f64,
    /// Lower limit of the residuals' standard deviation, in units of the residuals. It limits the
    /// stated accuracy if the residuals are smaller than the errors of any real measurement. It
    /// also determines which steps are negligible.
    pub min_noise: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            loss: Loss::Squared,
            max_steps: 100,
            tolerance: 1e-12,
            min_noise: 1e-9,
        }
    }
}

/// Minimizes the sum of the losses from an initial state.
///
/// # Errors
/// Fails if a residual is not defined at the initial state, or if there are not more residuals than
/// parameters.
pub fn minimize<P: Problem>(
    problem: &P,
    initial: P::State,
    options: &Options,
) -> Result<Fit<P::State>, Error> {
    // Damping of the first step, relative to the diagonal. Initial states are close to the
    // solution, so the first step is almost a Gauss-Newton step.
    const INITIAL_DAMPING: f64 = 1e-4;
    // Below the rounding of the diagonal, damping has no effect.
    const MIN_DAMPING: f64 = 1e-15;
    // With more damping, steps are too short to change the parameters, so the cost cannot decrease
    // further.
    const MAX_DAMPING: f64 = 1e12;
    let scales = problem.scales();
    let n_shared = scales.len();
    let mut at = Evaluation::new(problem, initial, options.loss)
        .map_err(|block_ix| Error::UndefinedResidual { block_ix })?;
    let n_params = n_shared + at.blocks.iter().map(BlockSums::n_local).sum::<usize>();
    if at.totals.n_scalars <= n_params {
        return Err(Error::TooFewResiduals {
            n_residuals: at.totals.n_scalars,
            n_params,
        });
    }
    let noise_floor = at.totals.n_scalars as f64 * options.min_noise.powi(2);
    let mut damping = INITIAL_DAMPING;
    let mut growth = 2.0;
    let mut converged = false;
    let mut n_steps = 0;
    while n_steps < options.max_steps && !converged && damping < MAX_DAMPING {
        n_steps += 1;
        let trial = normal_equations::step(&at.blocks, n_shared, damping).and_then(|step| {
            converged = step.predicted <= options.tolerance * 0.5 * (at.totals.loss + noise_floor);
            let state = problem.moved(&at.state, &step.shared, &step.local);
            let trial = Evaluation::new(problem, state, options.loss).ok()?;
            let gain = 0.5 * (at.totals.loss - trial.totals.loss) / step.predicted;
            (trial.totals.loss < at.totals.loss).then_some((trial, gain))
        });
        match trial {
            // The next step gets less damping if the model has predicted the decrease well.
            Some((trial, gain)) => {
                at = trial;
                damping =
                    (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 10.0)).max(MIN_DAMPING);
                growth = 2.0;
            }
            // The step failed or increased the cost. Damping grows faster with every failure.
            None => {
                damping *= growth;
                growth *= 2.0;
            }
        }
    }
    Ok(fit::fit(
        at,
        &scales,
        n_params,
        options,
        Progress { converged, n_steps },
    ))
}

/// How the minimization ended.
struct Progress {
    converged: bool,
    n_steps: usize,
}

/// The problem at one state.
struct Evaluation<S> {
    state: S,
    blocks: Vec<BlockSums>,
    totals: Totals,
}

impl<S: Clone> Evaluation<S> {
    /// # Errors
    /// Returns the block with a residual that is not defined.
    fn new<P: Problem<State = S>>(problem: &P, state: S, loss: Loss) -> Result<Self, usize> {
        let n_shared = problem.scales().len();
        let mut blocks = Vec::with_capacity(problem.n_blocks());
        let mut totals = Totals::default();
        for block_ix in 0..problem.n_blocks() {
            let mut sums = BlockSums::new(loss, n_shared, problem.n_local(block_ix));
            problem
                .evaluate(&state, block_ix, &mut sums)
                .ok_or(block_ix)?;
            if !sums.totals.loss.is_finite() {
                return Err(block_ix);
            }
            totals.add(&sums.totals);
            blocks.push(sums.summed());
        }
        Ok(Self {
            state,
            blocks,
            totals,
        })
    }
}
