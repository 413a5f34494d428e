//! Refines corners by comparing the image with the printed pattern around them.
//!
//! If other edges are close to a corner, such as the edges of a marker with a narrow margin, the
//! pattern around the corner is not a plain saddle. Since the pattern is known, it is rendered with
//! the local scale, rotation and shear, and shifted until it matches the image best. The method is
//! Lucas and Kanade 1981 in the inverse compositional form of Baker and Matthews 2004, with a gain
//! and an offset of the gray values.

use crate::gray::Plane;
use crate::surface::Surface;
use nalgebra::{Matrix2, Matrix4, Vector2, Vector4};

/// Smallest correlation between image and pattern. With a larger value, corners that are blurred or
/// partly covered by a highlight are lost. With a smaller value, other patterns are accepted.
const MIN_CORRELATION: f64 = 0.75;
/// Smallest standard deviation of the gray values. In an area of constant brightness, noise alone
/// could correlate.
const MIN_DEVIATION: f64 = 6.0;

/// The surroundings of a corner.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Neighborhood {
    /// Position in the board frame, meters.
    pub(crate) point_m: [f64; 2],
    /// Predicted position.
    pub(crate) pixel: [f64; 2],
    /// Derivative of the pixel with respect to the point, pixels per meter.
    pub(crate) pixel_by_point: Matrix2<f64>,
    /// Second derivatives of the pixel with respect to the point, pixels per square meter. The
    /// order is: x and x, x and y, y and y.
    pub(crate) bend: [[f64; 2]; 3],
    /// Size of the part of the board whose image is about as large as the compared window should
    /// be.
    pub(crate) side_m: f64,
    /// Largest distance from the predicted position, pixels. With `None`, it is a fraction of the
    /// image of `side_m`.
    pub(crate) reach_px: Option<f64>,
}

/// Half the side of the window, relative to the image of `side_m`. The next constants are its
/// limits in pixels. Larger windows average more noise, but contain more bending. Their time grows
/// with the square of the size.
pub(crate) const WINDOW_FRAC: f64 = 0.35;
const HALF_WINDOW_PX: [f64; 2] = [3.0, 9.0];
/// Largest distance from a prediction, relative to the image of `side_m`. The next constants are
/// its limits in pixels. The distance must stay below the distance to the next edge. Otherwise, the
/// pattern may be aligned with that edge.
const REACH_FRAC: f64 = 0.12;
const REACH_PX: [f64; 2] = [1.5, 8.0];
/// The pattern is blurred by applying the kernel (1 2 1) / 4 this many times. The numbers are for
/// images from in focus to out of focus. The kernel has a variance of 1/2, so the standard
/// deviations of the blurs are 0.7, 1.4 and 2.2 pixels.
const BLURS: [usize; 3] = [1, 4, 10];
/// Above this correlation, no other blur is tried.
const GOOD_CORRELATION: f64 = 0.94;

/// Finds the corner. `None` if the image does not show the pattern there.
pub(crate) fn find(
    plane: &Plane,
    surface: &Surface<'_>,
    neighborhood: &Neighborhood,
) -> Option<[f64; 2]> {
    let Neighborhood {
        pixel,
        pixel_by_point,
        side_m,
        ..
    } = *neighborhood;
    // The shorter side of the foreshortened square is used, so that the window does not reach into
    // neighboring squares.
    let side_px = pixel_by_point
        .column(0)
        .norm()
        .min(pixel_by_point.column(1).norm())
        * side_m;
    #[expect(clippy::cast_possible_truncation, reason = "a few pixels")]
    let half_px = (WINDOW_FRAC * side_px)
        .clamp(HALF_WINDOW_PX[0], HALF_WINDOW_PX[1])
        .round() as i32;
    let reach_px = neighborhood
        .reach_px
        .unwrap_or((REACH_FRAC * side_px).clamp(REACH_PX[0], REACH_PX[1]));
    if !side_px.is_finite() || !plane.contains(pixel, f64::from(half_px) + reach_px + 1.0) {
        return None;
    }
    let mut best: Option<(f64, [f64; 2])> = None;
    for n_blurs in BLURS {
        let found =
            Template::new(surface, neighborhood, half_px, n_blurs)?.find(plane, pixel, reach_px);
        // The correlation rises up to the blur of the image and falls beyond it.
        let is_worse = |best: (f64, [f64; 2])| found.is_none_or(|found| found.0 <= best.0);
        if best.is_some_and(is_worse) {
            break;
        }
        best = found;
        if best.is_some_and(|(correlation, _)| correlation >= GOOD_CORRELATION) {
            break;
        }
    }
    best.filter(|(correlation, _)| *correlation >= MIN_CORRELATION)
        .map(|(_, pixel)| pixel)
}

/// A function of the pixels of a square patch, row by row.
struct Patch {
    side: i32,
    values: Vec<f64>,
}

impl Patch {
    /// Value of a pixel.
    fn at(&self, x: i32, y: i32) -> f64 {
        self.values[(y * self.side + x).cast_unsigned() as usize]
    }

    /// Blurs with the kernel (1 2 1) / 4 along both axes. The `margin` outermost pixels on each
    /// side keep their values.
    fn blurred(&self, margin: i32) -> Self {
        let mut values = self.values.clone();
        for y in margin..self.side - margin {
            for x in margin..self.side - margin {
                let row = |y: i32| self.at(x - 1, y) + 2.0 * self.at(x, y) + self.at(x + 1, y);
                values[(y * self.side + x).cast_unsigned() as usize] =
                    (row(y - 1) + 2.0 * row(y) + row(y + 1)) / 16.0;
            }
        }
        Self {
            side: self.side,
            values,
        }
    }
}

/// The part of a pixel that is white, 0 to 1, in the printed pattern around a corner.
///
/// `offset` is the position of the pixel's center relative to the corner, pixels.
fn white_frac(
    surface: &Surface<'_>,
    neighborhood: &Neighborhood,
    point_by_pixel: &Matrix2<f64>,
    offset: [f64; 2],
) -> f64 {
    // The centers of 4 x 4 equal parts of the pixel.
    const OFFSETS: [f64; 4] = [-0.375, -0.125, 0.125, 0.375];
    let samples = OFFSETS
        .iter()
        .flat_map(|dy| OFFSETS.map(|dx| [offset[0] + dx, offset[1] + dy]));
    samples
        .filter(|&sample| is_white(surface, neighborhood, point_by_pixel, sample))
        .count() as f64
        / 16.0
}

/// Whether the printed pattern is white at a position relative to the corner, pixels.
fn is_white(
    surface: &Surface<'_>,
    neighborhood: &Neighborhood,
    point_by_pixel: &Matrix2<f64>,
    [x, y]: [f64; 2],
) -> bool {
    // The pixel is a second-order function of the board point. The inverse of this function is
    // approximated by one step. The linear inverse gives the point at which the second-order part
    // is evaluated. This part is subtracted before the final linear inverse.
    let first = point_by_pixel * Vector2::new(x, y);
    let [xx, xy, yy] = [
        first.x * first.x / 2.0,
        first.x * first.y,
        first.y * first.y / 2.0,
    ];
    let bent = [0, 1].map(|axis| {
        let bend = neighborhood.bend.map(|derivative| derivative[axis]);
        xx * bend[0] + xy * bend[1] + yy * bend[2]
    });
    let away = point_by_pixel * Vector2::new(x - bent[0], y - bent[1]);
    !surface.is_black([
        neighborhood.point_m[0] + away.x,
        neighborhood.point_m[1] + away.y,
    ])
}

/// The rendered pattern with its derivatives.
struct Template {
    half_px: i32,
    /// White fraction per pixel, row by row, minus the mean.
    values: Vec<f64>,
    norm: f64,
    /// Derivatives of each value with respect to shift, gain and offset.
    steepest: Vec<Vector4<f64>>,
    inverse: Matrix4<f64>,
}

impl Template {
    fn new(
        surface: &Surface<'_>,
        neighborhood: &Neighborhood,
        half_px: i32,
        n_blurs: usize,
    ) -> Option<Self> {
        let point_by_pixel = neighborhood.pixel_by_point.try_inverse()?;
        // The patch has additional pixels on each side. Each blur uses up one pixel, and the
        // derivatives use up another pixel.
        let padding = i32::try_from(n_blurs).ok()? + 1;
        let padded = half_px + padding;
        let side = 2 * padded + 1;
        let offset = |at: i32| [f64::from(at % side - padded), f64::from(at / side - padded)];
        let mut patch = Patch {
            side,
            values: (0..side * side)
                .map(|at| white_frac(surface, neighborhood, &point_by_pixel, offset(at)))
                .collect(),
        };
        // Lenses and sensors blur, too.
        for pass in 1..=padding - 1 {
            patch = patch.blurred(pass);
        }
        let inner = || {
            (padding..side - padding).flat_map(|y| (padding..side - padding).map(move |x| (x, y)))
        };
        let values: Vec<f64> = inner().map(|(x, y)| patch.at(x, y)).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let values: Vec<f64> = values.into_iter().map(|value| value - mean).collect();
        let norm = values.iter().map(|value| value * value).sum::<f64>().sqrt();
        // The derivatives are derivatives of the pattern, not of the image, so they are computed
        // once instead of in each step (Baker and Matthews 2004).
        let steepest: Vec<Vector4<f64>> = inner()
            .zip(&values)
            .map(|((x, y), &value)| {
                let dx = (patch.at(x + 1, y) - patch.at(x - 1, y)) / 2.0;
                let dy = (patch.at(x, y + 1) - patch.at(x, y - 1)) / 2.0;
                Vector4::new(dx, dy, value, 1.0)
            })
            .collect();
        let hessian = steepest
            .iter()
            .map(|row| row * row.transpose())
            .sum::<Matrix4<f64>>();
        Some(Self {
            half_px,
            values,
            norm,
            steepest,
            inverse: hessian.try_inverse()?,
        })
    }

    /// Finds the shift of the pattern, and the correlation there.
    fn find(&self, plane: &Plane, pixel: [f64; 2], reach_px: f64) -> Option<(f64, [f64; 2])> {
        // The best whole-pixel shift is searched first, because the alignment converges only from
        // about half of an edge's width.
        #[expect(clippy::cast_possible_truncation, reason = "a few pixels")]
        let steps = reach_px.floor() as i32;
        let shifts = (-steps..=steps)
            .flat_map(|y| (-steps..=steps).map(move |x| [f64::from(x), f64::from(y)]));
        let centers = shifts.map(|[x, y]| [pixel[0] + x, pixel[1] + y]);
        let scored = centers.map(|center| (self.correlation(plane, center), center));
        let (_, start) = scored.max_by(|a, b| a.0.total_cmp(&b.0))?;
        let refined = self.align(plane, start)?;
        let is_near = (refined[0] - pixel[0]).hypot(refined[1] - pixel[1]) <= reach_px + 0.5;
        is_near.then(|| (self.correlation(plane, refined), refined))
    }

    /// Gray values of the image in the window around a position, row by row.
    fn samples(&self, plane: &Plane, center: [f64; 2]) -> impl Iterator<Item = f64> {
        let range = -self.half_px..=self.half_px;
        let offsets = range
            .clone()
            .flat_map(move |y| range.clone().map(move |x| [f64::from(x), f64::from(y)]));
        offsets.map(move |[x, y]| f64::from(plane.sample([center[0] + x, center[1] + y])))
    }

    /// Correlation coefficient of the image and the pattern, -1 to 1.
    fn correlation(&self, plane: &Plane, center: [f64; 2]) -> f64 {
        let mut sum = 0.0;
        let mut squares = 0.0;
        let mut products = 0.0;
        for (sample, value) in self.samples(plane, center).zip(&self.values) {
            sum += sample;
            squares += sample * sample;
            products += sample * value;
        }
        let n = self.values.len() as f64;
        // Because of rounding, the variance of an area of constant brightness can be negative. The
        // products need no mean, because the values of the pattern add up to zero.
        let deviation = (squares - sum * sum / n).max(0.0).sqrt();
        if deviation < MIN_DEVIATION * n.sqrt() {
            0.0
        } else {
            products / (deviation * self.norm)
        }
    }

    /// Shifts the pattern to the position of least squares.
    fn align(&self, plane: &Plane, start: [f64; 2]) -> Option<[f64; 2]> {
        // This number is sufficient for any shift within the limits below. It also ends oscillating
        // steps. Whether the result is used then depends on the correlation.
        const MAX_STEPS: usize = 20;
        const CONVERGED_PX: f64 = 1e-3;
        let mut center = start;
        for _ in 0..MAX_STEPS {
            let right = self
                .samples(plane, center)
                .zip(&self.steepest)
                .map(|(sample, row)| row * sample)
                .sum::<Vector4<f64>>();
            let solution = self.inverse * right;
            // The image is gain * pattern(shifted) + offset. Its derivative with respect to the
            // shift is gain * gradient.
            let gain = solution[2];
            // Black and white are swapped, so this is another part of the pattern.
            if gain <= 0.0 {
                return None;
            }
            let step = [solution[0] / gain, solution[1] / gain];
            // Far from the solution, the linear model overshoots.
            let limited = step.map(|value| value.clamp(-0.7, 0.7));
            center = [center[0] - limited[0], center[1] - limited[1]];
            // The start is the best whole pixel, so the solution is within a pixel of the start.
            // The limit has some reserve. The comparison is written so that NaN does not count as
            // near.
            let is_near = (center[0] - start[0]).hypot(center[1] - start[1]) < 2.0;
            if !is_near {
                return None;
            }
            if step[0].hypot(step[1]) < CONVERGED_PX {
                break;
            }
        }
        Some(center)
    }
}
