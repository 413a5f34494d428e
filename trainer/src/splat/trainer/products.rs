//! Scores and gains of a rendered picture against a camera image, from the pixel sums that
//! `score.wgsl` computes.

use crate::Error;
use crate::splat::buffers::ImageBuffers;
use gpu::{Buffer, Gpu, Passes, Pipeline};

/// Bytes of sums that each workgroup of `score.wgsl` writes. There are four u32 for each of three
/// colors.
const GROUP_BYTES: usize = 48;
/// Pixels per workgroup.
const GROUP_PIXELS: u32 = 256;

/// Sums of products for one color.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Products {
    picture_picture: u64,
    picture_image: u64,
    image_image: u64,
    n_visible: u64,
}

/// Records the comparison of a picture with an image. Returns the size of the resulting sums in
/// bytes.
pub(super) fn record(
    gpu: &Gpu,
    passes: &mut Passes,
    score: &Pipeline,
    (view, image_buffers): (&Buffer, &ImageBuffers),
    size_px: [u32; 2],
    image: &Buffer,
) -> usize {
    let n_groups = (size_px[0] * size_px[1]).div_ceil(GROUP_PIXELS);
    let buffers = [
        ("view", view),
        ("pixels", &image_buffers.pixels),
        ("target_image", image),
        ("products", &image_buffers.products),
    ];
    passes.dispatch(gpu, score, n_groups.into(), &buffers);
    GROUP_BYTES * n_groups as usize
}

/// Adds up the sums of all workgroups, for red, green and blue.
pub(super) fn sum_up(sums: &[[u32; 4]]) -> [Products; 3] {
    [0, 1, 2].map(|color| Products {
        picture_picture: sum_of(sums, color, 0),
        picture_image: sum_of(sums, color, 1),
        image_image: sum_of(sums, color, 2),
        n_visible: sum_of(sums, color, 3),
    })
}

/// Adds up one of the four parts for one color.
fn sum_of(sums: &[[u32; 4]], color: usize, part: usize) -> u64 {
    // The sums of a workgroup of 256 pixels fit into u32 (256 * 255 * 255), but the sums of a
    // picture do not.
    sums.iter()
        .skip(color)
        .step_by(3)
        .map(|of| u64::from(of[part]))
        .sum()
}

/// PSNR in dB, bit-identical to [`crate::eval::psnr`] because integer sums are exact.
pub(super) fn psnr(products: &[Products; 3]) -> Result<f64, Error> {
    let n: u64 = products.iter().map(|color| color.n_visible).sum();
    if n == 0 {
        return Err(Error::AllPixelsMasked);
    }
    // (p - i)^2 = p^2 + i^2 - 2 p i. The difference of the sums is not negative, so it fits into
    // u64.
    let squares: u64 = products
        .iter()
        .map(|color| color.picture_picture + color.image_image - 2 * color.picture_image)
        .sum();
    let mean_square = squares as f64 / n as f64;
    Ok(10.0 * (255.0_f64.powi(2) / mean_square).log10())
}

/// PSNR in dB of a picture whose colors are multiplied by gains. `None` if all pixels are masked.
/// Values above white are not clamped.
pub(super) fn psnr_with_gains(products: &[Products; 3], gains: [f64; 3]) -> Option<f64> {
    let n: u64 = products.iter().map(|color| color.n_visible).sum();
    let square = |(color, gain): (&Products, f64)| {
        gain * gain * color.picture_picture as f64 - 2.0 * gain * color.picture_image as f64
            + color.image_image as f64
    };
    let squares: f64 = products.iter().zip(gains).map(square).sum();
    // The squared error is at least one, which is one level of one color at one pixel. The score
    // thus stays finite.
    (n > 0).then(|| 10.0 * (255.0f64.powi(2) * n as f64 / squares.max(1.0)).log10())
}

/// Logarithms of the gains that best match a picture to an image.
pub(super) fn log_gains(products: &[Products; 3]) -> [f64; 3] {
    // The maximum is about two photographic stops. Larger gains are not caused by exposure.
    const MAX_LOG_GAIN: f64 = 1.5;
    // The gain that minimizes the sum of `(gain * p - i)^2` is `sum(p i) / sum(p^2)`. The gain is
    // undefined for a black picture, and its logarithm is undefined for a black image.
    products.map(|color| match (color.picture_image, color.picture_picture) {
        (0, _) | (_, 0) => 0.0,
        (with_image, picture_only) => (with_image as f64 / picture_only as f64)
            .ln()
            .clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN),
    })
}
