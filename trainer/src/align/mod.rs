//! What is wrong with cameras, found before a scene is learned: pairs of keyframes with depth are laid over each other.
//!
//! Few causes explain most errors of poses: how a camera is mounted, by how much its poses lag, where joints have their zero, the
//! lens, where depth sits. Their effect on each pair of images is known, so a handful of numbers explains thousands of small
//! differences, by Gauss and Newton's steps from coarse to fine. A term stays when it predicts images better that were not
//! used for finding it; what the motion does not show is named and stays at zero.
//!
//! Pure functions of keyframes: no clock, no I/O, and sums in a fixed order however many threads there are.

mod background;
mod corrections;
mod fit;
mod layout;
mod pairs;
mod poses;
mod prepared_image;
mod report;
mod residual;
mod solve;
mod station;
mod sums;
#[cfg(test)]
pub(crate) mod tests;
mod validation;
mod view;

pub use background::run_in_background_pool;
pub(crate) use background::{AlignmentTask, alignment_step};
pub use report::{Alignment, Estimate, PoseEstimate, ScalarEstimate, Unobservable};
pub use station::{StationCorrection, register_station};

use crate::splat::{CameraRefinement, Candidate, ParamSet, Trial};
use crate::{Keyframe, Split};
use corrections::Corrections;
use fit::Fit;
use layout::Layout;
use pairs::Pair;
use prepared_image::PreparedImage;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;
use sums::PixelSubset;

/// Frames that shared terms are found from, and partners of each.
const MAX_IMAGES: usize = 100;
const PARTNERS_PER_IMAGE: usize = 4;
/// Selection images that decide, and fewest that can.
const MAX_VALIDATION_IMAGES: usize = 32;
const MIN_VALIDATION_IMAGES: usize = 4;
const MIN_PAIRS: usize = 4;
/// A correction below this many standard deviations is none.
const MIN_SIGNIFICANT_SIGMAS: f64 = 3.0;

/// Frames and the pairs that are looked at.
struct AlignmentScene {
    images: Vec<PreparedImage>,
    cameras: Vec<Arc<str>>,
    /// For shared terms.
    pairs: Vec<Pair>,
    /// For poses of images: all that are learned from.
    all_pairs: Vec<Pair>,
    /// From images that are learned from to selection images.
    validation_pairs: Vec<Pair>,
}

/// What alignment can find, the likelier first.
pub fn candidates() -> Vec<ParamSet> {
    vec![
        ParamSet { extrinsics: true, ..ParamSet::NONE },
        ParamSet { time_offset: true, ..ParamSet::NONE },
        ParamSet { joints: true, ..ParamSet::NONE },
        ParamSet { depth_pose: true, ..ParamSet::NONE },
        ParamSet { lens: true, ..ParamSet::NONE },
        ParamSet { depth_scale: true, ..ParamSet::NONE },
        ParamSet { readout: true, ..ParamSet::NONE },
        ParamSet { image_poses: true, ..ParamSet::NONE },
    ]
}

/// Finds what is asked for; none where keyframes have no depth, or too few of them see the same.
///
/// Only keyframes for training are learned from, selection keyframes judge, test keyframes are not looked at.
pub fn align(keyframes: &[Arc<Keyframe>], choice: &CameraRefinement) -> Option<Alignment> {
    let scene = AlignmentScene::new(keyframes, includes_image_poses(choice))?;
    let uncorrected =
        CalibrationModel { set: ParamSet::default(), fit: None, corrections: Corrections::none(scene.cameras.len()) };
    let (mut trials, mut unobservable) = (Vec::new(), Vec::new());
    let kept = match choice {
        CameraRefinement::Always(set) => {
            let variant = scene.model(*set, &uncorrected)?;
            trials.push(scene.evaluate(*set, &uncorrected, &variant));
            variant
        }
        CameraRefinement::Try(candidates) => {
            scene.select_params(candidates, uncorrected, &mut trials, &mut unobservable)
        }
    };
    if let Some(fit) = &kept.fit {
        unobservable.extend(report::unobservable(&scene, fit));
    }
    let kept = if kept.set.image_poses { scene.with_validation_poses(kept) } else { kept };
    Some(report::alignment(&scene, &kept, trials, unobservable))
}

fn includes_image_poses(choice: &CameraRefinement) -> bool {
    match choice {
        CameraRefinement::Always(set) => set.image_poses,
        CameraRefinement::Try(candidates) => candidates.iter().any(|set| set.image_poses),
    }
}

/// Corrections of a set of terms.
struct CalibrationModel {
    set: ParamSet,
    /// Of the shared terms.
    fit: Option<Fit>,
    corrections: Corrections,
}

impl AlignmentScene {
    fn new(keyframes: &[Arc<Keyframe>], for_poses: bool) -> Option<Self> {
        let used: Vec<&Arc<Keyframe>> =
            keyframes.iter().filter(|keyframe| keyframe.split != Split::Test && keyframe.depth.is_some()).collect();
        let names: BTreeSet<Arc<str>> = used.iter().map(|keyframe| keyframe.camera.clone()).collect();
        let cameras: Vec<Arc<str>> = names.into_iter().collect();
        let camera_of = |keyframe: &Keyframe| cameras.partition_point(|name| *name < keyframe.camera);
        let images: Vec<PreparedImage> =
            used.par_iter().filter_map(|keyframe| PreparedImage::new(keyframe, camera_of(keyframe))).collect();
        let images_of_split = |split: Split| -> Vec<usize> {
            (0..images.len()).filter(|ix| images[*ix].keyframe.split == split).collect()
        };
        let subsample = |ixs: &[usize], max_count: usize| -> Vec<usize> {
            let n = ixs.len().min(max_count);
            (0..n).map(|ix| ixs[ix * ixs.len() / n]).collect()
        };
        let (train, validation_images) = (images_of_split(Split::Train), images_of_split(Split::Validation));
        let views = Corrections::none(cameras.len()).views(&images, &Layout::default());
        let training_subset = subsample(&train, MAX_IMAGES);
        let pairs = pairs::choose(&images, &views, &training_subset, &training_subset, PARTNERS_PER_IMAGE);
        let all_pairs = match for_poses && training_subset.len() < train.len() {
            true => pairs::choose(&images, &views, &train, &train, PARTNERS_PER_IMAGE),
            false => pairs.clone(),
        };
        let validation_pairs = pairs::choose(
            &images,
            &views,
            &training_subset,
            &subsample(&validation_images, MAX_VALIDATION_IMAGES),
            PARTNERS_PER_IMAGE,
        );
        (pairs.len() >= MIN_PAIRS).then_some(Self { images, cameras, pairs, all_pairs, validation_pairs })
    }

    /// The corrections of a set of terms, starting from those of another.
    fn model(&self, set: ParamSet, from: &CalibrationModel) -> Option<CalibrationModel> {
        let shared = ParamSet { image_poses: false, image_gains: false, ..set };
        let layout = Layout::new(shared, &self.images, self.cameras.len());
        let mut fit = None;
        let mut corrections = self.restricted(&layout, &from.corrections);
        if layout.n() > 0 {
            let found = fit::fit(&self.images, &self.pairs, layout, &corrections)?;
            corrections = found.corrections.clone();
            fit = Some(found);
        }
        if set.image_poses {
            corrections = poses::fit(&self.images, &self.all_pairs, &corrections)?;
        }
        Some(CalibrationModel { set, fit, corrections })
    }

    /// Gives selection images poses of their own, too, when all is decided: they are learned from later.
    fn with_validation_poses(&self, mut model: CalibrationModel) -> CalibrationModel {
        let images_of_split = |split: Split| -> Vec<usize> {
            (0..self.images.len()).filter(|ix| self.images[*ix].keyframe.split == split).collect()
        };
        let views = model.corrections.views(&self.images, &Layout::default());
        let pose_of = |to: &usize| {
            let pairs = pairs::choose(&self.images, &views, &images_of_split(Split::Train), &[*to], PARTNERS_PER_IMAGE);
            let image = &self.images[*to];
            let correction = poses::fit_one(
                &self.images,
                &views,
                &pairs,
                &model.corrections.by_camera[image.camera],
                PixelSubset::All,
            )?;
            Some((image.camera, image.keyframe.stamp.0, correction.drift_at(image.keyframe.stamp)))
        };
        let found: Vec<_> = images_of_split(Split::Validation).par_iter().filter_map(pose_of).collect();
        for (camera, stamp, drift) in found {
            model.corrections.by_camera[camera].drift.insert(stamp, drift);
        }
        model
    }

    /// What given corrections say about the terms of a layout, and nothing about others.
    fn restricted(&self, layout: &Layout, given: &Corrections) -> Corrections {
        let mut restricted = Corrections::none(self.cameras.len());
        let values = layout.params.iter().map(|param| given.value(*param));
        restricted.apply_step(layout, &nalgebra::DVector::from_iterator(layout.n(), values));
        restricted
    }

    /// Adds one candidate after the other where it pays, then takes away what no longer does.
    ///
    /// A hand-eye transform that is not corrected may be wrong all the same where the motion does not show it: that is added to `unobservable`.
    fn select_params(
        &self,
        candidates: &[ParamSet],
        uncorrected: CalibrationModel,
        trials: &mut Vec<Trial>,
        unobservable: &mut Vec<Unobservable>,
    ) -> CalibrationModel {
        let mut kept = uncorrected;
        let mut kept_sets: Vec<ParamSet> = Vec::new();
        for candidate in candidates {
            let layout = Layout::new(*candidate, &self.images, self.cameras.len());
            if layout.n() == 0 && !candidate.image_poses {
                continue;
            }
            let Some(variant) = self.model(kept.set.and(*candidate), &kept) else { continue };
            let mut trial = self.evaluate(*candidate, &kept, &variant);
            trial.kept &= candidate.image_poses || variant.has_significant(&layout);
            if trial.kept {
                kept_sets.push(*candidate);
                kept = variant;
            } else if candidate.extrinsics {
                unobservable.extend(variant.fit.iter().flat_map(|fit| report::unobservable(self, fit)));
            }
            trials.push(trial);
        }
        for kept_set in kept_sets.clone().into_iter().rev().skip(1) {
            let other_params = kept_sets
                .iter()
                .filter(|other| **other != kept_set)
                .fold(ParamSet::default(), |set, other| set.and(*other));
            let Some(baseline) = self.model(other_params, &kept) else { continue };
            let trial = self.evaluate(kept_set, &baseline, &kept);
            if !trial.kept {
                kept_sets.retain(|other| *other != kept_set);
                trials.retain(|earlier| earlier.candidate != Candidate::Cameras(kept_set));
                trials.push(trial);
                kept = baseline;
            }
        }
        kept
    }

    /// How much better a set of terms predicts the selection images.
    fn evaluate(&self, params: ParamSet, baseline: &CalibrationModel, variant: &CalibrationModel) -> Trial {
        let noise = variant.fit.as_ref().map_or(sums::Noise { photo: 5.0, depth: 0.005 }, |fit| fit.noise);
        let comparison = validation::PairedComparison {
            images: &self.images,
            pairs: &self.validation_pairs,
            baseline: &baseline.corrections,
            variant: &variant.corrections,
            noise,
        };
        let trial = |(baseline_db, variant_db): (Vec<f64>, Vec<f64>)| {
            log::debug!("alignment: {params}: without {baseline_db:.2?}, with {variant_db:.2?} dB");
            let mut trial = Trial::of(Candidate::Cameras(params), &baseline_db, &variant_db);
            trial.kept &= trial.n_images >= MIN_VALIDATION_IMAGES;
            trial
        };
        match (params.image_poses, baseline.set.image_poses) {
            (true, _) => trial(comparison.scores_with_free_poses()),
            (false, false) => trial(comparison.scores()),
            // Images that move on their own hide what all share: it goes only where neither way shows it.
            (false, true) => Some(trial(comparison.scores()))
                .filter(|trial| trial.kept)
                .unwrap_or_else(|| trial(comparison.scores_with_free_poses())),
        }
    }
}

impl CalibrationModel {
    /// Whether any of the terms is clearly not zero.
    fn has_significant(&self, params: &Layout) -> bool {
        let Some(fit) = &self.fit else { return false };
        let is_significant = |ix: usize| {
            let value = self.corrections.value(fit.layout.params[ix]);
            value.abs() > MIN_SIGNIFICANT_SIGMAS * fit.solution.sigma(ix) && fit.solution.unobservable_frac(ix) < 0.5
        };
        (0..fit.layout.n()).any(|ix| params.params.contains(&fit.layout.params[ix]) && is_significant(ix))
    }
}
