//! Estimates extrinsics, time offsets and lenses of cameras from color images alone. Corners are
//! matched between images. Each match must lie near its epipolar line, which follows from the poses
//! of the two images.
//!
//! The effect of an extrinsics error on the epipolar lines depends on the relative rotation of the
//! two images. The effect of a time offset depends on their velocities. Both errors are therefore
//! observable without knowing any depth. The search for matches uses the approximately known poses.
//! It is limited to a band around the epipolar line, and patches are rotated by the relative
//! rotation of the images. Matches are searched again in a narrower band after each estimate.

mod epipolar;
mod feature_image;
mod image_pairs;
mod matching;
mod moving_camera;
#[cfg(test)]
mod tests;

use super::corrections::Corrections;
use super::fit::{Fit, INITIAL_NOISE};
use super::layout::Layout;
use super::pairs::Pair;
use super::report::{self, Alignment};
use super::solve::Solution;
use super::{AlignmentScene, CalibrationModel, MAX_IMAGES, MIN_PAIRS};
use crate::{CameraRefinement, Candidate, ParamSet, Trial};
use epipolar::PairMatches;
use feature_image::FeatureImage;
use keyframe::{Keyframe, Split};
use kinematics::Transform;
use moving_camera::MovingCamera;
use nalgebra::DVector;
use numbers::quantile::{Rank, quantile};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Typical calibration errors without depth, relative to the typical errors that registration with
/// depth assumes. Without depth, transforms are often measured by hand, so their errors are larger.
const SCALE: f64 = 2.0;

/// Cameras with fewer training and validation images keep the given extrinsics, because an estimate
/// may be less accurate than the given extrinsics.
const MIN_IMAGES_PER_CAMERA: usize = 10;

/// Minimum gain in cross-validation, dB. Errors of single poses also cause gains, but these gains
/// are smaller.
const MIN_GAIN_DB: f64 = 0.1;

/// Minimum gain that a variant must reach with the matches of the baseline before it is tried with
/// new matches. It is lower than [`MIN_GAIN_DB`], because the matches of the baseline favor the
/// baseline.
const MIN_QUICK_GAIN_DB: f64 = 0.03;

/// One round of matching.
#[derive(Clone, Copy, Debug)]
struct Round {
    /// Largest expected error of the extrinsics.
    rotation_rad: f64,
    translation_m: f64,
    /// Number of partners of each image.
    n_partners: usize,
}

/// Rounds of matching. A few pairs are enough for the coarse rounds. The last round is repeated,
/// because matches near the edge of the band pull the estimate towards its start.
const ROUNDS: [Round; 5] = [
    Round {
        rotation_rad: 0.105,
        translation_m: 0.03,
        n_partners: 4,
    },
    Round {
        rotation_rad: 0.05,
        translation_m: 0.02,
        n_partners: 4,
    },
    Round {
        rotation_rad: 0.02,
        translation_m: 0.01,
        n_partners: 6,
    },
    LAST_ROUND,
    LAST_ROUND,
];
const LAST_ROUND: Round = Round {
    rotation_rad: 0.01,
    translation_m: 0.004,
    n_partners: 12,
};
/// Matching for quick trials.
const QUICK_ROUND: Round = Round {
    rotation_rad: 0.02,
    translation_m: 0.01,
    n_partners: CROSS_VALIDATION_PARTNERS,
};
/// The last round is not repeated if it changed the estimate by less than this fraction of the
/// expected error.
const CLOSE_FRAC: f64 = 0.1;
/// Number of groups of images for cross-validation, and number of partners of each image.
const N_FOLDS: usize = 4;
const CROSS_VALIDATION_PARTNERS: usize = 8;
/// Largest displacement along the epipolar line, in units of the focal length, for which the search
/// band is wide enough. It corresponds to points at twice the distance between the cameras.
const MAX_PARALLAX: f64 = 0.5;
/// Minimum half width of the band, texels of the finest level. Corners are less accurate than a
/// texel, and matches must be able to move away from their start.
const MIN_BAND_TEXELS: f64 = 4.0;
/// Noise that cross-validation assumes. Differences below this noise do not count.
const NOISE_TEXELS: f64 = 0.5;
/// Minimum number of matches of a pair. Fewer may all be wrong.
const MIN_MATCHES: usize = 8;
/// Lower limit of the standard deviation of the distances from the epipolar lines, texels. The next
/// constant is the upper limit. Above it, wrong matches affect the median.
const MIN_NOISE_TEXELS: f64 = 0.25;
const MAX_NOISE_TEXELS: f64 = 1.5;
/// The standard deviation that an iteration assumes, relative to the previous iteration. With a
/// faster decrease, correct matches would be excluded before the estimate is close to them.
const ANNEALING: f64 = 0.75;
const MAX_ITERATIONS: usize = 40;
/// A step smaller than this number of standard deviations ends a round.
const CONVERGED_STEP_SIGMAS: f64 = 0.05;
/// Minimum fraction of the last round's matches that are near the epipolar line. A match is near if
/// its distance is below the same fraction of the half width of the band. Random matches are spread
/// evenly over the band.
const MIN_INNER_MATCHES: f64 = 0.5;
const MAX_INNER_FRAC: f64 = 0.25;

/// Parameters that matched features determine.
const PARAMS: ParamSet = ParamSet::EXTRINSICS
    .union(ParamSet::TIME_OFFSET)
    .union(ParamSet::LENS);

/// Images with corners.
struct FeatureScene {
    images: Vec<FeatureImage>,
    cameras: Vec<Arc<str>>,
}

/// Estimates the requested parameters from color. Returns `None` if none of them can be estimated
/// from color, or if too few images overlap or have corners.
///
/// Parameters are estimated from training and validation keyframes and evaluated by
/// cross-validation. Test keyframes are not used.
pub(super) fn align(keyframes: &[Arc<Keyframe>], choice: &CameraRefinement) -> Option<Alignment> {
    let always = choice.always() & PARAMS;
    let candidates = choice.candidates().iter().map(|set| *set & PARAMS);
    let sets: Vec<ParamSet> = [always]
        .into_iter()
        .chain(candidates)
        .filter(|set| !set.is_empty())
        .collect();
    if sets.is_empty() {
        return None;
    }
    let scene = FeatureScene::new(keyframes);
    let mut kept = CalibrationModel {
        set: ParamSet::empty(),
        fit: None,
        corrections: scene.uncorrected(),
    };
    let mut trials = Vec::new();
    let mut unobservable = Vec::new();
    let mut pairs = None;
    // Matches near the epipolar lines of the kept model.
    let mut kept_matches: Option<Vec<PairMatches>> = None;
    let is_optional = !matches!(choice, CameraRefinement::Always(_));
    for set in sets.into_iter().filter(|set| scene.layout(*set).n() > 0) {
        let has_extrinsics = set.contains(ParamSet::EXTRINSICS);
        // Matching takes most of the time, so parameters that hardly improve existing matches are
        // rejected without a search for new matches. Extrinsics are an exception, because existing
        // matches contain little information about the improvement by new extrinsics.
        if is_optional && !has_extrinsics {
            let matches =
                kept_matches.get_or_insert_with(|| scene.matches(&kept.corrections, &QUICK_ROUND));
            let rejected = scene
                .quick_trial(set, &kept, matches)
                .filter(|trial| trial.gain_db < MIN_QUICK_GAIN_DB);
            if let Some(trial) = rejected {
                trials.push(Trial {
                    kept: false,
                    ..trial
                });
                continue;
            }
        }
        let Some((variant_pairs, mut variant)) = scene.model(kept.set | set, &kept) else {
            // Without consistent matches, other parameters cannot be judged either.
            if has_extrinsics {
                return None;
            }
            continue;
        };
        let matches = scene.validation_matches(&kept, &variant);
        let mut trial = scene.cross_validate(set, &kept, &variant, &matches);
        trial.kept &= trial.gain_db > MIN_GAIN_DB && variant.has_significant(&scene.layout(set));
        let is_kept = trial.kept || !is_optional;
        if has_extrinsics || (is_kept && variant.set.contains(ParamSet::EXTRINSICS)) {
            let summary = scene.summary(&variant_pairs);
            unobservable = variant
                .fit
                .iter()
                .flat_map(|fit| report::unobservable(&summary, fit))
                .collect();
        }
        if is_optional {
            scene.reset_insignificant_extrinsics(&mut variant);
        }
        if is_kept {
            kept = variant;
            pairs = Some(variant_pairs);
            // The epipolar lines have moved.
            kept_matches = None;
        } else {
            pairs.get_or_insert(variant_pairs);
        }
        trials.push(trial);
    }
    // If there was no trial, the images do not overlap.
    (!trials.is_empty()).then(|| {
        let summary = scene.summary(&pairs.unwrap_or_default());
        report::alignment(&summary, &kept, trials, unobservable)
    })
}

impl FeatureScene {
    fn new(keyframes: &[Arc<Keyframe>]) -> Self {
        let mut ixs_of_camera = BTreeMap::<Arc<str>, Vec<usize>>::new();
        for (ix, keyframe) in keyframes.iter().enumerate() {
            if keyframe.split != Split::Test {
                ixs_of_camera
                    .entry(keyframe.camera.clone())
                    .or_default()
                    .push(ix);
            }
        }
        ixs_of_camera.retain(|_, ixs| ixs.len() >= MIN_IMAGES_PER_CAMERA);
        // The limit holds for all cameras together, but each camera keeps enough images for an
        // estimate.
        let max_images = (MAX_IMAGES / ixs_of_camera.len().max(1)).max(MIN_IMAGES_PER_CAMERA);
        let sampled = ixs_of_camera.values().flat_map(|ixs| {
            let n = ixs.len().min(max_images);
            (0..n).map(move |ix| ixs[ix * ixs.len() / n])
        });
        let used: BTreeSet<usize> = sampled.collect();
        let used: Vec<_> = used.into_iter().map(|ix| &keyframes[ix]).collect();
        let cameras: Vec<Arc<str>> = ixs_of_camera.into_keys().collect();
        let camera_of =
            |keyframe: &Keyframe| cameras.partition_point(|name| *name < keyframe.camera);
        let images = used
            .par_iter()
            .map(|keyframe| FeatureImage::new(keyframe, camera_of(keyframe)))
            .collect();
        Self { images, cameras }
    }

    /// No corrections.
    fn uncorrected(&self) -> Corrections {
        Corrections::none(self.cameras.len())
    }

    fn layout(&self, set: ParamSet) -> Layout {
        let images: Vec<_> = self
            .images
            .iter()
            .map(|image| (image.camera, &*image.keyframe))
            .collect();
        Layout::new(set, &images, self.cameras.len())
    }

    /// The cameras and pairs, for reports.
    fn summary(&self, pairs: &[Pair]) -> AlignmentScene {
        AlignmentScene {
            images: Vec::new(),
            cameras: self.cameras.clone(),
            pairs: pairs.to_vec(),
            all_pairs: Vec::new(),
            validation_pairs: Vec::new(),
        }
    }

    /// Cameras of the images with corrections.
    fn moving_cameras(&self, corrections: &Corrections) -> Vec<MovingCamera> {
        let of_image = |image: &FeatureImage| {
            MovingCamera::new(&image.keyframe, &corrections.by_camera[image.camera])
        };
        self.images.iter().map(of_image).collect()
    }

    /// Half the width of the search band of a pair, radians.
    fn band_rad(&self, pair: &Pair, to_from_from: &Transform, round: &Round) -> f64 {
        let from = &self.images[pair.from];
        let to = &self.images[pair.to];
        // If both images are from one camera, they share its error. This error cancels unless the
        // images are rotated relative to each other. Errors of two cameras are independent and add
        // up.
        let share = if from.camera == to.camera {
            2.0 * (0.5 * to_from_from.rotation.angle()).sin()
        } else {
            std::f64::consts::SQRT_2
        };
        let baseline_m = to_from_from.translation.vector.norm();
        let direction_rad = round.rotation_rad + share * round.translation_m / baseline_m;
        let expected_rad = share * round.rotation_rad + MAX_PARALLAX * direction_rad;
        expected_rad.max(MIN_BAND_TEXELS * from.finest_texel_rad().max(to.finest_texel_rad()))
    }

    /// Matches pairs of images near their epipolar lines. Pairs with few matches are dropped.
    fn matches(&self, corrections: &Corrections, round: &Round) -> Vec<PairMatches> {
        let cameras = self.moving_cameras(corrections);
        image_pairs::choose(&self.images, &cameras, round.n_partners)
            .into_par_iter()
            .map(|pair| self.matches_of_pair(pair, &cameras, round))
            .filter(|found| found.matches.len() >= MIN_MATCHES)
            .collect()
    }

    /// Matches one pair of images near their epipolar lines.
    fn matches_of_pair(&self, pair: Pair, cameras: &[MovingCamera], round: &Round) -> PairMatches {
        let pair_cameras = [&cameras[pair.from], &cameras[pair.to]];
        let [from_pose, to_pose] = pair_cameras.map(|camera| camera.world_from_camera);
        let to_from_from = to_pose.inverse() * from_pose;
        let band_rad = self.band_rad(&pair, &to_from_from, round);
        let from = &self.images[pair.from];
        let to = &self.images[pair.to];
        PairMatches {
            pair,
            cameras: [from.camera, to.camera],
            matches: matching::matches(from, to, pair_cameras, band_rad),
            band_rad,
        }
    }

    /// Estimates a set of parameters in rounds of matching, starting from another model. Also
    /// returns the pairs of the last round. `None` without consistent matches.
    fn model(
        &self,
        set: ParamSet,
        start: &CalibrationModel,
    ) -> Option<(Vec<Pair>, CalibrationModel)> {
        let mut corrections = start.corrections.clone();
        // The coarsest round is not needed if extrinsics were already estimated or are assumed to
        // be known.
        let is_coarse =
            set.contains(ParamSet::EXTRINSICS) && !start.set.contains(ParamSet::EXTRINSICS);
        let rounds = if is_coarse { &ROUNDS[..] } else { &ROUNDS[1..] };
        let mut last = None;
        for (ix, round) in rounds.iter().enumerate() {
            // In wide bands, wrong matches disturb the less observable parameters, so only the
            // extrinsics are estimated there.
            let layout = self.layout(if ix >= 2 || !is_coarse {
                set
            } else {
                ParamSet::EXTRINSICS
            });
            if layout.n() == 0 {
                return None;
            }
            let matches = self.matches(&corrections, round);
            if matches.len() < MIN_PAIRS {
                return None;
            }
            let fit = self.fit(&matches, &layout, &corrections)?;
            let [change_rad, change_m] = self.largest_difference(&fit.corrections, &corrections);
            let is_close = change_rad < CLOSE_FRAC * round.rotation_rad
                && change_m < CLOSE_FRAC * round.translation_m;
            corrections = fit.corrections.clone();
            last = Some((matches, fit));
            if ix + 2 == rounds.len() && is_close {
                break;
            }
        }
        let (matches, fit) = last?;
        // Images without texture or overlap also give matches, but these matches are not near the
        // predicted epipolar lines.
        let cameras = self.moving_cameras(&corrections);
        let mut n_inner = 0;
        let mut n = 0;
        for pair in &matches {
            let distances = pair.distances_rad(&cameras);
            let max_rad = MAX_INNER_FRAC * pair.band_rad;
            n_inner += distances.iter().filter(|rad| rad.abs() < max_rad).count();
            n += distances.len();
        }
        log::debug!("features: {n_inner} of {n} matches are consistent");
        let is_consistent = n_inner as f64 > MIN_INNER_MATCHES * n as f64;
        let model = CalibrationModel {
            set,
            fit: Some(fit),
            corrections,
        };
        is_consistent.then(|| (matches.iter().map(|pair| pair.pair).collect(), model))
    }

    /// Minimizes the distances of given matches. The influence of distant matches decreases with
    /// every iteration.
    fn fit(&self, matches: &[PairMatches], layout: &Layout, start: &Corrections) -> Option<Fit> {
        let pairs: Vec<Pair> = matches.iter().map(|pair| pair.pair).collect();
        let mut corrections = start.clone();
        let mut assumed_noise: Option<f64> = None;
        let mut last = None;
        for _ in 0..MAX_ITERATIONS {
            let cameras = self.moving_cameras(&corrections);
            let mut distances: Vec<f64> = matches
                .iter()
                .flat_map(|pair| pair.distances_texels(&cameras))
                .collect();
            distances
                .iter_mut()
                .for_each(|distance| *distance = distance.abs());
            let measured = 1.4826 * quantile(&mut distances, 0.5, Rank::Upper)?;
            let target = measured.clamp(MIN_NOISE_TEXELS, MAX_NOISE_TEXELS);
            // The scale decreases from wide to narrow, by at most `ANNEALING` per iteration. With a
            // narrow scale at the start, most correct matches would count as outliers.
            let noise_texels = assumed_noise
                .map_or(measured, |assumed| ANNEALING * assumed)
                .max(target);
            assumed_noise = Some(noise_texels);
            let sums: Vec<_> = matches
                .par_iter()
                .map(|pair| pair.sums(&cameras, layout, noise_texels))
                .collect();
            let scales = layout.params.iter().map(|param| SCALE * param.scale());
            let values = layout.params.iter().map(|param| corrections.value(*param));
            let [scales, values] =
                [scales.collect::<Vec<f64>>(), values.collect()].map(DVector::from);
            let solution = Solution::new(scales, &values, &pairs, &sums);
            corrections.apply_step(layout, &solution.step);
            let is_converged =
                noise_texels <= target && solution.step_in_sigmas() < CONVERGED_STEP_SIGMAS;
            log::debug!(
                "features: {} matches, noise {noise_texels:.2} texels, step of {:.2} sigma",
                distances.len(),
                solution.step_in_sigmas()
            );
            last = Some(solution);
            if is_converged {
                break;
            }
        }
        Some(Fit {
            corrections,
            layout: layout.clone(),
            solution: last?,
            noise: INITIAL_NOISE,
        })
    }

    /// Largest difference between two corrections of an image. See [`MovingCamera::difference`].
    fn largest_difference(&self, one: &Corrections, other: &Corrections) -> [f64; 2] {
        let both = self
            .moving_cameras(one)
            .into_iter()
            .zip(self.moving_cameras(other));
        let differences = both.map(|(one, other)| one.difference(&other));
        differences.fold([0.0; 2], |largest, difference| {
            [0, 1].map(|ix| largest[ix].max(difference[ix]))
        })
    }

    /// Restores the given extrinsics of cameras whose estimate is not significant.
    fn reset_insignificant_extrinsics(&self, model: &mut CalibrationModel) {
        for camera in 0..self.cameras.len() {
            if model.set.contains(ParamSet::EXTRINSICS)
                && !model.has_significant(&Layout::extrinsics_of(camera))
            {
                let correction = &mut model.corrections.by_camera[camera];
                correction.rotation_rad = [0.0; 3];
                correction.translation_m = [0.0; 3];
            }
        }
    }

    /// Cross-validation group of each image. The images of each camera are distributed evenly.
    fn folds(&self) -> Vec<usize> {
        let mut n_of_camera = vec![0; self.cameras.len()];
        let mut folds = Vec::with_capacity(self.images.len());
        for image in &self.images {
            let rank = &mut n_of_camera[image.camera];
            folds.push(*rank % N_FOLDS);
            *rank += 1;
        }
        folds
    }

    /// Matches for comparing two models.
    fn validation_matches(
        &self,
        baseline: &CalibrationModel,
        variant: &CalibrationModel,
    ) -> Vec<PairMatches> {
        // The band around the epipolar lines of the baseline is wide enough to contain the epipolar
        // lines of the variant.
        let [change_rad, change_m] =
            self.largest_difference(&baseline.corrections, &variant.corrections);
        let round = Round {
            rotation_rad: LAST_ROUND.rotation_rad + change_rad,
            translation_m: LAST_ROUND.translation_m + change_m,
            n_partners: CROSS_VALIDATION_PARTNERS,
        };
        self.matches(&baseline.corrections, &round)
    }

    /// Evaluates a set of parameters with given matches. This is faster than searching for new
    /// matches, but underestimates the gain.
    fn quick_trial(
        &self,
        set: ParamSet,
        baseline: &CalibrationModel,
        matches: &[PairMatches],
    ) -> Option<Trial> {
        let layout = self.layout(baseline.set | set);
        let fit = self
            .fit(matches, &layout, &baseline.corrections)
            .filter(|_| matches.len() >= MIN_PAIRS)?;
        let corrections = fit.corrections.clone();
        let variant = CalibrationModel {
            set: baseline.set | set,
            fit: Some(fit),
            corrections,
        };
        Some(self.cross_validate(set, baseline, &variant, matches))
    }

    /// Evaluates by cross-validation how much closer matches are to their epipolar lines with the
    /// variant than with the baseline. For each group of images, both models are estimated again
    /// without this group, and then applied to the matches of this group.
    fn cross_validate(
        &self,
        set: ParamSet,
        baseline: &CalibrationModel,
        variant: &CalibrationModel,
        matches: &[PairMatches],
    ) -> Trial {
        let folds = self.folds();
        let gains: Vec<(usize, f64)> = (0..N_FOLDS)
            .into_par_iter()
            .flat_map_iter(|fold| {
                let is_held_out: Vec<bool> =
                    folds.iter().map(|of_image| *of_image == fold).collect();
                self.held_out_gains_db([baseline, variant], matches, &is_held_out)
            })
            .collect();
        log::debug!("features: {set}: gains {gains:.2?} dB");
        let gains_db: Vec<f64> = gains.iter().map(|(_, gain_db)| *gain_db).collect();
        let by_camera = gains
            .iter()
            .map(|(image, gain_db)| (&*self.cameras[self.images[*image].camera], *gain_db));
        Trial::of_gains(Candidate::Cameras(set), &gains_db)
            .with_enough_images()
            .with_cameras(by_camera)
    }

    /// Index and gain of each held-out image, dB, if two models are estimated without them.
    fn held_out_gains_db(
        &self,
        [baseline, variant]: [&CalibrationModel; 2],
        matches: &[PairMatches],
        is_held_out: &[bool],
    ) -> Vec<(usize, f64)> {
        // A pair with one held-out image must not be used, because the estimate would then depend
        // on the corners of that image.
        let (tested, used): (Vec<PairMatches>, Vec<PairMatches>) = matches
            .iter()
            .cloned()
            .partition(|pair| is_held_out[pair.pair.from] || is_held_out[pair.pair.to]);
        let both = self
            .refitted(baseline, &used)
            .zip(self.refitted(variant, &used));
        let Some((baseline, variant)) = both else {
            return Vec::new();
        };
        (0..self.images.len())
            .filter(|image| is_held_out[*image])
            .filter_map(|image| {
                let gain_db = mean_gain_db(&tested, image, [&baseline, &variant])?;
                Some((image, gain_db))
            })
            .collect()
    }

    /// Cameras after the parameters of a model are estimated again from these matches.
    fn refitted(
        &self,
        model: &CalibrationModel,
        matches: &[PairMatches],
    ) -> Option<Vec<MovingCamera>> {
        let layout = self.layout(model.set);
        if layout.n() == 0 {
            return Some(self.moving_cameras(&model.corrections));
        }
        let fit = self.fit(matches, &layout, &model.corrections)?;
        Some(self.moving_cameras(&fit.corrections))
    }
}

/// Mean decrease from baseline to variant cameras of the distances between the matches of an image
/// and their epipolar lines, dB. `None` without matches.
fn mean_gain_db(
    pairs: &[PairMatches],
    image: usize,
    [baseline, variant]: [&[MovingCamera]; 2],
) -> Option<f64> {
    let pairs = pairs
        .iter()
        .filter(|pair| pair.pair.from == image || pair.pair.to == image);
    let gains = pairs.flat_map(|pair| {
        let before = pair.distances_texels(baseline).into_iter();
        before
            .zip(pair.distances_texels(variant))
            .map(|(before, after)| {
                20.0 * (NOISE_TEXELS.hypot(before) / NOISE_TEXELS.hypot(after)).log10()
            })
    });
    let gains: Vec<f64> = gains.collect();
    (!gains.is_empty()).then(|| gains.iter().sum::<f64>() / gains.len() as f64)
}
