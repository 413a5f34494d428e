//! The training views, with their training order, their resolution, and their images on the GPU.

use super::recorder::Recorder;
use crate::Error;
use crate::model_options::ModelOptions;
use crate::splat::camera_params::CameraParams;
use crate::splat::options::{ANY_SIZE_PX, SplatOptions};
use crate::splat::views::{self, Keep, Level, LevelImages, Order, TrainView};
use gpu::{Buffer, Gpu};
use keyframe::Keyframe;
use numbers::f32_of;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

/// Maximum bytes of images on a software adapter. Such an adapter allocates host memory, which
/// already holds all keyframes.
const SOFTWARE_IMAGE_BYTES: u64 = 256 << 20;
/// Number of images uploaded together when iterating over all views. They are downscaled in
/// parallel, so their number should be at least the number of cores. All of them must fit into
/// memory.
pub(super) const VIEWS_AT_ONCE: usize = 16;
/// Default of [`SplatOptions::coarse_steps`]. Coarse images make the first steps fast. On the
/// static arm, training at full resolution from the start lost 2 dB at 1 s and 0.1 dB at 8 s
/// (docs/benchmarks/2026-11-23-splats.md).
const COARSE_STEPS: [u64; 2] = [150, 400];
/// The default on a software adapter, whose steps at full resolution take much longer.
const SOFTWARE_COARSE_STEPS: [u64; 2] = [500, 4000];
/// Default of [`SplatOptions::max_coarse_px`] on a software adapter, where the duration of a step is
/// proportional to the number of pixels. Images of 640 x 480 pixels are trained at a quarter and at
/// half of their resolution, with 19 200 and 76 800 pixels, and images of 1280 x 720 pixels at an
/// eighth and at a quarter. Images of 160 x 120 pixels are never reduced: with fewer pixels, the
/// duration of a step depends on the number of splats.
const SOFTWARE_COARSE_PX: [u32; 2] = [24_000, 96_000];

/// Training views.
#[derive(Debug)]
pub(super) struct ViewSet {
    views: Vec<TrainView>,
    order: Order,
    resolution: Resolution,
    /// Maximum bytes of the views' images on the GPU, unless a submit needs more.
    max_image_bytes: u64,
    /// Number of image requests so far. Images store it at each use, and eviction compares the
    /// stored values.
    n_image_requests: u64,
}

/// Index of a view, and index of a resolution level of its images.
pub(super) type ViewLevel = (usize, usize);

/// The resolution of the images at each step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Resolution {
    /// See [`SplatOptions::coarse_steps`].
    pub(super) coarse_steps: [u64; 2],
    /// See [`SplatOptions::max_coarse_px`].
    pub(super) max_coarse_px: [u32; 2],
}

impl Resolution {
    fn new(options: &SplatOptions, is_software: bool) -> Self {
        let (coarse_steps, max_coarse_px) = if is_software {
            (SOFTWARE_COARSE_STEPS, SOFTWARE_COARSE_PX)
        } else {
            (COARSE_STEPS, ANY_SIZE_PX)
        };
        Self {
            coarse_steps: options.coarse_steps.unwrap_or(coarse_steps),
            max_coarse_px: options.max_coarse_px.unwrap_or(max_coarse_px),
        }
    }

    /// Level of an image of this size at a step. Level `n` divides width and height by `2^n`.
    fn level(&self, step: u64, size_px: [u32; 2]) -> u32 {
        let (fixed, max_px) = match step {
            step if step < self.coarse_steps[0] => (2, self.max_coarse_px[0]),
            step if step < self.coarse_steps[1] => (1, self.max_coarse_px[1]),
            _ => return 0,
        };
        if max_px == u32::MAX {
            return fixed;
        }
        let n_px = |level: u32| {
            size_px
                .map(|side| u64::from(side >> level))
                .iter()
                .product::<u64>()
        };
        // The last level of an image has one pixel or none.
        (0..u32::BITS)
            .find(|level| n_px(*level) <= u64::from(max_px))
            .unwrap_or(fixed)
    }
}

impl ViewSet {
    /// Creates an empty set.
    pub(super) fn new(options: &ModelOptions<SplatOptions>, is_software: bool) -> Self {
        Self {
            views: Vec::new(),
            order: Order::new(options.common.seed),
            resolution: Resolution::new(&options.specific, is_software),
            // On a GPU, a lack of memory is an error of the allocation, not a limit.
            max_image_bytes: if is_software {
                SOFTWARE_IMAGE_BYTES
            } else {
                u64::MAX
            },
            n_image_requests: 0,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.views.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Views in the order of their arrival.
    pub(super) fn iter(&self) -> std::slice::Iter<'_, TrainView> {
        self.views.iter()
    }

    pub(super) fn keyframes(&self) -> impl Iterator<Item = &Arc<Keyframe>> {
        self.views.iter().map(|view| &view.keyframe)
    }

    pub(super) fn keyframe(&self, view_ix: usize) -> &Arc<Keyframe> {
        &self.views[view_ix].keyframe
    }

    /// Index of the view of a keyframe.
    pub(super) fn position(&self, keyframe: &Arc<Keyframe>) -> Option<usize> {
        self.keyframes()
            .position(|view| Arc::ptr_eq(view, keyframe))
    }

    pub(super) fn push(&mut self, keyframe: Arc<Keyframe>) {
        self.views.push(TrainView::new(keyframe));
    }

    /// Mean color of the images, sRGB. It is black without images.
    pub(super) fn mean_srgb(&self) -> [f32; 3] {
        // Fully masked images have no mean color.
        let known: Vec<[f64; 3]> = self.views.iter().filter_map(TrainView::mean_srgb).collect();
        let mean = |color: usize| {
            known.iter().map(|image| image[color]).sum::<f64>() / known.len().max(1) as f64
        };
        [0, 1, 2].map(|color| f32_of(mean(color)))
    }

    /// Indices of the last view before and the first view after a keyframe, from the same camera.
    pub(super) fn neighbors(&self, keyframe: &Keyframe) -> Vec<usize> {
        // Other cameras have their own exposure. Views are in the order of arrival, which may
        // differ from the order of the stamps.
        let (before, after): (Vec<_>, Vec<_>) = self
            .keyframes()
            .enumerate()
            .filter(|(_, other)| other.camera == keyframe.camera)
            .partition(|(_, other)| other.stamp <= keyframe.stamp);
        let last = before.iter().max_by_key(|(_, other)| other.stamp);
        let next = after.iter().min_by_key(|(_, other)| other.stamp);
        last.into_iter().chain(next).map(|(ix, _)| *ix).collect()
    }

    pub(super) fn retain(&mut self, is_kept: impl Fn(&Arc<Keyframe>) -> bool) {
        self.views.retain(|view| is_kept(&view.keyframe));
    }

    /// Replaces all views.
    pub(super) fn replace(&mut self, keyframes: impl IntoIterator<Item = Arc<Keyframe>>) {
        self.views = keyframes.into_iter().map(TrainView::new).collect();
    }

    /// Replaces the cameras of all views. `correct` replaces a keyframe. Uploaded images are kept
    /// where possible.
    pub(super) fn replace_cameras(&mut self, gpu: &Gpu, correct: impl Fn(&mut Arc<Keyframe>)) {
        for view in &mut self.views {
            let mut keyframe = view.keyframe.clone();
            correct(&mut keyframe);
            view.replace_camera(gpu, keyframe);
        }
    }

    /// The resolution of the images at each step.
    pub(super) fn resolution(&self) -> Resolution {
        self.resolution
    }

    /// Level of a view at a step.
    fn level(&self, view: &TrainView, step: u64) -> usize {
        view.clamped(self.resolution.level(step, view.keyframe.size_px))
    }

    /// Allocates slots for the camera parameters of all views.
    pub(super) fn assign_lenses(
        &mut self,
        gpu: &Gpu,
        cameras: &mut CameraParams,
    ) -> Result<(), Error> {
        self.views
            .iter_mut()
            .try_for_each(|view| view.assign_lens(gpu, cameras))
    }

    /// The view and level that a step trains on.
    pub(super) fn of_step(&mut self, step: u64) -> ViewLevel {
        let view_ix = self.order.pick(step, self.views.len());
        (view_ix, self.level(&self.views[view_ix], step))
    }

    /// Size of the image of a view at a level, pixels.
    pub(super) fn size_px(&self, (view_ix, level_ix): ViewLevel) -> [u32; 2] {
        self.views[view_ix].size_at(level_ix)
    }

    /// The lens of a view, if any, and a level of the view. The images of the level must be
    /// uploaded.
    pub(super) fn ready_level(
        &self,
        (view_ix, level_ix): ViewLevel,
    ) -> Result<(Option<&Buffer>, &Level), Error> {
        self.views[view_ix].ready_level(level_ix)
    }

    /// Uploads the missing images of these steps. If any are missing, also uploads the images of
    /// later steps, so that at least `n_at_once` steps are covered.
    pub(super) fn prepare_steps(
        &mut self,
        recorder: &mut Recorder,
        steps: Range<u64>,
        n_at_once: u64,
    ) -> Result<(), Error> {
        // The larger batch is used only if images are missing. Otherwise, each submit would upload
        // the images of one more step and wait for them.
        let mut requested = self.levels_of_steps(steps.clone());
        if !requested.iter().all(|place| self.has_level(*place)) {
            requested = self.levels_of_steps(steps.start..steps.end.max(steps.start + n_at_once));
        }
        self.upload(recorder, &requested, steps.start)
    }

    fn levels_of_steps(&mut self, steps: Range<u64>) -> BTreeSet<ViewLevel> {
        steps.map(|step| self.of_step(step)).collect()
    }

    fn has_level(&self, (view_ix, level_ix): ViewLevel) -> bool {
        self.views[view_ix].has_level(level_ix)
    }

    /// Uploads the requested levels that are missing, using all CPU cores. May evict other images.
    pub(super) fn upload(
        &mut self,
        recorder: &mut Recorder,
        requested: &BTreeSet<ViewLevel>,
        step: u64,
    ) -> Result<(), Error> {
        let missing: Vec<ViewLevel> = requested
            .iter()
            .copied()
            .filter(|place| !self.has_level(*place))
            .collect();
        if !missing.is_empty() {
            self.upload_missing(recorder, missing, requested, step)?;
        }
        // A counter is used instead of the time, so that eviction does not depend on timing.
        self.n_image_requests += 1;
        for (view_ix, level) in requested {
            self.views[*view_ix].mark_used(*level, self.n_image_requests);
        }
        Ok(())
    }

    /// Uploads these levels, and evicts others if the limit of memory is exceeded.
    fn upload_missing(
        &mut self,
        recorder: &mut Recorder,
        missing: Vec<ViewLevel>,
        requested: &BTreeSet<ViewLevel>,
        step: u64,
    ) -> Result<(), Error> {
        let made: Vec<LevelImages> = missing
            .par_iter()
            .map(|(view_ix, level)| LevelImages::new(&self.views[*view_ix].keyframe, *level))
            .collect();
        let new_bytes = made.iter().map(LevelImages::bytes).sum();
        let coarsest: Vec<usize> = self
            .views
            .iter()
            .map(|view| self.level(view, step))
            .collect();
        let keep = Keep {
            needed: requested,
            coarsest: &coarsest,
            max_bytes: self.max_image_bytes.saturating_sub(new_bytes),
        };
        let mut dropped = views::drop_levels(&mut self.views, keep);
        // The recorded passes use images that are overwritten below. Writes are executed before
        // the passes of the next submit, so these passes must be submitted first.
        if !dropped.is_empty() && !recorder.passes.is_empty() {
            recorder.submit();
        }
        for ((view_ix, level), images) in missing.into_iter().zip(&made) {
            // Only buffers of the same size can be overwritten.
            let same_size = dropped
                .iter()
                .position(|level| level.size_px == images.size_px());
            let reused = same_size.map(|ix| dropped.swap_remove(ix));
            self.views[view_ix].upload(&recorder.gpu, level, images, reused)?;
        }
        // Cached bind groups keep the buffers that were not reused alive.
        if !dropped.is_empty() {
            recorder.passes.clear_bindings();
        }
        Ok(())
    }

    /// Uploads the images of a view and level, if they are missing.
    pub(super) fn ensure_level(
        &mut self,
        recorder: &mut Recorder,
        place: ViewLevel,
        step: u64,
    ) -> Result<(), Error> {
        if self.has_level(place) {
            Ok(())
        } else {
            self.upload(recorder, &BTreeSet::from([place]), step)
        }
    }

    /// Limits the GPU memory for images, as on a software adapter.
    #[cfg(test)]
    pub(super) fn limit_image_bytes(&mut self, max_bytes: u64) {
        self.max_image_bytes = max_bytes;
    }

    #[cfg(test)]
    pub(super) fn image_bytes(&self) -> u64 {
        self.views.iter().map(TrainView::image_bytes).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn levels(options: &SplatOptions, is_software: bool, size_px: [u32; 2]) -> [u32; 3] {
        let resolution = Resolution::new(options, is_software);
        let [first, second] = resolution.coarse_steps;
        [0, first, second].map(|step| resolution.level(step, size_px))
    }

    #[test]
    fn the_size_of_coarse_images_is_limited_on_a_software_adapter() {
        let options = SplatOptions::default();
        for (size_px, expected) in [
            ([160, 120], [0, 0, 0]),
            ([320, 240], [1, 0, 0]),
            ([640, 480], [2, 1, 0]),
            ([1280, 720], [3, 2, 0]),
            ([1920, 1080], [4, 3, 0]),
        ] {
            assert_eq!(levels(&options, true, size_px), expected, "{size_px:?}");
            assert_eq!(levels(&options, false, size_px), [2, 1, 0], "{size_px:?}");
        }
    }

    #[test]
    fn options_take_precedence_over_the_adapter() {
        let options = SplatOptions {
            max_coarse_px: Some(ANY_SIZE_PX),
            ..SplatOptions::default()
        };
        assert_eq!(levels(&options, true, [1920, 1080]), [2, 1, 0]);
        let full = SplatOptions {
            coarse_steps: Some([0, 0]),
            ..SplatOptions::default()
        };
        assert_eq!(levels(&full, true, [1920, 1080]), [0, 0, 0]);
    }
}
