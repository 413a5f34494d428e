//! Plain CPU version of the training loss in f64: absolute difference, structural similarity (SSIM)
//! and depth, with gradients.
//!
//! The loss is from Kerbl et al. 2023, equation 7, and SSIM with a Gaussian window is from Wang et
//! al. 2004. Unlike in these sources, sums are divided by the total number of pixels, including
//! masked pixels. The depth residual is not divided by the coverage, so that it is linear in the
//! image.

use super::rendered_image::{RenderedImage, Upstream};

/// Radius of the SSIM window, pixels.
pub const WINDOW_RADIUS: usize = 5;
/// Standard deviation of the SSIM window, pixels.
pub const WINDOW_SIGMA_PX: f64 = 1.5;
/// The constants `(K1 L)²` and `(K2 L)²` of Wang et al. 2004 for values from 0 to 1 (`L` = 1).
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// The target of a render, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Target {
    /// Width and height, pixels.
    pub size_px: [usize; 2],
    /// Color, 0 to 1.
    pub rgb: Vec<[f64; 3]>,
    /// Whether each pixel has a color. Masked pixels have no color loss, but may have a depth.
    pub visible: Vec<bool>,
    /// Depth along z, meters. It is 0 if unknown. The array is empty if the camera has no depth.
    pub depth_m: Vec<f64>,
}

/// Weights of the parts of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Weight of D-SSIM in the color loss. The rest is the absolute difference.
    pub dssim_frac: f64,
    /// Weight of the depth loss, per meter.
    pub depth_per_m: f64,
    /// Depth residuals beyond this limit have no gradient, meters.
    pub depth_clip_m: f64,
    /// Color behind the splats.
    pub background_rgb: [f64; 3],
}

/// The loss of one image and its parts before weighting.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Loss {
    /// `(1 - dssim_frac) * l1 + dssim_frac * dssim + depth_per_m * depth_m`.
    pub total: f64,
    /// Mean absolute difference of the colors.
    pub l1: f64,
    /// One minus the mean SSIM.
    pub dssim: f64,
    /// Mean clipped depth residual, meters.
    pub depth_m: f64,
}

/// Loss of a rendered image, and its gradient with respect to the image.
pub fn loss(image: &RenderedImage, target: &Target, weights: &Weights) -> (Loss, Upstream) {
    let n_pixels = target.rgb.len();
    // Masked pixels are black in both images, so they have no residual. SSIM windows that contain
    // masked pixels still count.
    let rendered = composed(image, target, weights);
    let truth = masked(&target.rgb, target);
    let mut upstream = Upstream {
        rgb: vec![[0.0; 3]; n_pixels],
        transmittance: vec![0.0; n_pixels],
        depth: vec![0.0; n_pixels],
    };
    let mut loss = Loss::default();
    for channel in 0..3 {
        let rendered = plane(&rendered, channel);
        let truth = plane(&truth, channel);
        let (l1, v_l1) = mean_abs(&rendered, &truth);
        let (ssim, v_ssim) = mean_ssim(target.size_px, &rendered, &truth);
        loss.l1 += l1 / 3.0;
        loss.dssim += (1.0 - ssim) / 3.0;
        for pixel_ix in (0..n_pixels).filter(|&pixel_ix| target.visible[pixel_ix]) {
            let v = ((1.0 - weights.dssim_frac) * v_l1[pixel_ix]
                - weights.dssim_frac * v_ssim[pixel_ix])
                / 3.0;
            upstream.rgb[pixel_ix][channel] = v;
            // The background is seen through the splats, so the color also depends on the
            // transmittance.
            upstream.transmittance[pixel_ix] += v * weights.background_rgb[channel];
        }
    }
    loss.depth_m = depth(image, target, weights, &mut upstream);
    loss.total = (1.0 - weights.dssim_frac) * loss.l1
        + weights.dssim_frac * loss.dssim
        + weights.depth_per_m * loss.depth_m;
    (loss, upstream)
}

/// One channel of an image.
fn plane(pixels: &[[f64; 3]], channel: usize) -> Vec<f64> {
    pixels.iter().map(|pixel| pixel[channel]).collect()
}

/// Mean absolute difference and its gradient with respect to `rendered`. The gradient is 0 where
/// the values are equal.
fn mean_abs(rendered: &[f64], truth: &[f64]) -> (f64, Vec<f64>) {
    let n_pixels = rendered.len() as f64;
    let residuals = rendered
        .iter()
        .zip(truth)
        .map(|(rendered, truth)| rendered - truth);
    (
        residuals.clone().map(f64::abs).sum::<f64>() / n_pixels,
        residuals.map(|r| sign(r) / n_pixels).collect(),
    )
}

/// Mean SSIM over all pixels of one channel and its gradient with respect to `rendered`. Both
/// images are 0 outside their borders.
pub fn mean_ssim(size_px: [usize; 2], rendered: &[f64], truth: &[f64]) -> (f64, Vec<f64>) {
    let n_pixels = rendered.len() as f64;
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>();
    let blurred = |plane: &[f64]| blurred(size_px, plane);
    let mean_x = blurred(rendered);
    let mean_y = blurred(truth);
    let mean_xx = blurred(&product(rendered, rendered));
    let mean_yy = blurred(&product(truth, truth));
    let mean_xy = blurred(&product(rendered, truth));

    let mut sum = 0.0;
    let mut v_mean_x = Vec::new();
    let mut v_mean_xx = Vec::new();
    let mut v_mean_xy = Vec::new();
    for ix in 0..rendered.len() {
        let x = mean_x[ix];
        let y = mean_y[ix];
        // Numerator and denominator of the two factors of SSIM (Wang et al. 2004, equation 13).
        let luminance = (2.0 * x * y + C1, x * x + y * y + C1);
        let contrast = (
            2.0 * (mean_xy[ix] - x * y) + C2,
            mean_xx[ix] - x * x + mean_yy[ix] - y * y + C2,
        );
        let denominator = luminance.1 * contrast.1;
        let ssim = luminance.0 * contrast.0 / denominator;
        sum += ssim;
        // The variances also depend on the mean. The gradient of the mean therefore has three
        // parts: a direct part, a part through variance = mean_xx - x², and a part through
        // covariance = mean_xy - x y.
        let v_variance = -ssim / contrast.1;
        let v_covariance = 2.0 * luminance.0 / denominator;
        let v_luminance = 2.0 * y * contrast.0 / denominator - 2.0 * x * ssim / luminance.1;
        v_mean_x.push((v_luminance - 2.0 * x * v_variance - y * v_covariance) / n_pixels);
        v_mean_xx.push(v_variance / n_pixels);
        v_mean_xy.push(v_covariance / n_pixels);
    }
    // The window is symmetric, so blurring is its own transpose.
    let by_mean = blurred(&v_mean_x);
    let by_square = blurred(&v_mean_xx);
    let by_product = blurred(&v_mean_xy);
    let v = (0..rendered.len())
        .map(|ix| by_mean[ix] + 2.0 * rendered[ix] * by_square[ix] + truth[ix] * by_product[ix]);
    (sum / n_pixels, v.collect())
}

/// Mean clipped depth residual over all pixels. Adds its weighted gradient to `upstream`.
fn depth(
    image: &RenderedImage,
    target: &Target,
    weights: &Weights,
    upstream: &mut Upstream,
) -> f64 {
    let n_pixels = target.rgb.len() as f64;
    let mut sum = 0.0;
    for (pixel_ix, &depth_m) in target
        .depth_m
        .iter()
        .enumerate()
        .filter(|(_, depth_m)| **depth_m > 0.0)
    {
        // Both the rendered and the true depth are weighted by the coverage.
        let residual_m = image.depth[pixel_ix] - (1.0 - image.transmittance[pixel_ix]) * depth_m;
        // A clipped residual has no gradient. Beyond the clip, the splats in this pixel belong to
        // another surface, and pulling them would not help.
        sum += residual_m.abs().min(weights.depth_clip_m);
        if residual_m.abs() < weights.depth_clip_m {
            let v = weights.depth_per_m * sign(residual_m) / n_pixels;
            upstream.depth[pixel_ix] += v;
            upstream.transmittance[pixel_ix] += v * depth_m;
        }
    }
    sum / n_pixels
}

/// The render over the background. Pixels are black where the target is masked.
fn composed(image: &RenderedImage, target: &Target, weights: &Weights) -> Vec<[f64; 3]> {
    let over_background: Vec<_> = image
        .rgb
        .iter()
        .zip(&image.transmittance)
        .map(|(rgb, transmittance)| over(rgb, *transmittance, &weights.background_rgb))
        .collect();
    masked(&over_background, target)
}

/// A premultiplied color over a background.
fn over(rgb: &[f64; 3], transmittance: f64, background_rgb: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|channel| rgb[channel] + transmittance * background_rgb[channel])
}

fn masked(rgb: &[[f64; 3]], target: &Target) -> Vec<[f64; 3]> {
    rgb.iter()
        .zip(&target.visible)
        .map(|(rgb, visible)| if *visible { *rgb } else { [0.0; 3] })
        .collect()
}

/// Weights of the SSIM window along one axis. Their sum is 1.
pub fn window() -> [f64; 2 * WINDOW_RADIUS + 1] {
    let weights: [f64; 2 * WINDOW_RADIUS + 1] = std::array::from_fn(|ix| {
        let offset = ix as f64 - WINDOW_RADIUS as f64;
        (-0.5 * (offset / WINDOW_SIGMA_PX).powi(2)).exp()
    });
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// Convolution with the window along x, then along y. Values outside the borders are 0.
fn blurred(size_px: [usize; 2], plane: &[f64]) -> Vec<f64> {
    let [width, height] = size_px;
    let along_x = Axis {
        stride: 1,
        side: width,
    };
    let along_y = Axis {
        stride: width,
        side: height,
    };
    blurred_along(along_y, &blurred_along(along_x, plane))
}

/// An axis of an image that is stored row by row.
struct Axis {
    /// Difference of the indices of two neighboring pixels.
    stride: usize,
    /// Number of pixels.
    side: usize,
}

/// Convolution with the window along one axis.
fn blurred_along(Axis { stride, side }: Axis, plane: &[f64]) -> Vec<f64> {
    let window = window();
    (0..plane.len())
        .map(|ix| {
            // Values outside the image are zero, so these taps are left out.
            let position = ix / stride % side;
            let first = WINDOW_RADIUS.saturating_sub(position);
            let end = window.len().min(side + WINDOW_RADIUS - position);
            (first..end)
                .map(|tap| window[tap] * plane[ix + stride * tap - stride * WINDOW_RADIUS])
                .sum()
        })
        .collect()
}

/// Sign of a value: -1, 0 or 1.
fn sign(value: f64) -> f64 {
    if value == 0.0 { 0.0 } else { value.signum() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mismatches::Mismatches;
    use crate::random::F32Random;

    const SIZE_PX: [usize; 2] = [17, 14];
    const N_PIXELS: usize = SIZE_PX[0] * SIZE_PX[1];
    const WEIGHTS: Weights = Weights {
        dssim_frac: 0.2,
        depth_per_m: 0.5,
        depth_clip_m: 0.3,
        background_rgb: [0.3, 0.6, 0.1],
    };

    /// A render and a target that differ, with masked pixels, pixels without depth, and large depth
    /// errors. No residual is close to zero or to the clip threshold.
    fn image_and_target() -> (RenderedImage, Target) {
        let mut random = F32Random::new(11);
        let mut image = RenderedImage::default();
        let mut target = Target {
            size_px: SIZE_PX,
            ..Target::default()
        };
        for pixel_ix in 0..N_PIXELS {
            let truth = random.array(0.2, 0.8);
            let transmittance = random.uniform(0.05, 0.6);
            let depth_m = if pixel_ix % 5 == 0 {
                0.0
            } else {
                random.uniform(0.5, 3.0)
            };
            let offset = |random: &mut F32Random| {
                random.uniform(0.02, 0.2)
                    * if random.uniform(0.0, 1.0) < 0.5 {
                        -1.0
                    } else {
                        1.0
                    }
            };
            let rgb = truth.map(|truth: f64| truth + offset(&mut random));
            image.rgb.push(std::array::from_fn(|c| {
                rgb[c] - transmittance * WEIGHTS.background_rgb[c]
            }));
            image.transmittance.push(transmittance);
            let residual_m = if pixel_ix % 7 == 0 {
                0.8
            } else {
                offset(&mut random)
            };
            image
                .depth
                .push((1.0 - transmittance) * depth_m + residual_m);
            image.last_contributor.push(None);
            target.rgb.push(truth);
            target
                .visible
                .push(pixel_ix % 11 != 3 && pixel_ix % SIZE_PX[0] != 2);
            target.depth_m.push(depth_m);
        }
        (image, target)
    }

    /// Compares the gradient, times `factor`, with central differences. Skips values that do not
    /// affect the loss.
    fn checked_gradient(factor: f64) -> Mismatches {
        const NUDGE: f64 = 1e-5;
        const ABS: f64 = 1e-10; // Rounding error of a loss near 1, divided by the nudge.
        const REL: f64 = 1e-6;
        let (image, target) = image_and_target();
        let (_, upstream) = loss(&image, &target, &WEIGHTS);
        let mut mismatches = Mismatches::default();
        let mut check = |name: String, analytic: f64, nudge: &dyn Fn(&mut RenderedImage, f64)| {
            let at = |step| {
                let mut image = image.clone();
                nudge(&mut image, step);
                loss(&image, &target, &WEIGHTS).0.total
            };
            let numeric = (at(NUDGE) - at(-NUDGE)) / (2.0 * NUDGE);
            if (analytic, numeric) != (0.0, 0.0) {
                mismatches.check(name, analytic * factor, numeric, ABS, REL);
            }
        };
        for ix in 0..N_PIXELS {
            for c in 0..3 {
                check(
                    format!("rgb {ix} {c}"),
                    upstream.rgb[ix][c],
                    &|image, step| image.rgb[ix][c] += step,
                );
            }
            check(
                format!("transmittance {ix}"),
                upstream.transmittance[ix],
                &|image, step| {
                    image.transmittance[ix] += step;
                },
            );
            check(format!("depth {ix}"), upstream.depth[ix], &|image, step| {
                image.depth[ix] += step
            });
        }
        mismatches
    }

    #[test]
    fn gradient_matches_central_differences() {
        checked_gradient(1.0).assert_none();
    }

    #[test]
    fn gradient_error_of_one_in_ten_thousand_is_detected() {
        let n_mismatches = checked_gradient(1.0001).n_mismatches();
        assert!(
            n_mismatches > 4 * N_PIXELS * 8 / 10,
            "only {n_mismatches} of about {} are detected",
            4 * N_PIXELS
        );
    }

    #[test]
    fn ssim_matches_its_definition() {
        let (image, target) = image_and_target();
        let plane = |pixels: &[[f64; 3]]| pixels.iter().map(|pixel| pixel[1]).collect::<Vec<_>>();
        let x = plane(&image.rgb);
        let y = plane(&target.rgb);
        let weight = |dx: i32, dy: i32| (-f64::from(dx * dx + dy * dy) / (2.0 * 1.5 * 1.5)).exp();
        let total: f64 = (-5..=5)
            .flat_map(|dy| (-5..=5).map(move |dx| weight(dx, dy)))
            .sum();
        let width = 17_i32;
        let height = 14_i32;
        let at = |plane: &[f64], column: i32, row: i32| {
            let inside = (0..width).contains(&column) && (0..height).contains(&row);
            if inside {
                plane[usize::try_from(row * width + column).expect("inside")]
            } else {
                0.0
            }
        };
        let mut sum = 0.0;
        for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column)))
        {
            let mean = |value: &dyn Fn(i32, i32) -> f64| -> f64 {
                let window = (-5..=5).flat_map(|dy| (-5..=5).map(move |dx| (dx, dy)));
                window
                    .map(|(dx, dy)| weight(dx, dy) / total * value(column + dx, row + dy))
                    .sum()
            };
            let mx = mean(&|c, r| at(&x, c, r));
            let my = mean(&|c, r| at(&y, c, r));
            let vx = mean(&|c, r| (at(&x, c, r) - mx).powi(2));
            let vy = mean(&|c, r| (at(&y, c, r) - my).powi(2));
            let vxy = mean(&|c, r| (at(&x, c, r) - mx) * (at(&y, c, r) - my));
            sum += (2.0 * mx * my + 0.0001) * (2.0 * vxy + 0.0009)
                / ((mx * mx + my * my + 0.0001) * (vx + vy + 0.0009));
        }
        let (got, _) = mean_ssim(SIZE_PX, &x, &y);
        assert!(
            (got - sum / f64::from(width * height)).abs() < 1e-12,
            "{got}"
        );
    }

    #[test]
    fn perfect_render_has_zero_loss_and_masked_pixels_no_gradient() {
        let (mut image, target) = image_and_target();
        let (_, upstream) = loss(&image, &target, &WEIGHTS);
        for ix in (0..N_PIXELS).filter(|&ix| !target.visible[ix]) {
            assert_eq!(upstream.rgb[ix], [0.0; 3]);
        }
        for ix in 0..N_PIXELS {
            let transmittance = image.transmittance[ix];
            image.depth[ix] = (1.0 - transmittance) * target.depth_m[ix];
            if target.visible[ix] {
                image.rgb[ix] = std::array::from_fn(|c| {
                    target.rgb[ix][c] - transmittance * WEIGHTS.background_rgb[c]
                });
            }
        }
        let (perfect, _) = loss(&image, &target, &WEIGHTS);
        assert!(perfect.total.abs() < 1e-12, "{perfect:?}");
    }

    #[test]
    fn flat_image_gives_known_values() {
        // The render is fully opaque and 0.25 too bright everywhere. The depth of one pixel is
        // wrong by 0.1 m, and the depth of another pixel is wrong by more than the clip threshold.
        let n = N_PIXELS;
        let mut depth_m = vec![0.0; n];
        (depth_m[3], depth_m[4]) = (2.0, 2.0);
        let target = Target {
            size_px: SIZE_PX,
            rgb: vec![[0.5; 3]; n],
            visible: vec![true; n],
            depth_m,
        };
        let mut depth = vec![0.0; n];
        (depth[3], depth[4]) = (2.1, 1.0);
        let image = RenderedImage {
            rgb: vec![[0.75; 3]; n],
            transmittance: vec![0.0; n],
            depth,
            last_contributor: vec![None; n],
        };
        let (loss, upstream) = loss(&image, &target, &WEIGHTS);
        assert!((loss.l1 - 0.25).abs() < 1e-12);
        assert!(
            (loss.depth_m - (0.1 + 0.3) / n as f64).abs() < 1e-12,
            "{}",
            loss.depth_m
        );
        assert!((upstream.depth[3] - 0.5 / n as f64).abs() < 1e-15);
        assert_eq!(upstream.depth[4], 0.0);
    }
}
