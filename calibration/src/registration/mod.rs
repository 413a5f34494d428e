//! Estimates calibration errors of cameras before a scene is trained, by registering pairs of
//! keyframes with depth.
//!
//! Few causes explain most pose errors: extrinsics, time offsets, joint offsets, intrinsics and the
//! pose of the depth camera. Their effect on each pair of images is known, so a few parameters
//! explain thousands of small differences. They are estimated by Gauss-Newton steps from coarse to
//! fine. A parameter is kept if it improves the prediction of images that were not used to estimate
//! it. If the motion does not make a parameter observable, this is reported and the parameter stays
//! at zero.
//!
//! All functions are pure functions of keyframes. They use no clock and no I/O. Sums are computed
//! in a fixed order, whatever the number of threads.

mod acceleration;
mod corrections;
mod covariance;
mod features;
mod fit;
mod halves;
mod layout;
mod movement;
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

pub use covariance::{ExtrinsicsCovariance, PoseSigmas};
pub use halves::{HalvesAgreement, compare_halves};
pub use movement::{CameraMovement, MOVEMENT_WINDOW, MovementDetector};
pub use report::{Alignment, Estimate, PoseEstimate, ScalarEstimate, Unobservable};
pub use station::{StationCorrection, register_station};

use crate::{CameraRefinement, Candidate, ParamSet, Trial};
use acceleration::Velocities;
use corrections::Corrections;
use fit::Fit;
use keyframe::{Keyframe, Split};
use layout::Layout;
use pairs::Pair;
use prepared_image::PreparedImage;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::sync::Arc;
use sums::PixelSubset;

/// Maximum number of images for estimating the shared parameters. The few shared parameters do not
/// need more images. The next constant is the maximum number of partners of each image. The time
/// grows with the product of both numbers.
const MAX_IMAGES: usize = 100;
const PARTNERS_PER_IMAGE: usize = 4;
/// Maximum number of validation images.
const MAX_VALIDATION_IMAGES: usize = 32;
/// Covariances are computed from the scatter between pairs. Fewer pairs than this do not determine
/// the scatter.
const MIN_PAIRS: usize = 4;
/// Corrections smaller than this number of standard deviations are not significant.
const MIN_SIGNIFICANT_SIGMAS: f64 = 3.0;

/// Prepared images and the pairs to register.
struct AlignmentScene {
    images: Vec<PreparedImage>,
    cameras: Vec<Arc<str>>,
    /// Pairs that determine the shared parameters.
    pairs: Vec<Pair>,
    /// Pairs of all training images, which determine image poses.
    all_pairs: Vec<Pair>,
    /// Pairs that predict validation images from training images.
    validation_pairs: Vec<Pair>,
}

/// All parameter sets that alignment can estimate. The more likely sets come first.
pub fn candidates() -> Vec<ParamSet> {
    vec![
        ParamSet::EXTRINSICS,
        ParamSet::TIME_OFFSET,
        ParamSet::JOINTS,
        ParamSet::DEPTH_POSE,
        ParamSet::LENS,
        ParamSet::DEPTH_SCALE,
        ParamSet::READOUT,
        ParamSet::IMAGE_POSES,
    ]
}

/// Estimates the requested parameters. Returns `None` if too few keyframes overlap. Without depth,
/// only extrinsics, time offsets and lenses are estimated, from matched features.
///
/// Parameters are estimated from training keyframes and evaluated on validation keyframes. Test
/// keyframes are not used.
pub fn align(keyframes: &[Arc<Keyframe>], choice: &CameraRefinement) -> Option<Alignment> {
    if keyframes.iter().all(|keyframe| keyframe.depth.is_none()) {
        return features::align(keyframes, choice);
    }
    let mut scene = AlignmentScene::new(keyframes, includes_image_poses(choice))?;
    let uncorrected = CalibrationModel {
        set: ParamSet::empty(),
        fit: None,
        corrections: Corrections::none(scene.cameras.len()),
    };
    let mut trials = Vec::new();
    let mut unobservable = Vec::new();
    let mut kept = match choice {
        CameraRefinement::Always(set) | CameraRefinement::AlwaysAndWatch(set, _) => {
            let variant = scene.model(*set, &uncorrected)?;
            trials.push(scene.evaluate(*set, &uncorrected, &variant));
            variant
        }
        CameraRefinement::Try(candidates) => {
            scene.select_params(candidates, uncorrected, &mut trials, &mut unobservable)
        }
        CameraRefinement::AlwaysAndTry(set, candidates) => {
            // Registration has no training steps. A set that would be optimized from the first step
            // on is therefore tried like the others.
            let all = [&[*set], &candidates[..]].concat();
            scene.select_params(&all, uncorrected, &mut trials, &mut unobservable)
        }
    };
    kept = scene.with_accelerations(kept, keyframes);
    if let Some(fit) = &mut kept.fit {
        fit.add_discretization_error(&scene.images, &scene.pairs);
        unobservable.extend(report::unobservable(&scene, fit));
    }
    let kept = if kept.set.contains(ParamSet::IMAGE_POSES) {
        scene.with_validation_poses(kept)
    } else {
        kept
    };
    Some(report::alignment(&scene, &kept, trials, unobservable))
}

/// Whether image poses may be estimated.
fn includes_image_poses(choice: &CameraRefinement) -> bool {
    let mut sets = choice.candidates().iter().copied().chain([choice.always()]);
    sets.any(|set| set.contains(ParamSet::IMAGE_POSES))
}

/// Indices of the images of a split.
fn images_of_split(images: &[PreparedImage], split: Split) -> Vec<usize> {
    (0..images.len())
        .filter(|ix| images[*ix].keyframe.split == split)
        .collect()
}

/// At most `max_count` of the indices, spread evenly.
fn subsample(ixs: &[usize], max_count: usize) -> Vec<usize> {
    let n = ixs.len().min(max_count);
    (0..n).map(|ix| ixs[ix * ixs.len() / n]).collect()
}

/// Corrections for a set of parameters.
struct CalibrationModel {
    set: ParamSet,
    /// Fit of the shared parameters.
    fit: Option<Fit>,
    corrections: Corrections,
}

impl AlignmentScene {
    fn new(keyframes: &[Arc<Keyframe>], for_poses: bool) -> Option<Self> {
        let used: Vec<&Arc<Keyframe>> = keyframes
            .iter()
            .filter(|keyframe| keyframe.split != Split::Test && keyframe.depth.is_some())
            .collect();
        let names: BTreeSet<Arc<str>> = used
            .iter()
            .map(|keyframe| keyframe.camera.clone())
            .collect();
        let cameras: Vec<Arc<str>> = names.into_iter().collect();
        let camera_of =
            |keyframe: &Keyframe| cameras.partition_point(|name| *name < keyframe.camera);
        let images: Vec<PreparedImage> = used
            .par_iter()
            .filter_map(|keyframe| PreparedImage::new(keyframe, camera_of(keyframe)))
            .collect();
        let train = images_of_split(&images, Split::Train);
        let validation_images = images_of_split(&images, Split::Validation);
        let views = Corrections::none(cameras.len()).views(&images, &Layout::default());
        let training_subset = subsample(&train, MAX_IMAGES);
        let pairs = pairs::choose(
            &images,
            &views,
            &training_subset,
            &training_subset,
            PARTNERS_PER_IMAGE,
        );
        // Estimating the poses of all images needs pairs of all images. Shared parameters need
        // fewer pairs.
        let all_pairs = if for_poses && training_subset.len() < train.len() {
            pairs::choose(&images, &views, &train, &train, PARTNERS_PER_IMAGE)
        } else {
            pairs.clone()
        };
        let validation_pairs = pairs::choose(
            &images,
            &views,
            &training_subset,
            &subsample(&validation_images, MAX_VALIDATION_IMAGES),
            PARTNERS_PER_IMAGE,
        );
        (pairs.len() >= MIN_PAIRS).then_some(Self {
            images,
            cameras,
            pairs,
            all_pairs,
            validation_pairs,
        })
    }

    /// The parameters of a set that apply to the images.
    fn layout(&self, set: ParamSet) -> Layout {
        let images: Vec<_> = self
            .images
            .iter()
            .map(|image| (image.camera, &*image.keyframe))
            .collect();
        Layout::new(set, &images, self.cameras.len())
    }

    /// Estimates the corrections of a set of parameters, starting from the corrections of another
    /// set.
    fn model(&self, set: ParamSet, from: &CalibrationModel) -> Option<CalibrationModel> {
        let shared = set - (ParamSet::IMAGE_POSES | ParamSet::IMAGE_GAINS);
        let layout = self.layout(shared);
        let mut fit = None;
        let mut corrections = self.restricted(&layout, &from.corrections);
        if layout.n() > 0 {
            let found = fit::fit(&self.images, &self.pairs, layout, &corrections)?;
            corrections = found.corrections.clone();
            fit = Some(found);
        }
        if set.contains(ParamSet::IMAGE_POSES) {
            corrections = poses::fit(&self.images, &self.all_pairs, &corrections)?;
        }
        Some(CalibrationModel {
            set,
            fit,
            corrections,
        })
    }

    /// Estimates the same parameters again, with velocities for which the estimated time offsets
    /// are exact even if a camera accelerates.
    fn with_accelerations(
        &mut self,
        model: CalibrationModel,
        keyframes: &[Arc<Keyframe>],
    ) -> CalibrationModel {
        // Poses of single images already contain the errors of a constant velocity.
        let is_affected =
            model.set.contains(ParamSet::TIME_OFFSET) && !model.set.contains(ParamSet::IMAGE_POSES);
        let velocities = Velocities::of(keyframes);
        if is_affected && velocities.apply_to(&mut self.images, &model.corrections) {
            self.model(model.set, &model).unwrap_or(model)
        } else {
            model
        }
    }

    /// Also estimates individual poses of the validation images, after all decisions, because these
    /// images are trained on later.
    fn with_validation_poses(&self, mut model: CalibrationModel) -> CalibrationModel {
        let views = model.corrections.views(&self.images, &Layout::default());
        let train = images_of_split(&self.images, Split::Train);
        let validation_images = images_of_split(&self.images, Split::Validation);
        let found: Vec<(usize, [f64; 6])> = validation_images
            .par_iter()
            .filter_map(|ix| Some((*ix, self.drift_of(*ix, &model.corrections, &views, &train)?)))
            .collect();
        // The poses are added after all of them are estimated, because an entry changes the
        // interpolated drift of other images.
        for (ix, drift) in found {
            let image = &self.images[ix];
            model.corrections.by_camera[image.camera]
                .drift
                .insert(image.keyframe.stamp.0, drift);
        }
        model
    }

    /// Drift of one image relative to training images.
    fn drift_of(
        &self,
        image_ix: usize,
        corrections: &Corrections,
        views: &[view::CorrectedView],
        train: &[usize],
    ) -> Option<[f64; 6]> {
        let pairs = pairs::choose(&self.images, views, train, &[image_ix], PARTNERS_PER_IMAGE);
        let image = &self.images[image_ix];
        let correction = poses::fit_one(
            &self.images,
            views,
            &pairs,
            &corrections.by_camera[image.camera],
            PixelSubset::All,
        )?;
        Some(correction.drift_at(image.keyframe.stamp))
    }

    /// Restricts corrections to the parameters of a layout.
    fn restricted(&self, layout: &Layout, given: &Corrections) -> Corrections {
        let mut restricted = Corrections::none(self.cameras.len());
        let values = layout.params.iter().map(|param| given.value(*param));
        restricted.apply_step(
            layout,
            &nalgebra::DVector::from_iterator(layout.n(), values),
        );
        restricted
    }

    /// Adds each candidate whose gain is significant. Then removes the candidates whose gain is no
    /// longer significant.
    ///
    /// If extrinsics are not corrected, they may still be wrong in directions that the motion does
    /// not make observable. These directions are added to `unobservable`.
    fn select_params(
        &self,
        candidates: &[ParamSet],
        uncorrected: CalibrationModel,
        trials: &mut Vec<Trial>,
        unobservable: &mut Vec<Unobservable>,
    ) -> CalibrationModel {
        // In this forward selection, the candidates are tested in order of likelihood. Each
        // candidate is tested together with the candidates that were kept before.
        let mut kept = uncorrected;
        let mut kept_sets: Vec<ParamSet> = Vec::new();
        for candidate in candidates {
            let layout = self.layout(*candidate);
            if layout.n() == 0 && !candidate.contains(ParamSet::IMAGE_POSES) {
                continue;
            }
            let Some(variant) = self.model(kept.set | *candidate, &kept) else {
                continue;
            };
            let mut trial = self.evaluate(*candidate, &kept, &variant);
            trial.kept &=
                candidate.contains(ParamSet::IMAGE_POSES) || variant.has_significant(&layout);
            if trial.kept {
                kept_sets.push(*candidate);
                kept = variant;
            } else if candidate.contains(ParamSet::EXTRINSICS) {
                unobservable.extend(
                    variant
                        .fit
                        .iter()
                        .flat_map(|fit| report::unobservable(self, fit)),
                );
            }
            trials.push(trial);
        }
        // This backward elimination is needed, because a later parameter may explain the same
        // errors as an earlier parameter. The earlier parameter is then superfluous. The last
        // parameter was already tested with all others.
        for kept_set in kept_sets.clone().into_iter().rev().skip(1) {
            let other_params = kept_sets
                .iter()
                .copied()
                .filter(|other| *other != kept_set)
                .collect();
            let Some(baseline) = self.model(other_params, &kept) else {
                continue;
            };
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

    /// Evaluates how much better a set of parameters predicts the validation images.
    fn evaluate(
        &self,
        params: ParamSet,
        baseline: &CalibrationModel,
        variant: &CalibrationModel,
    ) -> Trial {
        let noise = variant.fit.as_ref().map_or(
            sums::Noise {
                photo: 5.0,
                depth: 0.005,
            },
            |fit| fit.noise,
        );
        let comparison = validation::PairedComparison {
            images: &self.images,
            pairs: &self.validation_pairs,
            baseline: &baseline.corrections,
            variant: &variant.corrections,
            noise,
        };
        if params.contains(ParamSet::IMAGE_POSES) {
            return self.trial(params, &comparison.scores_with_free_poses());
        }
        let trial = self.trial(params, &comparison.scores());
        // Individual image poses hide shared errors. A parameter is therefore rejected only if
        // neither comparison shows a gain.
        if !trial.kept && baseline.set.contains(ParamSet::IMAGE_POSES) {
            return self.trial(params, &comparison.scores_with_free_poses());
        }
        trial
    }

    /// The trial of a set of parameters with these scores.
    fn trial(&self, params: ParamSet, scores: &[validation::ImageScore]) -> Trial {
        let gains_db = scores.iter().map(|score| {
            let camera = self.images[score.image_ix].camera;
            (&*self.cameras[camera], score.variant_db - score.baseline_db)
        });
        let (baseline_db, variant_db): (Vec<f64>, Vec<f64>) = scores
            .iter()
            .map(|score| (score.baseline_db, score.variant_db))
            .unzip();
        log::debug!("alignment: {params}: without {baseline_db:.2?}, with {variant_db:.2?} dB");
        let trial = Trial::of(Candidate::Cameras(params), &baseline_db, &variant_db);
        trial.with_enough_images().with_cameras(gains_db)
    }
}

impl CalibrationModel {
    /// Whether any of the parameters differs significantly from zero.
    fn has_significant(&self, params: &Layout) -> bool {
        let Some(fit) = &self.fit else { return false };
        fit.layout.params.iter().enumerate().any(|(ix, param)| {
            // The value of a mostly unobservable parameter follows only from its prior.
            params.params.contains(param)
                && self.corrections.value(*param).abs()
                    > MIN_SIGNIFICANT_SIGMAS * fit.solution.sigma(ix)
                && fit.solution.unobservable_frac(ix) < 0.5
        })
    }
}
