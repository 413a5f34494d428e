//! Compares the model in training with images, and scores it on validation images.

use super::products::{self, Products};
use super::renderer::DrawnView;
use super::training::Training;
use crate::Error;
use crate::splat::buffers::SplatBuffers;
use crate::splat::kernels::TrainPipelines;
use crate::splat::params::Camera;
use crate::splat::trials::{ImageId, Scores, SplatTrials};
use crate::splat::views::{Level, camera_of};
use calibration::{CalibratedCamera, CameraCorrection};
use gpu::Buffer;
use keyframe::Keyframe;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A keyframe and the sums from its comparison with the rendered picture.
pub(super) type ScoredKeyframe = (Arc<Keyframe>, [Products; 3]);

/// Compares pictures of the model in training with images. Cameras are corrected as they were
/// when the comparer was created.
pub(super) struct Comparer {
    learn: Arc<TrainPipelines>,
    /// Corrections by camera name.
    corrections: BTreeMap<String, CameraCorrection>,
    background_srgb: [f32; 3],
}

impl Comparer {
    /// A comparer with the current corrections.
    pub(super) fn new(training: &mut Training, trials: &SplatTrials) -> Result<Self, Error> {
        Ok(Self {
            learn: training.learn()?,
            corrections: training.learned_corrections()?,
            background_srgb: training.background_srgb(trials.n_validation()),
        })
    }

    /// Compares with an image on the GPU.
    pub(super) fn compare(
        &self,
        training: &mut Training,
        keyframe: &Keyframe,
        image: &Buffer,
    ) -> Result<[Products; 3], Error> {
        let Training {
            recorder,
            renderer,
            model,
            ..
        } = training;
        let camera = self.camera(keyframe);
        let drawn = self.drawn(&model.splats, &camera);
        renderer.compare(recorder, drawn, &self.learn.score, image)
    }

    /// Compares with the uploaded image of a training view.
    pub(super) fn compare_view(
        &self,
        training: &mut Training,
        view_ix: usize,
    ) -> Result<[Products; 3], Error> {
        let Training {
            recorder,
            renderer,
            model,
            views,
            ..
        } = training;
        let camera = self.camera(views.keyframe(view_ix));
        let (_, Level { image, .. }) = views.ready_level((view_ix, 0))?;
        let drawn = self.drawn(&model.splats, &camera);
        renderer.compare(recorder, drawn, &self.learn.score, image)
    }

    /// Compares with the image of a keyframe that is not on the GPU.
    pub(super) fn compare_with_upload(
        &self,
        training: &mut Training,
        keyframe: &Keyframe,
    ) -> Result<[Products; 3], Error> {
        let Training {
            recorder,
            renderer,
            model,
            ..
        } = training;
        let camera = self.camera(keyframe);
        let drawn = self.drawn(&model.splats, &camera);
        let rgba = keyframe.rgba_srgb.as_ref();
        renderer.compare_with_upload(recorder, drawn, &self.learn.score, rgba)
    }

    fn drawn<'a>(&self, splats: &'a SplatBuffers, camera: &'a Camera) -> DrawnView<'a> {
        DrawnView {
            splats,
            camera,
            background_srgb: self.background_srgb,
        }
    }

    /// The camera of a keyframe with its corrections, for drawing.
    fn camera(&self, keyframe: &Keyframe) -> Camera {
        // A camera without corrections is drawn as its keyframe reports it.
        let lens = self.corrections.get(keyframe.camera.as_ref()).map_or_else(
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
}

/// PSNR in dB of the validation keyframes, or of an evenly spaced subset if there are many.
pub(super) fn score_validation(
    training: &mut Training,
    trials: &mut SplatTrials,
) -> Result<Scores, Error> {
    let comparer = Comparer::new(training, trials)?;
    Ok(compare_validation(training, trials, &comparer)?
        .iter()
        .filter_map(score_of)
        .collect())
}

/// Compares the validation keyframes, or an evenly spaced subset if there are many.
pub(super) fn compare_validation(
    training: &mut Training,
    trials: &mut SplatTrials,
    comparer: &Comparer,
) -> Result<Vec<ScoredKeyframe>, Error> {
    let mut compared = Vec::new();
    for id in trials.scored() {
        // The keyframe may have been removed since the start of the trial.
        let Some(validation) = trials.validation(&id) else {
            continue;
        };
        let keyframe = validation.keyframe.clone();
        let image = validation.uploaded(&training.recorder.gpu)?;
        let products = comparer.compare(training, &keyframe, image)?;
        compared.push((keyframe, products));
    }
    Ok(compared)
}

/// Identity and PSNR in dB of a compared keyframe. `None` if it is fully masked.
fn score_of((keyframe, products): &ScoredKeyframe) -> Option<(ImageId, f64)> {
    Some((
        (keyframe.camera.clone(), keyframe.stamp),
        products::psnr_with_gains(products, [1.0; 3])?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::eval::{PixelPair, psnr};
    use crate::splat::SplatTrainer;
    use crate::splat::training_tests::{n_keyframes, options, request, train};
    use calibration::{CameraRefinement, ParamSet};
    use gpu::testing::test_gpu;
    use keyframe::Split;

    #[test]
    fn scores_match_rendered_pictures() {
        let gpu = test_gpu();
        let keyframes = n_keyframes(&gpu, 12, true);
        // Validation images are scored as long as a trial is to be made.
        let options = options().with(|options| {
            options.common.cameras = CameraRefinement::Try(vec![ParamSet::IMAGE_GAINS]);
            options.common.n_planned_steps = 1000;
        });
        let mut trainer = SplatTrainer::new(gpu, options).unwrap();
        for keyframe in &keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, 60);
        let validation: Vec<_> = keyframes
            .iter()
            .filter(|keyframe| keyframe.split == Split::Validation)
            .collect();
        let scores = score_validation(&mut trainer.training, &mut trainer.trials).unwrap();
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
            trainer.training.recorder.gpu.clone(),
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
}
