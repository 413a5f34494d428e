//! Resamples distorted images to pinhole images with the same focal length and principal point.

use crate::{Error, Intrinsics};

/// For every pixel of the pinhole image, its position in the distorted image. The map is computed
/// once per camera.
///
/// Input and output have the size of the camera. Pixel centers are at `(0.5, 0.5)`. OpenCV places
/// them at integers, so its principal point differs by half a pixel, but the resulting images are
/// the same.
#[derive(Clone, Debug)]
pub struct Undistortion {
    size_px: [u32; 2],
    taps: Vec<Tap>,
}

/// Source of one output pixel. It consists of the upper left of four neighbors, and of the weights
/// of the right and the lower neighbors.
#[derive(Clone, Copy, Debug)]
struct Tap {
    upper_left: u32,
    right: u16,
    lower: u16,
}

impl Tap {
    /// The [`Tap`] of a pixel whose source lies outside the image.
    const OUTSIDE: Self = Self {
        upper_left: u32::MAX,
        right: 0,
        lower: 0,
    };

    /// Index of the nearest of the four neighbors. It is 0 outside the image.
    ///
    /// * `steps`: see [`Undistortion::steps`].
    fn nearest(&self, depth_m: &[f32], [step_right, step_down]: [usize; 2]) -> f32 {
        if self.upper_left == u32::MAX {
            return 0.0;
        }
        let right = if u32::from(self.right) * 2 >= ONE {
            step_right
        } else {
            0
        };
        let down = if u32::from(self.lower) * 2 >= ONE {
            step_down
        } else {
            0
        };
        depth_m[self.upper_left as usize + right + down]
    }
}

/// The value 1 in the fixed-point format of [`Tap`].
///
/// Two 11-bit weights and 8 bits of color have 30 bits, so a weighted sum of four pixels fits 32
/// bits. A weight is exact to 1/4096, which changes a color by at most 1/16.
const ONE: u32 = 1 << SHARE_BITS;
const SHARE_BITS: u32 = 11;

impl Undistortion {
    /// Computes the map of one camera, which is the identity for a rectified or pinhole camera.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let pinhole = intrinsics.undistorted();
        let [width, height] = intrinsics.size_px;
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| [column, row]));
        let taps = pixels
            .map(|pixel| tap_of(pixel, &pinhole, intrinsics).unwrap_or(Tap::OUTSIDE))
            .collect();
        Self {
            size_px: [width, height],
            taps,
        }
    }

    /// Width and height of input and output, in pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Number of output pixels that the distorted image does not cover.
    pub fn n_outside(&self) -> usize {
        self.taps
            .iter()
            .filter(|tap| tap.upper_left == u32::MAX)
            .count()
    }

    /// Undistorts `[height, width, 3]` to `[height, width, 4]` with bilinear sampling. Alpha is
    /// 255. It is 0 if the source of a pixel lies outside the image.
    pub fn apply_rgb(&self, rgb: &[u8]) -> Result<Vec<u8>, Error> {
        self.check_len(rgb.len(), 3)?;
        Ok(self.resample::<3>(rgb))
    }

    /// Undistorts `[height, width, 4]` with bilinear sampling of all four channels. Pixels whose
    /// source lies outside the image are zero.
    ///
    /// Alpha is straight (not premultiplied). Masks that are stored in alpha are interpolated like
    /// colors.
    pub fn apply_rgba(&self, rgba: &[u8]) -> Result<Vec<u8>, Error> {
        self.check_len(rgba.len(), 4)?;
        Ok(self.resample::<4>(rgba))
    }

    /// Undistorts the rows of `[height, width, 4]` one at a time, with the same result as
    /// [`Self::apply_rgba`]. The undistorted image then need not be in memory.
    ///
    /// The returned function writes the row with the given index to `[width, 4]`.
    pub fn rgba_rows(&self, rgba: &[u8]) -> Result<impl Fn(usize, &mut [u8]), Error> {
        self.check_len(rgba.len(), 4)?;
        let width = self.size_px[0] as usize;
        Ok(move |row: usize, undistorted: &mut [u8]| {
            self.resample_to::<4>(
                rgba,
                &self.taps[row * width..(row + 1) * width],
                undistorted,
            );
        })
    }

    /// Undistorts `[height, width]` depth along the camera's z axis. Lens distortion moves depth
    /// values but does not change them. Each output pixel takes the nearest source pixel, because
    /// averaging across an edge gives a depth at which there is no surface. Pixels whose source
    /// lies outside the image are 0.
    pub fn apply_depth(&self, depth_m: &[f32]) -> Result<Vec<f32>, Error> {
        self.check_len(depth_m.len(), 1)?;
        let steps = self.steps();
        Ok(self
            .taps
            .iter()
            .map(|tap| tap.nearest(depth_m, steps))
            .collect())
    }

    fn resample<const CHANNELS: usize>(&self, source: &[u8]) -> Vec<u8> {
        let mut rgba = vec![0; self.taps.len() * 4];
        self.resample_to::<CHANNELS>(source, &self.taps, &mut rgba);
        rgba
    }

    /// Samples the source image at the given taps, one per output pixel.
    fn resample_to<const CHANNELS: usize>(&self, source: &[u8], taps: &[Tap], rgba: &mut [u8]) {
        let [step_right, step_down] = self.steps().map(|step| step * CHANNELS);
        for (tap, out) in taps.iter().zip(rgba.as_chunks_mut::<4>().0) {
            if tap.upper_left == u32::MAX {
                *out = [0; 4];
                continue;
            }
            let right = u32::from(tap.right);
            let lower = u32::from(tap.lower);
            let upper = ONE - lower;
            let at = tap.upper_left as usize * CHANNELS;
            let above = mix_pair::<CHANNELS>(&source[at..], step_right, right);
            let below = mix_pair::<CHANNELS>(&source[at + step_down..], step_right, right);
            // Images without alpha are opaque. With four channels, the loop overwrites this.
            out[3] = 255;
            for channel in 0..CHANNELS {
                let sum = above[channel] * upper + below[channel] * lower;
                out[channel] = round_share(sum);
            }
        }
    }

    /// Index offsets of the right and the lower neighbor in the source. An offset is 0 in an image
    /// of one column or row.
    fn steps(&self) -> [usize; 2] {
        let [width, height] = self.size_px;
        [
            usize::from(width > 1),
            if height > 1 { width as usize } else { 0 },
        ]
    }

    fn check_len(&self, got: usize, channels: usize) -> Result<(), Error> {
        let expected = self.taps.len() * channels;
        let [width, height] = self.size_px;
        if got == expected {
            Ok(())
        } else {
            Err(Error::ImageSize {
                got,
                expected,
                width,
                height,
            })
        }
    }
}

/// The channels of a pixel and of its right neighbor, weighted with `ONE - right` and `right`.
///
/// * `source`: from the first channel of the pixel on.
fn mix_pair<const CHANNELS: usize>(
    source: &[u8],
    step_right: usize,
    right: u32,
) -> [u32; CHANNELS] {
    let left = ONE - right;
    let a = &source[..CHANNELS];
    let b = &source[step_right..][..CHANNELS];
    std::array::from_fn(|channel| u32::from(a[channel]) * left + u32::from(b[channel]) * right)
}

/// The byte closest to a sum of colors that are weighted with two shares each.
#[expect(clippy::cast_possible_truncation, reason = "a mean of bytes is a byte")]
fn round_share(sum: u32) -> u8 {
    ((sum + (1 << (2 * SHARE_BITS - 1))) >> (2 * SHARE_BITS)) as u8
}

/// The tap of one pixel of the pinhole image. `None` if its source is outside the distorted image.
fn tap_of([column, row]: [u32; 2], pinhole: &Intrinsics, distorted: &Intrinsics) -> Option<Tap> {
    let ray = pinhole.unproject([f64::from(column) + 0.5, f64::from(row) + 0.5])?;
    let source = distorted
        .project(&ray)
        .filter(|source| distorted.contains(*source))?;
    Some(tap_at(source, distorted.size_px))
}

/// The tap for a source position inside the image. Positions within half a pixel of the border take
/// the color of the border.
fn tap_at(source: [f64; 2], size_px: [u32; 2]) -> Tap {
    let (column, right) = tap_along(source[0], size_px[0]);
    let (row, lower) = tap_along(source[1], size_px[1]);
    Tap {
        upper_left: row * size_px[0] + column,
        right,
        lower,
    }
}

/// The first of two neighbors along one axis, and the weight of the second.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "positions lie in the image, shares in 0..=1"
)]
fn tap_along(source_px: f64, size_px: u32) -> (u32, u16) {
    let last = f64::from(size_px - 1);
    // The position is converted from integer pixel edges to integer pixel centers, because the
    // samples are at pixel centers.
    let position = (source_px - 0.5).clamp(0.0, last);
    // The last pixel is read as the right neighbor of the pixel before it, so that no read goes
    // past the end.
    let start = position.floor().min((last - 1.0).max(0.0));
    let share = (position - start) * f64::from(ONE);
    (start as u32, share.round() as u16)
}

#[cfg(test)]
mod tests {
    #![expect(
        clippy::cast_possible_truncation,
        reason = "test numbers lie well inside the integers' ranges"
    )]

    use super::*;
    use crate::Lens;
    use numbers::random::Random;

    fn camera(size_px: [u32; 2], lens: Lens) -> Intrinsics {
        let [width, height] = size_px.map(f64::from);
        Intrinsics {
            size_px,
            focal_px: [0.9 * width, 0.85 * width],
            principal_px: [0.51 * width, 0.48 * height],
            lens,
            rectified: false,
        }
    }

    fn noise(len: usize) -> Vec<u8> {
        Random::new(1).bytes(len)
    }

    const BARREL: Lens = Lens::BrownConrady([-0.25, 0.05, 0.001, -0.002, 0.0]);
    const CUSHION: Lens = Lens::BrownConrady([0.2, 0.03, -0.001, 0.001, 0.0]);

    #[test]
    fn pinhole_image_is_unchanged() {
        let rgb = noise(40 * 30 * 3);
        for intrinsics in [
            camera([40, 30], Lens::Pinhole),
            Intrinsics {
                rectified: true,
                ..camera([40, 30], CUSHION)
            },
        ] {
            let out = Undistortion::new(&intrinsics).apply_rgb(&rgb).unwrap();
            assert!(
                out.chunks(4)
                    .zip(rgb.chunks(3))
                    .all(|(out, rgb)| out[..3] == *rgb && out[3] == 255)
            );
        }
        let distorted = Undistortion::new(&camera([40, 30], BARREL))
            .apply_rgb(&rgb)
            .unwrap();
        assert!(
            distorted
                .chunks(4)
                .zip(rgb.chunks(3))
                .any(|(out, rgb)| out[..3] != *rgb)
        );
    }

    #[test]
    fn straight_lines_become_straight() {
        // A ramp over x / z in the distorted image must become a ramp over columns.
        for lens in [
            BARREL,
            CUSHION,
            Lens::KannalaBrandt([0.02, -0.01, 0.0, 0.0]),
        ] {
            let intrinsics = camera([160, 120], lens);
            let ramp = |x_on_plane: f64| 128.0 + 150.0 * x_on_plane;
            let mut rgb = Vec::new();
            for (row, column) in (0..120).flat_map(|row| (0..160).map(move |column| (row, column)))
            {
                let ray = intrinsics
                    .unproject([f64::from(column) + 0.5, f64::from(row) + 0.5])
                    .unwrap();
                rgb.extend([ramp(ray.x).round().clamp(0.0, 255.0) as u8; 3]);
            }
            let map = Undistortion::new(&intrinsics);
            let out = map.apply_rgb(&rgb).unwrap();
            let mut n_compared = 0;
            for (at, pixel) in out
                .chunks(4)
                .enumerate()
                .filter(|(_, pixel)| pixel[3] == 255)
            {
                let ray = intrinsics
                    .undistorted()
                    .unproject([(at % 160) as f64 + 0.5, 0.0])
                    .unwrap();
                let off = (f64::from(pixel[0]) - ramp(ray.x)).abs();
                // Bytes are rounded twice. The outermost half pixel of the source repeats the
                // border, which adds up to half a step.
                assert!(off < 1.8, "{lens:?} at {at}: off by {off}");
                n_compared += 1;
            }
            assert_eq!(n_compared, 160 * 120 - map.n_outside());
            assert!(n_compared > 160 * 120 / 2);
        }
    }

    #[test]
    fn bilinear_weights_match_the_plain_formula() {
        let size_px = [33, 21];
        let intrinsics = camera(size_px, CUSHION);
        let rgba = noise(33 * 21 * 4);
        let out = Undistortion::new(&intrinsics).apply_rgba(&rgba).unwrap();
        let value = |column: f64, row: f64, channel: usize| {
            let (column, row) = (
                column.clamp(0.0, 32.0) as usize,
                row.clamp(0.0, 20.0) as usize,
            );
            f64::from(rgba[(row * 33 + column) * 4 + channel])
        };
        for at in 0..33 * 21 {
            let (column, row) = ((at % 33) as f64 + 0.5, (at / 33) as f64 + 0.5);
            let ray = intrinsics.undistorted().unproject([column, row]).unwrap();
            let source = intrinsics.project(&ray).unwrap();
            for channel in 0..4 {
                let expected = if intrinsics.contains(source) {
                    let (x, y) = (source[0] - 0.5, source[1] - 0.5);
                    let (right, lower) = (x - x.floor(), y - y.floor());
                    let mix = |row: f64| {
                        (1.0 - right) * value(x.floor(), row, channel)
                            + right * value(x.floor() + 1.0, row, channel)
                    };
                    (1.0 - lower) * mix(y.floor()) + lower * mix(y.floor() + 1.0)
                } else {
                    0.0
                };
                let off = (f64::from(out[at * 4 + channel]) - expected).abs();
                assert!(off < 0.65, "pixel {at} channel {channel}: off by {off}"); // 0.5 rounding, 2 * 255 / 4096 shares.
            }
        }
    }

    #[test]
    fn rows_equal_those_of_the_whole_image() {
        let map = Undistortion::new(&camera([33, 21], CUSHION));
        assert!(map.n_outside() > 0);
        let rgba = noise(33 * 21 * 4);
        let whole = map.apply_rgba(&rgba).unwrap();
        let write_row = map.rgba_rows(&rgba).unwrap();
        let mut row = vec![7; 33 * 4]; // Pixels outside the source must also be written.
        for (ix, expected) in whole.chunks(33 * 4).enumerate().rev() {
            write_row(ix, &mut row);
            assert_eq!(row, expected, "row {ix}");
        }
        assert!(map.rgba_rows(&rgba[1..]).is_err());
    }

    #[test]
    fn pixels_outside_the_source_are_transparent() {
        let map = Undistortion::new(&camera([64, 48], CUSHION));
        assert!(map.n_outside() > 0);
        let out = map.apply_rgb(&vec![200; 64 * 48 * 3]).unwrap();
        for pixel in out.chunks(4) {
            assert!(
                pixel == [200, 200, 200, 255] || pixel == [0, 0, 0, 0],
                "{pixel:?}"
            );
        }
        assert_eq!(
            out.chunks(4).filter(|pixel| pixel[3] == 0).count(),
            map.n_outside()
        );
        let depth = map.apply_depth(&[1.5; 64 * 48]).unwrap();
        assert_eq!(
            depth.iter().filter(|depth| **depth == 0.0).count(),
            map.n_outside()
        );
    }

    #[test]
    fn depth_uses_nearest_source_pixel() {
        let intrinsics = camera([33, 21], BARREL);
        let depth_m: Vec<f32> = (0..33 * 21).map(|at| at as f32).collect();
        let out = Undistortion::new(&intrinsics)
            .apply_depth(&depth_m)
            .unwrap();
        for (at, depth) in out.iter().enumerate() {
            let ray = intrinsics
                .undistorted()
                .unproject([(at % 33) as f64 + 0.5, (at / 33) as f64 + 0.5])
                .unwrap();
            let [u, v] = intrinsics.project(&ray).unwrap();
            assert_eq!(*depth as usize, v as usize * 33 + u as usize, "{at}");
        }
    }

    #[test]
    fn tiny_images_and_wrong_sizes_are_handled() {
        for size_px in [[1, 1], [1, 7], [7, 1], [2, 2]] {
            let n_pixels = (size_px[0] * size_px[1]) as usize;
            let map = Undistortion::new(&camera(size_px, Lens::Pinhole));
            let rgb = noise(n_pixels * 3);
            let out = map.apply_rgb(&rgb).unwrap();
            assert!(
                out.chunks(4)
                    .zip(rgb.chunks(3))
                    .all(|(out, rgb)| out[..3] == *rgb),
                "{size_px:?}"
            );
            assert_eq!(
                map.apply_depth(&vec![2.0; n_pixels]).unwrap(),
                vec![2.0; n_pixels]
            );
            assert!(matches!(
                map.apply_rgb(&rgb[1..]),
                Err(Error::ImageSize { .. })
            ));
        }
    }
}
