//! Structural similarity with a Gaussian window of 11 pixels, sigma 1.5, over windows inside the
//! picture.

use super::PixelPair;
use crate::Error;
use rayon::prelude::*;

/// Side of the window, pixels, as in Wang et al. 2004.
const WINDOW_PX: u32 = 11;
const WINDOW: usize = WINDOW_PX as usize;
/// Standard deviation of the Gaussian window, pixels, as in Wang et al. 2004.
const SIGMA_PX: f64 = 1.5;
/// The constants `(K1 L)²` and `(K2 L)²` of Wang et al. 2004 for values from 0 to 1 (`L` = 1). They
/// keep the quotient finite in black and in uniform windows.
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

/// Structural similarity: the mean over the three colors and over all windows inside the picture.
///
/// Windows that touch a masked pixel are left out. Source: Wang, Bovik, Sheikh, Simoncelli 2004,
/// section III. Fails for pictures smaller than a window, and if no window remains.
pub fn ssim(pair: &PixelPair<'_>) -> Result<f64, Error> {
    pair.require_side("SSIM", WINDOW_PX)?;
    let width = pair.size_px[0] as usize;
    let n_rows = pair.size_px[1] as usize - WINDOW + 1;
    let signal = SumAndDifference::of(pair);
    let masked = masked_counts(pair);
    // Rows are summed in order, so that the result does not depend on the number of threads.
    let rows: Vec<(f64, usize)> = (0..n_rows)
        .into_par_iter()
        .map_init(
            || RowScratch::new(width),
            |scratch, y| scratch.ssim_of_row(&signal, masked.as_deref(), y),
        )
        .collect();
    let n_windows: usize = rows.iter().map(|row| row.1).sum();
    if n_windows == 0 {
        return Err(Error::AllPixelsMasked);
    }
    Ok(rows.iter().map(|row| row.0).sum::<f64>() / (3 * n_windows) as f64)
}

/// The signals `rendered + truth` and `rendered - truth`. Colors are interleaved, and the values of
/// each picture are from 0 to 1.
///
/// SSIM follows from the local variances of these two signals. The sum of the variances is twice
/// the sum of the pictures' variances. Their difference is four times the covariance. This takes
/// four blurs instead of five.
struct SumAndDifference {
    row_len: usize,
    sum: Vec<f32>,
    difference: Vec<f32>,
}

impl SumAndDifference {
    fn of(pair: &PixelPair<'_>) -> Self {
        let n_pixels = pair.truth_rgba.len() / 4;
        let mut sum = Vec::with_capacity(3 * n_pixels);
        let mut difference = Vec::with_capacity(3 * n_pixels);
        for (rendered, truth) in pair
            .rendered_rgba
            .chunks_exact(4)
            .zip(pair.truth_rgba.chunks_exact(4))
        {
            for color in 0..3 {
                let rendered = f32::from(rendered[color]) / 255.0;
                let truth = f32::from(truth[color]) / 255.0;
                sum.push(rendered + truth);
                difference.push(rendered - truth);
            }
        }
        Self {
            row_len: 3 * pair.size_px[0] as usize,
            sum,
            difference,
        }
    }
}

/// For each column of each row of windows, the number of masked pixels among its 11 pixels. `None`
/// if no pixel is masked.
fn masked_counts(pair: &PixelPair<'_>) -> Option<Vec<u8>> {
    let [width, height] = pair.size_px.map(|side| side as usize);
    if (0..width * height).all(|ix| pair.is_visible(ix)) {
        return None;
    }
    let masked = |x: usize, y: usize| u8::from(!pair.is_visible(y * width + x));
    let mut counts = vec![0; width * (height - WINDOW + 1)];
    for x in 0..width {
        // This is a running count. When the window moves down by one row, it gains one pixel and
        // loses another.
        let mut count: u8 = (0..WINDOW).map(|y| masked(x, y)).sum();
        counts[x] = count;
        for y in 1..=height - WINDOW {
            count = count + masked(x, y + WINDOW - 1) - masked(x, y - 1);
            counts[y * width + x] = count;
        }
    }
    Some(counts)
}

/// Scratch memory for one row of windows: the four signals blurred along y, then along x.
struct RowScratch {
    weights: [f32; WINDOW],
    width: usize,
    blurred_y: [Vec<f32>; 4],
    blurred: [Vec<f32>; 4],
}

impl RowScratch {
    fn new(width: usize) -> Self {
        let inside = 3 * (width - WINDOW + 1);
        Self {
            weights: gaussian(),
            width,
            blurred_y: std::array::from_fn(|_| vec![0.0; 3 * width]),
            blurred: std::array::from_fn(|_| vec![0.0; inside]),
        }
    }

    /// The sum of SSIM over the windows whose first row is `y` and over the three colors, and the
    /// number of windows.
    fn ssim_of_row(
        &mut self,
        signal: &SumAndDifference,
        masked: Option<&[u8]>,
        y: usize,
    ) -> (f64, usize) {
        // The Gaussian window is separable. The signals are blurred along y first, so that only
        // four rows of scratch memory are needed.
        self.blur_along_y(signal, y);
        self.blur_along_x();
        let n_columns = self.width - WINDOW + 1;
        let masked_row = masked.map(|counts| &counts[y * self.width..(y + 1) * self.width]);
        let mut total = 0.0;
        let mut n_windows = 0;
        for x in 0..n_columns {
            if masked_row.is_some_and(|row| row[x..x + WINDOW].iter().any(|&count| count > 0)) {
                continue;
            }
            n_windows += 1;
            total += (3 * x..3 * x + 3)
                .map(|ix| f64::from(self.ssim_at(ix)))
                .sum::<f64>();
        }
        (total, n_windows)
    }

    fn blur_along_y(&mut self, signal: &SumAndDifference, y: usize) {
        for blurred in &mut self.blurred_y {
            blurred.fill(0.0);
        }
        let [sum, difference, sum_square, difference_square] = &mut self.blurred_y;
        for (offset, &weight) in self.weights.iter().enumerate() {
            let row = (y + offset) * signal.row_len..(y + offset + 1) * signal.row_len;
            add_weighted(sum, sum_square, &signal.sum[row.clone()], weight);
            add_weighted(
                difference,
                difference_square,
                &signal.difference[row],
                weight,
            );
        }
    }

    fn blur_along_x(&mut self) {
        for (blurred, blurred_y) in self.blurred.iter_mut().zip(&self.blurred_y) {
            blurred.fill(0.0);
            for (offset, &weight) in self.weights.iter().enumerate() {
                // Colors are interleaved, so the next pixel is three values further.
                for (out, value) in blurred.iter_mut().zip(&blurred_y[3 * offset..]) {
                    *out += weight * value;
                }
            }
        }
    }

    /// SSIM of one color of one window.
    fn ssim_at(&self, ix: usize) -> f32 {
        let [sum, difference, sum_square, difference_square] =
            self.blurred.each_ref().map(|blurred| blurred[ix]);
        // With s = x + y and d = x - y: s² - d² = 4 x y and s² + d² = 2 (x² + y²). The same
        // identities hold for means, variances and the covariance.
        let sum_variance = sum_square - sum * sum;
        let difference_variance = difference_square - difference * difference;
        let twice_product = (sum * sum - difference * difference) / 2.0;
        let squares = (sum * sum + difference * difference) / 2.0;
        let twice_covariance = (sum_variance - difference_variance) / 2.0;
        let variances = (sum_variance + difference_variance) / 2.0;
        ((twice_product + C1) * (twice_covariance + C2)) / ((squares + C1) * (variances + C2))
    }
}

/// Adds a weighted row and its weighted squares.
fn add_weighted(blurred: &mut [f32], blurred_square: &mut [f32], row: &[f32], weight: f32) {
    for ((blurred, square), &value) in blurred.iter_mut().zip(blurred_square).zip(row) {
        *blurred += weight * value;
        *square += weight * value * value;
    }
}

#[expect(clippy::cast_possible_truncation, reason = "weights between 0 and 1")]
fn gaussian() -> [f32; WINDOW] {
    let half = (WINDOW / 2) as f64;
    let raw: [f64; WINDOW] =
        std::array::from_fn(|ix| (-((ix as f64 - half) / SIGMA_PX).powi(2) / 2.0).exp());
    let total: f64 = raw.iter().sum();
    raw.map(|weight| (weight / total) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use numbers::random::Random;

    /// A picture of reproducible noise.
    fn noise(n_pixels: usize, seed: u64) -> Vec<u8> {
        let mut random = Random::new(seed);
        (0..n_pixels)
            .flat_map(|_| [random.byte(), random.byte(), random.byte(), 255])
            .collect()
    }

    #[test]
    fn equal_pictures_score_one_and_unrelated_ones_near_zero() {
        let a = noise(40 * 30, 1);
        let b = noise(40 * 30, 2);
        let same = ssim(&PixelPair::new([40, 30], &a, &a).unwrap()).unwrap();
        assert!((same - 1.0).abs() < 1e-6, "{same}");
        let unrelated = ssim(&PixelPair::new([40, 30], &a, &b).unwrap()).unwrap();
        assert!(unrelated.abs() < 0.1, "{unrelated}");
    }

    #[test]
    fn masked_pixel_removes_only_windows_that_touch_it() {
        let a = noise(40 * 30, 1);
        let mut rendered = a.clone();
        let mut truth = a.clone();
        // Only the masked pixel is wrong, so all remaining windows are perfect.
        let pixel = 4 * (15 * 40 + 20);
        rendered[pixel] ^= 0x80;
        truth[pixel + 3] = 0;
        let masked = ssim(&PixelPair::new([40, 30], &rendered, &truth).unwrap()).unwrap();
        assert!((masked - 1.0).abs() < 1e-6, "{masked}");
        let counted = ssim(&PixelPair::new([40, 30], &rendered, &a).unwrap()).unwrap();
        assert!(counted < 0.999_9, "{counted}");
        // A wrong pixel eight columns to the right still counts in the windows that do not reach
        // the mask.
        rendered[pixel + 4 * 8] ^= 0x80;
        let with_wrong_pixel = ssim(&PixelPair::new([40, 30], &rendered, &truth).unwrap()).unwrap();
        assert!(with_wrong_pixel < 0.999_9, "{with_wrong_pixel}");
    }

    #[test]
    fn small_and_fully_masked_pictures_are_rejected() {
        let a = noise(10 * 30, 1);
        let pair = PixelPair::new([10, 30], &a, &a).unwrap();
        assert!(matches!(
            ssim(&pair),
            Err(Error::PictureTooSmall {
                min_px: 11,
                width: 10,
                ..
            })
        ));
        let mut masked = noise(11 * 11, 1);
        masked[3] = 0;
        assert!(matches!(
            ssim(&PixelPair::new([11, 11], &masked, &masked).unwrap()),
            Err(Error::AllPixelsMasked)
        ));
    }
}
