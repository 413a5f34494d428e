//! Inverse kinematics as the chain of decisions needs it.

use kinematics::inverse::{InverseSolver, Target};
use kinematics::{Chain, Transform};

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

impl InverseKinematics for Chain {
    fn solve(
        &self,
        base_from_tip: &Transform,
        start: &[f64],
        bounds: &[[f64; 2]],
    ) -> Option<Vec<f64>> {
        // The bounds are valid, so an error only means that there is no solution.
        let mut solver = InverseSolver::within(self.clone(), bounds.to_vec()).ok()?;
        let target = Target::pose(*base_from_tip);
        solver.solve_near(&target, start).ok()
    }
}
