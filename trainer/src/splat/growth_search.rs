//! Cross-validation that limits the number of splats if there are few images.
//!
//! With few images, models with many splats overfit: beyond some number, the scores of other views
//! fall while those of the training images still rise. There are too few images for a validation
//! set, so the number is limited by cross-validation. For each fold, a new model is trained on the
//! images of the other folds. It is then trained further with the same and with twice the number of
//! splats, and both results are scored on the images of the fold. If doubling improves the mean
//! score, the search continues from the doubled models. Training on all images is paused meanwhile.

use super::snapshot::Snapshot;
use super::trial_steps::TrialSteps;
use super::trials::ImageId;
use calibration::{Candidate, Trial};
use serde::{Deserialize, Serialize};

/// From this number of images on, the number of splats is not limited.
///
/// The measured data sets with few images have 6, 11 and 36 of them, those with many 43 and more
/// (docs/benchmarks/2026-11-25-few-images.md). A larger value costs the time of a search where no
/// limit is needed.
pub(crate) const FEW_IMAGES: usize = 40;
/// Maximum number of folds. Each fold trains a model from the start, so more folds take more time.
/// With fewer folds, each model is trained on a smaller part of the images than the final model.
const MAX_FOLDS: usize = 3;
/// A new search starts when the number of images has grown by this factor. A smaller factor repeats
/// the search more often, and a larger one keeps a limit that is too low for the new images.
const NEW_SEARCH_GROWTH: f64 = 1.25;

/// State of the search.
#[derive(Debug)]
pub(crate) enum GrowthSearch {
    /// The number of splats is not limited.
    Off,
    /// The search starts at [`TrialSteps::search`] or later.
    Waiting {
        /// Step before which it does not start.
        not_before: u64,
    },
    Running(Box<FoldModels>),
    Finished(GrowthLimit),
}

/// Result of a search.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct GrowthLimit {
    /// Maximum number of splats.
    pub(crate) n_splats: u32,
    /// Number of images that the search used.
    pub(crate) n_images: usize,
}

/// The search in a checkpoint. A running search is repeated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SavedGrowthSearch {
    limit: Option<GrowthLimit>,
    not_before: u64,
    is_off: bool,
}

/// The models of a running search.
#[derive(Debug)]
pub(crate) struct FoldModels {
    /// The model that is trained on all images.
    pub(crate) main: Snapshot,
    /// The images of each fold.
    pub(crate) folds: Vec<Vec<ImageId>>,
    /// The fold whose images are excluded from the model in training.
    pub(crate) fold_ix: usize,
    pub(crate) phase: FoldPhase,
    /// Last step of this phase.
    pub(crate) until: u64,
    /// Number of splats of the baseline in terms of `main`: its number, doubled in each accepted
    /// round.
    pub(crate) n_splats: u32,
    /// The model before its number of splats is doubled.
    pub(crate) fork: Option<Snapshot>,
    /// Whether GPU memory was too small for a larger `main`.
    pub(crate) is_main_full: bool,
    /// Doubled models of the previous round, for the remaining folds.
    pub(crate) previous: std::collections::VecDeque<Snapshot>,
    /// Models with twice the number of splats.
    pub(crate) doubled: std::collections::VecDeque<Snapshot>,
    pub(crate) baseline: Vec<HeldOutScore>,
    pub(crate) variant: Vec<HeldOutScore>,
    /// Results of the finished rounds.
    pub(crate) trials: Vec<Trial>,
}

/// What the model of a fold is trained for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FoldPhase {
    /// Training from the start.
    WarmUp,
    /// Training with the same number of splats.
    Baseline,
    /// Training with twice the number of splats.
    Variant,
}

/// Score of an image that was excluded from training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct HeldOutScore {
    /// `None` if the image is fully masked.
    pub(crate) psnr_db: Option<f64>,
    /// `None` without measured depth, or where none is rendered.
    pub(crate) depth_rmse_m: Option<f64>,
}

/// Number of folds for a number of images.
pub(crate) fn n_folds(n_images: usize) -> usize {
    n_images.min(MAX_FOLDS)
}

/// Number of steps of the first round of a search that starts at `step`: see
/// [`FoldModels::n_steps`].
pub(crate) fn n_steps_of_first_round(step: u64, n_folds: usize, steps: &TrialSteps) -> u64 {
    n_folds as u64 * (step.min(steps.max_warm_up()) + 2 * steps.comparison)
}

impl FoldModels {
    /// Number of steps left in this round, and total number of steps of the search up to the end of
    /// this round.
    pub(crate) fn n_steps(&self, step: u64, steps: &TrialSteps) -> (u64, u64) {
        let warm_up = self.main.schedule.step.min(steps.max_warm_up());
        let n_folds = self.folds.len() as u64;
        // From the second round on, folds continue from the doubled models of the previous round.
        let of_fold = 2 * steps.comparison + if self.trials.is_empty() { warm_up } else { 0 };
        let after_phase = match self.phase {
            FoldPhase::WarmUp => 2 * steps.comparison,
            FoldPhase::Baseline => steps.comparison,
            FoldPhase::Variant => 0,
        };
        let n_later_folds = n_folds - 1 - self.fold_ix as u64;
        let n_left = self.until.saturating_sub(step) + after_phase + n_later_folds * of_fold;
        (
            n_left,
            n_folds * (warm_up + (self.trials.len() as u64 + 1) * 2 * steps.comparison),
        )
    }
}

impl GrowthSearch {
    pub(crate) fn new(is_tested: bool) -> Self {
        if is_tested {
            Self::Waiting { not_before: 0 }
        } else {
            Self::Off
        }
    }

    /// The running search.
    pub(crate) fn running(&self) -> Option<&FoldModels> {
        if let Self::Running(models) = self {
            Some(models)
        } else {
            None
        }
    }

    /// The running search.
    pub(crate) fn running_mut(&mut self) -> Option<&mut FoldModels> {
        if let Self::Running(models) = self {
            Some(models)
        } else {
            None
        }
    }

    /// Ends the running search without a result, so that it is repeated. Returns its models.
    pub(crate) fn abort(&mut self) -> Option<Box<FoldModels>> {
        match std::mem::replace(self, Self::Waiting { not_before: 0 }) {
            Self::Running(models) => Some(models),
            // Not running: put the state back.
            other => {
                *self = other;
                None
            }
        }
    }

    /// Whether regular densification may add splats.
    pub(crate) fn may_grow(&self) -> bool {
        // In a comparison, the two models must differ by exactly one doubling.
        self.running()
            .is_none_or(|models| models.phase == FoldPhase::WarmUp)
    }

    /// Maximum number of splats.
    pub(crate) fn limit(&self) -> u32 {
        if let Self::Finished(limit) = self {
            limit.n_splats
        } else {
            u32::MAX
        }
    }

    /// Steps until the phase of a running search ends, or until a search may start.
    pub(crate) fn steps_left(&self, step: u64, steps: &TrialSteps) -> u64 {
        match self {
            Self::Waiting { not_before } if step < steps.search.max(*not_before) => {
                steps.search.max(*not_before) - step
            }
            // At least 1, because a submit of zero steps would make no progress.
            Self::Running(models) => models.until.saturating_sub(step).max(1),
            _ => u64::MAX,
        }
    }

    /// Postpones a search that has not started at `step`, because the images have changed.
    /// Otherwise, if images arrived often, training on all images would always be paused.
    pub(crate) fn postpone(&mut self, step: u64, steps: &TrialSteps) {
        if let Self::Waiting { not_before } = self
            && step >= steps.search
        {
            *not_before = step + steps.search_pause;
        }
    }

    /// Discards the limit if there are many images, or many more than the search used.
    pub(crate) fn set_n_images(&mut self, n_images: usize) {
        if let Self::Finished(limit) = self
            && (n_images >= FEW_IMAGES
                || n_images as f64 >= NEW_SEARCH_GROWTH * limit.n_images as f64)
        {
            *self = Self::Waiting { not_before: 0 };
        }
    }

    /// State for a checkpoint.
    pub(crate) fn saved(&self) -> SavedGrowthSearch {
        SavedGrowthSearch {
            limit: if let Self::Finished(limit) = self {
                Some(*limit)
            } else {
                None
            },
            not_before: if let Self::Waiting { not_before } = self {
                *not_before
            } else {
                0
            },
            is_off: matches!(self, Self::Off),
        }
    }

    /// Restores the state from a checkpoint.
    pub(crate) fn restore(&mut self, saved: SavedGrowthSearch) {
        *self = match saved {
            SavedGrowthSearch { is_off: true, .. } => Self::Off,
            SavedGrowthSearch {
                limit: Some(limit), ..
            } => Self::Finished(limit),
            SavedGrowthSearch { not_before, .. } => Self::Waiting { not_before },
        };
    }
}

/// Divides images into folds. Consecutive images are in different folds, because an image is
/// predicted from its neighbors.
pub(crate) fn folds(images: Vec<ImageId>) -> Vec<Vec<ImageId>> {
    // Views are in the order of arrival, so neighbors in the list are neighbors in space. Blocks of
    // consecutive images would leave a whole area without training images.
    let n_folds = n_folds(images.len());
    let mut folds = vec![Vec::new(); n_folds];
    for (ix, image) in images.into_iter().enumerate() {
        folds[ix % n_folds].push(image);
    }
    folds
}

/// Decides whether to double the number of splats: the mean PSNR must gain more than 0.1 dB beyond
/// one standard error, and the mean depth error must not rise by more than its standard error.
pub(crate) fn doubling_trial(
    candidate: Candidate,
    baseline: &[HeldOutScore],
    variant: &[HeldOutScore],
) -> Trial {
    // Both lists contain the same images in the same order. Images without a score in either list
    // are left out of that mean.
    let pairs = || baseline.iter().zip(variant);
    let gains =
        pairs().filter_map(|(baseline, variant)| Some(variant.psnr_db? - baseline.psnr_db?));
    let rises = pairs()
        .filter_map(|(baseline, variant)| Some(variant.depth_rmse_m? - baseline.depth_rmse_m?));
    let mut trial = Trial::of_gains(candidate, &gains.collect::<Vec<f64>>());
    // Splats that float in front of surfaces can raise the PSNR of nearby views, but not the
    // accuracy of depth. Without depth, both values are 0, and only PSNR decides.
    let (rise_m, error_m) = mean_and_standard_error(&rises.collect::<Vec<f64>>());
    trial.kept &= rise_m <= error_m;
    log::info!(
        "{candidate}: depth error {:+.1} mm (standard error {:.1})",
        1e3 * rise_m,
        1e3 * error_m
    );
    trial
}

fn mean_and_standard_error(values: &[f64]) -> (f64, f64) {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    // The unbiased variance divides by n - 1. The lower bounds avoid 0 / 0 for short lists.
    let variance = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>()
        / f64::max(n - 1.0, 1.0);
    (mean, (variance / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Stamp;

    const DOUBLED: Candidate = Candidate::Doubled {
        from: 1000,
        to: 2000,
    };

    fn scores(psnr_db: [f64; 4], depth_rmse_m: [f64; 4]) -> Vec<HeldOutScore> {
        let score = |(psnr_db, depth_rmse_m)| HeldOutScore {
            psnr_db: Some(psnr_db),
            depth_rmse_m: Some(depth_rmse_m),
        };
        psnr_db.into_iter().zip(depth_rmse_m).map(score).collect()
    }

    #[test]
    fn doubling_needs_better_images_and_no_worse_depth() {
        let before = scores([20.0, 22.0, 18.0, 21.0], [0.10, 0.12, 0.09, 0.11]);
        let kept = |psnr_db, depth_rmse_m| {
            doubling_trial(DOUBLED, &before, &scores(psnr_db, depth_rmse_m)).kept
        };
        let same_depth = [0.10, 0.12, 0.09, 0.11];
        assert!(kept([20.4, 22.5, 18.4, 21.3], same_depth));
        assert!(
            kept([20.4, 22.5, 18.4, 21.3], [0.09, 0.13, 0.09, 0.11]),
            "within the standard error"
        );
        assert!(
            !kept([20.4, 22.5, 18.4, 21.3], [0.12, 0.14, 0.10, 0.13]),
            "the depth error rises"
        );
        assert!(
            !kept([20.09, 22.08, 18.09, 21.08], same_depth),
            "less than 0.1 dB"
        );
        assert!(
            !kept([21.0, 22.0, 18.0, 20.7], same_depth),
            "not beyond the standard error"
        );
    }

    #[test]
    fn images_without_depth_are_compared_by_color() {
        let score = |psnr_db| {
            vec![
                HeldOutScore {
                    psnr_db: Some(psnr_db),
                    depth_rmse_m: None
                };
                3
            ]
        };
        assert!(doubling_trial(DOUBLED, &score(20.0), &score(20.3)).kept);
        let masked = vec![
            HeldOutScore {
                psnr_db: None,
                depth_rmse_m: None
            };
            3
        ];
        assert!(!doubling_trial(DOUBLED, &masked, &masked).kept);
    }

    #[test]
    fn search_waits_after_images_changed_and_survives_a_checkpoint() {
        let steps = TrialSteps {
            search: 1000,
            search_pause: 300,
            ..TrialSteps::default()
        };
        let mut search = GrowthSearch::new(true);
        search.postpone(999, &steps);
        assert_eq!(
            search.steps_left(900, &steps),
            100,
            "before the first search, images may change"
        );
        search.postpone(1100, &steps);
        assert_eq!(search.steps_left(1100, &steps), 300);
        let mut resumed = GrowthSearch::new(true);
        resumed.restore(search.saved());
        assert_eq!(resumed.steps_left(1150, &steps), 250);
        resumed.restore(GrowthSearch::new(false).saved());
        assert_eq!(resumed.steps_left(1150, &steps), u64::MAX, "it is off");
    }

    #[test]
    fn every_image_is_in_one_fold() {
        let images = |n: i64| {
            (0..n)
                .map(|ix| ("camera".into(), Stamp(ix)))
                .collect::<Vec<ImageId>>()
        };
        let sizes = |n| {
            folds(images(n))
                .iter()
                .map(Vec::len)
                .collect::<Vec<usize>>()
        };
        assert_eq!(
            (sizes(11), sizes(2), sizes(0)),
            (vec![4, 4, 3], vec![1, 1], vec![])
        );
        let all: std::collections::BTreeSet<ImageId> =
            folds(images(11)).into_iter().flatten().collect();
        assert_eq!(all.len(), 11);
        assert!(
            folds(images(11))
                .iter()
                .all(|fold| fold.windows(2).all(|pair| pair[1].1.0 - pair[0].1.0 > 1))
        );
    }

    #[test]
    fn limit_expires_with_more_images() {
        let limit = GrowthLimit {
            n_splats: 500,
            n_images: 10,
        };
        let after = |n_images| {
            let mut search = GrowthSearch::Finished(limit);
            search.set_n_images(n_images);
            search.limit()
        };
        assert_eq!(
            [11, 12, 13, FEW_IMAGES].map(after),
            [500, 500, u32::MAX, u32::MAX]
        );
    }
}
