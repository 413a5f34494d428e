//! Finds dark convex quadrilaterals. They are outlines of dark regions after adaptive thresholding,
//! approximated by polygons.

use crate::gray::Plane;
use crate::lattice::distance;

/// Sides of the windows for the local mean, pixels.
///
/// A small window separates small markers in uneven light. In a marker that is much larger than the
/// window, the middle of a black area is not darker than its surroundings, so larger markers need
/// larger windows.
const WINDOWS_PX: [usize; 3] = [9, 23, 61];
/// A pixel is dark if it is darker than the local mean by this difference. The difference exceeds
/// the noise of common images, so that areas of constant brightness do not contain many dark dots.
const DARKER_BY: f32 = 5.0;
/// Shortest side of a quadrilateral, pixels. The smallest markers have 6 x 6 cells with the border,
/// which cannot be read with less than a pixel per cell.
const MIN_SIDE_PX: f64 = 6.0;
/// Largest distance of an outline from its polygon, relative to the square root of the enclosed
/// area.
const TOLERANCE: f64 = 0.1;
const MIN_TOLERANCE_PX: f64 = 1.2;

/// Corners in clockwise order as seen in the image, pixels.
pub(crate) type Quad = [[f64; 2]; 4];

/// Finds dark quadrilaterals. The same quadrilateral may be found several times, with slightly
/// different corners.
///
/// `do_touch` states whether corners of quadrilaterals touch other dark regions, as on AprilGrids.
pub(crate) fn find(plane: &Plane, do_touch: bool) -> Vec<Quad> {
    let sums = Sums::new(plane);
    let mut quads = Vec::new();
    for window_px in WINDOWS_PX {
        let mut is_dark = threshold(plane, &sums, window_px);
        // Dark regions are determined from pixels. The corners are then located in the gray image.
        let mut add =
            |outline: &[[i32; 2]]| quads.extend(quad(outline).map(|quad| refine(plane, quad)));
        Mask::new(&is_dark, plane.size()).outlines(&mut add);
        // Both masks are searched, because erosion separates touching regions but also removes
        // small markers.
        if do_touch {
            erode(&mut is_dark, plane.size());
            Mask::new(&is_dark, plane.size()).outlines(&mut add);
        }
    }
    quads
}

/// Sums of all values above and left of each pixel corner.
struct Sums {
    stride: usize,
    sums: Vec<f64>,
}

impl Sums {
    fn new(plane: &Plane) -> Self {
        let [width, height] = plane.size();
        let stride = width + 1;
        let mut sums = vec![0.0; stride * (height + 1)];
        for y in 0..height {
            let mut row_sum = 0.0;
            for (x, value) in plane.row(y).iter().enumerate() {
                row_sum += f64::from(*value);
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row_sum;
            }
        }
        Self { stride, sums }
    }
}

/// Whether each pixel is darker than the mean of a window around it.
fn threshold(plane: &Plane, sums: &Sums, window_px: usize) -> Vec<bool> {
    let [width, height] = plane.size();
    let half = window_px / 2;
    let mut is_dark = Vec::with_capacity(width * height);
    for y in 0..height {
        // At the border of the image, the window is cut off.
        let top = y.saturating_sub(half) * sums.stride;
        let bottom = (y + half + 1).min(height) * sums.stride;
        let n_rows = (bottom - top) / sums.stride;
        for (x, &value) in plane.row(y).iter().enumerate() {
            let left = x.saturating_sub(half);
            let right = (x + half + 1).min(width);
            let sum = sums.sums[bottom + right] - sums.sums[bottom + left] - sums.sums[top + right]
                + sums.sums[top + left];
            let n = (n_rows * (right - left)) as f64;
            is_dark.push(f64::from(value + DARKER_BY) * n < sum);
        }
    }
    is_dark
}

/// Makes dark pixels with a bright neighbor bright, which separates regions that touch at a corner.
fn erode(is_dark: &mut [bool], [width, height]: [usize; 2]) {
    let before = is_dark.to_vec();
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let at = y * width + x;
            is_dark[at] = before[at]
                && before[at - 1]
                && before[at + 1]
                && before[at - width]
                && before[at + width];
        }
    }
}

/// The pixels of an image that are dark.
#[derive(Clone, Copy)]
struct Mask<'a> {
    is_dark: &'a [bool],
    width: usize,
    height: usize,
}

impl<'a> Mask<'a> {
    fn new(is_dark: &'a [bool], [width, height]: [usize; 2]) -> Self {
        Self {
            is_dark,
            width,
            height,
        }
    }

    /// Whether a pixel is dark. Everything outside the image is bright.
    fn at(&self, [x, y]: [i32; 2]) -> bool {
        let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else {
            return false;
        };
        x < self.width && y < self.height && self.is_dark[y * self.width + x]
    }

    /// Index of a pixel inside the image.
    fn index(&self, [x, y]: [i32; 2]) -> usize {
        y.cast_unsigned() as usize * self.width + x.cast_unsigned() as usize
    }

    /// Walks around every dark region along the borders between pixels, with the dark region on the
    /// right. Pixels that touch only at a corner belong to different regions.
    ///
    /// Points are pixel corners, so the outline lies between dark and bright pixels. Holes are
    /// skipped.
    fn outlines(&self, mut visit: impl FnMut(&[[i32; 2]])) {
        let (Ok(n_columns), Ok(n_rows)) = (i32::try_from(self.width), i32::try_from(self.height))
        else {
            return;
        };
        // Upper borders of dark pixels that an outline has passed. Every outline has at least one
        // such border. Searching for borders that were not passed therefore finds every region
        // exactly once.
        let mut is_visited = vec![false; self.width * self.height];
        let mut outline = Vec::new();
        for y in 0..n_rows {
            for x in 0..n_columns {
                let at = self.index([x, y]);
                if !self.is_dark[at] || is_visited[at] || self.at([x, y - 1]) {
                    continue;
                }
                let twice_area = self.walk_around([x, y], &mut is_visited, &mut outline);
                // Outlines of holes have the opposite direction, so their area is negative.
                if twice_area as f64 > MIN_SIDE_PX * MIN_SIDE_PX {
                    visit(&outline);
                }
            }
        }
    }

    /// Walks around one region, starting with the upper border of a pixel, and marks all upper
    /// borders on the way. Returns twice the enclosed area, by the shoelace formula.
    fn walk_around(
        &self,
        start: [i32; 2],
        is_visited: &mut [bool],
        outline: &mut Vec<[i32; 2]>,
    ) -> i64 {
        outline.clear();
        let mut point = start;
        let mut step = 0_usize;
        let mut twice_area = 0_i64;
        loop {
            outline.push(point);
            if step == 0 {
                is_visited[self.index(point)] = true;
            }
            let [dx, dy] = crate::lattice::STEPS[step];
            let next = [point[0] + dx, point[1] + dy];
            twice_area +=
                i64::from(point[0]) * i64::from(next[1]) - i64::from(next[0]) * i64::from(point[1]);
            point = next;
            // These are the pixels ahead, to the left and to the right of the walking direction.
            let (left, right) = match step {
                0 => ([0, -1], [0, 0]),
                1 => ([0, 0], [-1, 0]),
                2 => ([-1, 0], [-1, -1]),
                _ => ([-1, -1], [0, -1]),
            };
            let is_dark_at = |[dx, dy]: [i32; 2]| self.at([point[0] + dx, point[1] + dy]);
            // The dark region stays on the right. The walk turns right where the region ends, and
            // left where the region blocks the way. If two dark pixels touch at a corner, the left
            // pixel belongs to another region.
            step = match (is_dark_at(left), is_dark_at(right)) {
                (_, false) => (step + 1) % 4,
                (true, true) => (step + 3) % 4,
                (false, true) => step,
            };
            if point == start && step == 0 {
                return twice_area;
            }
        }
    }
}

/// Approximates an outline by four corners, clockwise. `None` if it has a different shape.
fn quad(outline: &[[i32; 2]]) -> Option<Quad> {
    let points: Vec<[f64; 2]> = outline.iter().map(|point| point.map(f64::from)).collect();
    let area = area(&points);
    let tolerance_px = (TOLERANCE * area.sqrt()).max(MIN_TOLERANCE_PX);
    // Outlines of quadrilaterals are short compared to the square root of their area. For a square,
    // the ratio is 4. For a rectangle of 1 x 30, it is 11. The limit also bounds the time for text
    // and texture, whose outlines are long.
    if points.len() as f64 > 12.0 * area.sqrt() {
        return None;
    }
    let n = points.len();
    // The point farthest from the center is a corner, and so is the point farthest from that
    // corner. Splitting finds the other corners from these two.
    let center = [0, 1].map(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / n as f64);
    let farthest = |from: [f64; 2]| {
        (0..n).max_by(|&a, &b| distance(points[a], from).total_cmp(&distance(points[b], from)))
    };
    let first = farthest(center)?;
    let second = farthest(points[first])?;
    let low = first.min(second);
    let high = first.max(second);
    let mut corners = vec![low];
    split(&points, low, high, tolerance_px, &mut corners);
    corners.push(high);
    split(&points, high, low + n, tolerance_px, &mut corners);
    let corners: [usize; 4] = corners.try_into().ok()?;
    let quad = corners.map(|at| points[at % n]);
    // Polygons within the tolerance enclose a similar area, unless the outline is folded.
    let is_similar = (self::area(&quad) / area - 1.0).abs() < 0.3;
    (is_similar && is_convex(&quad) && shortest_side(&quad) >= MIN_SIDE_PX).then_some(quad)
}

/// Appends the corners between two points of an outline (Ramer 1972, Douglas and Peucker 1973).
/// Stops at five corners.
fn split(points: &[[f64; 2]], from: usize, to: usize, tolerance_px: f64, corners: &mut Vec<usize>) {
    let n = points.len();
    let a = points[from % n];
    let b = points[to % n];
    // If the outline is cut at only one point, `a` and `b` are the same point.
    let length = distance(a, b).max(1e-9);
    let away = |at: usize| cross(a, b, points[at % n]).abs() / length;
    let Some(at) = (from + 1..to).max_by(|&a, &b| away(a).total_cmp(&away(b))) else {
        return;
    };
    if away(at) <= tolerance_px || corners.len() > 4 {
        return;
    }
    split(points, from, at, tolerance_px, corners);
    corners.push(at);
    split(points, at, to, tolerance_px, corners);
}

/// Cross product of the vectors from `a` to `b` and from `a` to a point. It is twice the area of
/// the triangle.
fn cross(a: [f64; 2], b: [f64; 2], point: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])
}

/// Enclosed area. It is positive for clockwise outlines.
fn area(points: &[[f64; 2]]) -> f64 {
    let next = points.iter().cycle().skip(1);
    points
        .iter()
        .zip(next)
        .map(|(a, b)| a[0] * b[1] - b[0] * a[1])
        .sum::<f64>()
        / 2.0
}

/// Whether all corners turn clockwise.
fn is_convex(quad: &Quad) -> bool {
    (0..4).all(|at| {
        let [a, b, c] = [0, 1, 2].map(|offset| quad[(at + offset) % 4]);
        (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) > 0.0
    })
}

pub(crate) fn shortest_side(quad: &Quad) -> f64 {
    (0..4)
        .map(|at| distance(quad[at], quad[(at + 1) % 4]))
        .fold(f64::INFINITY, f64::min)
}

/// Moves the sides to the strongest change from dark to bright near them and intersects them.
///
/// Returns the quadrilateral unchanged if a side cannot be located or a corner moves far.
fn refine(plane: &Plane, quad: Quad) -> Quad {
    // A corner that moves farther belongs to another edge, such as the edge of a cell.
    let max_move_px = (0.15 * shortest_side(&quad)).max(2.0);
    let sides: [Option<Line>; 4] =
        std::array::from_fn(|at| fit_side(plane, quad[at], quad[(at + 1) % 4]));
    let corner = |at: usize| Line::intersection(&sides[(at + 3) % 4]?, &sides[at]?);
    let refined: [Option<[f64; 2]>; 4] = std::array::from_fn(corner);
    let [Some(a), Some(b), Some(c), Some(d)] = refined else {
        return quad;
    };
    let refined = [a, b, c, d];
    let is_near = (0..4).all(|at| distance(refined[at], quad[at]) <= max_move_px);
    if is_near && is_convex(&refined) {
        refined
    } else {
        quad
    }
}

/// Points with `normal · point = offset`.
#[derive(Clone, Copy, Debug)]
struct Line {
    normal: [f64; 2],
    offset: f64,
}

impl Line {
    fn distance(&self, point: [f64; 2]) -> f64 {
        (self.normal[0] * point[0] + self.normal[1] * point[1] - self.offset).abs()
    }

    fn intersection(a: &Self, b: &Self) -> Option<[f64; 2]> {
        let determinant = a.normal[0] * b.normal[1] - a.normal[1] * b.normal[0];
        let x = (a.offset * b.normal[1] - b.offset * a.normal[1]) / determinant;
        let y = (b.offset * a.normal[0] - a.offset * b.normal[0]) / determinant;
        // The determinant is the sine of the angle between the lines.
        (determinant.abs() > 1e-3).then_some([x, y])
    }
}

/// Fits a line to the transition from dark to bright along a side. The dark region is on the right.
fn fit_side(plane: &Plane, from: [f64; 2], to: [f64; 2]) -> Option<Line> {
    // The outline follows pixel borders, so it is off by about a pixel, and more with blur.
    const REACH_PX: f64 = 2.0;
    const STEP_PX: f64 = 0.5;
    let length = distance(from, to);
    let along = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
    let outward = [along[1], -along[0]];
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small positive number"
    )]
    // There is one point per pixel, but at most 40 points. More points hardly improve the line.
    let n = (length as usize).clamp(4, 40);
    let mut points: Vec<[f64; 2]> = Vec::with_capacity(n);
    for at in 0..n {
        // The ends are rounded by blur.
        let frac = 0.12 + 0.76 * (at as f64 + 0.5) / n as f64;
        let center = [0, 1].map(|axis| from[axis] + frac * (to[axis] - from[axis]));
        let sample = |away: f64| {
            f64::from(plane.sample([0, 1].map(|axis| center[axis] + away * outward[axis])))
        };
        // This is the mean of all positions across the side, weighted by the squared rise from dark
        // to bright. Falling edges belong to cells and do not count.
        let mut weight_sum = 0.0;
        let mut sum = 0.0;
        let mut away = -REACH_PX;
        while away <= REACH_PX {
            let rise = (sample(away + STEP_PX) - sample(away - STEP_PX)).max(0.0);
            weight_sum += rise * rise;
            sum += rise * rise * away;
            away += STEP_PX;
        }
        // The limit corresponds to one rise of 5 gray values, or to several smaller rises.
        if weight_sum > 25.0 {
            let away = sum / weight_sum;
            points.push([0, 1].map(|axis| center[axis] + away * outward[axis]));
        }
    }
    if points.len() < 3 {
        return None;
    }
    // If something touches the side, points there are wrong. Points are dropped according to their
    // distance from a first line, relative to the median distance. A lower limit ensures that a
    // perfect line does not drop its own noise.
    let line = fit_line(&points)?;
    let off = |point: &[f64; 2]| line.distance(*point);
    let mut offs: Vec<f64> = points.iter().map(off).collect();
    offs.sort_by(f64::total_cmp);
    let allowed = (2.5 * offs[offs.len() / 2]).max(0.1);
    points.retain(|point| off(point) <= allowed);
    fit_line(&points)
}

/// Sum of the products of the deviations from the mean along two axes.
fn central_moment(points: &[[f64; 2]], mean: [f64; 2], [a, b]: [usize; 2]) -> f64 {
    points
        .iter()
        .map(|point| (point[a] - mean[a]) * (point[b] - mean[b]))
        .sum::<f64>()
}

/// Fits a line by total least squares. Distances are measured perpendicular to the line, whatever
/// its direction.
fn fit_line(points: &[[f64; 2]]) -> Option<Line> {
    if points.len() < 2 {
        return None;
    }
    let n = points.len() as f64;
    let mean = [0, 1].map(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / n);
    let xx = central_moment(points, mean, [0, 0]);
    let xy = central_moment(points, mean, [0, 1]);
    let yy = central_moment(points, mean, [1, 1]);
    // Direction of the principal axis of the scatter.
    let direction_rad = (2.0 * xy).atan2(xx - yy) / 2.0;
    let normal = [-direction_rad.sin(), direction_rad.cos()];
    Some(Line {
        normal,
        offset: normal[0] * mean[0] + normal[1] * mean[1],
    })
}
