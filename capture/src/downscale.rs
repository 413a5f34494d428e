//! Downscales training images by averaging areas, together with their intrinsics.

use kinematics::Intrinsics;
use messages::BadInput;

/// Minimum side of a scaled image, pixels. Smaller images contain too little detail for training.
const MIN_SIDE_PX: u32 = 16;
/// Minimum fraction of the width and height.
pub(crate) const MIN_SCALE: f64 = 0.05;
/// Allowed fractions of the width and height.
const SCALE_RANGE: std::ops::RangeInclusive<f64> = MIN_SCALE..=1.0;

/// Parses a scale factor for the width and height of training images, such as `0.5`.
///
/// # Errors
///
/// If the text is not a number from 0.05 to 1; the message gives the range.
pub fn parse_scale(text: &str) -> Result<f64, String> {
    let share = text
        .parse::<f64>()
        .ok()
        .filter(|share| SCALE_RANGE.contains(share));
    share.ok_or_else(|| {
        format!(
            "must be a number from {} to {}",
            SCALE_RANGE.start(),
            SCALE_RANGE.end()
        )
    })
}

/// Intrinsics of images scaled to the fraction `share` of their width and height; returns an error
/// if they become too small.
pub(crate) fn intrinsics(full: &Intrinsics, share: f64) -> Result<Intrinsics, BadInput> {
    let scaled = full.scaled(share);
    // An image that is not scaled may have any size.
    if scaled.size_px != full.size_px && scaled.size_px.iter().any(|side| *side < MIN_SIDE_PX) {
        let [[from_width, from_height], [width, height]] = [full.size_px, scaled.size_px];
        return Err(BadInput(format!(
            "scale {share}: images of {from_width}x{from_height} pixels would have {width}x{height}, \
             the minimum is {MIN_SIDE_PX} along each side"
        )));
    }
    Ok(scaled)
}

/// Scales an image `[height, width, 4]` with alpha from `from_px` (width and height) to the smaller
/// size `to_px`.
///
/// If the sizes are equal, the color is unchanged. A new pixel is masked (alpha 0) if it covers any
/// masked pixel, so that no masked content leaks into the result.
#[must_use]
pub fn rgba(rgba: Vec<u8>, from_px: [u32; 2], to_px: [u32; 2]) -> Vec<u8> {
    if from_px == to_px {
        return with_binary_alpha(rgba);
    }
    let row_bytes = 4 * from_px[0] as usize;
    rgba_of_rows(from_px, to_px, |row, to| {
        to.copy_from_slice(&rgba[row * row_bytes..(row + 1) * row_bytes])
    })
}

/// Scales an image down as [`rgba`] does, without holding the whole image in memory.
///
/// * `write_row`: writes the row of the image with the given index to `[width, 4]`. It is called
///   once per row, in order.
pub(crate) fn rgba_of_rows(
    from_px: [u32; 2],
    to_px: [u32; 2],
    write_row: impl FnMut(usize, &mut [u8]),
) -> Vec<u8> {
    with_binary_alpha(area_mean(from_px, to_px, write_row))
}

/// Masks all pixels that are not completely opaque.
fn with_binary_alpha(mut rgba: Vec<u8>) -> Vec<u8> {
    for alpha in rgba.iter_mut().skip(3).step_by(4) {
        *alpha = if *alpha == 255 { 255 } else { 0 };
    }
    rgba
}

/// Shrinks `[height, width, 4]`. Each new pixel is the mean over the area it covers, including
/// fractions of pixels.
fn area_mean(
    from_px: [u32; 2],
    to_px: [u32; 2],
    mut write_row: impl FnMut(usize, &mut [u8]),
) -> Vec<u8> {
    let [from_width, to_width] = [from_px[0] as usize, to_px[0] as usize];
    let columns = coverage(from_px[0], to_px[0]);
    let rows = coverage(from_px[1], to_px[1]);
    let mut out = Vec::with_capacity(4 * to_width * rows.len());
    // The two directions are separable: rows are summed first, then columns. Only one row of the
    // source is in memory.
    let mut sums = vec![[0.0_f32; 4]; from_width];
    let mut row = vec![0; 4 * from_width];
    let mut row_y = None;
    for covered_rows in &rows {
        sums.fill([0.0; 4]);
        for &(y, share) in covered_rows {
            // The last source row of an output row may also be the first source row of the next
            // one.
            if row_y != Some(y) {
                write_row(y, &mut row);
                row_y = Some(y);
            }
            for (sum, pixel) in sums.iter_mut().zip(row.as_chunks::<4>().0) {
                (0..4).for_each(|channel| sum[channel] += share * f32::from(pixel[channel]));
            }
        }
        for covered_columns in &columns {
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "a mean of bytes is a byte"
            )]
            out.extend(
                (0..4).map(|channel| channel_mean(covered_columns, &sums, channel).round() as u8),
            );
        }
    }
    out
}

/// Weighted mean of one channel over the columns that a new pixel covers.
fn channel_mean(covered_columns: &[(usize, f32)], sums: &[[f32; 4]], channel: usize) -> f32 {
    covered_columns
        .iter()
        .map(|&(x, share)| share * sums[x][channel])
        .sum::<f32>()
}

/// For each new pixel of a line, the old pixels it covers and their weights, which add up to 1.
fn coverage(from: u32, to: u32) -> Vec<Vec<(usize, f32)>> {
    let ratio = f64::from(from) / f64::from(to);
    (0..to).map(|ix| covered_by(ix, ratio, from)).collect()
}

/// The old pixels, of `from`, that the new pixel `ix` covers, and their weights.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "positions lie inside the line"
)]
fn covered_by(ix: u32, ratio: f64, from: u32) -> Vec<(usize, f32)> {
    let start = f64::from(ix) * ratio;
    // Rounding may put the end of the last pixel slightly beyond the line.
    let end = (f64::from(ix + 1) * ratio).min(f64::from(from));
    let overlap = |source_ix: usize| {
        ((source_ix as f64 + 1.0).min(end) - (source_ix as f64).max(start)) / ratio
    };
    let source_pixels = start as usize..(end.ceil() as usize).min(from as usize);
    source_pixels
        .map(|source_ix| (source_ix, overlap(source_ix) as f32))
        // An old pixel that is included only because of rounding must be left out. If the old pixel
        // were masked, it would mask the new pixel.
        .filter(|(_, share)| *share > 1e-6)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Lens;

    #[test]
    fn partial_pixels_are_weighted_by_area() {
        let shares = coverage(5, 2);
        assert_eq!(shares[0], [(0, 0.4), (1, 0.4), (2, 0.2)]);
        assert_eq!(shares[1], [(2, 0.2), (3, 0.4), (4, 0.4)]);
    }

    #[test]
    fn rows_are_read_once_and_in_order() {
        const SIZE_PX: [u32; 2] = [5, 7];
        let image: Vec<u8> = (0..4 * 5 * 7)
            .map(|ix| if ix % 4 == 3 && ix != 43 { 255 } else { ix })
            .collect();
        for to_px in [[2, 3], [4, 6], [1, 1], [5, 2]] {
            let mut read = Vec::new();
            let scaled = rgba_of_rows(SIZE_PX, to_px, |row, to| {
                read.push(row);
                to.copy_from_slice(&image[20 * row..20 * (row + 1)]);
            });
            assert_eq!(read, (0..7).collect::<Vec<_>>());
            assert_eq!(scaled, rgba(image.clone(), SIZE_PX, to_px));
            assert_eq!(scaled.len(), 4 * (to_px[0] * to_px[1]) as usize);
            assert!(
                scaled.chunks(4).any(|pixel| pixel[3] == 0),
                "one pixel is masked"
            );
        }
        // The mean of columns 0 to 4 and rows 0 to 6.
        assert_eq!(rgba(image, SIZE_PX, [1, 1])[..3], [68, 69, 70]);
    }

    #[test]
    fn scale_and_image_size_are_bounded() {
        assert_eq!(parse_scale("0.05"), Ok(0.05));
        for invalid in ["0", "0.049", "1.01", "nan", "-1", "half"] {
            assert!(
                parse_scale(invalid).is_err_and(|message| message.contains("0.05 to 1")),
                "{invalid}"
            );
        }
        let full = Intrinsics {
            size_px: [160, 120],
            focal_px: [100.0; 2],
            principal_px: [80.0, 61.0],
            lens: Lens::Pinhole,
            rectified: true,
        };
        let half = intrinsics(&full, 0.5).expect("large enough");
        assert_eq!(
            (half.size_px, half.focal_px, half.principal_px),
            ([80, 60], [50.0; 2], [40.0, 30.5])
        );
        let message = intrinsics(&full, 0.1).expect_err("12 rows").to_string();
        assert!(
            message.contains("160x120") && message.contains("16x12"),
            "{message}"
        );
        let small = Intrinsics {
            size_px: [8, 6],
            ..full
        };
        assert_eq!(intrinsics(&small, 1.0).expect("unchanged"), small);
    }
}
