//! Peak signal-to-noise ratio of 8-bit pictures.

use super::PixelPair;
use crate::Error;

/// Peak signal-to-noise ratio in decibels over the three colors of the unmasked pixels. It is
/// infinite for equal pictures.
///
/// The ratio is `10 log10(255^2 / mean squared difference)`, for values already rounded to 8 bits.
/// Fails if all pixels are masked.
pub fn psnr(pair: &PixelPair<'_>) -> Result<f64, Error> {
    // Integer sums are exact, so the result does not depend on the order, and equals the result of
    // the GPU.
    let mut squares = 0_u64;
    let mut n_visible = 0_u64;
    for (rendered, truth) in pair
        .rendered_rgba
        .chunks_exact(4)
        .zip(pair.truth_rgba.chunks_exact(4))
    {
        if truth[3] == 0 {
            continue;
        }
        n_visible += 1;
        squares += (0..3)
            .map(|color| u64::from(rendered[color].abs_diff(truth[color])).pow(2))
            .sum::<u64>();
    }
    if n_visible == 0 {
        return Err(Error::AllPixelsMasked);
    }
    // Sums of squares of 8-bit pictures stay far below 2^53, so both casts are exact.
    let mean_square = squares as f64 / (3 * n_visible) as f64;
    Ok(10.0 * (255.0_f64.powi(2) / mean_square).log10())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_difference_gives_known_psnr() {
        // Every color differs by 5: 20 log10(255 / 5).
        let a = [100, 100, 100, 255].repeat(12);
        let b = [105, 95, 105, 255].repeat(12);
        let pair = PixelPair::new([4, 3], &a, &b).unwrap();
        assert!((psnr(&pair).unwrap() - 20.0 * 51.0_f64.log10()).abs() < 1e-12);
    }

    #[test]
    fn equal_pictures_have_infinite_psnr() {
        let a = [7, 8, 9, 255].repeat(4);
        assert_eq!(
            psnr(&PixelPair::new([2, 2], &a, &a).unwrap()).unwrap(),
            f64::INFINITY
        );
    }

    #[test]
    fn masked_pixels_are_ignored() {
        let rendered = [[105, 105, 105, 0], [255, 255, 255, 255]].concat();
        let truth = [[100, 100, 100, 255], [0, 0, 0, 0]].concat();
        let pair = PixelPair::new([2, 1], &rendered, &truth).unwrap();
        assert!((psnr(&pair).unwrap() - 20.0 * 51.0_f64.log10()).abs() < 1e-12);
        let unmasked = [[100, 100, 100, 255], [0, 0, 0, 255]].concat();
        assert!(psnr(&PixelPair::new([2, 1], &rendered, &unmasked).unwrap()).unwrap() < 10.0);
    }

    #[test]
    fn invalid_input_is_rejected() {
        let a = [1, 2, 3, 0].repeat(4);
        assert!(matches!(
            psnr(&PixelPair::new([2, 2], &a, &a).unwrap()),
            Err(Error::AllPixelsMasked)
        ));
        assert!(matches!(
            PixelPair::new([2, 3], &a, &a),
            Err(Error::PictureBytes {
                what: "rendered",
                ..
            })
        ));
        assert!(matches!(
            PixelPair::new([2, 2], &a, &a[1..]),
            Err(Error::PictureBytes { what: "true", .. })
        ));
    }
}
