//! Gray images, which are the input of detection, and a float copy with interpolation, blur and
//! pyramid.

use crate::error::NotDetected;

/// Smallest side of an image that is searched. The smallest chessboard has 4 by 4 squares, which
/// are at most 6 pixels wide in such an image.
const MIN_SIDE_PX: u32 = 24;

/// An 8-bit gray image, row by row. Pixel `(0, 0)` covers `[0,1) x [0,1)`.
#[derive(Clone, Copy, Debug)]
pub struct GrayImage<'a> {
    /// Width and height.
    pub size_px: [u32; 2],
    /// One byte per pixel.
    pub pixels: &'a [u8],
}

/// A gray image in floating point, 0 to 255.
#[derive(Clone, Debug)]
pub(crate) struct Plane {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Plane {
    /// Copies an image.
    ///
    /// # Errors
    /// Fails if the number of bytes does not match the size or the image is too small.
    pub(crate) fn new(image: GrayImage<'_>) -> Result<Self, NotDetected> {
        let [width, height] = image.size_px;
        let n_pixels = u64::from(width) * u64::from(height);
        if width.min(height) < MIN_SIDE_PX || image.pixels.len() as u64 != n_pixels {
            return Err(NotDetected::Image {
                n_bytes: image.pixels.len(),
                width,
                height,
                min: MIN_SIDE_PX,
            });
        }
        let values = image.pixels.iter().map(|&value| f32::from(value)).collect();
        Ok(Self {
            width: width as usize,
            height: height as usize,
            values,
        })
    }

    pub(crate) fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    pub(crate) fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    pub(crate) fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// Whether a position is at least `margin` pixels inside the image.
    pub(crate) fn contains(&self, [x, y]: [f64; 2], margin: f64) -> bool {
        x >= margin
            && y >= margin
            && x <= self.width as f64 - margin
            && y <= self.height as f64 - margin
    }

    /// Interpolates bilinearly between pixel centers. Positions outside the image take the nearest
    /// value.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "clamped to the image; the fraction needs no precision"
    )]
    pub(crate) fn sample(&self, [x, y]: [f64; 2]) -> f32 {
        let clamp = |value: f64, size: usize| (value - 0.5).clamp(0.0, (size - 1) as f64);
        let x = clamp(x, self.width);
        let y = clamp(y, self.height);
        // At the last column or row, the pixels to the left and above are used with a fraction of
        // 1, so that the neighbors always exist.
        let left = (x as usize).min(self.width - 2);
        let top = (y as usize).min(self.height - 2);
        let right_frac = (x - left as f64) as f32;
        let lower_frac = (y - top as f64) as f32;
        let at = top * self.width + left;
        let [upper, lower] = [at, at + self.width]
            .map(|at| self.values[at] + (self.values[at + 1] - self.values[at]) * right_frac);
        upper + (lower - upper) * lower_frac
    }

    /// Smooths with the binomial kernel (1 4 6 4 1) / 16 along both axes. This kernel approximates
    /// a Gaussian with a standard deviation of 1 px.
    pub(crate) fn smoothed(&self) -> Self {
        // The kernel is separable, so two passes with 5 values each replace one pass with 25
        // values. Two pixels at each border are not smoothed, because the kernel would reach
        // outside. Detection does not use them.
        let mut across = self.values.clone();
        for (out, row) in across
            .chunks_exact_mut(self.width)
            .zip(self.values.chunks_exact(self.width))
        {
            for (at, window) in row.windows(5).enumerate() {
                out[at + 2] = binomial([window[0], window[1], window[2], window[3], window[4]]);
            }
        }
        let mut values = across.clone();
        for y in 2..self.height - 2 {
            let row = |offset: usize| {
                &across[(y + offset - 2) * self.width..(y + offset - 1) * self.width]
            };
            let rows = [row(0), row(1), row(2), row(3), row(4)];
            for (x, out) in values[y * self.width..(y + 1) * self.width]
                .iter_mut()
                .enumerate()
            {
                *out = binomial(rows.map(|row| row[x]));
            }
        }
        Self { values, ..*self }
    }

    /// Halves the size by averaging blocks of 2x2 pixels. Position `p` becomes `p / 2`.
    pub(crate) fn halved(&self) -> Self {
        // A last odd column or row is dropped.
        let width = self.width / 2;
        let height = self.height / 2;
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let upper = self.row(2 * y);
            let lower = self.row(2 * y + 1);
            let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
            values.extend(
                pairs.map(|(upper, lower)| (upper[0] + upper[1] + lower[0] + lower[1]) * 0.25),
            );
        }
        Self {
            width,
            height,
            values,
        }
    }

    /// Whether the image can be halved and still be searched.
    pub(crate) fn can_be_halved(&self) -> bool {
        // The halved image then still has four times the smallest side. In smaller images, the
        // squares of most boards would be only a few pixels wide at half resolution.
        self.width.min(self.height) >= 8 * MIN_SIDE_PX as usize
    }
}

fn binomial(window: [f32; 5]) -> f32 {
    const SIXTEENTH: f32 = 1.0 / 16.0;
    (window[0] + window[4] + 4.0 * (window[1] + window[3]) + 6.0 * window[2]) * SIXTEENTH
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_centers_are_at_one_half() {
        let pixels: Vec<u8> = (0..32 * 32)
            .map(|at| u8::try_from(at % 32 * 8).unwrap())
            .collect();
        let plane = Plane::new(GrayImage {
            size_px: [32, 32],
            pixels: &pixels,
        })
        .unwrap();
        assert_eq!(plane.sample([3.5, 7.5]), 24.0);
        assert_eq!(plane.sample([4.0, 7.0]), 28.0);
        assert_eq!(plane.sample([-5.0, 99.0]), 0.0);
        assert_eq!(plane.halved().sample([2.0, 3.0]), 28.0);
        assert_eq!(plane.smoothed().at(5, 5), 40.0);
    }

    #[test]
    fn wrong_sizes_are_rejected() {
        for (size_px, n) in [
            ([32, 32], 1023),
            ([0, 0], 0),
            ([23, 40], 920),
            ([u32::MAX, u32::MAX], 7),
        ] {
            let pixels = vec![0; n];
            assert!(
                Plane::new(GrayImage {
                    size_px,
                    pixels: &pixels
                })
                .is_err(),
                "{size_px:?}"
            );
        }
    }
}
