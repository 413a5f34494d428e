//! Inverse kinematics as the chain of decisions needs it.

use kinematics::inverse::{InverseSolver, Target};
use kinematics::{Chain, Transform};
use std::cell::RefCell;

/// Finds joint values for a pose.
pub trait InverseKinematics {
    /// Joint values close to `start` for which the tip has a pose. `None` if there are none within
    /// the bounds.
    ///
    /// The result must depend on the arguments only, so that a record can be replayed.
    ///
    /// * `base_from_tip`: pose of the tip.
    /// * `start`: finite joint values within the bounds.
    /// * `bounds`: lower and upper bound of each joint.
    fn solve(
        &self,
        base_from_tip: &Transform,
        start: &[f64],
        bounds: &[[f64; 2]],
    ) -> Option<Vec<f64>>;
}

/// Short steps of damped least squares, for any chain.
#[derive(Debug)]
pub struct NearestPosture {
    chain: Chain,
    /// The solver for the newest bounds. They rarely change, and a new solver allocates.
    solver: RefCell<Option<(Vec<[f64; 2]>, InverseSolver)>>,
}

impl NearestPosture {
    /// * `chain`: chain from the base to the tip.
    pub fn new(chain: Chain) -> Self {
        Self {
            chain,
            solver: RefCell::new(None),
        }
    }
}

impl InverseKinematics for NearestPosture {
    fn solve(
        &self,
        base_from_tip: &Transform,
        start: &[f64],
        bounds: &[[f64; 2]],
    ) -> Option<Vec<f64>> {
        let mut kept = self.solver.borrow_mut();
        if kept.as_ref().is_none_or(|(of, _)| of != bounds) {
            let solver = InverseSolver::within(self.chain.clone(), bounds.to_vec()).ok()?;
            *kept = Some((bounds.to_vec(), solver));
        }
        let (_, solver) = kept.as_mut()?;
        // The bounds are valid, so an error only means that there is no solution.
        solver.solve_near(&Target::pose(*base_from_tip), start).ok()
    }
}
