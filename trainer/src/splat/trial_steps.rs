//! The steps at which parts of the model are tested, and the number of steps of a test.

use serde::{Deserialize, Serialize};

/// The steps at which trials start, and the number of steps that they take.
///
/// These values are options instead of constants, so that a checkpoint keeps them, and so that
/// tests can use fewer steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialSteps {
    /// Step of the first trial. Before this step, the model is too coarse for a decision.
    pub first_trial: u64,
    /// Steps of each half of a trial.
    pub trial_half: u64,
    /// Steps per image in each half of a trial of per-image parameters. They apply if they add up
    /// to more than [`Self::trial_half`].
    pub per_image: u64,
    /// Maximum number of steps of each half of a trial.
    pub max_trial_half: u64,
}

impl Default for TrialSteps {
    fn default() -> Self {
        Self {
            first_trial: 500,
            // This number is large enough for the optimizer to settle after the change. It is also
            // small enough that a trial does not cost much, although one of its halves is
            // discarded. A change that improves the model only later is rejected.
            trial_half: 250,
            // A pose of an image changes only in steps on this image.
            per_image: 4,
            max_trial_half: 1200,
        }
    }
}
