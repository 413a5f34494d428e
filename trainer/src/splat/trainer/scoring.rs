//! How the model as it learns does on images that it has not learned from.

use super::{Fixes, Learn, SplatTrainer, fixed};
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::splat::buffers::Frame;
use crate::splat::camera_terms::between;
use crate::splat::params::Camera;
use crate::splat::views::camera_of;
use crate::{Error, Keyframe};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Most images held back that a score is the mean over.
const MOST_SCORED: usize = 24;

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

impl SplatTrainer {
    /// PSNR of keyframes that were not learned from, dB; of many, some spread over them.
    pub(super) fn score_held_back(&mut self) -> Result<Vec<f64>, Error> {
        let products = self.compare_held_back()?;
        Ok(products.iter().filter_map(|(_, products)| psnr_with(products, [1.0; 3])).collect())
    }

    /// Scores the held-back keyframes as they are, and with the gains of the images before and after them in time; decides
    /// whether gains are learned.
    pub(super) fn try_gains(&mut self) -> Result<(), Error> {
        let held_back = self.compare_held_back()?;
        let fixes = self.learned_fixes()?;
        let neighbors: Vec<Vec<usize>> = held_back.iter().map(|(keyframe, _)| self.neighbors(keyframe)).collect();
        self.make_levels(neighbors.iter().flatten().map(|view_ix| (*view_ix, 0)).collect())?;
        let mut known: BTreeMap<usize, [f64; 3]> = BTreeMap::new();
        for view_ix in neighbors.iter().flatten() {
            if !known.contains_key(view_ix) {
                known.insert(*view_ix, self.gains_of(*view_ix, &fixes)?);
            }
        }
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
            self.make_levels((0..self.views.len()).map(|view_ix| (view_ix, 0)).collect())?;
            for view_ix in 0..self.views.len() {
                let gains = match known.get(&view_ix) {
                    Some(gains) => *gains,
                    None => self.gains_of(view_ix, &fixes)?,
                };
                let keyframe = &self.views[view_ix].keyframe;
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

    fn gains_of(&mut self, view_ix: usize, fixes: &Fixes) -> Result<[f64; 3], Error> {
        let keyframe = self.views[view_ix].keyframe.clone();
        self.draw_keyframe(&keyframe, fixes)?;
        let image = &self.views[view_ix].level(&self.gpu, 0)?.image;
        let drawn = Drawn::of(&self.gpu, &self.learn, &self.draw_frame, &self.draw_view)?;
        Ok(log_gains(&drawn.compare(&mut self.passes, &keyframe, image)?))
    }

    fn compare_held_back(&mut self) -> Result<Vec<Compared>, Error> {
        let fixes = self.learned_fixes()?;
        let stride = self.trials.held_back.len().div_ceil(MOST_SCORED).max(1);
        let mut compared = Vec::new();
        for ix in (0..self.trials.held_back.len()).step_by(stride) {
            let keyframe = self.trials.held_back[ix].keyframe.clone();
            self.draw_keyframe(&keyframe, &fixes)?;
            let image = match self.trials.held_back[ix].image.take() {
                Some(image) => image,
                None => self.gpu.storage_with("splat.held_back", &keyframe.rgba_srgb)?,
            };
            let drawn = Drawn::of(&self.gpu, &self.learn, &self.draw_frame, &self.draw_view)?;
            let products = drawn.compare(&mut self.passes, &keyframe, &image)?;
            self.trials.held_back[ix].image = Some(image);
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
        let n_groups = (keyframe.size_px[0] * keyframe.size_px[1]).div_ceil(256);
        let buffers = [
            ("view", self.view),
            ("pixels", &self.frame.pixels),
            ("target_image", image),
            ("products", &self.frame.products),
        ];
        passes.dispatch(self.gpu, self.score, n_groups.into(), &buffers);
        passes.submit(self.gpu);
        let sums: Vec<[u32; 4]> = self.gpu.read(&self.frame.products, 3 * n_groups as usize)?;
        let sum = |color: usize, part: usize| sums.iter().skip(color).step_by(3).map(|of| u64::from(of[part])).sum();
        Ok([0, 1, 2].map(|color| Products {
            picture_picture: sum(color, 0),
            picture_image: sum(color, 1),
            image_image: sum(color, 2),
            n_seen: sum(color, 3),
        }))
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
        for (score, keyframe) in scores.iter().zip(held_back) {
            let picture = trainer.render(&request(keyframe.world_from_camera)).unwrap();
            let pair = PixelPair::new(keyframe.size_px, &picture.rgba_srgb, &keyframe.rgba_srgb).unwrap();
            assert!((psnr(&pair).unwrap() - score).abs() < 1e-9);
        }
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
