//! Image parameters that are optimized with the field. They are pose corrections and appearance
//! embeddings (lighting and exposure). Trials decide which of them are kept. For images that were
//! not trained on, the parameters are interpolated.
//!
//! From a fixed step on, candidates are tried one after another, unless a quick check shows no
//! gain. The field is trained for some steps with the candidate, restored, and trained for as many
//! steps without it. The candidate is kept if it improves the prediction of validation images. The
//! parameters of validation images are interpolated from the training images before and after them
//! in time.

use super::NerfModel;
use crate::Error;
use crate::model_options::CommonOptions;
use crate::nerf::extent::Extent;
use crate::nerf::field_trainer::RayColor;
use crate::nerf::params::{EMBEDDING, IMAGE_PARAM_STRIDE};
use crate::nerf::rays::{self, RayImage, RaySampling};
use calibration::{
    CameraCorrection, CameraRefinement, Candidate, EMBEDDING_DIM, MIN_VALIDATION_IMAGES, ParamSet,
    Trial, TrialReport, drift_weight, interpolate,
};
use keyframe::Keyframe;
use kinematics::{Stamp, Transform};
use model_files::checkpoint::Array;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// This constant and the next two are divisors of the number of planned steps. They give the step
/// at which image parameters start to be optimized, the step at which trials start, and the length
/// of each half of a trial. Before the first start, the field is too coarse. With longer halves,
/// smaller gains are detected, but a rejected variant wastes all steps of its half.
const POSE_START_DIVISOR: u64 = 32;
const TRIAL_START_DIVISOR: u64 = 8;
const TRIAL_LENGTH_DIVISOR: u64 = 16;
/// Batches of rays for a comparison. They have some hundred rays per image. More rays reduce the
/// noise of each image's score, but decisions are also limited by the scatter between images.
const VALIDATION_BATCHES: u64 = 8;
/// Seed for choosing the rays of a comparison. It is fixed, so that variant and baseline are
/// compared on the same rays.
const VALIDATION_SEED: u64 = 0x6a75_6467;

/// Snapshot of the field at some step, in host memory.
#[derive(Debug)]
pub(super) struct FieldSnapshot {
    pub(super) arrays: Vec<Array>,
    pub(super) step: u64,
    /// Number of images whose hints were applied to the field.
    pub(super) n_hinted: usize,
    pub(super) learned_params: ParamSet,
}

/// Trials of image parameters.
#[derive(Debug, Default)]
pub(super) struct Trials {
    /// Candidates in the order of their trials. The first candidate is on trial.
    remaining: VecDeque<ParamSet>,
    pub(super) finished: Vec<TrialReport>,
    running: Option<RunningTrial>,
}

/// A trial in progress. Its first half trains the variant, and its second half trains the baseline.
#[derive(Debug)]
struct RunningTrial {
    before: FieldSnapshot,
    /// The field at the end of the first half, and the mean squared error of each validation image.
    variant: Option<(FieldSnapshot, Vec<f64>)>,
}

/// The camera parameters in a set that a field can optimize.
pub(super) fn image_params_of_set(set: ParamSet) -> ParamSet {
    set & (ParamSet::IMAGE_POSES | ParamSet::IMAGE_GAINS)
}

impl Trials {
    pub(super) fn of(choice: &CameraRefinement) -> Self {
        let remaining = choice
            .candidates()
            .iter()
            .map(|set| image_params_of_set(*set))
            .filter(|set| !set.is_empty());
        Self {
            remaining: remaining.collect(),
            ..Self::default()
        }
    }

    /// The trials that remain after some have finished.
    #[must_use]
    pub(super) fn after(mut self, finished: Vec<TrialReport>, are_finished: bool) -> Self {
        self.remaining.drain(
            ..if are_finished {
                self.remaining.len()
            } else {
                finished.len().min(self.remaining.len())
            },
        );
        Self { finished, ..self }
    }

    pub(super) fn are_finished(&self) -> bool {
        self.remaining.is_empty()
    }

    /// The field before the running trial. `None` if no trial is running.
    pub(super) fn before(&self) -> Option<&FieldSnapshot> {
        self.running.as_ref().map(|trial| &trial.before)
    }

    /// The step at which a trial starts or changes its phase.
    fn next_step(&self, common: &CommonOptions) -> Option<u64> {
        let share = |of: u64| (common.n_planned_steps / of).max(1);
        // Both halves begin at the same step, because the field is restored in between. The end of
        // each half is therefore measured from that step.
        let at = match self.before() {
            None => share(TRIAL_START_DIVISOR),
            Some(before) => before.step + share(TRIAL_LENGTH_DIVISOR),
        };
        (!self.are_finished()).then_some(at)
    }

    /// Steps from `step` until a trial starts or changes its phase.
    pub(super) fn steps_left(&self, step: u64, common: &CommonOptions) -> u64 {
        self.next_step(common)
            .map_or(u64::MAX, |at| at.saturating_sub(step).max(1))
    }
}

impl NerfModel {
    /// Image parameters that the next step optimizes.
    pub(super) fn current_params(&self) -> ParamSet {
        if self.step >= self.options.common.n_planned_steps / POSE_START_DIVISOR {
            self.learned_params
        } else {
            ParamSet::empty()
        }
    }

    /// When due, starts a trial, switches it to the baseline, or concludes it.
    pub(super) fn advance_trials_when_due(&mut self) -> Result<(), Error> {
        while self
            .trials
            .next_step(&self.options.common)
            .is_some_and(|at| self.step >= at)
        {
            self.finish_in_flight()?;
            self.advance_trial()?;
        }
        Ok(())
    }

    fn advance_trial(&mut self) -> Result<(), Error> {
        let Some(candidate) = self.trials.remaining.front().copied() else {
            return Ok(());
        };
        match self.trials.running.take() {
            // With few images, no gain can be significant.
            None if self.validation_images.len() < MIN_VALIDATION_IMAGES => {
                log::info!(
                    "{candidate}: no trial: {} validation images found, at least {MIN_VALIDATION_IMAGES} needed",
                    self.validation_images.len()
                );
                self.end_trials();
            }
            // At the start, the quick check comes first, because a trial takes steps.
            None => match self.rule_out(candidate)? {
                Some(trial) => self.end_trial(&trial),
                None => {
                    self.trials.running = Some(RunningTrial {
                        before: self.snapshot()?,
                        variant: None,
                    });
                    self.learned_params |= candidate;
                }
            },
            // After the first half, the variant is scored and stored, and the baseline starts from
            // the same field.
            Some(RunningTrial {
                before,
                variant: None,
            }) => {
                let variant_errors = self.validation_errors()?;
                let variant = self.snapshot()?;
                self.n_discarded_steps += self.step - before.step;
                self.restore(&before)?;
                self.trials.running = Some(RunningTrial {
                    before,
                    variant: Some((variant, variant_errors)),
                });
            }
            // At the end, the baseline is scored. The field already is the baseline, so it is
            // replaced only if the variant is kept.
            Some(RunningTrial {
                before,
                variant: Some((variant, variant_errors)),
            }) => {
                let trial = measure_gain(candidate, &variant_errors, &self.validation_errors()?);
                if trial.kept {
                    self.n_discarded_steps += self.step - before.step;
                    self.restore(&variant)?;
                }
                self.end_trial(&trial);
            }
        }
        Ok(())
    }

    fn end_trial(&mut self, trial: &Trial) {
        trial.log_result();
        self.trials.finished.push(trial.report());
        self.trials.remaining.pop_front();
        if self.trials.are_finished() {
            self.end_trials();
        }
    }

    /// Restores the field before the running trial, which starts again at the next step.
    pub(super) fn undo_trial(&mut self) -> Result<(), Error> {
        let Some(RunningTrial { before, .. }) = self.trials.running.take() else {
            return Ok(());
        };
        self.n_discarded_steps += self.step - before.step;
        self.restore(&before)
    }

    /// Ends all trials. This is needed if the field is recreated or loses an image, because
    /// snapshots then do not match the field.
    pub(super) fn abort_trials(&mut self) -> Result<(), Error> {
        let Some(before) = self.trials.before() else {
            return Ok(());
        };
        // The field keeps its steps, but not the parameters on trial, whose benefit is unknown.
        self.learned_params = before.learned_params;
        if let Some((_, field_trainer)) = &mut self.field {
            field_trainer.reset_image_params_except(&self.gpu, self.learned_params)?;
        }
        self.end_trials();
        Ok(())
    }

    /// Ends all trials. Validation images become training images.
    fn end_trials(&mut self) {
        self.trials.remaining.clear();
        self.trials.running = None;
        self.images.append(&mut self.validation_images);
        self.is_extent_stale = true;
    }

    /// Estimates the gain of a candidate without training it, and returns the result if the gain is
    /// not significant. For appearance, checks whether scaling pictures by gains interpolated from
    /// training images brings them closer to the validation images.
    fn rule_out(&mut self, candidate: ParamSet) -> Result<Option<Trial>, Error> {
        if !candidate.contains(ParamSet::IMAGE_GAINS) {
            return Ok(None);
        }
        let training_images = self.images.clone();
        let validation_images = self.validation_images.clone();
        let own = self.compare(&training_images, &[])?;
        let log_gains: Vec<f64> = own.iter().map(Comparison::log_gain).collect();
        // The mean over all images is the brightness of the field itself.
        let mean = log_gains.iter().sum::<f64>() / log_gains.len().max(1) as f64;
        let mut known: BTreeMap<&str, BTreeMap<i64, [f64; 1]>> = BTreeMap::new();
        for (image, log_gain) in training_images.iter().zip(log_gains) {
            let camera_gains = known.entry(&image.keyframe.camera).or_default();
            camera_gains.insert(image.keyframe.stamp.0, [log_gain - mean]);
        }
        let compared = self.compare(&validation_images, &[])?;
        let variant = validation_images.iter().zip(&compared).map(|(image, own)| {
            let of_camera = known.get(image.keyframe.camera.as_ref());
            let [log_gain] = of_camera
                .and_then(|of_camera| interpolate(of_camera, image.keyframe.stamp))
                .unwrap_or_default();
            own.error_with_gain(log_gain.exp())
        });
        let baseline = compared.iter().map(|own| own.error_with_gain(1.0));
        let trial = measure_gain(
            candidate,
            &variant.collect::<Vec<_>>(),
            &baseline.collect::<Vec<_>>(),
        );
        log::info!("estimated by scaling brightness: {trial}");
        Ok((!trial.kept).then_some(trial))
    }

    /// Mean squared color error of each validation image, with its pose and embedding interpolated
    /// from training images before and after it.
    fn validation_errors(&mut self) -> Result<Vec<f64>, Error> {
        let corrections = self.learned_corrections()?;
        let correction_of = |image: &RayImage| corrections.get(image.keyframe.camera.as_ref());
        let with_predicted_pose = |image: &RayImage| match correction_of(image) {
            Some(correction) => RayImage::new(correction.moved(&image.keyframe).into()),
            None => image.clone(),
        };
        let images: Vec<RayImage> = self
            .validation_images
            .iter()
            .map(with_predicted_pose)
            .collect();
        let appearance_embeddings: Vec<_> = self
            .validation_images
            .iter()
            .map(|image| interpolated_embedding(&corrections, image))
            .collect();
        let compared = self.compare(&images, &appearance_embeddings)?;
        Ok(compared
            .iter()
            .map(|own| own.error / f64::max(own.n_rays, 1.0))
            .collect())
    }

    /// Compares images with their renderings, using these appearance embeddings. If the list is
    /// empty, neutral embeddings are used.
    fn compare(
        &mut self,
        images: &[RayImage],
        appearance_embeddings: &[[f64; EMBEDDING_DIM]],
    ) -> Result<Vec<Comparison>, Error> {
        let mut sums = vec![Comparison::default(); images.len()];
        let Some((extent, field_trainer)) = &mut self.field else {
            return Ok(sums);
        };
        for batch in 0..VALIDATION_BATCHES {
            let n_rays = field_trainer.sizes.nerf_budget.n_rays;
            let draw = RaySampling {
                seed: VALIDATION_SEED,
                step: batch,
                n_rays,
                begin: super::NEAR_DISTANCE,
            };
            let rays = rays::draw(images, extent, &draw);
            for (ray, render_rays) in rays.iter().zip(field_trainer.render_rays(
                &self.gpu,
                &self.options,
                &rays,
                appearance_embeddings,
            )?) {
                // Masked pixels have no target. In a trial that diverges, the field may be
                // non-finite.
                let [rgb @ .., alpha] = ray.target_rgb.to_le_bytes();
                if alpha > 0 && render_rays.error.is_finite() {
                    sums[ray.embedding as usize]
                        .add(&render_rays, rgb.map(|value| f64::from(value) / 255.0));
                }
            }
        }
        Ok(sums)
    }

    /// Optimized correction of each camera. It is empty if no correction is optimized. No submit
    /// may be in flight.
    pub(super) fn learned_corrections(&self) -> Result<BTreeMap<String, CameraCorrection>, Error> {
        let Some((extent, field_trainer)) = &self.field else {
            return Ok(BTreeMap::new());
        };
        let image_params = field_trainer.image_param_values(&self.gpu, self.images.len())?;
        let mut corrections: BTreeMap<String, CameraCorrection> = BTreeMap::new();
        // Later images are not part of the field yet, so they have no parameters.
        for (image, image_params) in self.images.iter().zip(&image_params).take(self.n_hinted) {
            let correction = corrections
                .entry(image.keyframe.camera.to_string())
                .or_default();
            if self.learned_params.contains(ParamSet::IMAGE_POSES) {
                correction.drift.insert(
                    image.keyframe.stamp.0,
                    drift_of(&image.keyframe, image_params, extent),
                );
            }
            if self.learned_params.contains(ParamSet::IMAGE_GAINS) {
                correction.appearance_embeddings.insert(
                    image.keyframe.stamp.0,
                    std::array::from_fn(|ix| image_params[EMBEDDING + ix]),
                );
            }
        }
        for correction in corrections
            .values_mut()
            .filter(|_| self.learned_params.contains(ParamSet::IMAGE_POSES))
        {
            correction.drift_weight = drift_weight(&correction.drift, extent.radius_m);
        }
        Ok(corrections)
    }

    /// Initializes the embeddings of new images from the embeddings of images before and after
    /// them.
    pub(super) fn initialize_embeddings(&mut self) -> Result<(), Error> {
        if !self.learned_params.contains(ParamSet::IMAGE_GAINS)
            || self.n_hinted == self.images.len()
        {
            return Ok(());
        }
        self.finish_in_flight()?;
        let corrections = self.learned_corrections()?;
        let learned_params = self.current_params();
        let Some((_, field_trainer)) = &mut self.field else {
            return Ok(());
        };
        let appearance_embeddings: Vec<_> = self.images[self.n_hinted..]
            .iter()
            .map(|image| interpolated_embedding(&corrections, image))
            .collect();
        // If there are no parameters so far, the next step allocates them, and all of them start at
        // zero.
        if field_trainer.images.is_some() {
            field_trainer.allocate_images(&self.gpu, self.images.len(), learned_params)?;
            field_trainer.initialize_images(&self.gpu, self.n_hinted, &appearance_embeddings);
        }
        Ok(())
    }
}

/// Appearance embedding for a camera and stamp, interpolated between the images before and after
/// it. Falls back to the mean of all embeddings.
pub(super) fn embedding_of(
    corrections: &BTreeMap<String, CameraCorrection>,
    image: Option<&(Arc<str>, Stamp)>,
) -> [f64; EMBEDDING_DIM] {
    let embedding_of_image = image.and_then(|(camera, stamp)| {
        interpolate(
            &corrections.get(camera.as_ref())?.appearance_embeddings,
            *stamp,
        )
    });
    let all = || all_embeddings(corrections);
    let n = all().count().max(1) as f64;
    embedding_of_image.unwrap_or_else(|| {
        std::array::from_fn(|ix| all().map(|embedding| embedding[ix]).sum::<f64>() / n)
    })
}

/// Appearance embedding of an image, interpolated between the embeddings of its camera. It is
/// neutral if the camera has no embeddings.
fn interpolated_embedding(
    corrections: &BTreeMap<String, CameraCorrection>,
    image: &RayImage,
) -> [f64; EMBEDDING_DIM] {
    corrections
        .get(image.keyframe.camera.as_ref())
        .and_then(|correction| interpolate(&correction.appearance_embeddings, image.keyframe.stamp))
        .unwrap_or_default()
}

/// The embeddings of all images of all cameras.
fn all_embeddings(
    corrections: &BTreeMap<String, CameraCorrection>,
) -> impl Iterator<Item = &[f64; EMBEDDING_DIM]> {
    corrections
        .values()
        .flat_map(|correction| correction.appearance_embeddings.values())
}

/// Converts a pose correction of a field to a rotation and a translation after `camera_from_world`,
/// in the camera's axes. The correction of the field is a rotation about the camera and a
/// translation in world axes.
fn drift_of(
    keyframe: &Keyframe,
    [a, b, c, x, y, z, ..]: &[f64; IMAGE_PARAM_STRIDE],
    extent: &Extent,
) -> [f64; 6] {
    let given = &keyframe.world_from_camera;
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(*a, *b, *c));
    let translation_m = Vector3::new(*x, *y, *z) * extent.radius_m;
    // The kernel adds the translation in world axes, and rotates directions about the camera. The
    // rotation is therefore on the left.
    let found = Transform::from_parts(
        Translation3::from(given.translation.vector + translation_m),
        rotation * given.rotation,
    );
    let drift = found.inverse() * given;
    let rotation_rad = drift.rotation.scaled_axis();
    let translation_m = drift.translation.vector;
    [
        rotation_rad.x,
        rotation_rad.y,
        rotation_rad.z,
        translation_m.x,
        translation_m.y,
        translation_m.z,
    ]
}

/// Sums over the rays of an image. Products are summed over rays and color channels.
#[derive(Clone, Copy, Debug, Default)]
struct Comparison {
    error: f64,
    n_rays: f64,
    sum_rendered_sq: f64,
    sum_rendered_target: f64,
    sum_target_sq: f64,
}

impl Comparison {
    fn add(&mut self, render_rays: &RayColor, target: [f64; 3]) {
        self.error += render_rays.error;
        self.n_rays += 1.0;
        for (rendered, target) in render_rays.rgb.into_iter().zip(target) {
            self.sum_rendered_sq += rendered * rendered;
            self.sum_rendered_target += rendered * target;
            self.sum_target_sq += target * target;
        }
    }

    /// Logarithm of the gain that minimizes the squared error of the picture.
    fn log_gain(&self) -> f64 {
        // This is the least-squares solution, at which the derivative of |gain * rendered -
        // target|^2 is zero. A black picture has no gain.
        let gain = self.sum_rendered_target / self.sum_rendered_sq;
        if gain > 0.0 && gain.is_finite() {
            gain.ln()
        } else {
            0.0
        }
    }

    /// Sum of squared errors of the picture scaled by `gain`.
    fn error_with_gain(&self, gain: f64) -> f64 {
        gain * gain * self.sum_rendered_sq - 2.0 * gain * self.sum_rendered_target
            + self.sum_target_sq
    }
}

/// Gain of a candidate, from mean squared errors of the same images with it and without it.
fn measure_gain(candidate: ParamSet, variant: &[f64], baseline: &[f64]) -> Trial {
    // The gains are in dB, so that bright and dark images have the same weight. Images without rays
    // have an error of 0, and no gain.
    let gains: Vec<f64> = variant
        .iter()
        .zip(baseline)
        .filter(|(variant, baseline)| **variant > 0.0 && **baseline > 0.0)
        .map(|(variant, baseline)| 10.0 * (baseline / variant).log10())
        .collect();
    Trial::of_gains(Candidate::Cameras(candidate), &gains).with_enough_images()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scenes as scenes;

    #[test]
    fn drift_matches_pose_correction_in_field() {
        let keyframe = scenes::ring(&[scenes::floor()], nalgebra::Point3::origin(), 3)[1].clone();
        let extent = Extent {
            center_m: [0.1, 0.2, 0.3],
            radius_m: 2.5,
        };
        let pose = [0.02, -0.03, 0.01, 0.004, -0.002, 0.006, 0.5, 0.0, 0.0];
        let drift = BTreeMap::from([(keyframe.stamp.0, drift_of(&keyframe, &pose, &extent))]);
        let lens = CameraCorrection {
            drift,
            ..CameraCorrection::default()
        }
        .apply(&keyframe);
        let given = &keyframe.world_from_camera;
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.03, 0.01));
        let at: Vector3<f64> = given.translation.vector + 2.5 * Vector3::new(0.004, -0.002, 0.006);
        assert!((lens.world_from_camera.translation.vector - at).norm() < 1e-12);
        assert!(
            lens.world_from_camera
                .rotation
                .angle_to(&(rotation * given.rotation))
                < 1e-12
        );
    }

    #[test]
    fn only_significant_gains_are_kept() {
        let baseline = [1e-3; 6];
        assert!(
            measure_gain(
                ParamSet::IMAGE_POSES,
                &baseline.map(|error| 0.8 * error),
                &baseline
            )
            .kept
        );
        assert!(!measure_gain(ParamSet::IMAGE_POSES, &baseline, &baseline).kept);
        assert!(
            !measure_gain(
                ParamSet::IMAGE_POSES,
                &baseline.map(|error| 0.999 * error),
                &baseline
            )
            .kept,
            "below the minimum gain"
        );
        let mixed = [0.5e-3, 2e-3, 0.5e-3, 2e-3, 0.5e-3, 1.2e-3];
        assert!(
            !measure_gain(ParamSet::IMAGE_POSES, &mixed, &baseline).kept,
            "not significant"
        );
        assert!(
            !measure_gain(ParamSet::IMAGE_POSES, &[0.5e-3; 3], &[1e-3; 3]).kept,
            "too few images"
        );
    }
}
