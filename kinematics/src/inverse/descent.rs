//! Descent to a configuration with a pose: damped least squares within the ranges of the joints.

use super::bounds::Bounds;
use super::least_squares::damped_change;
use super::target::Target;
use crate::{Chain, Transform};
use nalgebra::Vector6;

/// Largest remaining error of a solution. It combines radians, and meters relative to half the
/// arm's length. It is far below the repeatability of any arm, and far above the rounding of
/// forward kinematics.
pub(super) const TOLERANCE: f64 = 1e-7;
/// Damping that remains when the error is zero. It bounds the steps near singular configurations. A
/// larger value would slow down the last steps. With a smaller value, rounding errors would
/// determine the step in directions in which the matrix is nearly singular.
const MIN_DAMPING: f64 = 1e-9;
/// Number of steps after which progress is checked.
const CHECK_STEPS: usize = 8;

/// What a descent works on.
#[derive(Clone, Copy)]
pub(super) struct Problem<'a> {
    pub(super) chain: &'a Chain,
    pub(super) bounds: &'a Bounds,
    pub(super) target: &'a Target,
    /// Length whose motion counts as much as one radian.
    pub(super) meters_per_rad: f64,
}

/// Limits of a descent: number of steps, length of steps, and minimum progress.
#[derive(Clone, Copy, Debug)]
pub(super) struct Effort {
    pub(super) max_steps: usize,
    /// Largest step of one joint, radians or meters. The Jacobian is only valid near a
    /// configuration.
    pub(super) max_change: f64,
    /// The descent ends if the squared error is above this fraction of the squared error eight
    /// steps earlier.
    pub(super) stall_frac: f64,
}

impl Effort {
    /// Limits for a search from several starts. Slow descents end early, because most of them would
    /// end in a local minimum. A new start is faster. On the robots of `rigs/robots`, the search
    /// takes 19 instead of 35 steps per pose.
    pub(super) const SEARCH: Self = Self {
        max_steps: 100,
        max_change: 1.0,
        stall_frac: 0.3,
    };
    /// The descent continues until no step decreases the error, in order to end at the closest
    /// pose.
    pub(super) const THOROUGH: Self = Self {
        max_steps: 300,
        max_change: 0.3,
        stall_frac: 1.0 - 1e-6,
    };
    /// Short steps, with which the descent ends at a solution near the start.
    pub(super) const NEAR: Self = Self {
        max_steps: 100,
        max_change: 0.3,
        stall_frac: 1.0,
    };
}

impl Problem<'_> {
    /// The pose at `joints` and the columns of the part of the Jacobian that counts, in radians.
    pub(super) fn linearize(&self, joints: &[f64], columns: &mut [Vector6<f64>]) -> Transform {
        let base_from_tip = self.chain.forward_with_columns(joints, columns);
        self.target.remove_free(&base_from_tip, columns);
        for column in columns {
            self.scale(column);
        }
        base_from_tip
    }

    /// The error of a pose, in radians.
    pub(super) fn error(&self, base_from_tip: &Transform) -> Vector6<f64> {
        let mut error = self.target.error(base_from_tip);
        self.scale(&mut error);
        error
    }

    /// Converts meters to radians.
    fn scale(&self, motion: &mut Vector6<f64>) {
        let linear = motion.fixed_rows::<3>(0) / self.meters_per_rad;
        motion.fixed_rows_mut::<3>(0).copy_from(&linear);
    }
}

/// Buffers of descents, so that their steps do not allocate.
#[derive(Clone, Debug)]
pub(super) struct Descent {
    columns: Vec<Vector6<f64>>,
    trial: Vec<f64>,
    trial_columns: Vec<Vector6<f64>>,
    /// The columns of the Jacobian. The columns of joints that are held at the ends of their ranges
    /// are 0.
    free_columns: Vec<Vector6<f64>>,
    change: Vec<f64>,
}

impl Descent {
    pub(super) fn new(n_joints: usize) -> Self {
        Self {
            columns: vec![Vector6::zeros(); n_joints],
            trial: vec![0.0; n_joints],
            trial_columns: vec![Vector6::zeros(); n_joints],
            free_columns: vec![Vector6::zeros(); n_joints],
            change: vec![0.0; n_joints],
        }
    }

    /// Moves `joints`, which must be within the ranges, toward the target. Returns the remaining
    /// error, which is below [`TOLERANCE`] if the target is reached.
    ///
    /// Uses Levenberg-Marquardt steps whose damping is the squared error of the pose. Joints that
    /// would leave their ranges stay at the ends for the rest of the step.
    ///
    /// Source: Sugihara 2011, "Solvability-unconcerned inverse kinematics by the
    /// Levenberg-Marquardt method", section III.
    pub(super) fn run(&mut self, problem: Problem<'_>, effort: Effort, joints: &mut [f64]) -> f64 {
        let pose = problem.linearize(joints, &mut self.columns);
        let mut error = problem.error(&pose);
        let mut extra_damping = 1.0;
        let mut checked = f64::INFINITY;
        for step in 0..effort.max_steps {
            let squared = error.norm_squared();
            if squared < TOLERANCE * TOLERANCE {
                break;
            }
            if step % CHECK_STEPS == 0 {
                if squared > effort.stall_frac * checked {
                    break;
                }
                checked = squared;
            }
            // Sugihara's damping decreases with the squared error. Far from the target, where the
            // linear model is wrong, steps are short and safe. Close to the target, they are Newton
            // steps and converge quickly.
            let damping = extra_damping * 0.5 * squared + MIN_DAMPING;
            self.choose_change(problem.bounds, joints, &error, damping);
            self.try_change(problem.bounds, joints, effort.max_change);
            let pose = problem.linearize(&self.trial, &mut self.trial_columns);
            let trial_error = problem.error(&pose);
            // The factor on the damping comes from Levenberg and Marquardt. A step that increases
            // the error is discarded and tried again with more damping. The lower bound keeps the
            // factor large enough to react. The upper bound ends the search if no step improves the
            // pose.
            if trial_error.norm_squared() < squared {
                joints.copy_from_slice(&self.trial);
                std::mem::swap(&mut self.columns, &mut self.trial_columns);
                error = trial_error;
                extra_damping = f64::max(0.2 * extra_damping, 1e-6);
            } else if extra_damping < 1e6 {
                extra_damping *= 10.0;
            } else {
                break;
            }
        }
        error.norm()
    }

    /// Computes the damped step of the joints that may move.
    fn choose_change(
        &mut self,
        bounds: &Bounds,
        joints: &[f64],
        error: &Vector6<f64>,
        damping: f64,
    ) {
        self.free_columns.copy_from_slice(&self.columns);
        // Every round removes a joint, except the last.
        loop {
            damped_change(&self.free_columns, error, damping, &mut self.change);
            let mut is_complete = true;
            for (joint_ix, value) in joints.iter().enumerate() {
                // Joints that are at an end of their range and would move beyond it are left out,
                // and the step is computed with the other joints. The change of an omitted joint is 0.
                if bounds.would_leave(joint_ix, *value, self.change[joint_ix]) {
                    self.free_columns[joint_ix] = Vector6::zeros();
                    is_complete = false;
                }
            }
            if is_complete {
                return;
            }
        }
    }

    /// Applies the step to a copy of the joints. All joints are scaled by the same factor, so that
    /// the direction of the step stays the same.
    fn try_change(&mut self, bounds: &Bounds, joints: &[f64], max_change: f64) {
        let longest = self
            .change
            .iter()
            .fold(0.0f64, |longest, change| longest.max(change.abs()));
        let scale = if longest > max_change {
            max_change / longest
        } else {
            1.0
        };
        for (joint_ix, value) in joints.iter().enumerate() {
            // A joint that was not at an end may still cross it. The joint then stops at this end,
            // and the next step leaves the joint out if necessary.
            self.trial[joint_ix] = bounds.clamp(joint_ix, value + scale * self.change[joint_ix]);
        }
    }
}
