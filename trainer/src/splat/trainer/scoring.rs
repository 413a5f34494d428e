//! Scores the model in training on validation images.

use super::products::{self, Products};
use super::renderer::DrawnView;
use super::view_set::VIEWS_AT_ONCE;
use super::SplatTrainer;
use crate::splat::params::Camera;
use crate::splat::trials::{ImageId, Scores};
use crate::splat::views::{Level, camera_of};
use crate::{Error, Method};
use calibration::{CalibratedCamera, CameraCorrection, ParamSet, interpolate};
use keyframe::Keyframe;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Number of latest views whose gains are computed when gains are enabled in a live run. It is
/// twice the number of keyframes that the decision is based on, so it usually includes all that
/// arrived after the change of exposure. Each view costs one picture.
const MAX_NEW_EXPOSURES: usize = 16;

/// A keyframe and the sums from its comparison with the rendered picture.
type ScoredKeyframe = (Arc<Keyframe>, [Products; 3]);

/// Corrections by camera name.
type CameraCorrections = BTreeMap<String, CameraCorrection>;

impl SplatTrainer {
    /// PSNR in dB of a displayed view against a keyframe's image; `None` if their sizes differ or
    /// training has not started.
    pub(super) fn psnr_of_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        keyframe: &Keyframe,
    ) -> Result<Option<f64>, Error> {
        // Not `wait`: a score must not be delayed by the compilation of training pipelines. The
        // caller can score the picture on the CPU.
        let Some(learn) = self.optimizer.pipelines.ready() else {
            return Ok(None);
        };
        let rgba = keyframe.rgba_srgb.as_ref();
        if rgba.len() != 4 * camera.size_px[0] as usize * camera.size_px[1] as usize {
            return Ok(None);
        }
        let drawn = DrawnView {
            splats: self.trials.displayed(&self.model.splats),
            camera,
            background_srgb,
        };
        let products =
            self.renderer
                .compare_with_upload(&mut self.recorder, drawn, &learn.score, rgba)?;
        products::psnr(&products).map(Some)
    }

    /// PSNR in dB of the validation keyframes, or of an evenly spaced subset if there are many.
    pub(super) fn score_validation(&mut self) -> Result<Scores, Error> {
        Ok(self
            .compare_validation()?
            .iter()
            .filter_map(score_of)
            .collect())
    }

    /// Scores the validation keyframes with and without gains, and enables gains if their benefit
    /// is significant. The gains of a validation keyframe are interpolated in time between the
    /// neighboring training images.
    pub(super) fn try_gains(&mut self) -> Result<(), Error> {
        let validation = self.compare_validation()?;
        let corrections = self.learned_corrections()?;
        let neighbors: Vec<Vec<usize>> = validation
            .iter()
            .map(|(keyframe, _)| self.views.neighbors(keyframe))
            .collect();
        // The gains of a validation keyframe itself would be fitted to the image that they are
        // scored on. Those of its neighbors predict them only if exposure really changes.
        let mut known: BTreeMap<usize, [f64; 3]> = BTreeMap::new();
        self.add_gains(
            &mut known,
            neighbors.iter().flatten().copied().collect(),
            &corrections,
        )?;
        // Subtract the mean over all images, because it is an error of the model's brightness.
        let mean = [0, 1, 2].map(|color| mean_gain(&known, color));
        let mut baseline_db = Vec::new();
        let mut variant_db = Vec::new();
        for ((keyframe, products), neighbors) in validation.iter().zip(&neighbors) {
            let mut neighbor_gains: BTreeMap<i64, [f64; 3]> = BTreeMap::new();
            for view_ix in neighbors {
                if let Some(gains) = known.get(view_ix) {
                    let stamp = self.views.keyframe(*view_ix).stamp.0;
                    let relative = [0, 1, 2].map(|color| gains[color] - mean[color]);
                    neighbor_gains.insert(stamp, relative);
                }
            }
            let gains = interpolate(&neighbor_gains, keyframe.stamp)
                .unwrap_or_default()
                .map(f64::exp);
            baseline_db.extend(products::psnr_with_gains(products, [1.0; 3]));
            variant_db.extend(products::psnr_with_gains(products, gains));
        }
        match self.trials.decide_gains(&baseline_db, &variant_db) {
            Some(gains) => self.enable_gains(gains, known, mean, 0),
            None => Ok(()),
        }
    }

    /// Optimizes image gains from now on. From the view `first_ix` on, starts with the gains that
    /// best match pictures to images, relative to `mean`; those in `known` are already computed.
    fn enable_gains(
        &mut self,
        gains: ParamSet,
        mut known: BTreeMap<usize, [f64; 3]>,
        mean: [f64; 3],
        first_ix: usize,
    ) -> Result<(), Error> {
        // Read before gains are enabled: the pictures for the initial gains have none.
        let corrections = self.learned_corrections()?;
        self.model.cameras.enable(gains);
        // Assigns the slots that the gains are written to.
        self.prepare_training()?;
        self.add_gains(
            &mut known,
            (first_ix..self.views.len()).collect(),
            &corrections,
        )?;
        for (view_ix, gains) in &known {
            let log_gains = [0, 1, 2].map(|color| gains[color] - mean[color]);
            let keyframe = self.views.keyframe(*view_ix);
            self.model
                .cameras
                .initialize_gains(&self.recorder.gpu, keyframe, log_gains);
        }
        Ok(())
    }

    /// Adds a training keyframe that arrives at the current step. If image gains are watched for or
    /// optimized, compares the keyframe with the picture before training on it. During a trial, or
    /// if memory is too small for the picture, the keyframe is added without a comparison.
    pub(super) fn add_live_arrival(&mut self, keyframe: Arc<Keyframe>) -> Result<(), Error> {
        // Before the first trial, the model is too coarse for a comparison. During a trial, the
        // change must not depend on which half is in training.
        let is_watched = self.trials.watches_gains();
        let is_compared = is_watched || self.model.cameras.set.contains(ParamSet::IMAGE_GAINS);
        if !is_compared
            || self.schedule.step < self.trials.steps.first_trial
            || self.trials.running_trial().is_some()
        {
            return self.add_arrival(keyframe);
        }
        let learn = self.learn()?;
        let background_srgb = self.background_srgb();
        let camera = corrected_camera(&self.learned_corrections()?, &keyframe);
        let drawn = DrawnView {
            splats: &self.model.splats,
            camera: &camera,
            background_srgb,
        };
        let rgba = keyframe.rgba_srgb.as_ref();
        let products =
            match self
                .renderer
                .compare_with_upload(&mut self.recorder, drawn, &learn.score, rgba)
            {
                Err(error) if error.is_out_of_memory() => return self.add_arrival(keyframe),
                products => products?,
            };
        let log_gains = products::log_gains(&products);
        self.add_arrival(keyframe.clone())?;
        // While gains are watched for, they are not optimized, so there is nothing to initialize.
        if is_watched {
            let psnr = |gains| products::psnr_with_gains(&products, gains);
            let needed = self.trials.add_arrival_gains(&keyframe, log_gains, psnr);
            // The model still has the brightness of earlier views, which need no gains. The
            // latest views include those after the change of exposure.
            let first_ix = self.views.len().saturating_sub(MAX_NEW_EXPOSURES);
            return needed.map_or(Ok(()), |gains| {
                self.enable_gains(gains, BTreeMap::new(), [0.0; 3], first_ix)
            });
        }
        // Training would need many steps on this image to reach these gains. Until then, its
        // brightness would change the model.
        self.views
            .assign_lenses(&self.recorder.gpu, &mut self.model.cameras)?;
        self.model
            .cameras
            .initialize_gains(&self.recorder.gpu, &keyframe, log_gains);
        Ok(())
    }

    /// Computes the gains of those views that `known` does not contain yet.
    fn add_gains(
        &mut self,
        known: &mut BTreeMap<usize, [f64; 3]>,
        view_ixs: BTreeSet<usize>,
        corrections: &CameraCorrections,
    ) -> Result<(), Error> {
        let unknown: Vec<usize> = view_ixs
            .into_iter()
            .filter(|view_ix| !known.contains_key(view_ix))
            .collect();
        // In chunks: images are downscaled and uploaded in parallel, but not all of them fit into
        // memory on a software adapter.
        for chunk in unknown.chunks(VIEWS_AT_ONCE) {
            let places = chunk.iter().map(|view_ix| (*view_ix, 0)).collect();
            self.views
                .upload(&mut self.recorder, &places, self.schedule.step)?;
            for view_ix in chunk {
                known.insert(*view_ix, self.gains_of(*view_ix, corrections)?);
            }
        }
        Ok(())
    }

    /// Logarithms of the gains that best match the picture of a view to its uploaded image.
    fn gains_of(
        &mut self,
        view_ix: usize,
        corrections: &CameraCorrections,
    ) -> Result<[f64; 3], Error> {
        let learn = self.learn()?;
        let camera = corrected_camera(corrections, self.views.keyframe(view_ix));
        let background_srgb = self.background_srgb();
        let (_, Level { image, .. }) = self.views.ready_level((view_ix, 0))?;
        let drawn = DrawnView {
            splats: &self.model.splats,
            camera: &camera,
            background_srgb,
        };
        let products = self
            .renderer
            .compare(&mut self.recorder, drawn, &learn.score, image)?;
        Ok(products::log_gains(&products))
    }

    fn compare_validation(&mut self) -> Result<Vec<ScoredKeyframe>, Error> {
        let learn = self.learn()?;
        let corrections = self.learned_corrections()?;
        let background_srgb = self.background_srgb();
        let mut compared = Vec::new();
        for id in self.trials.scored() {
            // The keyframe may have been removed since the start of the trial.
            let Some(validation) = self.trials.validation(&id) else {
                continue;
            };
            let camera = corrected_camera(&corrections, &validation.keyframe);
            let image = validation.uploaded(&self.recorder.gpu)?;
            let drawn = DrawnView {
                splats: &self.model.splats,
                camera: &camera,
                background_srgb,
            };
            let products = self
                .renderer
                .compare(&mut self.recorder, drawn, &learn.score, image)?;
            compared.push((validation.keyframe.clone(), products));
        }
        Ok(compared)
    }

    /// Current corrections of each camera, including those of a running trial. They apply to
    /// keyframes that alignment has already corrected.
    pub(super) fn learned_corrections(&self) -> Result<CameraCorrections, Error> {
        let cameras = &self.model.cameras;
        if cameras.set.is_empty() {
            return Ok(CameraCorrections::new());
        }
        cameras.corrections(
            &self.recorder.gpu,
            cameras.set,
            &cameras.params,
            self.seeding.scene.size_m,
        )
    }
}

/// Identity and PSNR in dB of a compared keyframe; `None` if it is fully masked.
fn score_of((keyframe, products): &ScoredKeyframe) -> Option<(ImageId, f64)> {
    Some((
        (keyframe.camera.clone(), keyframe.stamp),
        products::psnr_with_gains(products, [1.0; 3])?,
    ))
}

/// Mean of the logarithms of the gains of one color over all views.
fn mean_gain(known: &BTreeMap<usize, [f64; 3]>, color: usize) -> f64 {
    known.values().map(|gains| gains[color]).sum::<f64>() / known.len().max(1) as f64
}

/// The camera of a keyframe with its corrections, for drawing.
pub(super) fn corrected_camera(corrections: &CameraCorrections, keyframe: &Keyframe) -> Camera {
    // A camera without corrections is drawn as its keyframe reports it.
    let lens = corrections.get(keyframe.camera.as_ref()).map_or_else(
        || CalibratedCamera::of(keyframe),
        |correction| correction.apply(keyframe),
    );
    Camera {
        world_from_camera: lens.world_from_camera,
        focal_px: lens.focal_px,
        principal_px: lens.principal_px,
        ..camera_of(keyframe)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::eval::{PixelPair, psnr};
    use crate::splat::training_tests::{n_keyframes, options, request, train};
    use crate::test_scenes::calibrated_camera;
    use calibration::{CameraRefinement, ParamSet};
    use gpu::Gpu;
    use gpu::testing::test_gpu;
    use keyframe::Split;

    const GAINS: ParamSet = ParamSet::IMAGE_GAINS;

    fn trained(keyframes: &[Arc<Keyframe>], gpu: Arc<Gpu>, n_steps: u64) -> SplatTrainer {
        let options = options().with(|options| {
            options.common.cameras = CameraRefinement::Try(vec![GAINS]);
            options.common.n_planned_steps = 1000;
        });
        let mut trainer = SplatTrainer::new(gpu, options).unwrap();
        for keyframe in keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, n_steps);
        trainer
    }

    #[test]
    fn scores_match_rendered_pictures() {
        let gpu = test_gpu();
        let keyframes = n_keyframes(&gpu, 12, true);
        let mut trainer = trained(&keyframes, gpu, 60);
        let validation: Vec<_> = keyframes
            .iter()
            .filter(|keyframe| keyframe.split == Split::Validation)
            .collect();
        let scores = trainer.score_validation().unwrap();
        assert_eq!(scores.len(), validation.len());
        for ((id, score), keyframe) in scores.iter().zip(validation) {
            assert_eq!(id.1, keyframe.stamp);
            let background_srgb = trainer.background_srgb();
            assert!(background_srgb[0] > 0.1, "{background_srgb:?}");
            let request = crate::RenderRequest {
                background_srgb,
                ..request(keyframe.world_from_camera)
            };
            let picture = trainer.render(&request).unwrap();
            let pair =
                PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert!((psnr(&pair).unwrap() - score).abs() < 1e-9);
        }
    }

    #[test]
    fn gpu_scores_match_rendered_pictures_bit_for_bit() {
        let gpu = test_gpu();
        let keyframes = n_keyframes(&gpu, 5, true);
        let request_for = |keyframe: &Keyframe| request(keyframe.world_from_camera);
        let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
        trainer.push(keyframes[1].clone()).unwrap();
        train(&mut trainer, 20);
        // The mask starts and ends in the middle of a workgroup. The unmasked images that follow
        // reuse the buffer.
        let mut rgba = keyframes[0].rgba_srgb.to_vec();
        rgba.as_chunks_mut::<4>().0[250..900]
            .iter_mut()
            .for_each(|pixel| pixel[3] = 0);
        let masked = Keyframe {
            rgba_srgb: rgba.into(),
            ..keyframes[0].as_ref().clone()
        };
        for keyframe in [&masked, &keyframes[0], &keyframes[3]] {
            let picture = trainer.render(&request_for(keyframe)).unwrap();
            let pair =
                PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert_eq!(
                trainer.psnr(&request_for(keyframe), keyframe).unwrap(),
                Some(psnr(&pair).unwrap())
            );
        }
        // A picture compared with itself.
        let picture = trainer.render(&request_for(&keyframes[0])).unwrap();
        let mut rgba = picture.rgba_srgb;
        rgba.as_chunks_mut::<4>()
            .0
            .iter_mut()
            .for_each(|pixel| pixel[3] = 255);
        let same = Keyframe {
            rgba_srgb: rgba.into(),
            ..keyframes[0].as_ref().clone()
        };
        assert_eq!(
            trainer.psnr(&request_for(&same), &same).unwrap(),
            Some(f64::INFINITY)
        );
        let fully_masked = Keyframe {
            rgba_srgb: vec![0; same.rgba_srgb.len()].into(),
            ..same.clone()
        };
        assert!(matches!(
            trainer.psnr(&request_for(&same), &fully_masked),
            Err(Error::AllPixelsMasked)
        ));
        let small = crate::RenderRequest {
            size_px: [8, 8],
            ..request_for(&same)
        };
        assert_eq!(trainer.psnr(&small, &same).unwrap(), None, "another size");
        let mut loaded = SplatTrainer::from_arrays(
            trainer.recorder.gpu.clone(),
            options(),
            &trainer.arrays().unwrap(),
        )
        .unwrap();
        assert_eq!(
            loaded.psnr(&request_for(&same), &same).unwrap(),
            None,
            "the training pipelines are not compiled"
        );
    }

    /// Darkens the second half of the images by one stop.
    fn with_exposure_step(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
        let darken = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
            let mut rgba = keyframe.rgba_srgb.to_vec();
            if ix >= keyframes.len() / 2 {
                rgba.as_chunks_mut::<4>()
                    .0
                    .iter_mut()
                    .for_each(|pixel| pixel[..3].iter_mut().for_each(|color| *color /= 2));
            }
            Arc::new(Keyframe {
                rgba_srgb: rgba.into(),
                ..keyframe.as_ref().clone()
            })
        };
        keyframes.iter().enumerate().map(darken).collect()
    }

    #[test]
    fn gains_are_learned_only_if_exposure_changes() {
        let gpu = test_gpu();
        let even = n_keyframes(&gpu, 36, true);
        let trainer = trained(&even, gpu.clone(), 510);
        assert!(
            trainer.trials().len() == 1 && !trainer.trials()[0].kept,
            "{:?}",
            trainer.trials()
        );
        let stepped = with_exposure_step(&even);
        let mut trainer = trained(&stepped, gpu, 700);
        assert!(
            trainer.trials()[0].kept && trainer.trials()[0].gain_db > 1.0,
            "{:?}",
            trainer.trials()
        );
        let gains = |trainer: &mut SplatTrainer, ix: usize| {
            calibrated_camera(trainer, &stepped[ix]).gains[1]
        };
        // Only images near the exposure step show parts of the scene that were captured with both
        // exposures.
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 18);
        assert!((1.6..2.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn gains_are_learned_once_arriving_keyframes_show_a_change_of_exposure() {
        const FIRST_TRIAL: u64 = 250;
        let gpu = test_gpu();
        let even = n_keyframes(&gpu, 36, true);
        let watching = options().with(|options| {
            options.common.cameras = CameraRefinement::AlwaysAndWatch(ParamSet::empty(), GAINS);
            options.common.n_planned_steps = 1000;
            options.specific.trial_steps.first_trial = FIRST_TRIAL;
        });
        let trained_live = |keyframes: &[Arc<Keyframe>]| {
            let mut trainer = SplatTrainer::new(gpu.clone(), watching.clone()).unwrap();
            let (first, later) = keyframes.split_at(keyframes.len() / 2 - 3);
            first
                .iter()
                .for_each(|keyframe| trainer.push(keyframe.clone()).unwrap());
            train(&mut trainer, FIRST_TRIAL);
            for keyframe in later {
                trainer.push(keyframe.clone()).unwrap();
                train(&mut trainer, 5);
            }
            trainer
        };
        let trainer = trained_live(&even);
        assert!(trainer.trials().is_empty(), "{:?}", trainer.trials());
        let stepped = with_exposure_step(&even);
        let mut trainer = trained_live(&stepped);
        assert!(
            trainer.trials().len() == 1 && trainer.trials()[0].kept,
            "{:?}",
            trainer.trials()
        );
        train(&mut trainer, 100);
        let gains = |trainer: &mut SplatTrainer, ix: usize| {
            calibrated_camera(trainer, &stepped[ix]).gains[1]
        };
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 19);
        assert!((1.4..2.6).contains(&ratio), "{ratio}");
    }
}
