//! Saddle points of gray images: places where two black and two white sectors meet, such as
//! chessboard corners.
//!
//! Candidates are maxima of minus the determinant of the Hessian. A ring of samples around each
//! candidate shows whether it has two black and two white sectors, and the directions of the four
//! edges between them. Positions are then refined (Förstner and Gülch 1987). At the refined point,
//! every image gradient in the window is perpendicular to the direction from this point to the
//! pixel of the gradient.

use crate::gray::Plane;
use std::f64::consts::{PI, TAU};

/// Smallest difference in gray value between black and white sectors. With a larger value, dark
/// boards are lost. With a smaller value, saddles are found in noise. This and the other thresholds
/// of detection were tuned on the photographs of docs/benchmarks/2026-11-26-calibration.md.
const MIN_CONTRAST: f32 = 12.0;
/// Largest deviation of opposite edges from a straight line, radians. Perspective keeps lines
/// straight, so the tolerance is needed only for blur, noise and fisheye lenses.
const MAX_BEND_RAD: f64 = 0.55;
/// Smallest angle of a sector, radians. It corresponds to about two samples of the ring, because a
/// sector without a sample inside cannot be detected. Such sharp sectors occur only on strongly
/// tilted boards.
const MIN_SECTOR_RAD: f64 = 0.35;
/// Radius of the ring around candidates, pixels. The ring must be outside the blur of the corner,
/// and smaller than the squares around it.
const RING_PX: f64 = 4.0;
/// Number of samples of the ring. There is one per 0.8 pixels of its length.
const N_RING: usize = 32;

/// A saddle point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Saddle {
    pub(crate) pixel: [f64; 2],
    /// Directions of the edges as angles from x towards y, in ascending order. The sectors from
    /// edge 0 to 1 and from 2 to 3 are black.
    pub(crate) edges_rad: [f64; 4],
    /// Difference in gray value between the sectors.
    pub(crate) contrast: f32,
}

/// Finds saddle points. `plane` is slightly smoothed.
pub(crate) fn find(plane: &Plane) -> Vec<Saddle> {
    let [width, height] = plane.size();
    // With this margin, the ring and the Hessian stay inside the image.
    let margin = 6;
    if width <= 2 * margin + 2 || height <= 2 * margin + 2 {
        return Vec::new();
    }
    let response = response(plane);
    let mut saddles = Vec::new();
    for y in margin..height - margin {
        for x in margin..width - margin {
            let value = response[y * width + x];
            if value > MIN_RESPONSE && is_maximum(&response, width, x, y) {
                let start = stationary_point(plane, x, y);
                saddles.extend(ring(plane, start, RING_PX));
            }
        }
    }
    saddles
}

/// Smallest determinant, in squared gray values per pixel to the fourth. A blurred chessboard
/// corner of minimum contrast has this determinant.
const MIN_RESPONSE: f32 = 0.2;

/// Minus the determinant of the Hessian at every pixel.
fn response(plane: &Plane) -> Vec<f32> {
    let [width, height] = plane.size();
    let mut response = vec![0.0; width * height];
    for y in 1..height - 1 {
        let rows = [plane.row(y - 1), plane.row(y), plane.row(y + 1)];
        for x in 1..width - 1 {
            response[y * width + x] = response_at(rows, x);
        }
    }
    response
}

/// Minus the determinant of the Hessian at column `x` of the middle of three rows. It is positive
/// at saddles, where the two principal curvatures have opposite signs, and negative at blobs.
fn response_at([above, here, below]: [&[f32]; 3], x: usize) -> f32 {
    let xx = here[x - 1] - 2.0 * here[x] + here[x + 1];
    let yy = above[x] - 2.0 * here[x] + below[x];
    let xy = (below[x + 1] - below[x - 1] - above[x + 1] + above[x - 1]) * 0.25;
    xy * xy - xx * yy
}

/// Whether a response is the largest within two pixels. If responses are equal, the first response
/// counts as larger.
fn is_maximum(response: &[f32], width: usize, x: usize, y: usize) -> bool {
    let value = response[y * width + x];
    (y - 2..=y + 2).all(|near_y| {
        let row = &response[near_y * width + x - 2..=near_y * width + x + 2];
        row.iter()
            .zip(x - 2..)
            .all(|(&near, near_x)| near < value || (near == value && (near_y, near_x) >= (y, x)))
    })
}

/// The point near a pixel's center where the gradient vanishes, from the second-order expansion
/// there.
fn stationary_point(plane: &Plane, x: usize, y: usize) -> [f64; 2] {
    let at = |dx: usize, dy: usize| f64::from(plane.at(x + dx - 1, y + dy - 1));
    let gradient = [(at(2, 1) - at(0, 1)) / 2.0, (at(1, 2) - at(1, 0)) / 2.0];
    let xx = at(0, 1) - 2.0 * at(1, 1) + at(2, 1);
    let yy = at(1, 0) - 2.0 * at(1, 1) + at(1, 2);
    let xy = (at(2, 2) - at(0, 2) - at(2, 0) + at(0, 0)) / 4.0;
    let determinant = xx * yy - xy * xy;
    let dx = (xy * gradient[1] - yy * gradient[0]) / determinant;
    let dy = (xy * gradient[0] - xx * gradient[1]) / determinant;
    [x as f64 + 0.5 + limited(dx), y as f64 + 0.5 + limited(dy)]
}

/// Limits a Newton step to one pixel. The expansion holds only near the pixel. On a plateau, the
/// determinant is zero and the step is not finite.
fn limited(delta_px: f64) -> f64 {
    if delta_px.is_finite() {
        delta_px.clamp(-1.0, 1.0)
    } else {
        0.0
    }
}

/// Samples a ring around a point and returns the saddle if two black and two white sectors
/// alternate.
pub(crate) fn ring(plane: &Plane, center: [f64; 2], radius_px: f64) -> Option<Saddle> {
    if !plane.contains(center, radius_px + 1.0) {
        return None;
    }
    let angle = |at: usize| TAU * at as f64 / N_RING as f64;
    let sample = |at: usize| {
        let (sine, cosine) = angle(at).sin_cos();
        plane.sample([center[0] + radius_px * cosine, center[1] + radius_px * sine])
    };
    let samples: [f32; N_RING] = std::array::from_fn(sample);
    let mut sorted = samples;
    sorted.sort_by(f32::total_cmp);
    // The means of the darkest and the brightest quarter are used. About half of the samples are
    // black, so these quarters lie inside the sectors, and single noisy samples have little
    // influence.
    let quarter_mean = |quarter: &[f32]| quarter.iter().sum::<f32>() / quarter.len() as f32;
    let black = quarter_mean(&sorted[..N_RING / 4]);
    let white = quarter_mean(&sorted[N_RING * 3 / 4..]);
    let contrast = white - black;
    let threshold = (white + black) / 2.0;
    if contrast < MIN_CONTRAST {
        return None;
    }
    // The loop walks around the ring and collects every change of color. Each change has an angle,
    // which is interpolated between two samples, and a flag that states whether black follows.
    let mut edges = [(0.0, false); 4];
    let mut n_edges = 0;
    for at in 0..N_RING {
        let here = samples[at] - threshold;
        let next = samples[(at + 1) % N_RING] - threshold;
        if (here < 0.0) != (next < 0.0) {
            let edge = edges.get_mut(n_edges)?; // A fifth edge: not a saddle.
            *edge = (
                angle(at) + TAU / N_RING as f64 * f64::from(here / (here - next)),
                next < 0.0,
            );
            n_edges += 1;
        }
    }
    if n_edges != 4 {
        return None;
    }
    // Start with the edge that a black sector follows.
    let first = usize::from(!edges[0].1);
    let edges_rad: [f64; 4] = std::array::from_fn(|at| {
        // If the first edge is moved to the end, a full turn is added, so that angles stay
        // ascending.
        let turns = if first + at >= 4 { TAU } else { 0.0 };
        edges[(first + at) % 4].0 + turns
    });
    // Two lines cross at a corner of a board. Other places with four sectors, such as texture, have
    // edges that do not continue on the other side.
    let bend = |at: usize| (edges_rad[at + 2] - edges_rad[at] - PI).abs();
    let sectors_rad = [
        edges_rad[1] - edges_rad[0],
        edges_rad[2] - edges_rad[1],
        edges_rad[3] - edges_rad[2],
        edges_rad[0] + TAU - edges_rad[3],
    ];
    let is_saddle = bend(0) < MAX_BEND_RAD
        && bend(1) < MAX_BEND_RAD
        && sectors_rad.iter().all(|&sector| sector > MIN_SECTOR_RAD);
    is_saddle.then_some(Saddle {
        pixel: center,
        edges_rad,
        contrast,
    })
}

/// Difference between two angles, radians, -pi to pi.
pub(crate) fn angle_between(a_rad: f64, b_rad: f64) -> f64 {
    (a_rad - b_rad + PI).rem_euclid(TAU) - PI
}

/// Refines the position of a saddle in a window that must not reach beyond the edges which meet
/// there.
///
/// Returns the point `q` that minimizes the weighted sum of `(gradient · (pixel - q))^2` (Förstner
/// and Gülch 1987), with Gaussian weights centered at `q`. Every pixel on a straight edge through
/// `q` has a gradient perpendicular to the edge. `None` if the point moves out of the window or the
/// window shows only one edge.
#[expect(
    clippy::cast_possible_truncation,
    reason = "pixel indices are bounded by the image"
)]
pub(crate) fn refine(plane: &Plane, start: [f64; 2], half_window_px: f64) -> Option<[f64; 2]> {
    // Most corners converge in a few steps. Points that still move after this number of steps are
    // kept.
    const MAX_STEPS: usize = 12;
    // This is a fiftieth of the smallest error of corners in renders, which is 0.011 pixels
    // (docs/benchmarks/2026-11-26-calibration.md).
    const CONVERGED_PX: f64 = 2e-4;
    let reach = half_window_px.ceil() + 1.0;
    let mut center = start;
    for _ in 0..MAX_STEPS {
        if !plane.contains(center, reach + 1.5) {
            return None;
        }
        // Sums of the normal equations, which are the structure tensor and its product with the
        // positions. Positions are relative to the current center, so the solution is the step.
        let mut xx = 0.0;
        let mut xy = 0.0;
        let mut yy = 0.0;
        let mut bx = 0.0;
        let mut by = 0.0;
        // Half of `half_window_px` is one standard deviation.
        let per_variance = -2.0 / (half_window_px * half_window_px);
        for y in (center[1] - reach) as usize..=(center[1] + reach) as usize {
            for x in (center[0] - reach) as usize..=(center[0] + reach) as usize {
                let dx = x as f64 + 0.5 - center[0];
                let dy = y as f64 + 0.5 - center[1];
                let gx = f64::from(plane.at(x + 1, y) - plane.at(x - 1, y));
                let gy = f64::from(plane.at(x, y + 1) - plane.at(x, y - 1));
                let weight = ((dx * dx + dy * dy) * per_variance).exp();
                let along = gx * dx + gy * dy;
                xx += weight * gx * gx;
                xy += weight * gx * gy;
                yy += weight * gy * gy;
                bx += weight * gx * along;
                by += weight * gy * along;
            }
        }
        let determinant = xx * yy - xy * xy;
        // The smaller eigenvalue is at least determinant / trace. If it is near zero, the position
        // is known in only one direction.
        const MIN_RATIO: f64 = 0.02;
        let is_corner = determinant > MIN_RATIO * (xx + yy) * (xx + yy);
        if !is_corner {
            return None;
        }
        let step = [
            (yy * bx - xy * by) / determinant,
            (xx * by - xy * bx) / determinant,
        ];
        center = [center[0] + step[0], center[1] + step[1]];
        let moved = (center[0] - start[0]).hypot(center[1] - start[1]);
        // The comparison is written so that NaN does not count as near.
        let is_near = moved <= half_window_px;
        if !is_near {
            return None;
        }
        if step[0].hypot(step[1]) < CONVERGED_PX {
            break;
        }
    }
    Some(center)
}

/// Finds a saddle near a predicted position. The saddle is the largest response within `reach_px`,
/// and it is verified by a ring.
#[expect(
    clippy::cast_possible_truncation,
    reason = "pixel indices are bounded by the image"
)]
pub(crate) fn find_near(
    plane: &Plane,
    predicted: [f64; 2],
    reach_px: f64,
    radius_px: f64,
) -> Option<Saddle> {
    if !plane.contains(predicted, reach_px + 3.0) {
        return None;
    }
    let range = |center: f64| (center - reach_px) as usize..=(center + reach_px) as usize;
    let mut best: Option<(f32, usize, usize)> = None;
    for y in range(predicted[1]) {
        let rows = [plane.row(y - 1), plane.row(y), plane.row(y + 1)];
        for x in range(predicted[0]) {
            let value = response_at(rows, x);
            if best.is_none_or(|best| value > best.0) {
                best = Some((value, x, y));
            }
        }
    }
    // A negative response is a blob. Unlike in `find`, weak responses are allowed, because the
    // prediction is evidence and the ring checks the contrast.
    let (_, x, y) = best.filter(|best| best.0 > 0.0)?;
    ring(plane, stationary_point(plane, x, y), radius_px)
}
