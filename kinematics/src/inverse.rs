//! Inverse kinematics: joint values that give the tip a pose.

use crate::{Chain, Error, Transform};
use nalgebra::{Matrix6, Matrix6xX, Vector6};

/// Maximum number of steps. From a start within half a radian, about ten are enough; more are
/// needed only near singular configurations and bounds.
const MAX_STEPS: usize = 100;
/// Largest remaining error of the pose, meters and radians. It is far below the repeatability of
/// any arm, and far above the rounding errors of forward kinematics.
const TOLERANCE: f64 = 1e-7;
/// Damping that remains when the error is zero; it bounds the steps near singular configurations. A
/// larger value would slow down the last steps. With a smaller value, rounding errors would
/// determine the step in directions in which the matrix is nearly singular.
const MIN_DAMPING: f64 = 1e-9;
/// Largest step of one joint, radians or meters. The Jacobian is only valid near a configuration.
const MAX_STEP: f64 = 0.3;

impl Chain {
    /// Joint values near `start` for which the tip has the pose `base_from_tip`. `None` if none are
    /// found within the bounds. With more than six joints, the solution is the closest one that the
    /// steps reach.
    ///
    /// * `bounds`: lower and upper bound of each joint.
    ///
    /// Uses Levenberg-Marquardt steps whose damping is the squared error of the pose. Joints that
    /// would leave their bounds stay at them for the rest of the step.
    ///
    /// Source: Sugihara 2011, "Solvability-unconcerned inverse kinematics by the
    /// Levenberg-Marquardt method", section III.
    ///
    /// # Errors
    /// If `start` or `bounds` do not have one finite value per joint (bounds may be infinite).
    pub fn inverse(
        &self,
        base_from_tip: &Transform,
        start: &[f64],
        bounds: &[[f64; 2]],
    ) -> Result<Option<Vec<f64>>, Error> {
        if bounds.len() != self.n_joints() {
            return Err(Error::JointCount {
                got: bounds.len(),
                expected: self.n_joints(),
                joints: self.joint_names().to_vec(),
            });
        }
        // Bounds that are in the wrong order contain no value.
        let clamped = |value: f64, [lower, upper]: [f64; 2]| value.max(lower).min(upper);
        let mut q: Vec<f64> = start
            .iter()
            .zip(bounds)
            .map(|(value, bound)| clamped(*value, *bound))
            .collect();
        // The pose of `start` is computed even if the clamped values differ, because `forward`
        // rejects wrong lengths and NaN. NaN values no longer appear after clamping, because
        // clamping turns NaN into a bound.
        let mut error = pose_error(base_from_tip, &self.forward(start)?);
        if q != start {
            error = pose_error(base_from_tip, &self.forward(&q)?);
        }
        let mut extra_damping = 1.0;
        for _ in 0..MAX_STEPS {
            if error.norm() < TOLERANCE {
                return Ok(Some(q));
            }
            // Sugihara's damping decreases with the squared error. Far from the target, where the
            // linear model is wrong, steps are short and safe. Close to the target, they are Newton
            // steps and converge quickly.
            let damping = extra_damping * 0.5 * error.norm_squared() + MIN_DAMPING;
            let next = self.step(&q, &error, damping, bounds)?;
            let next_error = pose_error(base_from_tip, &self.forward(&next)?);
            // The factor on the damping comes from Levenberg and Marquardt: a step that increases
            // the error is discarded and tried again with more damping. The lower bound keeps the
            // factor large enough to react. The upper bound ends the search if no step improves the
            // pose.
            if next_error.norm() < error.norm() {
                (q, error) = (next, next_error);
                extra_damping = f64::max(0.2 * extra_damping, 1e-6);
            } else if extra_damping < 1e6 {
                extra_damping *= 10.0;
            } else {
                break;
            }
        }
        Ok(None)
    }

    /// One damped step within the bounds.
    fn step(
        &self,
        q: &[f64],
        error: &Vector6<f64>,
        damping: f64,
        bounds: &[[f64; 2]],
    ) -> Result<Vec<f64>, Error> {
        let mut jacobian = self.jacobian(q)?;
        loop {
            let change = damped_change(&jacobian, error, damping);
            let longest = change
                .iter()
                .fold(0.0f64, |longest, value| longest.max(value.abs()));
            // All joints are scaled by the same factor, so that the direction of the step stays the
            // same.
            let scale = if longest > MAX_STEP {
                MAX_STEP / longest
            } else {
                1.0
            };
            let moved: Vec<f64> = q
                .iter()
                .zip(&change)
                .map(|(value, change)| value + scale * change)
                .collect();
            // Joints that are at a bound and would leave it are removed, and the others take over.
            let is_stuck = |ix: usize| {
                let [lower, upper] = bounds[ix];
                (q[ix] <= lower && moved[ix] < lower) || (q[ix] >= upper && moved[ix] > upper)
            };
            let stuck: Vec<usize> = (0..q.len())
                .filter(|ix| is_stuck(*ix) && jacobian.column(*ix).norm() > 0.0)
                .collect();
            if stuck.is_empty() {
                let clamped = moved
                    .iter()
                    .zip(bounds)
                    .map(|(value, [lower, upper])| value.max(*lower).min(*upper));
                // A joint may still cross a bound that it was not at. It then ends at the bound,
                // and the next step leaves it out if necessary.
                return Ok(clamped.collect());
            }
            stuck
                .into_iter()
                .for_each(|ix| jacobian.column_mut(ix).fill(0.0));
        }
    }
}

fn damped_change(jacobian: &Matrix6xX<f64>, error: &Vector6<f64>, damping: f64) -> Vec<f64> {
    let square: Matrix6<f64> = jacobian * jacobian.transpose() + Matrix6::identity() * damping;
    // `J^T (J J^T + d 1)^-1 e` is the 6 x 6 form of the damped least-squares step, for any number
    // of joints.
    match square.cholesky() {
        Some(factor) => (jacobian.transpose() * factor.solve(error))
            .iter()
            .copied()
            .collect(),
        // The damped matrix is positive definite unless its elements overflow. No step means no
        // improvement, which ends the search.
        None => vec![0.0; jacobian.ncols()],
    }
}

/// Translation and rotation from the actual pose to the target, in base axes.
fn pose_error(target: &Transform, actual: &Transform) -> Vector6<f64> {
    let translation = target.translation.vector - actual.translation.vector;
    let rotation = (target.rotation * actual.rotation.inverse()).scaled_axis();
    Vector6::new(
        translation.x,
        translation.y,
        translation.z,
        rotation.x,
        rotation.y,
        rotation.z,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    const PANDA: &str = include_str!("../tests/data/panda.urdf");
    const REST: [f64; 7] = [0.0, -0.3, 0.0, -2.2, 0.0, 2.2, 0.8];

    fn panda() -> (Chain, Vec<[f64; 2]>) {
        let chain = Chain::from_urdf(PANDA, "link0", "link8").unwrap();
        let bounds = chain
            .limits()
            .iter()
            .map(|limit| [limit.lower, limit.upper])
            .collect();
        (chain, bounds)
    }

    fn distance(chain: &Chain, q: &[f64], target: &Transform) -> f64 {
        pose_error(target, &chain.forward(q).unwrap()).norm()
    }

    #[test]
    fn poses_near_the_start_are_reached_within_the_limits() {
        let (chain, bounds) = panda();
        let start = chain.forward(&REST).unwrap();
        for ix in 0..60 {
            let value = |salt: usize| ((ix * 11 + salt * 5 + 2) as f64 * 1.3).sin();
            let translation = Vector3::new(value(0), value(1), value(2)) * 0.12;
            let rotation = Vector3::new(value(3), value(4), value(5)) * 0.45;
            let target = start * Transform::new(translation, rotation);
            let found = chain
                .inverse(&target, &REST, &bounds)
                .unwrap()
                .expect("the pose is reachable");
            assert!(distance(&chain, &found, &target) < 1e-6);
            let is_inside = found
                .iter()
                .zip(&bounds)
                .all(|(q, [lower, upper])| (*lower..=*upper).contains(q));
            let largest = found
                .iter()
                .zip(&REST)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max);
            assert!(is_inside && largest < 2.0, "{found:?}");
        }
    }

    #[test]
    fn joints_at_their_bounds_stay_there_and_others_take_over() {
        let (chain, mut bounds) = panda();
        let target = chain.forward(&REST).unwrap()
            * Transform::new(Vector3::new(0.02, 0.0, 0.0), Vector3::z() * 0.1);
        let free = chain
            .inverse(&target, &REST, &bounds)
            .unwrap()
            .expect("reachable");
        assert!(
            (free[0] - REST[0]).abs() > 1e-3,
            "the joint moves if it may"
        );
        bounds[0] = [REST[0], REST[0]];
        let held = chain
            .inverse(&target, &REST, &bounds)
            .unwrap()
            .expect("six joints are left");
        assert_eq!(held[0], REST[0]);
        assert!(distance(&chain, &held, &target) < 1e-6);
        bounds[2] = bounds[0];
        bounds[4] = bounds[0];
        assert_eq!(
            chain.inverse(&target, &REST, &bounds).unwrap(),
            None,
            "four joints are not enough"
        );
    }

    #[test]
    fn singular_and_distant_poses_do_not_diverge() {
        let (chain, bounds) = panda();
        let stretched = [0.0, 0.0, 0.0, -0.0698, 0.0, 1.6, 0.8];
        let reachable = chain.forward(&stretched).unwrap();
        if let Some(found) = chain.inverse(&reachable, &REST, &bounds).unwrap() {
            assert!(distance(&chain, &found, &reachable) < 1e-6);
        }
        let distant = Transform::translation(3.0, 0.0, 0.0);
        assert_eq!(chain.inverse(&distant, &REST, &bounds).unwrap(), None);
        assert_eq!(
            chain
                .inverse(&reachable, &stretched, &bounds)
                .unwrap()
                .as_deref(),
            Some(&stretched[..])
        );
    }

    #[test]
    fn wrong_numbers_of_values_are_rejected() {
        let (chain, bounds) = panda();
        let pose = Transform::identity();
        assert!(chain.inverse(&pose, &REST[..3], &bounds).is_err());
        assert!(chain.inverse(&pose, &[f64::NAN; 7], &bounds).is_err());
        let error = chain
            .inverse(&pose, &REST, &bounds[..3])
            .unwrap_err()
            .to_string();
        assert!(
            error.starts_with("3 joint values given, the chain has 7"),
            "{error}"
        );
    }
}
