//! Test images next to the model's renders, small enough to embed in a page.

use crate::evaluate;
use capture::downscale;
use keyframe::Keyframe;
use numbers::f32s_of;
use numbers::quantile::trimmed_range;
use report::inline_picture::{data_uri, fit_size};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::{AlignedModel, Picture};

/// Maximum number of test images shown. Each one is rendered again for the page, and adds to its
/// size.
const MAX_IMAGES: usize = 12;
/// Fraction of the depths that are clipped at each end of the color scale. Without clipping, a few
/// wrong depth values would leave only a small part of the scale for the scene.
const OUTSIDE_FRAC: f64 = 0.02;
/// Maximum side of the image and the render.
const MAX_SIDE_PX: u32 = 640;
/// Maximum side of the error and depth pictures.
const MAX_SMALL_SIDE_PX: u32 = 320;
/// JPEG quality of image and render. Artifacts of the compression must not look like errors of the
/// model.
const QUALITY: u8 = 82;
/// JPEG quality of the error and depth pictures, which show only large-scale structure.
const SMALL_QUALITY: u8 = 75;
/// Maximum total size of all pictures, encoded as base64. The page should open at once and fit into
/// a message.
const MAX_TEXT_BYTES: usize = 2_600_000;
/// After this time, no further picture is drawn. On a CPU, one picture of a neural field may take
/// half a minute.
const MAX_RENDER_TIME: Duration = Duration::from_secs(10);
/// Color difference, 0 to 255, from which the error map has its brightest color: a quarter of the
/// range. With the full range, typical errors of a few percent would all look black.
const MAX_ERROR: u8 = 64;

/// One test image and the model's render of it.
pub(crate) struct Comparison {
    pub name: String,
    pub psnr: f64,
    pub ssim: Option<f64>,
    /// Size of the larger pictures in CSS pixels.
    pub(super) size_px: [u32; 2],
    pub(super) image: String,
    pub(super) render: String,
    pub(super) error: String,
    pub(super) depth: Option<DepthPicture>,
}

/// Depth of a render in false color.
pub(super) struct DepthPicture {
    pub(super) picture: String,
    /// Depth at the two ends of the color scale, meters.
    pub(super) range_m: [f32; 2],
}

/// A test image with its name and scores.
pub(crate) struct Scored<'a> {
    pub keyframe: &'a Arc<Keyframe>,
    pub name: String,
    pub psnr: f64,
    pub ssim: Option<f64>,
}

/// Renders an evenly spread selection of test images, including the best and the worst, in the
/// order of `scored`.
///
/// * `meanwhile`: called between two images.
pub(crate) fn compare(
    method: &mut AlignedModel,
    scored: &[Scored<'_>],
    mut meanwhile: impl FnMut(&mut AlignedModel),
) -> anyhow::Result<Vec<Comparison>> {
    let mut spent = Duration::ZERO;
    let mut comparisons: Vec<(usize, Comparison)> = Vec::new();
    let mut n_bytes = 0;
    for ix in selected(&scored.iter().map(|image| image.psnr).collect::<Vec<_>>()) {
        if !comparisons.is_empty() && spent > MAX_RENDER_TIME {
            log::info!(
                "report.html shows only {} test images: rendering more takes too long",
                comparisons.len()
            );
            break;
        }
        let before = Instant::now();
        let comparison = Comparison::of(method, &scored[ix])?;
        spent += before.elapsed();
        meanwhile(method);
        n_bytes += comparison.n_bytes();
        // One comparison is shown in any case.
        if n_bytes > MAX_TEXT_BYTES && !comparisons.is_empty() {
            break;
        }
        comparisons.push((ix, comparison));
    }
    // They were drawn in order of importance, and are shown in the order of the images.
    comparisons.sort_by_key(|(ix, _)| *ix);
    Ok(comparisons
        .into_iter()
        .map(|(_, comparison)| comparison)
        .collect())
}

/// Indices of the images to show, the most important first: the worst, the best, and others evenly
/// spread.
fn selected(psnr: &[f64]) -> Vec<usize> {
    let by_psnr = |a: &usize, b: &usize| psnr[*a].total_cmp(&psnr[*b]);
    let mut selected: Vec<usize> = (0..psnr.len()).min_by(by_psnr).into_iter().collect();
    let n_spread = MAX_IMAGES.saturating_sub(2).max(1);
    // Bit-reversed order, so that the shown images are spread out even if drawing stops early.
    let mut spread: Vec<usize> = (0..n_spread).collect();
    spread.sort_by_key(|n| n.reverse_bits());
    let spread = spread.into_iter().map(|n| n * psnr.len() / n_spread);
    // The spread indices may contain the worst or the best image. The last part fills the gaps that
    // these duplicates leave.
    for ix in (0..psnr.len())
        .max_by(by_psnr)
        .into_iter()
        .chain(spread)
        .chain(0..psnr.len())
    {
        if ix < psnr.len() && selected.len() < MAX_IMAGES && !selected.contains(&ix) {
            selected.push(ix);
        }
    }
    selected
}

impl Comparison {
    fn of(method: &mut AlignedModel, scored: &Scored<'_>) -> anyhow::Result<Self> {
        let keyframe = scored.keyframe;
        let rendered = evaluate::draw(method, keyframe, true)?;
        let [size_px, small_px] =
            [MAX_SIDE_PX, MAX_SMALL_SIDE_PX].map(|side| fit_size(keyframe.size_px, side));
        let small = |rgba: &[u8], to_px| downscale::rgba(rgba.to_vec(), keyframe.size_px, to_px);
        // The render is masked like the image, so that both show the pixels that are scored.
        let image = small(&keyframe.rgba_srgb, size_px);
        let render = mask_colors(&small(&opaque(&rendered.rgba_srgb), size_px), &image);
        let error = errors(
            &small(&opaque(&rendered.rgba_srgb), small_px),
            &small(&keyframe.rgba_srgb, small_px),
        );
        Ok(Self {
            name: scored.name.clone(),
            psnr: scored.psnr,
            ssim: scored.ssim,
            size_px,
            image: data_uri(&rgb(&image), size_px, QUALITY)?,
            render: data_uri(&render, size_px, QUALITY)?,
            error: data_uri(&error, small_px, SMALL_QUALITY)?,
            depth: DepthPicture::of(&rendered, small_px)?,
        })
    }

    fn n_bytes(&self) -> usize {
        let depth = self.depth.as_ref().map_or(0, |depth| depth.picture.len());
        self.image.len() + self.render.len() + self.error.len() + depth
    }
}

impl DepthPicture {
    /// `None` if nothing was drawn.
    fn of(picture: &Picture, size_px: [u32; 2]) -> anyhow::Result<Option<Self>> {
        let subsampled = nearest_pixels(&picture.depth_m, picture.size_px, size_px);
        let valid = subsampled
            .iter()
            .copied()
            .filter(|z| *z > 0.0 && z.is_finite());
        let mut known: Vec<f64> = valid.map(f64::from).collect();
        let Some(range_m) = trimmed_range(&mut known, OUTSIDE_FRAC).map(f32s_of) else {
            return Ok(None);
        };
        let pixels: Vec<u8> = subsampled
            .into_iter()
            .flat_map(|z_m| depth_color(z_m, range_m))
            .collect();
        Ok(Some(Self {
            picture: data_uri(&pixels, size_px, SMALL_QUALITY)?,
            range_m,
        }))
    }
}

/// Color of a depth in a range; black if the depth is unknown.
fn depth_color(z_m: f32, [near_m, far_m]: [f32; 2]) -> [u8; 3] {
    if z_m > 0.0 && z_m.is_finite() {
        // A picture of a wall that faces the camera has a single depth.
        let span_m = (far_m - near_m).max(1e-6);
        turbo((z_m - near_m) / span_m)
    } else {
        [0; 3]
    }
}

/// A render over a black background, as in scoring.
fn opaque(rgba: &[u8]) -> Vec<u8> {
    rgba.as_chunks::<4>()
        .0
        .iter()
        .flat_map(|[r, g, b, _]| [*r, *g, *b, 255])
        .collect()
}

/// The colors of `rgba`; black where `image` is masked.
fn mask_colors(rgba: &[u8], image: &[u8]) -> Vec<u8> {
    let pixels = rgba.as_chunks::<4>().0.iter().zip(image.as_chunks::<4>().0);
    pixels
        .flat_map(|([r, g, b, _], [.., alpha])| if *alpha > 0 { [*r, *g, *b] } else { [0; 3] })
        .collect()
}

fn rgb(rgba: &[u8]) -> Vec<u8> {
    mask_colors(rgba, rgba)
}

/// The largest channel difference of each pixel in the colors of [`heat`]; black where the image is
/// masked.
fn errors(render: &[u8], image: &[u8]) -> Vec<u8> {
    let pixels = render
        .as_chunks::<4>()
        .0
        .iter()
        .zip(image.as_chunks::<4>().0);
    pixels
        .flat_map(|(render, image)| error_color(render, image))
        .collect()
}

/// Color of the difference of two pixels; black if the image is masked there.
fn error_color(render: &[u8; 4], image: &[u8; 4]) -> [u8; 3] {
    // The largest difference of a channel. A mean would hide an error that changes only the hue.
    let largest = (0..3)
        .map(|channel| render[channel].abs_diff(image[channel]))
        .max()
        .unwrap_or_default();
    if image[3] > 0 {
        heat(f32::from(largest) / f32::from(MAX_ERROR))
    } else {
        [0; 3]
    }
}

/// A color map of increasing brightness: black, purple, red, orange, light yellow, evenly spaced.
fn heat(value_frac: f32) -> [u8; 3] {
    const STOPS: [[f32; 3]; 5] = [
        [0.0, 0.0, 4.0],
        [87.0, 16.0, 110.0],
        [188.0, 55.0, 84.0],
        [249.0, 142.0, 9.0],
        [252.0, 255.0, 164.0],
    ];
    let at = value_frac.clamp(0.0, 1.0) * 4.0;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "0 to 3"
    )]
    let ix = (at.floor() as usize).min(3);
    let frac = at - ix as f32;
    std::array::from_fn(|channel| {
        byte(STOPS[ix][channel] + frac * (STOPS[ix + 1][channel] - STOPS[ix][channel]))
    })
}

/// Color map from red (near) to blue (far): the polynomial of Mikhailov 2019, "Turbo, an improved
/// rainbow colormap", reversed.
fn turbo(value_frac: f32) -> [u8; 3] {
    const RED: [f32; 6] = [
        0.135_721_4,
        4.615_392_6,
        -42.660_32,
        132.131_08,
        -152.942_4,
        59.286_38,
    ];
    const GREEN: [f32; 6] = [
        0.091_402_61,
        2.194_188_4,
        4.842_966_6,
        -14.185_033,
        4.277_298_5,
        2.829_566,
    ];
    const BLUE: [f32; 6] = [
        0.106_673_3,
        12.641_946,
        -60.582_05,
        110.362_77,
        -89.903_11,
        27.348_25,
    ];
    let x = 1.0 - value_frac.clamp(0.0, 1.0);
    [RED, GREEN, BLUE].map(|factors| {
        byte(
            255.0
                * factors
                    .iter()
                    .rev()
                    .fold(0.0, |sum, factor| sum * x + factor),
        )
    })
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to a byte"
)]
fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Samples the values at the pixel centers of a smaller picture. Averaging would put depth between
/// surfaces.
fn nearest_pixels(values: &[f32], from_px: [u32; 2], to_px: [u32; 2]) -> Vec<f32> {
    let source_ix =
        |ix: u32, from: u32, to: u32| (2 * ix as usize + 1) * from as usize / (2 * to as usize);
    let mut subsampled = Vec::with_capacity(to_px[0] as usize * to_px[1] as usize);
    for y in 0..to_px[1] {
        let row = source_ix(y, from_px[1], to_px[1]) * from_px[0] as usize;
        subsampled.extend((0..to_px[0]).map(|x| values[row + source_ix(x, from_px[0], to_px[0])]));
    }
    subsampled
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worst_and_best_images_are_selected() {
        let mut psnr = vec![20.0; 100];
        (psnr[37], psnr[61]) = (11.0, 30.0);
        let selected_of_many = selected(&psnr);
        assert_eq!(
            (
                selected_of_many[0],
                selected_of_many[1],
                selected_of_many.len()
            ),
            (37, 61, MAX_IMAGES)
        );
        assert!(
            selected_of_many.iter().filter(|ix| **ix < 50).count() >= 5,
            "{selected_of_many:?}"
        );
        let mut few = selected(&psnr[..5]);
        few.sort_unstable();
        assert_eq!(few, [0, 1, 2, 3, 4]);
        assert!(selected(&[]).is_empty());
    }

    #[test]
    fn error_map_is_masked_outside_the_image() {
        let image = [10, 10, 10, 255, 200, 10, 10, 255, 0, 0, 0, 0];
        let render = [10, 10, 10, 255, 100, 10, 10, 255, 250, 250, 250, 255];
        assert_eq!(errors(&render, &image), [0, 0, 4, 252, 255, 164, 0, 0, 0]);
        assert_eq!(mask_colors(&render, &image)[6..], [0, 0, 0]);
    }

    #[test]
    fn near_is_red_and_far_is_blue() {
        let [near, far] = [turbo(0.1), turbo(0.9)];
        assert!(near[0] > 150 && near[2] < 60, "{near:?}");
        assert!(far[2] > 150 && far[0] < 100, "{far:?}");
    }

    #[test]
    fn depth_is_sampled_not_averaged() {
        let depth_m = [1.0, 1.0, 9.0, 9.0, 1.0, 2.0, 9.0, 8.0];
        assert_eq!(nearest_pixels(&depth_m, [4, 2], [2, 1]), [2.0, 8.0]);
        assert_eq!(nearest_pixels(&depth_m, [4, 2], [4, 2]), depth_m);
        let picture = Picture {
            size_px: [4, 2],
            rgba_srgb: vec![0; 32],
            depth_m: depth_m.to_vec(),
        };
        let rendered = DepthPicture::of(&picture, [4, 2])
            .expect("a picture")
            .expect("depth");
        assert_eq!(rendered.range_m, [1.0, 9.0]);
        let empty = Picture {
            size_px: [4, 2],
            rgba_srgb: vec![0; 32],
            depth_m: vec![0.0; 8],
        };
        assert!(
            DepthPicture::of(&empty, [4, 2])
                .expect("a picture")
                .is_none()
        );
    }
}
