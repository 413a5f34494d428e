//! Scores of the model in training on images that it was not trained on.

use super::{CameraCorrections, RequestedParts, SplatTrainer, TrainPipelineState, VIEWS_AT_ONCE, corrected_camera};
use crate::Error;
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::splat::buffers::ImageBuffers;
use crate::splat::params::Camera;
use crate::splat::trials::Scores;
use crate::splat::views::{Level, camera_of};
use calibration::interpolate;
use keyframe::Keyframe;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Sums over the pixels of a picture and an image, for one color.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Products {
    picture_picture: u64,
    picture_image: u64,
    image_image: u64,
    n_visible: u64,
}

/// A keyframe and the sums of its comparison with a picture.
type ScoredKeyframe = (Arc<Keyframe>, [Products; 3]);

/// PSNR in dB of a picture whose colors are multiplied by gains; `None` if all pixels are masked. Values above white
/// are not clamped.
fn psnr_with(products: &[Products; 3], gains: [f64; 3]) -> Option<f64> {
    let n: u64 = products.iter().map(|color| color.n_visible).sum();
    let square = |(color, gain): (&Products, f64)| {
        gain * gain * color.picture_picture as f64 - 2.0 * gain * color.picture_image as f64 + color.image_image as f64
    };
    let squares: f64 = products.iter().zip(gains).map(square).sum();
    // A squared error of at least one bounds the score: one level of one color at one pixel.
    (n > 0).then(|| 10.0 * (255.0f64.powi(2) * n as f64 / squares.max(1.0)).log10())
}

/// Logarithms of the gains that best match a picture to an image.
fn log_gains(products: &[Products; 3]) -> [f64; 3] {
    const MAX_LOG_GAIN: f64 = 1.5; // Two photographic stops: larger gains are not caused by exposure.
    products.map(|color| match (color.picture_image, color.picture_picture) {
        (0, _) | (_, 0) => 0.0,
        (with_image, picture_only) => (with_image as f64 / picture_only as f64).ln().clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN),
    })
}

/// Size of a workgroup's sums in `score.wgsl`, bytes.
pub(super) const PRODUCTS_BYTES: usize = 48;

/// Records the comparison of a picture with an image; returns the number of workgroups that write sums.
pub(super) fn compare(
    gpu: &Gpu,
    passes: &mut Passes,
    score: &Pipeline,
    (view, image_buffers): (&Buffer, &ImageBuffers),
    size_px: [u32; 2],
    image: &Buffer,
) -> u32 {
    let n_groups = (size_px[0] * size_px[1]).div_ceil(256);
    let buffers = [
        ("view", view),
        ("pixels", &image_buffers.pixels),
        ("target_image", image),
        ("products", &image_buffers.products),
    ];
    passes.dispatch(gpu, score, n_groups.into(), &buffers);
    n_groups
}

/// The sums over all workgroups.
fn sum_up(sums: &[[u32; 4]]) -> [Products; 3] {
    let sum = |color: usize, part: usize| sums.iter().skip(color).step_by(3).map(|of| u64::from(of[part])).sum();
    [0, 1, 2].map(|color| Products {
        picture_picture: sum(color, 0),
        picture_image: sum(color, 1),
        image_image: sum(color, 2),
        n_visible: sum(color, 3),
    })
}

/// PSNR in dB, bit-identical to [`crate::eval::psnr`] because integer sums are exact.
fn psnr_as_evaluated(products: &[Products; 3]) -> Result<f64, Error> {
    let n: u64 = products.iter().map(|color| color.n_visible).sum();
    if n == 0 {
        return Err(Error::AllPixelsMasked);
    }
    let squares: u64 =
        products.iter().map(|color| color.picture_picture + color.image_image - 2 * color.picture_image).sum();
    let mean_square = squares as f64 / n as f64;
    Ok(10.0 * (255.0_f64.powi(2) / mean_square).log10())
}

impl SplatTrainer {
    /// PSNR of the displayed picture of a view against a keyframe's image of the same size; `None` before training
    /// has started.
    pub(super) fn psnr_of_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        keyframe: &Keyframe,
    ) -> Result<Option<f64>, Error> {
        let TrainPipelineState::Ready(pipelines) = &self.train else { return Ok(None) };
        let pipelines = pipelines.clone();
        let rgba = keyframe.rgba_srgb.as_ref();
        if rgba.len() != 4 * camera.size_px[0] as usize * camera.size_px[1] as usize {
            return Ok(None);
        }
        let image = match self.compared.take() {
            Some(image) if image.bytes() >= rgba.len() as u64 => {
                self.gpu.write(&image, 0, rgba);
                image
            }
            _ => {
                self.passes.clear_bindings();
                self.gpu.storage_with("splat.compared", rgba)?
            }
        };
        let requested = RequestedParts::Comparison { score: &pipelines.score, image: &image };
        let take = |parts: &[&[u8]]| sum_up(&bytemuck::pod_collect_to_vec::<u8, [u32; 4]>(parts[0]));
        let products = self.draw_reading(camera, background_srgb, true, requested, take)?;
        self.compared = Some(image);
        psnr_as_evaluated(&products).map(Some)
    }

    /// PSNR of the validation keyframes, dB; of at most a limited number, spread evenly over them.
    pub(super) fn score_validation(&mut self) -> Result<Scores, Error> {
        let score = |(keyframe, products): &ScoredKeyframe| {
            Some(((keyframe.camera.clone(), keyframe.stamp), psnr_with(products, [1.0; 3])?))
        };
        Ok(self.compare_validation()?.iter().filter_map(score).collect())
    }

    /// Scores the validation keyframes with and without gains, which are interpolated between the images before and
    /// after them in time. Enables gains if they are significant.
    pub(super) fn try_gains(&mut self) -> Result<(), Error> {
        let validation = self.compare_validation()?;
        let corrections = self.learned_corrections()?;
        let neighbors: Vec<Vec<usize>> = validation.iter().map(|(keyframe, _)| self.neighbors(keyframe)).collect();
        let mut known: BTreeMap<usize, [f64; 3]> = BTreeMap::new();
        self.add_gains(&mut known, neighbors.iter().flatten().copied().collect(), &corrections)?;
        // The mean over all images is an error of the model's brightness, not of an image.
        let mean = |color: usize| known.values().map(|gains| gains[color]).sum::<f64>() / known.len().max(1) as f64;
        let mean = [0, 1, 2].map(mean);
        let (mut baseline_db, mut variant_db) = (Vec::new(), Vec::new());
        for ((keyframe, products), neighbors) in validation.iter().zip(&neighbors) {
            let own = |view_ix: &usize| {
                let gains = known.get(view_ix)?;
                let stamp = self.views[*view_ix].keyframe.stamp.0;
                Some((stamp, [0, 1, 2].map(|color| gains[color] - mean[color])))
            };
            let neighbor_gains: BTreeMap<i64, [f64; 3]> = neighbors.iter().filter_map(own).collect();
            let gains = interpolate(&neighbor_gains, keyframe.stamp).unwrap_or_default().map(f64::exp);
            baseline_db.extend(psnr_with(products, [1.0; 3]));
            variant_db.extend(psnr_with(products, gains));
        }
        if let Some(gains) = self.trials.decide_gains(&baseline_db, &variant_db) {
            self.cameras.enable(gains);
            self.prepare_training()?;
            self.add_gains(&mut known, (0..self.views.len()).collect(), &corrections)?;
            for (view_ix, gains) in &known {
                let keyframe = &self.views[*view_ix].keyframe;
                self.cameras.initialize_gains(&self.gpu, keyframe, [0, 1, 2].map(|color| gains[color] - mean[color]));
            }
        }
        Ok(())
    }

    /// The views of the same camera before and after a keyframe.
    fn neighbors(&self, keyframe: &Keyframe) -> Vec<usize> {
        let of_camera = || self.views.iter().enumerate().filter(|(_, view)| view.keyframe.camera == keyframe.camera);
        let before = of_camera().filter(|(_, view)| view.keyframe.stamp <= keyframe.stamp);
        let after = of_camera().filter(|(_, view)| view.keyframe.stamp > keyframe.stamp);
        let before = before.max_by_key(|(_, view)| view.keyframe.stamp);
        let after = after.min_by_key(|(_, view)| view.keyframe.stamp);
        before.into_iter().chain(after).map(|(ix, _)| ix).collect()
    }

    /// Computes the missing gains of these views.
    fn add_gains(
        &mut self,
        known: &mut BTreeMap<usize, [f64; 3]>,
        view_ixs: BTreeSet<usize>,
        corrections: &CameraCorrections,
    ) -> Result<(), Error> {
        let unknown: Vec<usize> = view_ixs.into_iter().filter(|view_ix| !known.contains_key(view_ix)).collect();
        for chunk in unknown.chunks(VIEWS_AT_ONCE) {
            self.make_levels(&chunk.iter().map(|view_ix| (*view_ix, 0)).collect())?;
            for view_ix in chunk {
                known.insert(*view_ix, self.gains_of(*view_ix, corrections)?);
            }
        }
        Ok(())
    }

    /// The gains that best match the picture of a view to its image, which is on the GPU.
    fn gains_of(&mut self, view_ix: usize, corrections: &CameraCorrections) -> Result<[f64; 3], Error> {
        let keyframe = self.views[view_ix].keyframe.clone();
        self.draw_keyframe(&keyframe, corrections)?;
        let (_, Level { image, .. }) = self.views[view_ix].ready_level(0)?;
        let rendered_view = RenderedView::of(&self.gpu, &self.train, &self.drawing_buffers, &self.draw_view)?;
        Ok(log_gains(&rendered_view.compare(&mut self.passes, &keyframe, image)?))
    }

    fn compare_validation(&mut self) -> Result<Vec<ScoredKeyframe>, Error> {
        let corrections = self.learned_corrections()?;
        let mut compared = Vec::new();
        for id in self.trials.scored() {
            let Some(validation) = self.trials.validation(&id) else { continue }; // Removed in the meantime.
            let (keyframe, image) = (validation.keyframe.clone(), validation.image.take());
            self.draw_keyframe(&keyframe, &corrections)?;
            let image = match image {
                Some(image) => image,
                None => self.gpu.storage_with("splat.validation", &keyframe.rgba_srgb)?,
            };
            let rendered_view = RenderedView::of(&self.gpu, &self.train, &self.drawing_buffers, &self.draw_view)?;
            let products = rendered_view.compare(&mut self.passes, &keyframe, &image)?;
            if let Some(validation) = self.trials.validation(&id) {
                validation.image = Some(image);
            }
            compared.push((keyframe, products));
        }
        Ok(compared)
    }

    /// Draws the model in training from the camera of a keyframe.
    fn draw_keyframe(&mut self, keyframe: &Keyframe, corrections: &CameraCorrections) -> Result<(), Error> {
        let lens = corrected_camera(corrections, keyframe);
        let camera = Camera {
            world_from_camera: lens.world_from_camera,
            focal_px: lens.focal_px,
            principal_px: lens.principal_px,
            ..camera_of(keyframe)
        };
        self.draw_into_buffers(&camera, [0.0; 3], false)
    }
}

/// The picture drawn last.
struct RenderedView<'a> {
    gpu: &'a Gpu,
    score: &'a Pipeline,
    view: &'a Buffer,
    image_buffers: &'a ImageBuffers,
}

impl<'a> RenderedView<'a> {
    fn of(
        gpu: &'a Gpu,
        train: &'a TrainPipelineState,
        image_buffers: &'a Option<ImageBuffers>,
        view: &'a Buffer,
    ) -> Result<Self, Error> {
        match (train, image_buffers) {
            (TrainPipelineState::Ready(pipelines), Some(image_buffers)) => {
                Ok(Self { gpu, score: &pipelines.score, view, image_buffers })
            }
            _ => Err(Error::DeviceLost),
        }
    }

    /// Sums of the comparison with a keyframe's image.
    fn compare(&self, passes: &mut Passes, keyframe: &Keyframe, image: &Buffer) -> Result<[Products; 3], Error> {
        let n_groups = compare(self.gpu, passes, self.score, (self.view, self.image_buffers), keyframe.size_px, image);
        let read =
            passes.submit_reading(self.gpu, &[(&self.image_buffers.products, PRODUCTS_BYTES * n_groups as usize)]);
        Ok(sum_up(&read.finish(self.gpu)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Method;
    use crate::eval::{PixelPair, psnr};
    use crate::gpu::GpuOptions;
    use crate::splat::training_tests::{n_keyframes, options, request, train};
    use calibration::{CameraRefinement, ParamSet};
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
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let keyframes = n_keyframes(&gpu, 12, true);
        let mut trainer = trained(&keyframes, gpu, 60);
        let validation: Vec<_> = keyframes.iter().filter(|keyframe| keyframe.split == Split::Validation).collect();
        let scores = trainer.score_validation().unwrap();
        assert_eq!(scores.len(), validation.len());
        for ((id, score), keyframe) in scores.iter().zip(validation) {
            assert_eq!(id.1, keyframe.stamp);
            let picture = trainer.render(&request(keyframe.world_from_camera)).unwrap();
            let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert!((psnr(&pair).unwrap() - score).abs() < 1e-9);
        }
    }

    #[test]
    fn gpu_scores_match_rendered_pictures_bit_for_bit() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let keyframes = n_keyframes(&gpu, 5, true);
        let request_for = |keyframe: &Keyframe| request(keyframe.world_from_camera);
        let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
        trainer.push(keyframes[1].clone()).unwrap();
        train(&mut trainer, 20);
        // A masked image whose mask starts and ends within workgroups, followed by complete images in the same
        // buffer.
        let mut rgba = keyframes[0].rgba_srgb.to_vec();
        rgba.as_chunks_mut::<4>().0[250..900].iter_mut().for_each(|pixel| pixel[3] = 0);
        let masked = Keyframe { rgba_srgb: rgba.into(), ..keyframes[0].as_ref().clone() };
        for keyframe in [&masked, &keyframes[0], &keyframes[3]] {
            let picture = trainer.render(&request_for(keyframe)).unwrap();
            let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert_eq!(trainer.psnr(&request_for(keyframe), keyframe).unwrap(), Some(psnr(&pair).unwrap()));
        }
        // A picture compared with itself.
        let picture = trainer.render(&request_for(&keyframes[0])).unwrap();
        let mut rgba = picture.rgba_srgb;
        rgba.as_chunks_mut::<4>().0.iter_mut().for_each(|pixel| pixel[3] = 255);
        let same = Keyframe { rgba_srgb: rgba.into(), ..keyframes[0].as_ref().clone() };
        assert_eq!(trainer.psnr(&request_for(&same), &same).unwrap(), Some(f64::INFINITY));
        let fully_masked = Keyframe { rgba_srgb: vec![0; same.rgba_srgb.len()].into(), ..same.clone() };
        assert!(matches!(trainer.psnr(&request_for(&same), &fully_masked), Err(Error::AllPixelsMasked)));
        let small = crate::RenderRequest { size_px: [8, 8], ..request_for(&same) };
        assert_eq!(trainer.psnr(&small, &same).unwrap(), None, "another size");
        let mut loaded = SplatTrainer::from_arrays(trainer.gpu.clone(), options(), &trainer.arrays().unwrap()).unwrap();
        assert_eq!(loaded.psnr(&request_for(&same), &same).unwrap(), None, "the training pipelines are not compiled");
    }

    /// Darkens the images by one stop from the middle of the capture on.
    fn with_exposure_step(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
        let darken = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
            let mut rgba = keyframe.rgba_srgb.to_vec();
            if ix >= keyframes.len() / 2 {
                rgba.as_chunks_mut::<4>()
                    .0
                    .iter_mut()
                    .for_each(|pixel| pixel[..3].iter_mut().for_each(|color| *color /= 2));
            }
            Arc::new(Keyframe { rgba_srgb: rgba.into(), ..keyframe.as_ref().clone() })
        };
        keyframes.iter().enumerate().map(darken).collect()
    }

    #[test]
    fn gains_are_learned_only_if_exposure_changes() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let even = n_keyframes(&gpu, 36, true);
        let trainer = trained(&even, gpu.clone(), 510);
        assert!(trainer.trials().len() == 1 && !trainer.trials()[0].kept, "{:?}", trainer.trials());
        let stepped = with_exposure_step(&even);
        let mut trainer = trained(&stepped, gpu, 700);
        assert!(trainer.trials()[0].kept && trainer.trials()[0].gain_db > 1.0, "{:?}", trainer.trials());
        let gains = |trainer: &mut SplatTrainer, ix: usize| trainer.calibrated_camera(&stepped[ix]).unwrap().gains[1];
        // Away from the step, no image shows a part of the scene that was captured with the other exposure.
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 18);
        assert!((1.6..2.4).contains(&ratio), "{ratio}");
    }
}
