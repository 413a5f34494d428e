//! Pixels that convex pieces cover in an image, on a coarse grid.

use super::ConvexPiece;
use super::directions::directions;
use nalgebra::Point3;
use std::f64::consts::TAU;

/// Approximate number of columns of the grid. At a width of 1280 pixels, a cell has 4 pixels. The
/// mask then extends beyond its margin by up to 0.3 % of the width.
const N_COLUMNS: u32 = 320;
/// Distance of the near plane, meters. Parts of the robot behind it are not visible.
const NEAR_M: f64 = 0.02;
/// Number of points that replace the circle around a point.
const N_CORNERS: u32 = 8;

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// How far the robot may be from where it is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uncertainty {
    /// Error of the rotation of the camera, radians.
    pub rotation_rad: f64,
    /// Error of the position of the robot's surface in the frame of the camera, meters.
    pub position_m: f64,
}

/// The cells of an image that show the robot.
#[derive(Debug)]
pub struct Silhouette {
    view: Pinhole,
    uncertainty: Uncertainty,
    /// Largest square of the tangent of the angle between the optical axis and a pixel.
    max_tan_squared: f64,
    cell_px: u32,
    n_cells: [usize; 2],
    is_covered: Vec<bool>,
}

/// A position in the image, pixels. It may be outside the image.
type Pixel = [f64; 2];

impl Silhouette {
    /// An image that shows no robot.
    #[must_use]
    pub fn new(view: Pinhole, uncertainty: Uncertainty) -> Self {
        let cell_px = view.size_px[0].div_ceil(N_COLUMNS).max(1);
        let n_cells = view.size_px.map(|side| side.div_ceil(cell_px) as usize);
        let largest_tan = [0, 1].map(|axis| {
            let [start, end] = [0.0, f64::from(view.size_px[axis])]
                .map(|edge_px| (edge_px - view.principal_px[axis]) / view.focal_px[axis]);
            f64::max(start.abs(), end.abs())
        });
        Self {
            view,
            uncertainty,
            max_tan_squared: largest_tan[0].powi(2) + largest_tan[1].powi(2),
            cell_px,
            n_cells,
            is_covered: vec![false; n_cells[0] * n_cells[1]],
        }
    }

    /// Adds a convex piece, given by points in the frame of the camera. A piece that contains the
    /// camera is not visible: it is the simplified shape of the housing or mount of the camera.
    pub fn add(&mut self, points_in_camera: &[Point3<f64>]) {
        // The projection of the convex hull of points in front of the camera is the convex hull of
        // their projections.
        if contains_camera(points_in_camera) {
            return;
        }
        let visible = in_front(points_in_camera);
        let corners: Vec<Pixel> = visible
            .iter()
            .flat_map(|point| self.corners_around(point))
            .collect();
        let is_outside = (0..2).any(|axis| {
            let side = f64::from(self.view.size_px[axis]);
            corners.iter().all(|corner| corner[axis] < 0.0)
                || corners.iter().all(|corner| corner[axis] >= side)
        });
        if !is_outside {
            self.fill(&convex_hull(corners));
        }
    }

    /// Whether a pixel shows the robot.
    #[must_use]
    pub fn covers(&self, x: u32, y: u32) -> bool {
        let [column, row] = [x, y].map(|at| (at / self.cell_px) as usize);
        self.is_covered[row * self.n_cells[0] + column]
    }

    /// Corners of an octagon around the circle in which a point may be.
    fn corners_around(&self, point: &Point3<f64>) -> impl Iterator<Item = Pixel> + use<> {
        let Pinhole {
            focal_px,
            principal_px,
            ..
        } = self.view;
        let tan = [point.x / point.z, point.y / point.z];
        // Points outside the image move faster, but the edge of the robot is inside.
        let secant_squared = 1.0 + (tan[0].powi(2) + tan[1].powi(2)).min(self.max_tan_squared);
        // To first order, rotating the camera by an angle moves the image of a point by at most
        // this angle times `secant_squared` focal lengths. Moving the point by a distance moves its
        // image by at most this distance over z times the secant. Both errors are independent.
        let by_rotation = self.uncertainty.rotation_rad * secant_squared;
        let by_position = self.uncertainty.position_m / point.z * secant_squared.sqrt();
        let margin = by_rotation.hypot(by_position) / (0.5 * TAU / f64::from(N_CORNERS)).cos();
        (0..N_CORNERS).map(move |ix| {
            let (sin, cos) = (TAU * f64::from(ix) / f64::from(N_CORNERS)).sin_cos();
            [
                focal_px[0] * (tan[0] + margin * cos) + principal_px[0],
                focal_px[1] * (tan[1] + margin * sin) + principal_px[1],
            ]
        })
    }

    /// Covers all cells that a convex polygon touches.
    fn fill(&mut self, polygon: &[Pixel]) {
        let cell_px = f64::from(self.cell_px);
        let ys = polygon.iter().map(|corner| corner[1]);
        let [low, high] = [
            ys.clone().fold(f64::INFINITY, f64::min),
            ys.fold(f64::NEG_INFINITY, f64::max),
        ];
        for row in cells(low, high, cell_px, self.n_cells[1]) {
            #[expect(clippy::cast_precision_loss, reason = "an image has few rows")]
            let top = row as f64 * cell_px;
            let Some([left, right]) = width_in_band(polygon, [top, top + cell_px]) else {
                continue;
            };
            let columns = cells(left, right, cell_px, self.n_cells[0]);
            let start = row * self.n_cells[0];
            self.is_covered[start + columns.start..start + columns.end].fill(true);
        }
    }
}

/// The cells from one coordinate to another, within the grid.
fn cells(low: f64, high: f64, cell_px: f64, n_cells: usize) -> std::ops::Range<usize> {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "casts of negative and large numbers saturate, which is the end of the grid"
    )]
    let [first, last] = [low, high]
        .map(|at| (at / cell_px).floor().max(-1.0) + 1.0)
        .map(|at| at as usize);
    // Cells are counted from 1 here, so that those before the first one are 0.
    let start = first.saturating_sub(1).min(n_cells);
    start..last.min(n_cells).max(start)
}

/// The range of x of a convex polygon between two values of y. `None` if it has no point there.
fn width_in_band(polygon: &[Pixel], [top, bottom]: [f64; 2]) -> Option<[f64; 2]> {
    let mut range: Option<[f64; 2]> = None;
    for (ix, start) in polygon.iter().enumerate() {
        let end = &polygon[(ix + 1) % polygon.len()];
        for x in ends_in_band(*start, *end, [top, bottom])
            .into_iter()
            .flatten()
        {
            let [left, right] = range.unwrap_or([x; 2]);
            range = Some([left.min(x), right.max(x)]);
        }
    }
    range
}

/// The x coordinates of the ends of the part of an edge that is between two values of y.
fn ends_in_band(start: Pixel, end: Pixel, [top, bottom]: [f64; 2]) -> Option<[f64; 2]> {
    let [low, high] = if start[1] <= end[1] {
        [start, end]
    } else {
        [end, start]
    };
    if high[1] < top || low[1] > bottom {
        return None;
    }
    let height = high[1] - low[1];
    if height <= 0.0 {
        return Some([low[0], high[0]]);
    }
    let at = |y: f64| low[0] + (high[0] - low[0]) * ((y - low[1]) / height).clamp(0.0, 1.0);
    Some([at(top), at(bottom)])
}

/// Whether no direction separates the camera from a convex piece.
fn contains_camera(points: &[Point3<f64>]) -> bool {
    let is_around = points.iter().any(|point| point.z < NEAR_M);
    is_around
        && directions().iter().all(|direction| {
            let is_beyond = |point: &Point3<f64>| point.coords.dot(direction) > 0.0;
            !points.iter().all(is_beyond)
        })
}

/// The part of a convex piece in front of the near plane.
fn in_front(points: &[Point3<f64>]) -> ConvexPiece {
    let (front, behind): (ConvexPiece, ConvexPiece) =
        points.iter().copied().partition(|point| point.z >= NEAR_M);
    let mut visible = front.clone();
    // All edges of the hull that cross the plane are among these lines. The other lines cross it
    // inside the hull, so they do not change the hull of the result.
    for inside in &front {
        for outside in &behind {
            let share = (inside.z - NEAR_M) / (inside.z - outside.z);
            visible.push(inside + (outside - inside) * share);
        }
    }
    visible
}

/// The corners of the convex hull, in order around it. Source: Andrew, "Another efficient algorithm
/// for convex hulls in two dimensions", 1979.
fn convex_hull(mut points: Vec<Pixel>) -> Vec<Pixel> {
    points.sort_by(|one, other| {
        one[0]
            .total_cmp(&other[0])
            .then(one[1].total_cmp(&other[1]))
    });
    let mut hull: Vec<Pixel> = Vec::new();
    let mut add_chain = |chain: &mut dyn Iterator<Item = &Pixel>| {
        let start = hull.len();
        for point in chain {
            while hull.len() >= start + 2 && !turns_left(&hull[hull.len() - 2..], point) {
                hull.pop();
            }
            hull.push(*point);
        }
        // The last point is the first point of the other chain.
        hull.pop();
    };
    add_chain(&mut points.iter());
    add_chain(&mut points.iter().rev());
    hull
}

fn turns_left(last_two: &[Pixel], point: &Pixel) -> bool {
    let [a, b] = [last_two[0], last_two[1]];
    (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const VIEW: Pinhole = Pinhole {
        size_px: [640, 480],
        focal_px: [600.0, 610.0],
        principal_px: [310.0, 245.0],
    };
    const EXACT: Uncertainty = Uncertainty {
        rotation_rad: 0.0,
        position_m: 0.0,
    };

    fn covered(points: &[[f64; 3]], uncertainty: Uncertainty) -> Vec<[u32; 2]> {
        let mut silhouette = Silhouette::new(VIEW, uncertainty);
        let points: ConvexPiece = points.iter().map(|point| Point3::from(*point)).collect();
        silhouette.add(&points);
        let pixels = (0..480_u32).flat_map(|y| (0..640_u32).map(move |x| [x, y]));
        pixels.filter(|[x, y]| silhouette.covers(*x, *y)).collect()
    }

    /// Smallest and largest x and y of pixels.
    fn bounds(pixels: &[[u32; 2]]) -> [[u32; 2]; 2] {
        [0, 1].map(|axis| {
            let values = pixels.iter().map(|pixel| pixel[axis]);
            let low = values.clone().min().expect("pixels");
            [low, values.max().expect("pixels")]
        })
    }

    #[test]
    fn a_triangle_covers_its_pixels_and_the_rest_of_their_cells() {
        // Corners at the pixels (310, 245), (370, 245) and (310, 306), 2 m away.
        let triangle = [[0.0, 0.0, 2.0], [0.2, 0.0, 2.0], [0.0, 0.2, 2.0]];
        let pixels = covered(&triangle, EXACT);
        assert_eq!(bounds(&pixels), [[310, 371], [244, 307]]);
        let half_square = 0.5 * 60.0 * 61.0;
        let excess = pixels.len() as f64 / half_square - 1.0;
        assert!((0.0..0.2).contains(&excess), "{excess}");
        assert!(pixels.contains(&[339, 273]) && !pixels.contains(&[360, 296]));
    }

    #[test]
    fn the_margin_follows_from_rotation_and_distance() {
        let point = [[0.0, 0.0, 2.0]];
        let by_rotation = Uncertainty {
            rotation_rad: 0.01,
            ..EXACT
        };
        // 6 pixels around (310, 245), and up to one pixel of a cell.
        assert_eq!(bounds(&covered(&point, by_rotation))[0], [302, 317]);
        let by_position = Uncertainty {
            position_m: 0.02,
            ..EXACT
        };
        assert_eq!(
            bounds(&covered(&point, by_position)),
            bounds(&covered(&point, by_rotation))
        );
        let nearer = covered(&[[0.0, 0.0, 1.0]], by_position);
        let [[left, right], _] = bounds(&nearer);
        assert!((24..28).contains(&(right - left)), "{left} to {right}");
    }

    #[test]
    fn parts_behind_the_camera_are_cut_off() {
        let behind = [[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [0.0, 0.1, -2.0]];
        assert!(covered(&behind, EXACT).is_empty());
        // A bar that passes below the camera covers the image below its far end.
        let bar = [
            [-0.05, 0.2, -1.0],
            [0.05, 0.2, -1.0],
            [-0.05, 0.2, 1.0],
            [0.05, 0.2, 1.0],
        ];
        let pixels = covered(&bar, EXACT);
        let [_, [top, bottom]] = bounds(&pixels);
        assert!(
            (364..368).contains(&top) && bottom == 479,
            "{top} to {bottom}"
        );
    }

    #[test]
    fn a_housing_around_the_camera_is_not_visible() {
        let corner = |ix: u32, side: f64| if ix == 0 { -side } else { side };
        let housing = |shift_z: f64| -> Vec<[f64; 3]> {
            (0..8)
                .map(|ix| {
                    let z = corner(ix / 4, 0.05) + shift_z;
                    [corner(ix % 2, 0.1), corner(ix / 2 % 2, 0.1), z]
                })
                .collect()
        };
        assert!(covered(&housing(0.0), EXACT).is_empty());
        assert!(
            covered(&housing(-0.1), EXACT).is_empty(),
            "behind the camera"
        );
        assert_eq!(
            covered(&housing(0.2), EXACT).len(),
            640 * 480,
            "in front of it"
        );
    }

    #[test]
    fn pieces_beyond_the_edges_are_cut_off() {
        let beside = [[2.0, 0.0, 1.0], [3.0, 0.0, 1.0], [2.0, 0.5, 1.0]];
        assert!(covered(&beside, EXACT).is_empty());
        let whole = [
            [-9.0, -9.0, 1.0],
            [9.0, -9.0, 1.0],
            [9.0, 9.0, 1.0],
            [-9.0, 9.0, 1.0],
        ];
        assert_eq!(covered(&whole, EXACT).len(), 640 * 480);
    }
}
