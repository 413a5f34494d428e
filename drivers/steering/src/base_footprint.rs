//! The space that a base occupies: a convex polygon on the floor, between two heights.

use crate::capsule::Capsule;
use crate::check::check;
use crate::error::Error;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// Largest distance of two neighboring points of a wall, meters. With a smaller distance, more
/// points are compared with the map; with a larger one, the base stays farther away from surfaces.
const SPACING_M: f64 = 0.12;
/// Number of corners of a circle.
const N_CIRCLE: u32 = 16;
/// Number of points of a circle around the end of a capsule.
const N_CAPSULE: u32 = 12;
/// Largest distance of a corner from the base link, meters.
const MAX_RADIUS_M: f64 = 3.0;
/// A point this far outside still belongs to the footprint, meters: rounding of a motion along an
/// edge.
const ON_EDGE_M: f64 = 1e-3;

/// The space that a base occupies, in the frame of its base link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Footprint {
    /// Corners of a convex polygon, counterclockwise, meters.
    outline_m: Vec<[f64; 2]>,
    /// Lowest and highest height, meters.
    height_m: [f64; 2],
}

impl Footprint {
    /// The convex hull of points on the floor.
    ///
    /// # Errors
    /// If the points have no area or are too far away, or the heights are not increasing.
    pub fn of_points(points_m: &[[f64; 2]], height_m: [f64; 2]) -> Result<Self, Error> {
        let radius_m =
            points_m
                .iter()
                .map(|[x, y]| x.hypot(*y))
                .fold(0.0, |largest: f64, radius_m| {
                    // A radius that is not a number must not be ignored.
                    if radius_m <= largest {
                        largest
                    } else {
                        radius_m
                    }
                });
        let is_valid = radius_m <= MAX_RADIUS_M;
        check(
            "the radius of the footprint",
            radius_m,
            is_valid,
            "at most 3 m",
        )?;
        let [low, high] = height_m;
        let is_valid = high > low && high - low <= MAX_RADIUS_M && low.is_finite();
        check(
            "the upper end of the footprint",
            high,
            is_valid,
            "above the lower end, by at most 3 m",
        )?;
        let outline_m = convex_hull(points_m);
        let n_corners = outline_m.len();
        check(
            "the number of corners of the footprint",
            n_corners as f64,
            n_corners >= 3,
            "at least 3",
        )?;
        Ok(Self {
            outline_m,
            height_m,
        })
    }

    /// A circle around the base link.
    ///
    /// # Errors
    /// As [`Footprint::of_points`].
    pub fn circle(radius_m: f64, height_m: [f64; 2]) -> Result<Self, Error> {
        // The polygon is around the circle.
        let corner_m = radius_m / (PI / f64::from(N_CIRCLE)).cos();
        Self::of_points(&circle([0.0, 0.0], corner_m, N_CIRCLE), height_m)
    }

    /// The hull of the parts of a robot between two heights.
    ///
    /// * `capsules`: the parts in the frame of the base link.
    /// * `height_m`: lowest and highest height; `None` for the whole robot above its lowest
    ///   `floor_margin_m`.
    ///
    /// # Errors
    /// As [`Footprint::of_points`], for example if no part is between the heights.
    pub fn of_robot(
        capsules: &[Capsule],
        height_m: Option<[f64; 2]>,
        floor_margin_m: f64,
    ) -> Result<Self, Error> {
        let ends = |capsule: &Capsule| capsule.ends.map(|end| (end, capsule.radius_m));
        let [mut lowest_m, mut highest_m] = [f64::INFINITY, f64::NEG_INFINITY];
        for (end, radius_m) in capsules.iter().flat_map(ends) {
            lowest_m = lowest_m.min(end.z - radius_m);
            highest_m = highest_m.max(end.z + radius_m);
        }
        let height_m = height_m.unwrap_or([lowest_m + floor_margin_m, highest_m]);
        let is_inside = |capsule: &&Capsule| {
            let [a, b] = ends(capsule);
            let low = (a.0.z - a.1).min(b.0.z - b.1);
            let high = (a.0.z + a.1).max(b.0.z + b.1);
            high > height_m[0] && low < height_m[1]
        };
        let points: Vec<[f64; 2]> = capsules
            .iter()
            .filter(is_inside)
            .flat_map(ends)
            .flat_map(|(end, radius_m)| {
                let corner_m = radius_m / (PI / f64::from(N_CAPSULE)).cos();
                circle([end.x, end.y], corner_m, N_CAPSULE)
            })
            .collect();
        Self::of_points(&points, height_m)
    }

    /// Corners, counterclockwise, meters.
    pub fn outline_m(&self) -> &[[f64; 2]] {
        &self.outline_m
    }

    /// Lowest and highest height, meters.
    pub fn height_m(&self) -> [f64; 2] {
        self.height_m
    }

    /// Distance of the farthest corner from the base link.
    pub fn radius_m(&self) -> f64 {
        let radii = self.outline_m.iter().map(|[x, y]| x.hypot(*y));
        radii.fold(0.0, f64::max)
    }

    /// Vertical capsules that together contain the space of the footprint, and at most 7 cm around
    /// it.
    pub fn capsules(&self) -> Vec<Capsule> {
        /// Distance of neighboring capsules on the outline, and their radius, meters. They cover the
        /// outline with 4 cm on both sides, more than the diagonal of a voxel of common maps.
        const EDGE: (f64, f64) = (0.08, 0.06);
        /// The same inside. Half of the diagonal between four capsules is less than the radius.
        const INSIDE: (f64, f64) = (0.1, 0.075);
        let [low, high] = self.height_m;
        let capsule = |[x, y]: [f64; 2], radius_m: f64| Capsule {
            ends: [Vector3::new(x, y, low), Vector3::new(x, y, high)],
            radius_m,
        };
        let mut capsules = Vec::new();
        let n = self.outline_m.len();
        for (ix, from) in self.outline_m.iter().enumerate() {
            let to = self.outline_m[(ix + 1) % n];
            let n_along = spans((to[0] - from[0]).hypot(to[1] - from[1]), EDGE.0);
            for along in 0..n_along {
                let share = f64::from(along) / f64::from(n_along);
                let point = [0, 1].map(|axis| from[axis] + (to[axis] - from[axis]) * share);
                capsules.push(capsule(point, EDGE.1));
            }
        }
        let n_inside = spans(2.0 * self.radius_m(), INSIDE.0);
        let at = |ix: u32| INSIDE.0 * (f64::from(ix) - 0.5 * f64::from(n_inside));
        for x in (0..=n_inside).map(at) {
            for y in (0..=n_inside).map(at) {
                if self.contains([x, y]) {
                    capsules.push(capsule([x, y], INSIDE.1));
                }
            }
        }
        capsules
    }

    /// How far a point is inside of the outline; negative outside.
    pub(crate) fn depth_m(&self, [x, y]: [f64; 2]) -> f64 {
        let n = self.outline_m.len();
        let mut depth_m = f64::INFINITY;
        for (ix, [ax, ay]) in self.outline_m.iter().enumerate() {
            let [bx, by] = self.outline_m[(ix + 1) % n];
            let (ex, ey) = (bx - ax, by - ay);
            let left_m = (ex * (y - ay) - ey * (x - ax)) / ex.hypot(ey);
            depth_m = depth_m.min(left_m);
        }
        depth_m
    }

    /// Whether a point is inside of the outline or on it.
    pub(crate) fn contains(&self, point: [f64; 2]) -> bool {
        self.depth_m(point) >= -ON_EDGE_M
    }

    /// Points on the walls, and the radius of spheres around them that cover the walls.
    pub(crate) fn wall_points(&self) -> (Vec<[f64; 3]>, f64) {
        let n = self.outline_m.len();
        let [low, high] = self.height_m;
        let n_heights = spans(high - low, SPACING_M);
        let mut points = Vec::new();
        for (ix, from) in self.outline_m.iter().enumerate() {
            let to = self.outline_m[(ix + 1) % n];
            let n_along = spans((to[0] - from[0]).hypot(to[1] - from[1]), SPACING_M);
            for along in 0..n_along {
                let share = f64::from(along) / f64::from(n_along);
                let x = from[0] + (to[0] - from[0]) * share;
                let y = from[1] + (to[1] - from[1]) * share;
                for up in 0..=n_heights {
                    let z = low + (high - low) * f64::from(up) / f64::from(n_heights);
                    points.push([x, y, z]);
                }
            }
        }
        // A point of a wall is at most half a spacing away along both directions.
        (points, SPACING_M * 0.5_f64.sqrt())
    }
}

/// Number of parts of a length that are not longer than a spacing.
fn spans(length_m: f64, spacing_m: f64) -> u32 {
    let mut n = 1;
    while f64::from(n) * spacing_m < length_m {
        n += 1;
    }
    n
}

fn circle(center: [f64; 2], radius_m: f64, n: u32) -> Vec<[f64; 2]> {
    let corner = |ix: u32| {
        let (sin, cos) = (2.0 * PI * f64::from(ix) / f64::from(n)).sin_cos();
        [center[0] + radius_m * cos, center[1] + radius_m * sin]
    };
    (0..n).map(corner).collect()
}

/// The convex hull, counterclockwise, without points on its edges (Andrew 1979, monotone chain).
fn convex_hull(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    sorted.dedup();
    let mut hull = half_hull(sorted.iter());
    hull.extend(half_hull(sorted.iter().rev()));
    hull
}

/// One side of the hull, without its last point.
fn half_hull<'a>(points: impl Iterator<Item = &'a [f64; 2]>) -> Vec<[f64; 2]> {
    /// Area of a triangle whose corners are on a line, square meters.
    const ON_LINE_M2: f64 = 1e-9;
    let mut hull: Vec<[f64; 2]> = Vec::new();
    for point in points {
        while let [.., a, b] = hull[..] {
            let cross = (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]);
            if cross > ON_LINE_M2 {
                break;
            }
            hull.pop();
        }
        hull.push(*point);
    }
    hull.pop();
    hull
}
