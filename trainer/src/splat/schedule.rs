//! The training schedule: progress, and the steps at which the splat count and the SH degree
//! change.

/// Steps between changes of the splat count, as in Kerbl et al. 2023.
///
/// Each change restarts Adam moments and lowers the scores for some tens of steps
/// (docs/benchmarks/2026-11-23-splats.md). With a shorter period, there is no time to recover. A
/// longer period delays growth.
pub(crate) const GROWTH_PERIOD: u64 = 100;
/// Step of the first change of the splat count. Before it, the error sums that select parents
/// reflect mainly the initial colors.
const GROWTH_START: u64 = 200;
/// Fraction of the planned steps after which the splat count stays constant. The remaining steps
/// refine the splats and test smaller models.
const GROWTH_END_FRAC: f64 = 0.75;
/// Steps between increases of the active SH degree. If all degrees were active from the start,
/// view-dependent colors could explain errors of the geometry. Kerbl et al. 2023 raise the degree
/// every 1000 of 30 000 steps.
const SH_PERIOD: u64 = 300;
/// Maximum SH degree that the kernels evaluate, as in Kerbl et al. 2023.
const MAX_SH_DEGREE: u64 = 3;

/// Position in the training schedule.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    /// Optimizer updates so far.
    pub(super) step: u64,
    /// Step at which the planned steps begin. A keyframe that arrives late moves this step forward.
    pub(super) start: u64,
    pub(super) last_growth_step: u64,
    pub(super) n_planned_steps: u64,
}

impl Schedule {
    /// The start of training.
    pub(super) fn new(n_planned_steps: u64) -> Self {
        Self {
            step: 0,
            start: 0,
            last_growth_step: 0,
            n_planned_steps,
        }
    }

    /// Moves the planned steps forward when a keyframe arrives, so that at least half of the
    /// planned steps remain. This keeps the learning rates large enough for the new keyframe and
    /// continues growth.
    pub(super) fn extend_for_arrival(&mut self) {
        self.start = self
            .start
            .max(self.step.saturating_sub(self.n_planned_steps / 2));
    }

    /// Step at which growth ends.
    fn growth_end(&self) -> u64 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a fraction of a u64"
        )]
        let n_growth_steps = (GROWTH_END_FRAC * self.n_planned_steps as f64) as u64;
        // Submits end at these steps, so the end takes effect at an exact step.
        (self.start + n_growth_steps).next_multiple_of(GROWTH_PERIOD)
    }

    /// Whether growth has ended.
    pub(super) fn is_mature(&self) -> bool {
        self.step >= self.growth_end()
    }

    /// Whether the splat count changes at the current step.
    pub(super) fn is_growth_due(&self) -> bool {
        // The count changes before a step is trained, and a failed submit may lead to the same step
        // again. The step of the last change is therefore compared with the current step.
        self.step >= GROWTH_START
            && !self.is_mature()
            && self.step.is_multiple_of(GROWTH_PERIOD)
            && self.last_growth_step != self.step
    }

    /// Steps until the splat count or the active degree may change.
    pub(super) fn steps_to_next_change(&self) -> u64 {
        GROWTH_PERIOD - self.step % GROWTH_PERIOD
    }

    /// SH degree to train at the current step, unless the model has a lower degree.
    pub(super) fn active_degree(&self) -> u32 {
        u32::try_from((self.step / SH_PERIOD).min(MAX_SH_DEGREE)).expect("at most 3")
    }

    /// Completed fraction of the planned steps at the last multiple of [`GROWTH_PERIOD`]. Values
    /// that are set once per submit use this fraction, because the first step of a submit depends
    /// on timing.
    pub(super) fn completed_frac(&self) -> f64 {
        let step = self.step - self.step % GROWTH_PERIOD;
        step.saturating_sub(self.start) as f64 / self.n_planned_steps.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_counts_from_the_start_in_whole_periods() {
        let at = |step| {
            Schedule {
                step,
                start: 1000,
                ..Schedule::new(4000)
            }
            .completed_frac()
        };
        assert_eq!(
            [at(500), at(1000), at(1199), at(1200), at(5000)],
            [0.0, 0.0, 0.025, 0.05, 1.0]
        );
    }

    #[test]
    fn sh_degree_rises_to_three() {
        let at = |step| {
            Schedule {
                step,
                ..Schedule::new(4000)
            }
            .active_degree()
        };
        assert_eq!(
            [0, 299, 300, 600, 899, 900, 5000].map(at),
            [0, 0, 1, 2, 2, 3, 3]
        );
    }
}
