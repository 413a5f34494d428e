//! Regularization of models trained on few images. It fades out as the number of images rises,
//! because it costs detail with many images.

use super::options::SplatOptions;
use super::params::Supervision;
use numbers::f32_of;

/// With this number of images or more, models are not regularized, and the number of splats is
/// limited only by the options.
///
/// In the measurements, data sets with few images have 6 to 36 images, and data sets with many
/// images have at least 43 images (docs/benchmarks/2026-11-25-few-images.md).
pub(crate) const FEW_IMAGES: usize = 40;
/// Maximum number of splats per image if there are few images.
///
/// More splats overfit. Beyond some number, other views score worse although the training images
/// still score better. On eleven sets of 6 to 43 images, half as many splats reduced the score by
/// 0.2 dB on average, and four times as many raised the depth error
/// (docs/benchmarks/2026-11-29-number-of-splats.md).
const MAX_SPLATS_PER_IMAGE: u32 = 8000;
/// Up to this number of images, the regularization is complete. The changes were measured with 6
/// and 11 images (docs/benchmarks/2026-11-25-few-images.md).
const VERY_FEW_IMAGES: usize = 20;
/// Completed fraction of the planned steps at which the rate of dropped splats reaches its full
/// value. At earlier steps, dropping would only slow down training.
const DROP_RAMP_FRAC: f64 = 0.2;
/// Depth residuals above this limit have no gradient, because such readings are often outliers of
/// the sensor.
const DEPTH_CLIP_M: f64 = 0.2;
/// Limit for few images. Splats that float in front of a surface are often farther from it than
/// [`DEPTH_CLIP_M`]. With many images, the color loss removes such splats. With few images, only
/// the depth loss removes them.
const FEW_DEPTH_CLIP_M: f64 = 1.0;
/// Weight of the depth loss for few images, relative to the usual weight. It lowers the depth
/// error. Ten times the weight lowers the depth error a little more, but it also lowers the PSNR
/// (docs/benchmarks/2026-11-25-few-images.md).
const FEW_DEPTH_WEIGHT: f64 = 3.0;

/// Maximum number of splats for `n` images, counting validation images.
pub(crate) fn max_splats(n_images: usize) -> u32 {
    match u32::try_from(n_images) {
        Ok(n) if n_images < FEW_IMAGES => n * MAX_SPLATS_PER_IMAGE,
        _ => u32::MAX,
    }
}

/// How much regularization a model needs, from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scarcity(f64);

impl Scarcity {
    /// Scarcity for `n` images, counting validation images.
    pub(crate) fn of_images(n: usize) -> Self {
        // The scarcity is linear between the two numbers, so that a single new image never changes
        // the training much.
        let missing = FEW_IMAGES.saturating_sub(n) as f64 / (FEW_IMAGES - VERY_FEW_IMAGES) as f64;
        Self(missing.min(1.0))
    }

    /// Fraction of the splats that a step leaves out, given the maximum of this fraction (Park et
    /// al. 2025, `DropGaussian`).
    pub(crate) fn drop_frac(self, max: f64, completed_frac: f64) -> f64 {
        self.0 * max * (completed_frac / DROP_RAMP_FRAC).min(1.0)
    }

    /// Background and loss weights of a training step.
    pub(crate) fn supervision(self, options: &SplatOptions, mean_srgb: [f32; 3]) -> Supervision {
        let [red, green, blue] = self.min_background_srgb(mean_srgb, options.random_background);
        Supervision {
            background_srgb: [red, green, blue, 0.0],
            dssim_frac: f32_of(options.dssim_frac),
            depth_weight: f32_of(options.depth_per_m * self.depth_weight()),
            depth_clip_m: f32_of(self.depth_clip_m()),
            random_background: f32_of(options.random_background),
        }
    }

    /// Depth residuals above this limit have no gradient, meters.
    fn depth_clip_m(self) -> f64 {
        self.between(DEPTH_CLIP_M, FEW_DEPTH_CLIP_M)
    }

    /// Factor of the weight of the depth loss.
    fn depth_weight(self) -> f64 {
        self.between(1.0, FEW_DEPTH_WEIGHT)
    }

    /// Background of pictures. With few images, it is the mean color of the images, which is the
    /// best guess for unobserved areas. With many images, it is black.
    pub(crate) fn background_srgb(self, mean_srgb: [f32; 3]) -> [f32; 3] {
        mean_srgb.map(|color| f32_of(self.0) * color)
    }

    /// Lower end of the random background's range of colors during training. With few images, the
    /// range is centered at the mean color as far as it fits into 0 to 1. With many images, it
    /// begins at black.
    fn min_background_srgb(self, mean_srgb: [f32; 3], range: f64) -> [f32; 3] {
        // The random color is this minimum plus up to `range`.
        mean_srgb.map(|color| {
            f32_of(self.0 * (f64::from(color) - 0.5 * range).clamp(0.0, (1.0 - range).max(0.0)))
        })
    }

    fn between(self, many: f64, few: f64) -> f64 {
        many + self.0 * (few - many)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_of_splats_is_limited_only_with_few_images() {
        assert_eq!(
            [0, 1, 11, 39, 40, 500].map(max_splats),
            [0, 8000, 88_000, 312_000, u32::MAX, u32::MAX]
        );
    }

    #[test]
    fn regularization_fades_with_the_number_of_images() {
        let drop_frac = |n| Scarcity::of_images(n).drop_frac(0.2, 0.5);
        assert_eq!([1, 20, 40, 300].map(drop_frac), [0.2, 0.2, 0.0, 0.0]);
        assert!((drop_frac(30) - 0.1).abs() < 1e-12);
        assert_eq!(
            Scarcity::of_images(5).drop_frac(0.2, 0.0),
            0.0,
            "no splats are dropped at the start"
        );
        let background = |n, color| {
            let scarcity = Scarcity::of_images(n);
            (
                scarcity.background_srgb([color; 3])[0],
                scarcity.min_background_srgb([color; 3], 0.25)[0],
            )
        };
        assert_eq!(
            [background(8, 0.5), background(8, 0.0), background(8, 1.0)],
            [(0.5, 0.375), (0.0, 0.0), (1.0, 0.75)]
        );
        assert_eq!(background(40, 0.5), (0.0, 0.0));
        let depth = |n| {
            (
                Scarcity::of_images(n).depth_clip_m(),
                Scarcity::of_images(n).depth_weight(),
            )
        };
        assert_eq!(
            (depth(40), depth(8)),
            ((DEPTH_CLIP_M, 1.0), (FEW_DEPTH_CLIP_M, FEW_DEPTH_WEIGHT))
        );
    }
}
