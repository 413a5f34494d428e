//! Schedule of the trials that double the number of splats while images arrive.
//!
//! The trials run while the model grows, so the number of splats rises only as long as this
//! improves the scores of validation images. Models with few splats converge sooner, so an early
//! trial may reject a useful doubling. Rejected doublings are therefore tried again after more
//! training, and when many images are new.

use super::schedule::GROWTH_PERIOD;
use super::trial_steps::TrialSteps;
use serde::{Deserialize, Serialize};

/// A rejected doubling is tried again at this multiple of the step at which it was rejected. The
/// intervals grow, because the longer a model has converged, the less likely the result changes.
const RETRY_FACTOR: f64 = 1.5;
/// Maximum share of the planned steps, or of the steps so far if these are more, that are spent on
/// the discarded halves of trials. These steps are missing from training: a larger share finds the
/// number of splats sooner, but makes the model worse at every time before that.
const MAX_SHARE: f64 = 0.15;
/// The search for the number of splats restarts when this share of the images is new. With a
/// smaller share, the model would hardly ever be reduced while images arrive.
const NEW_SHARE: f64 = 0.25;

/// Schedule of the trials.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Doubling {
    /// Step before which no trial starts.
    not_before: u64,
    /// Number of trials so far.
    n_trials: u64,
    /// Number of images at the last restart.
    n_images: usize,
}

impl Doubling {
    /// Whether a trial may start at `step`. Trials start only at multiples of [`GROWTH_PERIOD`],
    /// where submits end.
    pub(crate) fn is_due(&self, step: u64, n_planned_steps: u64, steps: &TrialSteps) -> bool {
        // One half of each trial is discarded, whatever the result. The first trial is always run:
        // without it, short trainings would never grow beyond the first steps.
        let max_discarded = MAX_SHARE * step.max(n_planned_steps) as f64;
        let is_affordable = self.n_trials == 0
            || ((self.n_trials + 1) * steps.doubling_half) as f64 <= max_discarded;
        step >= steps.first_doubling.max(self.not_before)
            && step.is_multiple_of(GROWTH_PERIOD)
            && is_affordable
    }

    /// Counts a trial that starts.
    pub(crate) fn begin(&mut self) {
        self.n_trials += 1;
    }

    /// Postpones the next trial after a rejection at `step`.
    pub(crate) fn reject(&mut self, step: u64) {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a multiple of a step"
        )]
        let retry = (RETRY_FACTOR * step as f64) as u64;
        self.not_before = retry;
    }

    /// Whether the search must restart, because many of the `n_images` images are new. If so,
    /// allows the next trial.
    pub(crate) fn restart(&mut self, n_images: usize) -> bool {
        // After resuming, images are pushed again one by one, so their number may be smaller than
        // the saved one for a while.
        let n_new = n_images.saturating_sub(self.n_images);
        let is_due = n_new > 0 && n_new as f64 >= NEW_SHARE * n_images as f64;
        if is_due {
            // With new images, an earlier rejection says little.
            self.not_before = 0;
            self.n_images = n_images;
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const N_PLANNED: u64 = 7000;

    fn steps() -> TrialSteps {
        TrialSteps::default()
    }

    #[test]
    fn trials_take_a_limited_share_of_the_steps() {
        let mut doubling = Doubling::default();
        let mut due_at = |range: std::ops::Range<u64>| {
            let mut n = 0;
            for step in range {
                if doubling.is_due(step, N_PLANNED, &steps()) {
                    doubling.begin();
                    n += 1;
                }
            }
            n
        };
        assert_eq!(due_at(0..steps().first_doubling), 0);
        assert_eq!(
            due_at(steps().first_doubling..N_PLANNED),
            3,
            "15 % of the planned steps"
        );
        assert_eq!(
            due_at(N_PLANNED..4 * N_PLANNED),
            10,
            "15 % of the steps so far"
        );
        assert!(
            Doubling::default().is_due(900, 1000, &steps()),
            "one trial is always affordable"
        );
    }

    #[test]
    fn rejected_doubling_is_retried_after_more_training_or_with_new_images() {
        let mut doubling = Doubling::default();
        assert!(doubling.restart(40));
        doubling.reject(1000);
        let is_due = |doubling: &Doubling, step| doubling.is_due(step, N_PLANNED, &steps());
        assert_eq!(
            [1000, 1400, 1500, 1550].map(|step| is_due(&doubling, step)),
            [false, false, true, false]
        );
        assert!((1..=53).all(|n_images| !doubling.restart(n_images)) && !is_due(&doubling, 1000));
        assert!(doubling.restart(54) && is_due(&doubling, 1000));
        assert!(!doubling.restart(54), "no image is new");
    }
}
