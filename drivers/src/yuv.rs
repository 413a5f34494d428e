//! Converts YUV images (luma and chroma) from cameras to red, green and blue.
//!
//! Source: ITU-R BT.601-7 and BT.709-6 (matrices, limited range), Linux `videodev2.h` (defaults,
//! layouts). The transfer function of sRGB is assumed for all cameras, because the transfer
//! function that a camera announces is rarely correct. A wrong transfer function only changes the
//! tone curve.

use crate::Error;

/// Memory layout of luma (Y) and chroma (U for blue, V for red), 8 bits each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YuvLayout {
    /// `Y0 U Y1 V` for every two pixels of a row.
    Yuyv,
    /// `U Y0 V Y1` for every two pixels of a row.
    Uyvy,
    /// First all Y, in rows padded to an even width. Then follows one row of chroma for every two
    /// rows of pixels, with `U V` for every two pixels.
    Nv12,
}

/// Weights of red and blue in the luma.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YuvMatrix {
    /// BT.601: standard definition and webcams.
    Bt601,
    /// BT.709: high definition.
    Bt709,
}

/// Range of the counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YuvRange {
    /// Luma 16 to 235, chroma 16 to 240.
    Limited,
    /// 0 to 255.
    Full,
}

/// Color encoding of a YUV image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct YuvColors {
    /// Matrix between YUV and RGB.
    pub matrix: YuvMatrix,
    /// Range of the counts.
    pub range: YuvRange,
}

/// Color encoding reported by a V4L2 device (`struct v4l2_pix_format`), with the constants of
/// `videodev2.h`; 0 means default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct V4l2Colors {
    /// `enum v4l2_colorspace`.
    pub colorspace: u32,
    /// `enum v4l2_ycbcr_encoding`.
    pub ycbcr_enc: u32,
    /// `enum v4l2_quantization`.
    pub quantization: u32,
    /// Whether the device receives a high-definition television signal. HDMI grabbers receive one
    /// and report DV timings. Cameras do not.
    pub is_hdtv: bool,
}

impl YuvColors {
    /// Resolves defaults like `V4L2_MAP_COLORSPACE_DEFAULT`, `V4L2_MAP_YCBCR_ENC_DEFAULT` and
    /// `V4L2_MAP_QUANTIZATION_DEFAULT`.
    ///
    /// # Errors
    /// For BT.2020 and SMPTE 240M.
    pub fn from_v4l2(reported: V4l2Colors) -> Result<Self, Error> {
        const REC709: u32 = 3;
        const JPEG: u32 = 7;
        const SRGB: u32 = 8;
        const DCI_P3: u32 = 12;
        let colorspace = match (reported.colorspace, reported.is_hdtv) {
            (0, true) => REC709,
            // The matrix and range are those of standard definition (SMPTE 170M).
            (0, false) => SRGB,
            (colorspace, _) => colorspace,
        };
        let matrix = match (reported.ycbcr_enc, colorspace) {
            // 601, xvYCC 601, sYCC; 709, xvYCC 709.
            (1 | 3 | 5, _) => YuvMatrix::Bt601,
            (2 | 4, _) | (0, REC709 | DCI_P3) => YuvMatrix::Bt709,
            (0, 1 | 4..=9 | 11) => YuvMatrix::Bt601,
            _ => {
                return Err(Error::YuvColors {
                    colorspace,
                    ycbcr_enc: reported.ycbcr_enc,
                });
            }
        };
        let range = match (reported.quantization, colorspace) {
            (1, _) | (0, JPEG) => YuvRange::Full,
            _ => YuvRange::Limited,
        };
        Ok(Self { matrix, range })
    }

    /// Weights of red and blue in the luma.
    fn luma_weights(self) -> [f64; 2] {
        match self.matrix {
            YuvMatrix::Bt601 => [0.299, 0.114],
            YuvMatrix::Bt709 => [0.2126, 0.0722],
        }
    }

    /// Luma count of black, and coefficients of the counts: `[y, v in red, u in green, v in green,
    /// u in blue]`.
    fn coefficients(self) -> (f64, [f64; 5]) {
        let [red, blue] = self.luma_weights();
        let green = 1.0 - red - blue;
        // Limited range uses 219 steps of luma and 224 of chroma.
        let (black, luma, chroma) = match self.range {
            YuvRange::Limited => (16.0, 255.0 / 219.0, 255.0 / 224.0),
            YuvRange::Full => (0.0, 1.0, 1.0),
        };
        // BT.601-7, section 2.5: V is `(R - Y) / (2 (1 - red))`, U is `(B - Y) / (2 (1 - blue))`.
        // The equations are solved for R and B. G follows from `Y = red R + green G + blue B`.
        let v_in_red = 2.0 * (1.0 - red) * chroma;
        let u_in_blue = 2.0 * (1.0 - blue) * chroma;
        (
            black,
            [
                luma,
                v_in_red,
                -u_in_blue * blue / green,
                -v_in_red * red / green,
                u_in_blue,
            ],
        )
    }
}

impl YuvLayout {
    /// Bytes per row without padding. For an odd width, the last pixel has its own pair.
    pub(crate) fn row_bytes(self, width: usize) -> usize {
        match self {
            Self::Yuyv | Self::Uyvy => width.div_ceil(2).saturating_mul(4),
            Self::Nv12 => width.div_ceil(2).saturating_mul(2),
        }
    }

    /// Number of rows of that length.
    pub(crate) fn n_rows(self, height: usize) -> usize {
        match self {
            Self::Yuyv | Self::Uyvy => height,
            Self::Nv12 => height.saturating_add(height.div_ceil(2)),
        }
    }
}

/// Converts an image without padding to red, green and blue, `[height, width, 3]`. The length of
/// `data` must match the layout.
pub(crate) fn rgb(layout: YuvLayout, colors: YuvColors, size_px: [u32; 2], data: &[u8]) -> Vec<u8> {
    let [width, height] = size_px.map(|side| side as usize);
    let mut rgb = vec![0; width * height * 3];
    // `chunks_exact` panics for chunks of zero bytes.
    if rgb.is_empty() {
        return rgb;
    }
    let fixed = Fixed::new(colors);
    let row_bytes = layout.row_bytes(width);
    let (rows, chroma) = data.split_at(row_bytes * height);
    for (row_ix, (out, row)) in rgb
        .chunks_exact_mut(width * 3)
        .zip(rows.chunks_exact(row_bytes))
        .enumerate()
    {
        match layout {
            YuvLayout::Yuyv => fixed.row(
                out,
                row.as_chunks::<4>()
                    .0
                    .iter()
                    .map(|&[y0, u, y1, v]| [y0, y1, u, v]),
            ),
            YuvLayout::Uyvy => fixed.row(
                out,
                row.as_chunks::<4>()
                    .0
                    .iter()
                    .map(|&[u, y0, v, y1]| [y0, y1, u, v]),
            ),
            YuvLayout::Nv12 => {
                // Two rows of pixels share one row of chroma.
                let chroma_row = chroma[row_ix / 2 * row_bytes..][..row_bytes]
                    .as_chunks::<2>()
                    .0;
                let lumas = row.as_chunks::<2>().0.iter();
                fixed.row(
                    out,
                    lumas
                        .zip(chroma_row)
                        .map(|(&[y0, y1], &[u, v])| [y0, y1, u, v]),
                );
            }
        }
    }
    rgb
}

/// Coefficients of [`YuvColors`] times `1 << SHIFT`. Products and sums fit in 32 bits, with errors
/// below 0.04 counts. Integers are faster than floats here, and give the same bytes on every
/// machine.
#[derive(Clone, Copy)]
struct Fixed {
    black: i32,
    luma: i32,
    v_in_red: i32,
    u_in_green: i32,
    v_in_green: i32,
    u_in_blue: i32,
}

/// The largest sum is below `3 * 255 * 2^13`, which is below `2^23`. More bits would only reduce
/// errors that rounding to bytes hides.
const SHIFT: u32 = 13;

impl Fixed {
    fn new(colors: YuvColors) -> Self {
        let (black, coefficients) = colors.coefficients();
        #[expect(
            clippy::cast_possible_truncation,
            reason = "coefficients are below 3, black is 0 or 16"
        )]
        let to_integer = |number: f64| number.round() as i32;
        let [luma, v_in_red, u_in_green, v_in_green, u_in_blue] =
            coefficients.map(|coefficient| to_integer(coefficient * f64::from(1 << SHIFT)));
        Self {
            black: to_integer(black),
            luma,
            v_in_red,
            u_in_green,
            v_in_green,
            u_in_blue,
        }
    }

    /// Converts one row from its pairs `[y0, y1, u, v]`. For an odd width, only the first pixel of
    /// the last pair is used.
    #[inline(always)]
    fn row(self, out: &mut [u8], mut pairs: impl Iterator<Item = [u8; 4]>) {
        let (complete, rest) = out.as_chunks_mut::<6>();
        for (out, pair) in complete.iter_mut().zip(&mut pairs) {
            *out = self.pair(pair);
        }
        if let (false, Some(pair)) = (rest.is_empty(), pairs.next()) {
            rest.copy_from_slice(&self.pair(pair)[..3]);
        }
    }

    #[inline(always)]
    fn pair(self, [y0, y1, u, v]: [u8; 4]) -> [u8; 6] {
        const HALF: i32 = 1 << (SHIFT - 1);
        // Chroma is centered at 128 in both ranges.
        let u = i32::from(u) - 128;
        let v = i32::from(v) - 128;
        // The chroma parts are computed once for the two pixels that share them. `HALF` rounds the
        // result to the nearest count.
        let red = v * self.v_in_red + HALF;
        let green = u * self.u_in_green + v * self.v_in_green + HALF;
        let blue = u * self.u_in_blue + HALF;
        let [y0, y1] = [y0, y1].map(|y| (i32::from(y) - self.black) * self.luma);
        [
            y0 + red,
            y0 + green,
            y0 + blue,
            y1 + red,
            y1 + green,
            y1 + blue,
        ]
        .map(to_byte)
    }
}

#[inline(always)]
fn to_byte(scaled: i32) -> u8 {
    (scaled >> SHIFT).clamp(0, 255) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUTS: [YuvLayout; 3] = [YuvLayout::Yuyv, YuvLayout::Uyvy, YuvLayout::Nv12];

    fn all_colors() -> impl Iterator<Item = YuvColors> {
        [YuvMatrix::Bt601, YuvMatrix::Bt709]
            .into_iter()
            .flat_map(|matrix| {
                [YuvRange::Limited, YuvRange::Full]
                    .into_iter()
                    .map(move |range| YuvColors { matrix, range })
            })
    }

    /// CPU twin in f64 that follows the definition in the standards: chroma is `blue - luma` and
    /// `red - luma`, scaled.
    fn twin(colors: YuvColors, y: u8, u: u8, v: u8) -> [f64; 3] {
        let [red_weight, blue_weight] = colors.luma_weights();
        let [y, u, v] = [y, u, v].map(f64::from);
        let (luma, cb, cr) = match colors.range {
            YuvRange::Limited => ((y - 16.0) / 219.0, (u - 128.0) / 224.0, (v - 128.0) / 224.0),
            YuvRange::Full => (y / 255.0, (u - 128.0) / 255.0, (v - 128.0) / 255.0),
        };
        let red = luma + 2.0 * (1.0 - red_weight) * cr;
        let blue = luma + 2.0 * (1.0 - blue_weight) * cb;
        let green =
            (luma - red_weight * red - blue_weight * blue) / (1.0 - red_weight - blue_weight);
        [red, green, blue].map(|color| (color * 255.0).clamp(0.0, 255.0))
    }

    #[test]
    fn every_value_is_within_one_count_of_twin() {
        const MAX_ERROR: f64 = 0.54; // Half a count of rounding plus the error of `Fixed`.
        for colors in all_colors() {
            let fixed = Fixed::new(colors);
            for y in 0..=255 {
                for u in (0..=255).step_by(5) {
                    for v in (0..=255).step_by(3) {
                        let got = fixed.pair([y, 255 - y, u, v]);
                        for (got, expected) in got.iter().zip(
                            twin(colors, y, u, v)
                                .into_iter()
                                .chain(twin(colors, 255 - y, u, v)),
                        ) {
                            assert!(
                                (f64::from(*got) - expected).abs() <= MAX_ERROR,
                                "{colors:?} {y} {u} {v}: {got}, expected {expected}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn published_colors_convert_correctly() {
        let limited = YuvColors {
            matrix: YuvMatrix::Bt601,
            range: YuvRange::Limited,
        };
        let of = |colors: YuvColors, y, u, v| rgb(YuvLayout::Yuyv, colors, [1, 1], &[y, u, 0, v]);
        assert_eq!(of(limited, 16, 128, 128), [0, 0, 0]);
        assert_eq!(of(limited, 235, 128, 128), [255, 255, 255]);
        assert_eq!(of(limited, 81, 90, 240), [254, 0, 0]); // Red bar of BT.601. Counts are rounded, so red is not 255.
        assert_eq!(of(limited, 41, 240, 110), [0, 0, 255]);
        let high = YuvColors {
            matrix: YuvMatrix::Bt709,
            range: YuvRange::Limited,
        };
        assert_eq!(of(high, 63, 102, 240), [255, 1, 0]); // Bars of BT.709.
        let full = YuvColors {
            matrix: YuvMatrix::Bt601,
            range: YuvRange::Full,
        };
        assert_eq!(of(full, 76, 85, 255), [254, 0, 0]); // JFIF's red.
    }

    #[test]
    fn all_layouts_convert_identically_at_odd_sizes() {
        let colors = YuvColors {
            matrix: YuvMatrix::Bt601,
            range: YuvRange::Full,
        };
        let luma = |x: usize, y: usize| (20 + 31 * x + 47 * y).to_le_bytes()[0];
        let chroma = |x: usize, y: usize, plus: usize| {
            (90 + plus + 13 * (x / 2) + 7 * (y / 2)).to_le_bytes()[0]
        };
        for size_px in [[1, 1], [2, 2], [5, 3], [4, 3], [7, 2]] {
            let [width, height] = size_px.map(|side| side as usize);
            let pairs = width.div_ceil(2);
            let packed = |order: fn(u8, u8, u8, u8) -> [u8; 4]| -> Vec<u8> {
                let pair = |x: usize, y: usize| {
                    order(
                        luma(x, y),
                        luma(x + 1, y),
                        chroma(x, y, 0),
                        chroma(x, y, 40),
                    )
                };
                (0..height)
                    .flat_map(|y| (0..pairs).flat_map(move |pair_ix| pair(2 * pair_ix, y)))
                    .collect()
            };
            let lumas = (0..height).flat_map(|y| (0..2 * pairs).map(move |x| luma(x, y)));
            let chroma_row = (0..height.div_ceil(2)).flat_map(|row| {
                (0..pairs).flat_map(move |pair| [0, 40].map(|plus| chroma(2 * pair, 2 * row, plus)))
            });
            let images = [
                packed(|y0, y1, u, v| [y0, u, y1, v]),
                packed(|y0, y1, u, v| [u, y0, v, y1]),
                lumas.chain(chroma_row).collect(),
            ];
            for (layout, data) in LAYOUTS.into_iter().zip(images) {
                assert_eq!(
                    data.len(),
                    layout.row_bytes(width) * layout.n_rows(height),
                    "{layout:?}"
                );
                let got = rgb(layout, colors, size_px, &data);
                for (ix, got) in got.chunks_exact(3).enumerate() {
                    let (x, y) = (ix % width, ix / width);
                    let expected = twin(colors, luma(x, y), chroma(x, y, 0), chroma(x, y, 40));
                    for (got, expected) in got.iter().zip(expected) {
                        assert!(
                            (f64::from(*got) - expected).abs() <= 1.0,
                            "{layout:?} {width}x{height} at {x}, {y}"
                        );
                    }
                }
                assert_eq!(got.len(), width * height * 3);
            }
        }
    }

    #[test]
    fn unset_colors_use_v4l2_defaults() {
        let resolved = |colorspace, ycbcr_enc, quantization, is_hdtv| {
            let reported = V4l2Colors {
                colorspace,
                ycbcr_enc,
                quantization,
                is_hdtv,
            };
            YuvColors::from_v4l2(reported)
                .map(|colors| (colors.matrix, colors.range))
                .ok()
        };
        use YuvMatrix::{Bt601, Bt709};
        use YuvRange::{Full, Limited};
        assert_eq!(resolved(0, 0, 0, false), Some((Bt601, Limited))); // No information: sRGB.
        assert_eq!(resolved(0, 0, 0, true), Some((Bt709, Limited))); // An HDMI grabber.
        assert_eq!(resolved(1, 0, 0, true), Some((Bt601, Limited))); // SMPTE 170M
        assert_eq!(resolved(3, 0, 0, false), Some((Bt709, Limited))); // Rec. 709
        assert_eq!(resolved(7, 0, 0, false), Some((Bt601, Full))); // JPEG
        assert_eq!(resolved(8, 0, 1, false), Some((Bt601, Full))); // sRGB, reported as full range.
        assert_eq!(resolved(8, 2, 0, false), Some((Bt709, Limited)));
        assert_eq!(resolved(7, 0, 2, false), Some((Bt601, Limited)));
        assert_eq!(resolved(12, 0, 0, false), Some((Bt709, Limited))); // DCI-P3
        assert_eq!(resolved(10, 0, 0, false), None); // BT.2020
        assert_eq!(resolved(2, 0, 0, false), None); // SMPTE 240M
        assert_eq!(resolved(2, 1, 0, false), Some((Bt601, Limited)));
        assert_eq!(resolved(8, 6, 0, false), None);
    }
}
