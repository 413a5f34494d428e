//! Training keyframes on the GPU at several resolutions.
#![expect(
    clippy::cast_possible_truncation,
    reason = "pixels are rounded down on purpose, within image sizes that are u32"
)]

use super::camera_params::CameraParams;
use super::params::{Camera, LOW_PASS_PX2, TILE_PX};
use crate::Error;
use crate::view::{depth_in_color_view, median_depth_m};
use calibration::CalibratedCamera;
use gpu::{Buffer, Gpu};
use keyframe::{DepthMap, Keyframe};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Near clipping distance of training cameras along z, meters. Nearer splats would cover the whole
/// image.
const NEAR_M: f64 = 0.01;
/// Far clipping distance along z, meters. Larger depth readings are also not seeded.
pub(crate) const FAR_M: f64 = 1e4;

/// Number of resolutions of an image. At the coarsest, an image of 4096 x 3072 pixels has 128 x 96.
const N_LEVELS: usize = 6;

/// Transforms that differ by less than this value, in meters and radians, are the same up to
/// rounding.
const MAX_ROUNDING: f64 = 1e-9;

/// One training keyframe.
#[derive(Debug)]
pub(crate) struct TrainView {
    pub(crate) keyframe: Arc<Keyframe>,
    /// Median of the keyframe's depth readings, if any.
    pub(crate) median_depth_m: Option<f64>,
    /// Mean color of the pixels that are not masked, sRGB. `None` if all pixels are masked.
    mean_srgb: Option<[f64; 3]>,
    levels: [Option<Level>; N_LEVELS],
    /// `None` until camera parameters are optimized.
    lens: Option<Buffer>,
}

/// Training order of the views. Each round visits every view once, in a new random order.
#[derive(Debug)]
pub(crate) struct Order {
    seed: u64,
    round: u64,
    /// Order in `round`.
    order: Vec<usize>,
}

impl Order {
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            seed,
            round: 0,
            order: Vec::new(),
        }
    }

    pub(crate) fn pick(&mut self, step: u64, n_views: usize) -> usize {
        // The order depends only on seed, step and number of views, so that a resumed run
        // continues with the same views.
        let n = n_views as u64;
        if self.order.len() != n_views || self.round != step / n {
            self.round = step / n;
            self.order = shuffled(self.round, n_views, self.seed);
        }
        self.order[(step % n) as usize]
    }
}

/// Returns a random order. Source: Durstenfeld 1964, with the linear congruential generator of
/// Knuth (MMIX).
fn shuffled(round: u64, n_views: usize, seed: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n_views).collect();
    // Multiplication by large odd constants spreads seed and round over all bits, so that
    // successive rounds start from unrelated states.
    let mut state =
        seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ round.wrapping_mul(0xd134_2543_de82_ef95);
    for at in (1..n_views).rev() {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        // The upper bits are used, because the low bits of such a generator have short periods.
        order.swap(at, ((state >> 33) % (at as u64 + 1)) as usize);
    }
    order
}

/// One keyframe at one resolution.
#[derive(Debug)]
pub(crate) struct Level {
    pub(crate) size_px: [u32; 2],
    pub(crate) view: Buffer,
    /// Color as rgba8. Alpha is 0 for masked pixels.
    pub(crate) image: Buffer,
    /// Meters along z in the color camera, 0 if unknown.
    pub(crate) depth: Buffer,
    /// Value of the request counter when the level was last used, for [`drop_levels`].
    used_at: u64,
}

impl Level {
    /// GPU memory of the images, bytes.
    fn bytes(&self) -> u64 {
        self.image.bytes() + self.depth.bytes()
    }
}

/// Rules for keeping images on the GPU.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keep<'a> {
    /// Views and levels that the next steps need. They are always kept.
    pub(crate) needed: &'a BTreeSet<(usize, usize)>,
    /// Coarsest level of each view that is still used for training.
    pub(crate) coarsest: &'a [usize],
    /// Maximum total bytes of the kept images.
    pub(crate) max_bytes: u64,
}

/// Removes images from the GPU and returns their buffers for reuse.
///
/// First removes images coarser than [`Keep::coarsest`]. If the rest still exceeds `max_bytes`,
/// removes the most recently used images. Every view is used once per round, so less recently used
/// images are needed sooner.
pub(crate) fn drop_levels(views: &mut [TrainView], keep: Keep<'_>) -> Vec<Level> {
    let mut dropped = Vec::new();
    let mut candidates = Vec::new();
    let mut bytes = 0;
    for (view_ix, view) in views.iter_mut().enumerate() {
        let coarsest = keep.coarsest[view_ix];
        for level_ix in 0..view.levels.len() {
            let is_needed = keep.needed.contains(&(view_ix, level_ix));
            // Training never returns to a coarser resolution. Finer images are kept, because
            // trials, gains and contributions use full resolution.
            if level_ix > coarsest && !is_needed {
                dropped.extend(view.levels[level_ix].take());
            } else if let Some(level) = &view.levels[level_ix] {
                bytes += level.bytes();
                if !is_needed {
                    candidates.push((level.used_at, view_ix, level_ix));
                }
            }
        }
    }
    candidates.sort_unstable();
    while bytes > keep.max_bytes {
        // The last candidate is the most recently used image. Without candidates, all images are
        // needed, and the limit is exceeded.
        let Some((_, view_ix, level_ix)) = candidates.pop() else {
            break;
        };
        if let Some(level) = views[view_ix].levels[level_ix].take() {
            bytes -= level.bytes();
            dropped.push(level);
        }
    }
    dropped
}

impl TrainView {
    pub(crate) fn new(keyframe: Arc<Keyframe>) -> Self {
        Self {
            median_depth_m: median_depth_m(&keyframe),
            mean_srgb: mean_srgb(&keyframe),
            keyframe,
            levels: [const { None }; N_LEVELS],
            lens: None,
        }
    }

    /// Mean color of the pixels that are not masked, sRGB. `None` if all pixels are masked.
    pub(crate) fn mean_srgb(&self) -> Option<[f64; 3]> {
        self.mean_srgb
    }

    /// Replaces the camera by the camera of the same keyframe with other corrections. Uploaded
    /// images are kept unless the correction changes them.
    pub(crate) fn replace_camera(&mut self, gpu: &Gpu, keyframe: Arc<Keyframe>) {
        let has_same_images =
            has_same_color(&self.keyframe, &keyframe) && has_same_depth(&self.keyframe, &keyframe);
        // The lens is a slot of camera parameters. They start again at zero after a correction.
        self.lens = None;
        self.keyframe = keyframe;
        // Color changes only with the mask of a robot. Uploaded depth is reprojected into the color
        // camera, so it depends on the extrinsics and intrinsics.
        if !has_same_images {
            self.median_depth_m = median_depth_m(&self.keyframe);
            self.mean_srgb = mean_srgb(&self.keyframe);
            self.levels = [const { None }; N_LEVELS];
        }
        // Poses are part of the small view uniform, so large images need no second upload.
        for (level_ix, level) in self.levels.iter().enumerate() {
            if let Some(level) = level {
                let view = camera_of(&self.keyframe).at_level(level_ix as u32).view();
                gpu.write(&level.view, 0, bytemuck::bytes_of(&view));
            }
        }
    }

    /// Allocates slots for the camera parameters of this view.
    pub(crate) fn assign_lens(
        &mut self,
        gpu: &Gpu,
        cameras: &mut CameraParams,
    ) -> Result<(), Error> {
        if self.lens.is_none() {
            self.lens = Some(cameras.lens(gpu, &self.keyframe)?);
        }
        Ok(())
    }

    /// The lens, if any, and a level. The images of the level must be uploaded.
    pub(crate) fn ready_level(&self, level: usize) -> Result<(Option<&Buffer>, &Level), Error> {
        Ok((
            self.lens.as_ref(),
            self.levels[level].as_ref().ok_or_else(not_uploaded)?,
        ))
    }

    /// Returns `level`, or a finer level if there is no such level, or if a side of the image would
    /// be smaller than a tile.
    pub(crate) fn clamped(&self, level: u32) -> usize {
        clamped(level, self.keyframe.size_px).min(N_LEVELS - 1)
    }

    /// Size of the image at a level, pixels.
    pub(crate) fn size_at(&self, level: usize) -> [u32; 2] {
        self.keyframe.size_px.map(|px| (px >> level).max(1))
    }

    /// GPU memory of the images, bytes.
    #[cfg(test)]
    pub(crate) fn image_bytes(&self) -> u64 {
        self.levels.iter().flatten().map(Level::bytes).sum()
    }

    pub(crate) fn has_level(&self, level: usize) -> bool {
        self.levels[level].is_some()
    }

    /// Records that a level is used. `now` is the value of the request counter.
    pub(crate) fn mark_used(&mut self, level: usize, now: u64) {
        if let Some(level) = &mut self.levels[level] {
            level.used_at = now;
        }
    }

    /// Uploads the images of a level. `reused` is a dropped level of the same size whose buffers
    /// are overwritten.
    pub(crate) fn upload(
        &mut self,
        gpu: &Gpu,
        level: usize,
        images: &LevelImages,
        reused: Option<Level>,
    ) -> Result<(), Error> {
        let depth_bytes = bytemuck::cast_slice(&images.depth_m);
        let size_px = images.camera.size_px;
        let view = images.camera.view();
        // If not all images fit into memory, writing to an existing buffer avoids an allocation in
        // each step.
        self.levels[level] = Some(match reused {
            Some(reused) => {
                gpu.write(&reused.view, 0, bytemuck::bytes_of(&view));
                gpu.write(&reused.image, 0, &images.image);
                // Without depth, the readings of the previous view must not remain.
                match depth_bytes {
                    [] => gpu.clear(&reused.depth, 0, reused.depth.bytes()),
                    _ => gpu.write(&reused.depth, 0, depth_bytes),
                }
                Level { size_px, ..reused }
            }
            None => Level {
                size_px,
                view: gpu.uniform_with("splat.view", &view),
                image: gpu.storage_with("splat.target_image", &images.image)?,
                depth: match depth_bytes {
                    // New buffers are zeroed, which means unknown depth.
                    [] => gpu.storage(
                        "splat.target_depth",
                        4 * u64::from(size_px[0]) * u64::from(size_px[1]),
                    )?,
                    _ => gpu.storage_with("splat.target_depth", depth_bytes)?,
                },
                used_at: 0,
            },
        });
        Ok(())
    }
}

/// A keyframe at one resolution, in host memory. At full resolution, it shares the keyframe's
/// pixels.
#[derive(Debug)]
pub(crate) struct LevelImages {
    camera: Camera,
    image: Arc<[u8]>,
    /// Empty if the keyframe has no depth.
    depth_m: Arc<[f32]>,
}

impl LevelImages {
    pub(crate) fn new(keyframe: &Keyframe, level: usize) -> Self {
        let camera = camera_of(keyframe).at_level(level as u32);
        let image = downscaled_image(keyframe, camera.size_px, level as u32);
        let depth_m = downscaled_depth(keyframe, camera.size_px, level as u32);
        Self {
            camera,
            image,
            depth_m,
        }
    }

    /// Required GPU memory of the images, bytes.
    pub(crate) fn bytes(&self) -> u64 {
        (self.image.len() + size_of_val(&*self.depth_m)) as u64
    }

    pub(crate) fn size_px(&self) -> [u32; 2] {
        self.camera.size_px
    }
}

/// See [`TrainView::clamped`].
fn clamped(level: u32, [width, height]: [u32; 2]) -> usize {
    // Halving the shorter side `ilog2(side / tile)` times leaves at least one tile.
    level.min((width.min(height) / TILE_PX).max(1).ilog2()) as usize
}

/// Whether two versions of a keyframe have the same color pixels.
fn has_same_color(a: &Keyframe, b: &Keyframe) -> bool {
    // Corrected keyframes usually share the array, so the comparison of all pixels is rare.
    Arc::ptr_eq(&a.rgba_srgb, &b.rgba_srgb) || a.rgba_srgb == b.rgba_srgb
}

/// Whether two versions of a keyframe have the same depth as seen from its color camera.
fn has_same_depth(a: &Keyframe, b: &Keyframe) -> bool {
    // A correction of the color camera's pose often moves the depth camera along with it. In that
    // case, their relative pose is the same except for rounding. Only the relative pose matters
    // here.
    let color_from_depth = |keyframe: &Keyframe| CalibratedCamera::of(keyframe).color_from_depth;
    let is_same_frame = match (color_from_depth(a), color_from_depth(b)) {
        (Some(a), Some(b)) => {
            let rounding = a.inverse() * b;
            rounding.translation.vector.norm() < MAX_ROUNDING
                && rounding.rotation.angle() < MAX_ROUNDING
        }
        (a, b) => a.is_none() && b.is_none(),
    };
    let is_same_lens =
        |a: &DepthMap, b: &DepthMap| a.focal_px == b.focal_px && a.principal_px == b.principal_px;
    // Corrected keyframes usually share the array, so the comparison of all readings is rare.
    let has_same_readings = a.depth.as_ref().zip(b.depth.as_ref()).is_none_or(|(a, b)| {
        is_same_lens(a, b) && (Arc::ptr_eq(&a.depth_m, &b.depth_m) || a.depth_m == b.depth_m)
    });
    is_same_frame
        && has_same_readings
        && a.focal_px == b.focal_px
        && a.principal_px == b.principal_px
}

/// The uncorrected camera of a keyframe.
pub(crate) fn camera_of(keyframe: &Keyframe) -> Camera {
    Camera {
        world_from_camera: keyframe.world_from_camera,
        size_px: keyframe.size_px,
        focal_px: keyframe.focal_px,
        principal_px: keyframe.principal_px,
        shutter: CalibratedCamera::of(keyframe).shutter,
        near_m: NEAR_M,
        far_m: FAR_M,
        crop: None,
        edits: Arc::default(),
        low_pass_px2: LOW_PASS_PX2,
    }
}

/// Mean color of a sample of the pixels that are not masked.
fn mean_srgb(keyframe: &Keyframe) -> Option<[f64; 3]> {
    const STRIDE: usize = 61; // The step is a prime, so that the sample covers all columns.
    let mut sums = [0.0; 3];
    let mut n = 0.0;
    for pixel in keyframe
        .rgba_srgb
        .as_chunks::<4>()
        .0
        .iter()
        .step_by(STRIDE)
        .filter(|pixel| pixel[3] > 0)
    {
        n += 1.0;
        sums.iter_mut()
            .zip(pixel)
            .for_each(|(sum, color)| *sum += f64::from(*color) / 255.0);
    }
    (n > 0.0).then(|| sums.map(|sum| sum / n))
}

/// Averages squares of pixels. A square is masked if any of its pixels is masked.
fn downscaled_image(keyframe: &Keyframe, size_px: [u32; 2], level: u32) -> Arc<[u8]> {
    if level == 0 {
        return keyframe.rgba_srgb.clone();
    }
    let width = keyframe.size_px[0] as usize;
    let edge = 1usize << level;
    let mut downscaled = Vec::with_capacity(4 * (size_px[0] * size_px[1]) as usize);
    for y in 0..size_px[1] as usize {
        for x in 0..size_px[0] as usize {
            // Integer sums fit: at level 5, 1024 pixels of at most 255 are added.
            let mut sums = [0u32; 3];
            // A mean that includes masked pixels would leak their color into the loss.
            let mut is_visible = true;
            for row in y * edge..(y + 1) * edge {
                for pixel in keyframe.rgba_srgb[4 * (row * width + x * edge)..]
                    .chunks_exact(4)
                    .take(edge)
                {
                    is_visible &= pixel[3] > 0;
                    for (sum, value) in sums.iter_mut().zip(pixel) {
                        *sum += u32::from(*value);
                    }
                }
            }
            // Half of the area is added, so that the division rounds to the nearest value. Rounding
            // down would darken coarse images by half a level.
            let area = (edge * edge) as u32;
            downscaled.extend(sums.map(|sum| {
                u8::try_from((sum + area / 2) / area).expect("a mean of bytes is a byte")
            }));
            downscaled.push(if is_visible { 255 } else { 0 });
        }
    }
    downscaled.into()
}

/// Samples the depth at the center of each square, because averages would create surfaces between
/// near and far objects. Returns an empty array for a keyframe without depth.
fn downscaled_depth(keyframe: &Keyframe, size_px: [u32; 2], level: u32) -> Arc<[f32]> {
    let full = depth_in_color_view(keyframe);
    if full.is_empty() || level == 0 {
        return full;
    }
    let width = keyframe.size_px[0] as usize;
    let edge = 1usize << level;
    let middle = edge / 2;
    (0..size_px[1] as usize)
        .flat_map(|y| (0..size_px[0] as usize).map(move |x| (x, y)))
        .map(|(x, y)| full[(y * edge + middle) * width + x * edge + middle])
        .collect()
}

/// The error if a view is used before its image is uploaded.
fn not_uploaded() -> Error {
    Error::internal("a view was used before its image was uploaded")
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::scenes::{Miscalibration, capture};
    use gpu::testing::test_gpu;
    use kinematics::Transform;

    #[test]
    fn no_side_of_a_level_is_smaller_than_a_tile() {
        for size_px in [[640, 480], [33, 1000], [17, 17], [5, 9]] {
            for level in 0..8 {
                let clamped = clamped(level, size_px);
                let shorter_px = size_px[0].min(size_px[1]);
                assert!(
                    clamped == 0 || shorter_px >> clamped >= TILE_PX,
                    "{size_px:?} at {level}"
                );
                assert!(
                    clamped == level as usize || shorter_px >> (clamped + 1) < TILE_PX,
                    "{size_px:?} at {level}"
                );
            }
        }
    }

    #[test]
    fn images_are_uploaded_again_only_if_a_mask_has_changed() {
        let gpu = test_gpu();
        let keyframe = capture(&Miscalibration::none()).remove(0);
        let mut view = TrainView::new(keyframe.clone());
        let images = LevelImages::new(&keyframe, 0);
        view.upload(&gpu, 0, &images, None).unwrap();
        let moved = Keyframe {
            world_from_camera: Transform::translation(0.1, 0.0, 0.0) * keyframe.world_from_camera,
            depth: None,
            ..(*keyframe).clone()
        };
        let without_depth = Keyframe {
            depth: None,
            ..(*keyframe).clone()
        };
        view.replace_camera(&gpu, without_depth.into());
        view.upload(&gpu, 0, &images, None).unwrap();
        view.replace_camera(&gpu, Arc::new(moved.clone()));
        assert!(view.has_level(0), "only the pose has changed");
        let mut rgba = moved.rgba_srgb.to_vec();
        let n_masked = rgba.len() / 2;
        rgba[..n_masked]
            .chunks_mut(4)
            .for_each(|pixel| pixel[3] = 0);
        let before = view.mean_srgb();
        let masked = Keyframe {
            rgba_srgb: rgba.into(),
            ..moved
        };
        view.replace_camera(&gpu, masked.into());
        assert!(!view.has_level(0), "the mask has changed");
        assert_ne!(view.mean_srgb(), before);
    }
}
