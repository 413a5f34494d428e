//! How the model as it learns does on images that it has not learned from.

use super::{Fixes, Learn, SplatTrainer, VIEWS_AT_ONCE, Wanted, fixed};
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::splat::buffers::Frame;
use crate::splat::camera_terms::between;
use crate::splat::params::Camera;
use crate::splat::trials::Scores;
use crate::splat::views::{Level, camera_of};
use crate::{Error, Keyframe};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Sums over the pixels of a picture and an image, of each color.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Products {
    picture_picture: u64,
    picture_image: u64,
    image_image: u64,
    n_seen: u64,
}

/// A keyframe and how the picture of it compares.
type Compared = (Arc<Keyframe>, [Products; 3]);

/// PSNR, dB, of a picture whose colors are multiplied; `None` where nothing was seen. What would be brighter than white counts
/// as it is.
fn psnr_with(products: &[Products; 3], gains: [f64; 3]) -> Option<f64> {
    let n: u64 = products.iter().map(|color| color.n_seen).sum();
    let square = |(color, gain): (&Products, f64)| {
        gain * gain * color.picture_picture as f64 - 2.0 * gain * color.picture_image as f64 + color.image_image as f64
    };
    let squares: f64 = products.iter().zip(gains).map(square).sum();
    // One level of one color: nothing is better.
    (n > 0).then(|| 10.0 * (255.0f64.powi(2) * n as f64 / squares.max(1.0)).log10())
}

/// Logarithms of the gains that bring a picture nearest to an image.
fn log_gains(products: &[Products; 3]) -> [f64; 3] {
    const MOST: f64 = 1.5; // Two photographic stops: what asks for more is no exposure.
    products.map(|color| match (color.picture_image, color.picture_picture) {
        (0, _) | (_, 0) => 0.0,
        (with_image, alone) => (with_image as f64 / alone as f64).ln().clamp(-MOST, MOST),
    })
}

/// Size of a workgroup's sums in `score.wgsl`, bytes.
pub(super) const PRODUCTS_BYTES: usize = 48;

/// Adds the comparison of a picture with an image to the list; returns how many workgroups write sums.
pub(super) fn compare(
    gpu: &Gpu,
    passes: &mut Passes,
    score: &Pipeline,
    (view, frame): (&Buffer, &Frame),
    size_px: [u32; 2],
    image: &Buffer,
) -> u32 {
    let n_groups = (size_px[0] * size_px[1]).div_ceil(256);
    let buffers = [("view", view), ("pixels", &frame.pixels), ("target_image", image), ("products", &frame.products)];
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
        n_seen: sum(color, 3),
    })
}

/// PSNR in dB with the same bits as [`crate::eval::psnr`]: integer sums have no rounding.
fn psnr_as_evaluated(products: &[Products; 3]) -> Result<f64, Error> {
    let n: u64 = products.iter().map(|color| color.n_seen).sum();
    if n == 0 {
        return Err(Error::NothingSeen);
    }
    let squares: u64 =
        products.iter().map(|color| color.picture_picture + color.image_image - 2 * color.picture_image).sum();
    let mean_square = squares as f64 / n as f64;
    Ok(10.0 * (255.0_f64.powi(2) / mean_square).log10())
}

impl SplatTrainer {
    /// PSNR of the picture that viewers see of a view against a keyframe's image of the same size; `None` before training has
    /// begun.
    pub(super) fn psnr_of_view(
        &mut self,
        camera: &Camera,
        background_srgb: [f32; 3],
        keyframe: &Keyframe,
    ) -> Result<Option<f64>, Error> {
        let Learn::Ready(learn) = &self.learn else { return Ok(None) };
        let learn = learn.clone();
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
                self.passes.forget_bindings();
                self.gpu.storage_with("splat.compared", rgba)?
            }
        };
        let wanted = Wanted::Comparison { score: &learn.score, image: &image };
        let take = |parts: &[&[u8]]| sum_up(&bytemuck::pod_collect_to_vec::<u8, [u32; 4]>(parts[0]));
        let products = self.draw_reading(camera, background_srgb, true, wanted, take)?;
        self.compared = Some(image);
        psnr_as_evaluated(&products).map(Some)
    }

    /// PSNR of keyframes that were not learned from, dB; of many, some spread over them.
    pub(super) fn score_held_back(&mut self) -> Result<Scores, Error> {
        let score = |(keyframe, products): &Compared| {
            Some(((keyframe.camera.clone(), keyframe.stamp), psnr_with(products, [1.0; 3])?))
        };
        Ok(self.compare_held_back()?.iter().filter_map(score).collect())
    }

    /// Scores the held-back keyframes as they are, and with the gains of the images before and after them in time; decides
    /// whether gains are learned.
    pub(super) fn try_gains(&mut self) -> Result<(), Error> {
        let held_back = self.compare_held_back()?;
        let fixes = self.learned_fixes()?;
        let neighbors: Vec<Vec<usize>> = held_back.iter().map(|(keyframe, _)| self.neighbors(keyframe)).collect();
        let mut known: BTreeMap<usize, [f64; 3]> = BTreeMap::new();
        self.add_gains(&mut known, neighbors.iter().flatten().copied().collect(), &fixes)?;
        // What all images ask for is the brightness of the model, not of an image.
        let mean = |color: usize| known.values().map(|gains| gains[color]).sum::<f64>() / known.len().max(1) as f64;
        let mean = [0, 1, 2].map(mean);
        let (mut without_db, mut with_db) = (Vec::new(), Vec::new());
        for ((keyframe, products), neighbors) in held_back.iter().zip(&neighbors) {
            let own = |view_ix: &usize| {
                let gains = known.get(view_ix)?;
                let stamp = self.views[*view_ix].keyframe.stamp.0;
                Some((stamp, [0, 1, 2].map(|color| gains[color] - mean[color])))
            };
            let around: BTreeMap<i64, [f64; 3]> = neighbors.iter().filter_map(own).collect();
            let gains = between(&around, keyframe.stamp).unwrap_or_default().map(f64::exp);
            without_db.extend(psnr_with(products, [1.0; 3]));
            with_db.extend(psnr_with(products, gains));
        }
        if let Some(gains) = self.trials.end_gains(&without_db, &with_db) {
            self.cameras.learn_also(gains);
            self.begin_learning()?;
            self.add_gains(&mut known, (0..self.views.len()).collect(), &fixes)?;
            for (view_ix, gains) in &known {
                let keyframe = &self.views[*view_ix].keyframe;
                self.cameras.begin_gains(&self.gpu, keyframe, [0, 1, 2].map(|color| gains[color] - mean[color]));
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

    /// Adds the missing gains of these views.
    fn add_gains(
        &mut self,
        known: &mut BTreeMap<usize, [f64; 3]>,
        view_ixs: BTreeSet<usize>,
        fixes: &Fixes,
    ) -> Result<(), Error> {
        let unknown: Vec<usize> = view_ixs.into_iter().filter(|view_ix| !known.contains_key(view_ix)).collect();
        for some in unknown.chunks(VIEWS_AT_ONCE) {
            self.make_levels(&some.iter().map(|view_ix| (*view_ix, 0)).collect())?;
            for view_ix in some {
                known.insert(*view_ix, self.gains_of(*view_ix, fixes)?);
            }
        }
        Ok(())
    }

    /// The gains that best match the picture of a view to its image, which is on the GPU.
    fn gains_of(&mut self, view_ix: usize, fixes: &Fixes) -> Result<[f64; 3], Error> {
        let keyframe = self.views[view_ix].keyframe.clone();
        self.draw_keyframe(&keyframe, fixes)?;
        let (_, Level { image, .. }) = self.views[view_ix].made(0)?;
        let drawn = Drawn::of(&self.gpu, &self.learn, &self.draw_frame, &self.draw_view)?;
        Ok(log_gains(&drawn.compare(&mut self.passes, &keyframe, image)?))
    }

    fn compare_held_back(&mut self) -> Result<Vec<Compared>, Error> {
        let fixes = self.learned_fixes()?;
        let mut compared = Vec::new();
        for id in self.trials.scored() {
            let Some(held_back) = self.trials.held_back(&id) else { continue }; // Evicted since.
            let (keyframe, image) = (held_back.keyframe.clone(), held_back.image.take());
            self.draw_keyframe(&keyframe, &fixes)?;
            let image = match image {
                Some(image) => image,
                None => self.gpu.storage_with("splat.held_back", &keyframe.rgba_srgb)?,
            };
            let drawn = Drawn::of(&self.gpu, &self.learn, &self.draw_frame, &self.draw_view)?;
            let products = drawn.compare(&mut self.passes, &keyframe, &image)?;
            if let Some(held_back) = self.trials.held_back(&id) {
                held_back.image = Some(image);
            }
            compared.push((keyframe, products));
        }
        Ok(compared)
    }

    /// Draws the model as it learns where a keyframe was taken.
    fn draw_keyframe(&mut self, keyframe: &Keyframe, fixes: &Fixes) -> Result<(), Error> {
        let lens = fixed(fixes, keyframe);
        let camera = Camera {
            world_from_camera: lens.world_from_camera,
            focal_px: lens.focal_px,
            principal_px: lens.principal_px,
            ..camera_of(keyframe)
        };
        self.draw_into_frame(&camera, [0.0; 3], false)
    }
}

/// The picture drawn last.
struct Drawn<'a> {
    gpu: &'a Gpu,
    score: &'a Pipeline,
    view: &'a Buffer,
    frame: &'a Frame,
}

impl<'a> Drawn<'a> {
    fn of(gpu: &'a Gpu, learn: &'a Learn, frame: &'a Option<Frame>, view: &'a Buffer) -> Result<Self, Error> {
        match (learn, frame) {
            (Learn::Ready(learn), Some(frame)) => Ok(Self { gpu, score: &learn.score, view, frame }),
            _ => Err(Error::DeviceLost),
        }
    }

    /// Sums over the pixels of it and of the image that it shows.
    fn compare(&self, passes: &mut Passes, keyframe: &Keyframe, image: &Buffer) -> Result<[Products; 3], Error> {
        let n_groups = compare(self.gpu, passes, self.score, (self.view, self.frame), keyframe.size_px, image);
        let read = passes.submit_reading(self.gpu, &[(&self.frame.products, PRODUCTS_BYTES * n_groups as usize)]);
        Ok(sum_up(&read.finish(self.gpu)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::{PixelPair, psnr};
    use crate::gpu::GpuOptions;
    use crate::splat::learning::{n_keyframes, options, request, train};
    use crate::splat::{CameraChoice, SplatOptions, TermSet};
    use crate::{Method, Split};

    const GAINS: TermSet = TermSet { image_gains: true, ..TermSet::NONE };

    fn trained(keyframes: &[Arc<Keyframe>], gpu: Arc<Gpu>, n_steps: u64) -> SplatTrainer {
        let options = SplatOptions { cameras: CameraChoice::Try(vec![GAINS]), n_planned_steps: 1000, ..options() };
        let mut trainer = SplatTrainer::new(gpu, options).unwrap();
        for keyframe in keyframes {
            trainer.push(keyframe.clone()).unwrap();
        }
        train(&mut trainer, n_steps);
        trainer
    }

    #[test]
    fn scores_are_those_of_the_pictures() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let keyframes = n_keyframes(&gpu, 12, true);
        let mut trainer = trained(&keyframes, gpu, 60);
        let held_back: Vec<_> = keyframes.iter().filter(|keyframe| keyframe.split == Split::Selection).collect();
        let scores = trainer.score_held_back().unwrap();
        assert_eq!(scores.len(), held_back.len());
        for ((id, score), keyframe) in scores.iter().zip(held_back) {
            assert_eq!(id.1, keyframe.stamp);
            let picture = trainer.render(&request(keyframe.world_from_camera)).unwrap();
            let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert!((psnr(&pair).unwrap() - score).abs() < 1e-9);
        }
    }

    #[test]
    fn scores_computed_on_the_gpu_are_those_of_pictures_to_the_last_bit() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let keyframes = n_keyframes(&gpu, 5, true);
        let asked = |keyframe: &Keyframe| request(keyframe.world_from_camera);
        let mut trainer = SplatTrainer::new(gpu, options()).unwrap();
        trainer.push(keyframes[1].clone()).unwrap();
        train(&mut trainer, 20);
        // A masked image at the edge of a workgroup, followed by complete images in the same buffer.
        let mut rgba = keyframes[0].rgba_srgb.to_vec();
        rgba.as_chunks_mut::<4>().0[250..900].iter_mut().for_each(|pixel| pixel[3] = 0);
        let masked = Keyframe { rgba_srgb: rgba.into(), ..keyframes[0].as_ref().clone() };
        for keyframe in [&masked, &keyframes[0], &keyframes[3]] {
            let picture = trainer.render(&asked(keyframe)).unwrap();
            let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert_eq!(trainer.psnr(&asked(keyframe), keyframe).unwrap(), Some(psnr(&pair).unwrap()));
        }
        // A picture compared with itself.
        let picture = trainer.render(&asked(&keyframes[0])).unwrap();
        let mut rgba = picture.rgba_srgb;
        rgba.as_chunks_mut::<4>().0.iter_mut().for_each(|pixel| pixel[3] = 255);
        let same = Keyframe { rgba_srgb: rgba.into(), ..keyframes[0].as_ref().clone() };
        assert_eq!(trainer.psnr(&asked(&same), &same).unwrap(), Some(f64::INFINITY));
        let unseen = Keyframe { rgba_srgb: vec![0; same.rgba_srgb.len()].into(), ..same.clone() };
        assert!(matches!(trainer.psnr(&asked(&same), &unseen), Err(Error::NothingSeen)));
        let small = crate::RenderRequest { size_px: [8, 8], ..asked(&same) };
        assert_eq!(trainer.psnr(&small, &same).unwrap(), None, "another size");
        let mut loaded = SplatTrainer::from_arrays(trainer.gpu.clone(), options(), &trainer.arrays().unwrap()).unwrap();
        assert_eq!(loaded.psnr(&asked(&same), &same).unwrap(), None, "the training pipelines are not compiled");
    }

    /// From the middle of the capture on the images are darker by a stop.
    fn with_exposure_step(keyframes: &[Arc<Keyframe>]) -> Vec<Arc<Keyframe>> {
        let darker = |(ix, keyframe): (usize, &Arc<Keyframe>)| {
            let mut rgba = keyframe.rgba_srgb.to_vec();
            if ix >= keyframes.len() / 2 {
                rgba.as_chunks_mut::<4>()
                    .0
                    .iter_mut()
                    .for_each(|pixel| pixel[..3].iter_mut().for_each(|color| *color /= 2));
            }
            Arc::new(Keyframe { rgba_srgb: rgba.into(), ..keyframe.as_ref().clone() })
        };
        keyframes.iter().enumerate().map(darker).collect()
    }

    #[test]
    fn gains_are_learned_where_the_exposure_changed_and_nowhere_else() {
        let gpu = Gpu::open(&GpuOptions::default()).unwrap();
        let even = n_keyframes(&gpu, 36, true);
        let trainer = trained(&even, gpu.clone(), 510);
        assert!(trainer.trials().len() == 1 && !trainer.trials()[0].kept, "{:?}", trainer.trials());
        let stepped = with_exposure_step(&even);
        let mut trainer = trained(&stepped, gpu, 700);
        assert!(trainer.trials()[0].kept && trainer.trials()[0].gain_db > 1.0, "{:?}", trainer.trials());
        let gains = |trainer: &mut SplatTrainer, ix: usize| trainer.posed_lens(&stepped[ix]).unwrap().gains[1];
        // Further from the step no image sees what was seen with the other exposure.
        let ratio = gains(&mut trainer, 17) / gains(&mut trainer, 18);
        assert!((1.6..2.4).contains(&ratio), "{ratio}");
    }
}
