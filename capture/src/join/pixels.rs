//! Pixel statistics of an image: brightness, clipping, sharpness.

use numbers::quantile::{Rank, quantile};

/// Approximate width of the reduced image. A common width makes sharpness comparable between
/// cameras and averages out noise.
const REDUCED_WIDTH: usize = 320;
/// Number of images whose median sharpness is the reference. The number is small enough for the
/// images to show similar content. With more images, different parts of the scene would be
/// compared. With fewer, two consecutive blurred images could become the reference.
const SHARPNESS_WINDOW: usize = 9;
/// Brightness limits (0 to 255). Pixels at or beyond them count as clipped. One level of margin at
/// both ends allows for the rounding of JPEG and YUV conversions.
const CLIPPED: [u8; 2] = [1, 254];

/// Brightness and sharpness of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PixelStatistics {
    /// Mean brightness, 0 to 1.
    pub(super) luma_frac: f64,
    /// Fraction of pixels that are black or white.
    pub(super) clipped_frac: f64,
    /// Variance of the Laplacian of the reduced image, divided by the variance of that image. The
    /// division removes the effect of contrast. Only ratios between images of the same camera are
    /// meaningful.
    pub(super) sharpness: f64,
}

impl PixelStatistics {
    /// Computes the statistics of `rgb`, `[height, width, 3]`, sRGB.
    pub(super) fn of(rgb: &[u8], size_px: [u32; 2]) -> Self {
        let [width, height] = size_px.map(|side| side as usize);
        // The blocks have an integer size, so that every pixel has the same weight. Pixels of an
        // incomplete block at the right and bottom edge are left out.
        let block = (width / REDUCED_WIDTH).max(1);
        let reduced = Reduced::of(rgb, [width, height], block);
        #[expect(
            clippy::cast_precision_loss,
            reason = "counts of pixels stay far below 2^53"
        )]
        let fraction = |n: u64| n as f64 / (reduced.n_pixels as f64).max(1.0);
        Self {
            luma_frac: fraction(reduced.luma_sum) / 255.0,
            clipped_frac: fraction(reduced.n_clipped),
            sharpness: reduced.sharpness(),
        }
    }
}

/// Block means of the brightness.
struct Reduced {
    size: [usize; 2],
    luma: Vec<f64>,
    luma_sum: u64,
    n_clipped: u64,
    n_pixels: u64,
}

impl Reduced {
    fn of(rgb: &[u8], [width, height]: [usize; 2], block: usize) -> Self {
        let size = [width / block, height / block];
        let mut sums = vec![0_u32; size[0] * size[1]];
        let mut reduced = Self {
            size,
            luma: Vec::new(),
            luma_sum: 0,
            n_clipped: 0,
            n_pixels: 0,
        };
        for row in 0..size[1] * block {
            let line = &rgb[row * width * 3..][..size[0] * block * 3];
            let out = &mut sums[row / block * size[0]..][..size[0]];
            for (pixels, sum) in line.chunks_exact(block * 3).zip(out) {
                // Sums of integers are exact, so that the order of summation does not matter.
                for pixel in pixels.as_chunks::<3>().0 {
                    let luma = luma(*pixel);
                    *sum += luma;
                    // A saturated color, such as a red lamp, has one channel at the limit. The
                    // exposure is wrong only if all channels are at the limit.
                    let clipped = pixel.iter().all(|c| *c <= CLIPPED[0])
                        || pixel.iter().all(|c| *c >= CLIPPED[1]);
                    reduced.n_clipped += u64::from(clipped);
                }
            }
        }
        #[expect(clippy::cast_precision_loss, reason = "a block has few pixels")]
        let per_block = (block * block) as f64;
        reduced.luma_sum = sums.iter().map(|sum| u64::from(*sum)).sum();
        reduced.n_pixels = (sums.len() * block * block) as u64;
        reduced.luma = sums
            .into_iter()
            .map(|sum| f64::from(sum) / per_block)
            .collect();
        reduced
    }

    fn sharpness(&self) -> f64 {
        let [width, height] = self.size;
        let mut luma = Variance::default();
        let mut laplacian = Variance::default();
        // The border has no four neighbors. A 2 x 2 image has no inner pixels, and its sharpness is
        // 0.
        for row in 1..height.saturating_sub(1) {
            for column in 1..width.saturating_sub(1) {
                let at = row * width + column;
                let neighbor_sum = self.luma[at - 1]
                    + self.luma[at + 1]
                    + self.luma[at - width]
                    + self.luma[at + width];
                laplacian.add(neighbor_sum - 4.0 * self.luma[at]);
                luma.add(self.luma[at]);
            }
        }
        // A flat image, for example of a covered lens, has no contrast by which to divide.
        if luma.get() > 0.0 {
            laplacian.get() / luma.get()
        } else {
            0.0
        }
    }
}

/// A running variance.
#[derive(Clone, Copy, Debug, Default)]
struct Variance {
    n: f64,
    sum: f64,
    sum_of_squares: f64,
}

impl Variance {
    fn add(&mut self, value: f64) {
        self.n += 1.0;
        self.sum += value;
        self.sum_of_squares += value * value;
    }

    fn get(&self) -> f64 {
        if self.n == 0.0 {
            0.0
        } else {
            // Rounding can make this slightly negative for equal values. Callers therefore compare
            // it with 0 before they divide by it.
            self.sum_of_squares / self.n - (self.sum / self.n) * (self.sum / self.n)
        }
    }
}

/// Brightness, 0 to 255, with the weights of Rec. 601 in 256ths.
fn luma([red, green, blue]: [u8; 3]) -> u32 {
    (u32::from(red) * 77 + u32::from(green) * 150 + u32::from(blue) * 29) >> 8
}

/// Sharpness of the latest images of a camera.
#[derive(Clone, Debug, Default)]
pub(super) struct SharpnessHistory(std::collections::VecDeque<f64>);

impl SharpnessHistory {
    /// Adds a value and returns its ratio to the median of the latest images, including this one.
    pub(super) fn relative(&mut self, sharpness: f64) -> f64 {
        if self.0.len() == SHARPNESS_WINDOW {
            self.0.pop_front();
        }
        self.0.push_back(sharpness);
        let mut latest: Vec<f64> = self.0.iter().copied().collect();
        let median = quantile(&mut latest, 0.5, Rank::Upper).unwrap_or(0.0);
        // If most images are flat, nothing can be compared, and the image passes.
        if median > 0.0 {
            sharpness / median
        } else {
            1.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stripes with a period in pixels, blurred over `blur` pixels.
    fn stripes(size_px: [u32; 2], period: u32, blur: u32) -> Vec<u8> {
        let level = |x: u32| {
            if (x / period).is_multiple_of(2) {
                40_u32
            } else {
                200
            }
        };
        let blurred = |x: u32| {
            u8::try_from((0..=blur).map(|dx| level(x + dx)).sum::<u32>() / (blur + 1))
                .expect("a mean")
        };
        (0..size_px[1])
            .flat_map(|_| (0..size_px[0]).flat_map(|x| [blurred(x); 3]))
            .collect()
    }

    #[test]
    fn blur_lowers_sharpness_and_leaves_brightness() {
        for size_px in [[160, 120], [640, 480], [1280, 720]] {
            let statistics = [0, 8, 24].map(|blur| {
                PixelStatistics::of(
                    &stripes(size_px, size_px[0] / 10, blur * size_px[0] / 640),
                    size_px,
                )
            });
            assert!(
                statistics[0].sharpness >= statistics[1].sharpness
                    && statistics[1].sharpness > 1.3 * statistics[2].sharpness,
                "{size_px:?}: {statistics:?}"
            );
            assert!(
                (statistics[0].luma_frac - statistics[2].luma_frac).abs() < 0.02
                    && statistics[0].clipped_frac == 0.0,
                "{statistics:?}"
            );
        }
    }

    #[test]
    fn contrast_does_not_change_sharpness() {
        let strong = stripes([640, 480], 32, 8);
        let weak: Vec<u8> = strong.iter().map(|level| 100 + level / 4).collect();
        let [strong, weak] =
            [strong, weak].map(|rgb| PixelStatistics::of(&rgb, [640, 480]).sharpness);
        assert!((strong - weak).abs() < 0.05 * strong, "{strong} {weak}");
    }

    #[test]
    fn clipped_pixels_are_counted_and_flat_images_have_no_sharpness() {
        let mut rgb = vec![255; 30 * 20 * 3];
        rgb[..30 * 5 * 3].fill(0);
        rgb[30 * 5 * 3..30 * 10 * 3].fill(128);
        let statistics = PixelStatistics::of(&rgb, [30, 20]);
        assert!(
            (statistics.clipped_frac - 0.75).abs() < 1e-12,
            "{statistics:?}"
        );
        assert_eq!(
            PixelStatistics::of(&[77; 8 * 8 * 3], [8, 8]).sharpness,
            0.0,
            "flat"
        );
        assert_eq!(
            PixelStatistics::of(&[77; 3], [1, 1]).sharpness,
            0.0,
            "too small for a Laplacian"
        );
    }

    #[test]
    fn sharpness_is_relative_to_the_recent_median() {
        for scale in [1.0, 1e4] {
            let mut history = SharpnessHistory::default();
            assert_eq!(
                history.relative(5.0 * scale),
                1.0,
                "the first image is compared with itself"
            );
            for _ in 0..40 {
                history.relative(10.0 * scale);
            }
            assert!((history.relative(2.0 * scale) - 0.2).abs() < 1e-12);
            for _ in 0..20 {
                history.relative(2.0 * scale);
            }
            assert!(
                history.relative(2.0 * scale) > 0.9,
                "a blurry scene becomes the new reference"
            );
        }
    }
}
