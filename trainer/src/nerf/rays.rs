//! Training rays, which are pixels of all keyframes. A hash of seed, step and position in the batch
//! chooses the pixels.

use super::extent::Extent;
use super::params;
use crate::view::depth_in_color_view;
use keyframe::Keyframe;
use nalgebra::Vector3;
use numbers::random::{hash, unit_from_bits};
use numbers::{f32_of, f32s_of};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// Rays per parallel task. A ray takes only a few operations, so the overhead of smaller tasks
/// would be larger than their work.
const RAYS_PER_TASK: usize = 512;
/// Attempts to find a pixel that is not masked. If all fail, the ray has no target and no effect.
/// The number is bounded, because an image may be masked entirely.
const MAX_ATTEMPTS: u64 = 4;
/// End of rays without a reading. Contraction leaves no resolution far beyond this distance.
const MAX_DISTANCE: f32 = 1e3;

/// Offset in units of the scene radius up to which a ray is sampled behind a reading. A fraction of
/// the reading's distance is added, which is the next constant. The space farther back is
/// unobserved.
const BEHIND_SURFACE: f64 = 0.03;
const BEHIND_SURFACE_FRAC: f64 = 0.03;

/// A keyframe that rays are sampled from.
#[derive(Clone, Debug)]
pub(crate) struct RayImage {
    pub(crate) keyframe: Arc<Keyframe>,
    /// Depth of each pixel, meters along z. It is 0 where unknown. The array is empty without
    /// depth, and computed on first use.
    depth_m: OnceLock<Arc<[f32]>>,
}

impl RayImage {
    pub(crate) fn new(keyframe: Arc<Keyframe>) -> Self {
        Self {
            keyframe,
            depth_m: OnceLock::new(),
        }
    }

    pub(crate) fn depth_m(&self) -> &[f32] {
        self.depth_m
            .get_or_init(|| depth_in_color_view(&self.keyframe))
    }

    /// Origin, direction of length 1, and measured distance along the ray, in units of the extent's
    /// radius. The distance is 0 if there is no reading.
    pub(crate) fn reading(&self, extent: &Extent, pixel_ix: usize) -> ([f64; 3], [f64; 3], f64) {
        let Keyframe {
            size_px: [width, height],
            focal_px,
            principal_px,
            ..
        } = &*self.keyframe;
        let x = pixel_ix % *width as usize;
        let y = pixel_ix / *width as usize;
        let along =
            |pixel: usize, axis: usize| (pixel as f64 + 0.5 - principal_px[axis]) / focal_px[axis];
        let mut in_camera = Vector3::new(along(x, 0), along(y, 1), 1.0);
        let mut origin_m = Vector3::zeros();
        if let Some(twist) = &self.keyframe.twist {
            // The camera motion moves a point by -tau (v + w x p) in the camera frame. The inverse
            // is applied to the ray. `tau` is the time of the pixel's row after the middle of the
            // image, to which the pose belongs.
            let tau_secs =
                ((y as f64 + 0.5) / f64::from(*height) - 0.5) * self.keyframe.readout_secs;
            in_camera += twist.angular_rad_s.cross(&in_camera) * tau_secs;
            origin_m = twist.linear_m_s * tau_secs;
        }
        let pose = &self.keyframe.world_from_camera;
        let origin =
            (pose * nalgebra::Point3::from(origin_m)).coords - Vector3::from(extent.center_m);
        let z_m = self
            .depth_m()
            .get(pixel_ix)
            .copied()
            .filter(|z| z.is_finite())
            .unwrap_or(0.0);
        let length = in_camera.norm();
        let distance = f64::from(z_m) * length / extent.radius_m;
        (
            (origin / extent.radius_m).into(),
            (pose.rotation * (in_camera / length)).into(),
            distance.max(0.0),
        )
    }

    /// The ray through the center of a pixel, with the color and depth observed there.
    fn ray(&self, extent: &Extent, pixel_ix: usize, begin: f32, jitter: f32) -> params::Ray {
        let (origin, direction, distance) = self.reading(extent, pixel_ix);
        let pixel = &self.keyframe.rgba_srgb[4 * pixel_ix..4 * pixel_ix + 4];
        params::Ray {
            origin: f32s_of(origin),
            direction: f32s_of(direction),
            begin,
            end: if distance > 0.0 {
                f32_of(distance * (1.0 + BEHIND_SURFACE_FRAC) + BEHIND_SURFACE)
            } else {
                MAX_DISTANCE
            },
            target_rgb: u32::from_le_bytes([pixel[0], pixel[1], pixel[2], pixel[3]]),
            target_distance: f32_of(distance),
            jitter,
            ..params::Ray::default()
        }
    }
}

/// Parameters for sampling the rays of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RaySampling {
    pub(crate) seed: u64,
    pub(crate) step: u64,
    pub(crate) n_rays: u32,
    /// Distance at which rays begin, in units of the radius.
    pub(crate) begin: f32,
}

/// Draws the rays of a step evenly from all images, in the order of the images.
pub(crate) fn draw(images: &[RayImage], extent: &Extent, draw: &RaySampling) -> Vec<params::Ray> {
    if images.is_empty() {
        return Vec::new();
    }
    (0..draw.n_rays)
        .into_par_iter()
        .with_min_len(RAYS_PER_TASK)
        .map(|ix| draw.ray(images, extent, ix.into()))
        .collect()
}

impl RaySampling {
    /// The ray at an index of the batch. It depends only on seed, step and index, so rays are
    /// computed in parallel.
    fn ray(&self, images: &[RayImage], extent: &Extent, ix: u64) -> params::Ray {
        let key = hash(self.seed ^ hash(self.step));
        let ray_key = hash(key ^ hash(ix));
        // The sampling is stratified. Successive rays belong to successive images, so all images
        // get the same number of rays.
        let share = (ix as f64 + unit_from_bits(ray_key)) / f64::from(self.n_rays);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a fraction of a length"
        )]
        let image_ix = ((share * images.len() as f64) as usize).min(images.len() - 1);
        let image = &images[image_ix];
        let pixel_ix = unmasked_pixel(&image.keyframe, ray_key);
        // Each purpose needs its own random number. The constant has no meaning except that it
        // gives a different key.
        let jitter = f32_of(unit_from_bits(hash(ray_key ^ 0x5bd1_e995)));
        let embedding = u32::try_from(image_ix).expect("few images");
        params::Ray {
            embedding,
            ..image.ray(extent, pixel_ix, self.begin, jitter)
        }
    }
}

/// Index of a random pixel, which is not masked if a few attempts find one.
fn unmasked_pixel(keyframe: &Keyframe, ray_key: u64) -> usize {
    let n_pixels = keyframe.rgba_srgb.len() as u64 / 4;
    let pick = |attempt: u64| random_ix(hash(ray_key.wrapping_add(1 + attempt)), n_pixels);
    let is_unmasked = |pixel_ix: &usize| keyframe.rgba_srgb[4 * pixel_ix + 3] > 0;
    (0..MAX_ATTEMPTS)
        .map(pick)
        .find(is_unmasked)
        .unwrap_or_else(|| pick(0))
}

/// An index below `n` from random bits.
fn random_ix(bits: u64, n: u64) -> usize {
    // The upper half of the product is uniformly distributed over all indices.
    usize::try_from((u128::from(bits) * u128::from(n)) >> 64).expect("less than a length")
}
