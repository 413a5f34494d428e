//! When parts of the model are tested, and for how long.

use super::schedule::GROWTH_PERIOD;
use serde::{Deserialize, Serialize};

/// Steps at which trials and searches start, and how many steps they take.
///
/// They are options, not constants, so that a checkpoint keeps them, and so that tests can use
/// fewer steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialSteps {
    /// Step of the first trial. Before this step, the model is too coarse for a decision.
    pub first_trial: u64,
    /// Steps of each half of a trial.
    pub trial_half: u64,
    /// Steps per image in each half of a trial of per-image parameters, if these are more than
    /// [`Self::trial_half`].
    pub per_image: u64,
    /// Maximum number of steps of each half of a trial.
    pub max_trial_half: u64,
    /// Step of the first trial that doubles the number of splats while images arrive. Before it,
    /// the number grows without trials.
    pub first_doubling: u64,
    /// Steps of each half of a trial that doubles the number of splats. Both halves end just before
    /// a densification step, which would lower the scores for some steps.
    pub doubling_half: u64,
    /// Step at which the search for the number of splats for few images starts. Earlier, the models
    /// are too coarse for a decision. The models of folds are trained for at most twice as many
    /// steps before the first comparison.
    pub search: u64,
    /// Steps that the model on all images is trained for between a change of the images and the
    /// search.
    pub search_pause: u64,
    /// Steps that train each of the two models of a comparison.
    pub comparison: u64,
}

impl Default for TrialSteps {
    fn default() -> Self {
        Self {
            first_trial: 500,
            // Long enough for the optimizer to settle after the change, and short enough that a
            // trial, whose losing half is discarded, does not cost much. A change that pays only
            // later is rejected.
            trial_half: 250,
            // A pose of an image changes only in steps on this image.
            per_image: 4,
            max_trial_half: 1200,
            // After six changes of the splat count, so that the model has grown by more than half.
            first_doubling: 800,
            // Three periods, because a doubling needs time until the new splats have found their
            // places.
            doubling_half: 3 * GROWTH_PERIOD,
            // The same steps as above, for few images.
            search: 800,
            search_pause: 500,
            comparison: 250,
        }
    }
}

impl TrialSteps {
    /// Maximum number of steps that train the model of a fold before the first comparison.
    pub(crate) fn max_warm_up(&self) -> u64 {
        2 * self.search
    }
}
