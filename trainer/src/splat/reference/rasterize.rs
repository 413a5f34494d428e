//! Front-to-back compositing of projected splats, pixel by pixel, and its gradient.
//!
//! Source: Kerbl et al. 2023, section 6 and appendix C.

use super::clip::{Clipping, RayPoints};
use super::project::{MIN_ALPHA, project, row_share};
use super::{Projected, ProjectedGrad, RenderedImage, Splat, Upstream, View};

/// Maximum alpha of a splat at a pixel. The gradient divides by `1 - alpha`, which must not become
/// zero.
pub const MAX_ALPHA: f64 = 0.999;
/// Compositing of a pixel stops before the splat that would lower the transmittance to this value
/// or less.
pub const MIN_TRANSMITTANCE: f64 = 1e-4;

/// Results of all comparisons, stored so that forward and backward passes agree.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decisions {
    /// Time at which each splat is read out, as a share of the readout (see [`row_share`]). `None`
    /// for splats that are not drawn.
    pub row_shares: Vec<Option<f64>>,
    /// Indices of the splats that contribute to each pixel, front to back. Pixels are row by row.
    pub contributors: Vec<Vec<usize>>,
}

/// Decides which splats are visible, their order, and the contributors of each pixel.
pub fn decide(view: &View, splats: &[Splat]) -> Decisions {
    decide_clipped(view, splats, &Clipping::default())
}

/// [`decide`] for the part of the splats that is shown.
pub fn decide_clipped(view: &View, splats: &[Splat], clipping: &Clipping) -> Decisions {
    let clipped = ClippedSplats::new(view, splats, clipping);
    let projected: Vec<_> = splats.iter().map(|splat| project(view, splat)).collect();
    let front_to_back = front_to_back(&projected);
    Decisions {
        row_shares: projected
            .iter()
            .zip(splats)
            .map(|(visible_splat, splat)| visible_splat.map(|_| row_share(view, splat)))
            .collect(),
        contributors: view
            .pixel_centers()
            .map(|center_px| contributors(&front_to_back, &clipped, &center_px))
            .collect(),
    }
}

/// Composites the splats according to `decisions`.
pub fn composite(view: &View, projected: &[Projected], decisions: &Decisions) -> RenderedImage {
    let mut image = RenderedImage::default();
    for (center_px, contributors) in view.pixel_centers().zip(&decisions.contributors) {
        let mut rgb = [0.0; 3];
        let mut depth = 0.0;
        let mut transmittance = 1.0;
        for splat in contributors.iter().map(|&splat_ix| &projected[splat_ix]) {
            let alpha = Coverage::new(splat, &center_px).alpha();
            let weight = alpha * transmittance;
            rgb.iter_mut()
                .zip(splat.color)
                .for_each(|(sum, color)| *sum += weight * color);
            depth += weight * splat.depth;
            transmittance *= 1.0 - alpha;
        }
        image.rgb.push(rgb);
        image.depth.push(depth);
        image.transmittance.push(transmittance);
        image.last_contributor.push(contributors.last().copied());
    }
    image
}

/// Gradient of a loss with respect to each projected splat, given its gradient with respect to the
/// image.
pub fn composite_backward(
    view: &View,
    projected: &[Projected],
    decisions: &Decisions,
    upstream: &Upstream,
) -> Vec<ProjectedGrad> {
    let mut grads = vec![ProjectedGrad::default(); projected.len()];
    for (pixel_ix, center_px) in view.pixel_centers().enumerate() {
        let v_rgb = upstream.rgb[pixel_ix];
        let v_depth = upstream.depth[pixel_ix];
        // Transmittance in front of each contributor. Kerbl et al. 2023 recover it by divisions,
        // in which small values lose precision.
        let mut in_front = Vec::new();
        let mut transmittance = 1.0;
        for &splat_ix in &decisions.contributors[pixel_ix] {
            in_front.push(transmittance);
            transmittance *= 1.0 - Coverage::new(&projected[splat_ix], &center_px).alpha();
        }
        // This is the part of the loss that depends on everything behind the current splat. The
        // twin iterates back to front, as in Kerbl et al. 2023, whereas the kernel iterates front
        // to back.
        let mut behind = upstream.transmittance[pixel_ix] * transmittance;
        for (&splat_ix, transmittance) in
            decisions.contributors[pixel_ix].iter().zip(in_front).rev()
        {
            let splat = &projected[splat_ix];
            let grad = &mut grads[splat_ix];
            let coverage = Coverage::new(splat, &center_px);
            let weight = coverage.alpha() * transmittance;
            let per_weight = (0..3)
                .map(|channel| splat.color[channel] * v_rgb[channel])
                .sum::<f64>()
                + splat.depth * v_depth;
            // A higher alpha increases the weight of this splat. It decreases the weights of
            // everything behind it, which all contain the factor `1 - alpha`.
            let v_alpha = transmittance * per_weight - behind / (1.0 - coverage.alpha());
            grad.color
                .iter_mut()
                .zip(v_rgb)
                .for_each(|(sum, v)| *sum += weight * v);
            grad.depth += weight * v_depth;
            coverage.backward(splat, v_alpha, grad);
            behind += weight * per_weight;
        }
    }
    grads
}

/// Smallest relative distance of each pixel's decisions from their thresholds.
///
/// All alphas are compared with [`MIN_ALPHA`] and [`MAX_ALPHA`], and all transmittances with
/// [`MIN_TRANSMITTANCE`]. The depths of consecutive splats are compared with each other unless they
/// are equal. Arithmetic with larger rounding errors may decide differently.
pub fn threshold_margins(view: &View, splats: &[Splat]) -> Vec<f64> {
    threshold_margins_clipped(view, splats, &Clipping::default())
}

/// [`threshold_margins`] for the part of the splats that is shown.
pub fn threshold_margins_clipped(view: &View, splats: &[Splat], clipping: &Clipping) -> Vec<f64> {
    let clipped = ClippedSplats::new(view, splats, clipping);
    let projected: Vec<_> = splats.iter().map(|splat| project(view, splat)).collect();
    let front_to_back = front_to_back(&projected);
    view.pixel_centers()
        .map(|center_px| threshold_margin(&front_to_back, &clipped, &center_px))
        .collect()
}

/// Smallest distance of a splat's point on each pixel's ray from a side of a box, meters.
#[cfg(test)]
pub(crate) fn clip_margins_m(view: &View, splats: &[Splat], clipping: &Clipping) -> Vec<f64> {
    let clipped = ClippedSplats::new(view, splats, clipping);
    let projected: Vec<_> = splats.iter().map(|splat| project(view, splat)).collect();
    let front_to_back = front_to_back(&projected);
    let margin_m = |center_px: [f64; 2]| {
        let covering = front_to_back
            .iter()
            .filter(|(_, splat)| Coverage::new(splat, &center_px).is_drawn());
        covering
            .map(|(splat_ix, splat)| clipped.margin_m(*splat_ix, splat, &center_px))
            .fold(f64::INFINITY, f64::min)
    };
    view.pixel_centers().map(margin_m).collect()
}

/// The splats of a view, with the part of them that is shown.
struct ClippedSplats<'a> {
    clipping: &'a Clipping,
    /// Empty if everything is shown.
    points: Vec<RayPoints>,
}

impl<'a> ClippedSplats<'a> {
    fn new(view: &View, splats: &[Splat], clipping: &'a Clipping) -> Self {
        let cut = if clipping.is_empty() { &[] } else { splats };
        Self {
            clipping,
            points: cut
                .iter()
                .map(|splat| RayPoints::new(view, splat))
                .collect(),
        }
    }

    /// Whether a splat is shown at the pixel at `center_px`.
    fn shows(&self, splat_ix: usize, splat: &Projected, center_px: &[f64; 2]) -> bool {
        self.points
            .get(splat_ix)
            .is_none_or(|points| self.clipping.shows(points, offset_px(splat, center_px)))
    }

    /// Distance of the splat's point on the ray of the pixel from a side of a box, meters.
    #[cfg(test)]
    fn margin_m(&self, splat_ix: usize, splat: &Projected, center_px: &[f64; 2]) -> f64 {
        self.points.get(splat_ix).map_or(f64::INFINITY, |points| {
            self.clipping.margin_m(points, offset_px(splat, center_px))
        })
    }
}

/// Vector from the center of the splat to the pixel at `center_px`.
fn offset_px(splat: &Projected, center_px: &[f64; 2]) -> [f64; 2] {
    [0, 1].map(|axis| center_px[axis] - splat.mean_px[axis])
}

fn threshold_margin(
    front_to_back: &[(usize, Projected)],
    clipped: &ClippedSplats<'_>,
    center_px: &[f64; 2],
) -> f64 {
    let distance = |value: f64, threshold: f64| (value / threshold - 1.0).abs();
    let mut margin = f64::INFINITY;
    let mut transmittance = 1.0;
    let mut depth_in_front = None;
    for (splat_ix, splat) in front_to_back {
        let coverage = Coverage::new(splat, center_px);
        margin = margin
            .min(distance(coverage.unclamped, MIN_ALPHA))
            .min(distance(coverage.unclamped, MAX_ALPHA));
        if !coverage.is_drawn() || !clipped.shows(*splat_ix, splat, center_px) {
            continue;
        }
        if let Some(depth_in_front) = depth_in_front.filter(|&depth| depth != splat.depth) {
            margin = margin.min(distance(splat.depth, depth_in_front));
        }
        depth_in_front = Some(splat.depth);
        transmittance *= 1.0 - coverage.alpha();
        margin = margin.min(distance(transmittance, MIN_TRANSMITTANCE));
        if transmittance <= MIN_TRANSMITTANCE {
            break;
        }
    }
    margin
}

/// Visible splats with their indices, ordered by depth rounded to f32, then by index.
fn front_to_back(projected: &[Option<Projected>]) -> Vec<(usize, Projected)> {
    let mut visible: Vec<_> = projected
        .iter()
        .enumerate()
        .filter_map(|(ix, visible_splat)| visible_splat.map(|splat| (ix, splat)))
        .collect();
    visible.sort_by_key(|(splat_ix, splat)| (depth_bits(splat.depth), *splat_ix));
    visible
}

/// Positive floats sort like their bit patterns.
fn depth_bits(depth: f64) -> u32 {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the kernels sort by the depth in f32"
    )]
    let depth = depth as f32;
    depth.to_bits()
}

/// Indices of the splats that contribute to the pixel at `center_px`.
fn contributors(
    front_to_back: &[(usize, Projected)],
    clipped: &ClippedSplats<'_>,
    center_px: &[f64; 2],
) -> Vec<usize> {
    let mut added = Vec::new();
    let mut transmittance = 1.0;
    for (splat_ix, splat) in front_to_back {
        let coverage = Coverage::new(splat, center_px);
        if !coverage.is_drawn() || !clipped.shows(*splat_ix, splat, center_px) {
            continue;
        }
        transmittance *= 1.0 - coverage.alpha();
        // Compositing stops before the splat is added, because it would no longer be visible (Kerbl
        // et al. 2023).
        if transmittance <= MIN_TRANSMITTANCE {
            break;
        }
        added.push(*splat_ix);
    }
    added
}

/// Coverage of one pixel by one splat.
struct Coverage {
    /// Vector from the center of the pixel to the center of the splat, pixels.
    offset_px: [f64; 2],
    /// Half the squared distance in standard deviations.
    sigma: f64,
    /// `exp(-sigma)`.
    falloff: f64,
    /// Opacity times falloff.
    unclamped: f64,
}

impl Coverage {
    fn new(splat: &Projected, center_px: &[f64; 2]) -> Self {
        let [dx, dy] = [
            splat.mean_px[0] - center_px[0],
            splat.mean_px[1] - center_px[1],
        ];
        let [a, b, c] = splat.conic;
        let sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy;
        let falloff = (-sigma).exp();
        Self {
            offset_px: [dx, dy],
            sigma,
            falloff,
            unclamped: splat.opacity * falloff,
        }
    }

    fn alpha(&self) -> f64 {
        self.unclamped.min(MAX_ALPHA)
    }

    /// Whether the splat contributes. Splats whose conic is not positive definite due to rounding
    /// are not drawn.
    fn is_drawn(&self) -> bool {
        self.sigma >= 0.0 && self.alpha() >= MIN_ALPHA
    }

    /// Adds the gradient with respect to center, conic and opacity. It is zero if alpha is clamped.
    fn backward(&self, splat: &Projected, v_alpha: f64, grad: &mut ProjectedGrad) {
        if self.unclamped > MAX_ALPHA {
            return;
        }
        let [dx, dy] = self.offset_px;
        let [a, b, c] = splat.conic;
        let v_sigma = -self.unclamped * v_alpha;
        grad.opacity += self.falloff * v_alpha;
        grad.conic[0] += 0.5 * dx * dx * v_sigma;
        grad.conic[1] += dx * dy * v_sigma;
        grad.conic[2] += 0.5 * dy * dy * v_sigma;
        grad.mean_px[0] += (a * dx + b * dy) * v_sigma;
        grad.mean_px[1] += (b * dx + c * dy) * v_sigma;
    }
}
