//! Computes when and how precisely each part of a scene was observed.
//!
//! Each keyframe contributes information (inverse covariance) about the position of the surface in
//! a cell. Across the ray, the information comes from the size of a pixel. Along the ray, it comes
//! from the depth camera, if there is one. Two keyframes from different directions therefore
//! determine a position without depth, as in triangulation (Hartley and Zisserman 2004, section
//! 12.6). Errors that keyframes have in common, such as calibration errors, are not part of the
//! result.
#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "cells and pixels are rounded down on purpose; their numbers are small"
)]

use keyframe::DepthMap;
use kinematics::Stamp;
use nalgebra::{Matrix3, Point3, Vector3};
use numbers::quantile::{Rank, quantile};
use viz::{ObservationMap, ObservedCell};

/// Number of cells along the longest side of the grid. With more cells, the map is sharper, but
/// fewer rays meet each cell, and the size of the map grows with the cube of this number.
const MAX_CELLS: u32 = 96;
/// The grid contains the points between these quantiles along each axis. A few wrong depth values,
/// for example at reflections, would otherwise enlarge the grid and make all cells coarse.
const QUANTILES: [f64; 2] = [0.01, 0.99];
/// The grid extends beyond the quantiles by this fraction of the extent, so that it also contains
/// surfaces at the border.
const MARGIN_FRAC: f64 = 0.1;
/// Number of cells by which observations are extended. Depth maps have as many pixels per row as
/// the grid has cells, so neighboring rays of a near camera meet adjacent cells. Seen from farther
/// away or at an angle, they leave gaps of a few cells, which two extensions fill.
const N_EXTENSIONS: usize = 2;
/// Number of points that determine the quantiles. With this many, 200 points lie beyond each
/// quantile.
const MAX_SAMPLES: usize = 20_000;
/// Standard deviation of a position across the ray, pixels of the image. It includes the error of
/// the pose.
const SIGMA_PX: f64 = 1.0;
/// Standard deviation of depth at 1 m, meters. It grows with the square of the depth, as for stereo
/// cameras.
const DEPTH_SIGMA_AT_1_M: f64 = 0.002;
/// Positions with a larger deviation count as not determined, meters. Rounding gives a singular
/// information matrix a small eigenvalue, and thus a large deviation instead of an infinite one.
const MAX_SIGMA_M: f64 = 10.0;

/// Depth and pose of one keyframe.
#[derive(Clone, Debug)]
pub(crate) struct PosedDepth {
    /// Stamp of the image.
    pub(crate) stamp: Stamp,
    /// Depth and pose, of a depth camera or rendered.
    pub(crate) depth: DepthMap,
    /// Angle that a pixel of the image subtends, radians.
    pub(crate) pixel_rad: f64,
    /// Whether the depth was measured. If not, it only determines which surface is visible.
    pub(crate) is_measured: bool,
}

/// The observations of a cell.
#[derive(Clone, Debug)]
struct Cell {
    /// Sum of the inverse covariances of its position, meters^-2.
    information: Matrix3<f64>,
    newest: Stamp,
    /// Index of the last keyframe that has contributed.
    keyframe: usize,
}

/// A grid of cubic cells, axis-aligned in world.
#[derive(Clone, Copy, Debug)]
struct Grid {
    min_m: Vector3<f64>,
    cell_m: f64,
    n_cells: [u32; 3],
}

/// The map of these keyframes; `None` if they have seen nothing.
pub(crate) fn map_of(keyframes: &[PosedDepth]) -> Option<ObservationMap> {
    let newest = keyframes.iter().map(|keyframe| keyframe.stamp).max()?;
    let grid = Grid::around(keyframes)?;
    let mut cells = SparseCells::new(&grid);
    for (ix, keyframe) in keyframes.iter().enumerate() {
        add_keyframe(&mut cells, &grid, ix, keyframe);
    }
    let observed = cells.cells.into_iter().map(|(ix, cell)| ObservedCell {
        ix,
        age_secs: (newest.0 - cell.newest.0) as f64 * 1e-9,
        sigma_m: cell.sigma_m(),
    });
    let mut observed: Vec<ObservedCell> = observed.collect();
    for _ in 0..N_EXTENSIONS {
        observed = extended(&grid, &observed);
    }
    Some(ObservationMap {
        min_m: grid.min_m.into(),
        cell_m: grid.cell_m,
        n_cells: grid.n_cells,
        observed,
        n_keyframes: keyframes.len(),
        newest_at: None,
    })
}

/// Adds the observations of a keyframe. Each cell is counted once, however many rays meet it, so
/// that the size of the cell does not matter.
fn add_keyframe(cells: &mut SparseCells<Cell>, grid: &Grid, ix: usize, keyframe: &PosedDepth) {
    let camera = keyframe.depth.world_from_camera.translation.vector;
    for point in points(&keyframe.depth) {
        let Some(cell_ix) = grid.index(&point) else {
            continue;
        };
        let cell = cells.entry(cell_ix, || Cell {
            information: Matrix3::zeros(),
            newest: keyframe.stamp,
            keyframe: usize::MAX,
        });
        // The loop handles all points of one keyframe before the next keyframe. The index of the
        // last keyframe is therefore enough to detect that a keyframe has already contributed to
        // this cell.
        if std::mem::replace(&mut cell.keyframe, ix) == ix {
            continue;
        }
        cell.newest = cell.newest.max(keyframe.stamp);
        let ray = point.coords - camera;
        let distance_m = ray.norm();
        let direction = ray.normalize();
        // Information, in 1/m^2, is the inverse square of the standard deviation. Across the ray,
        // the deviation is the width that a pixel covers at this distance.
        let across = (distance_m * keyframe.pixel_rad * SIGMA_PX).powi(-2);
        // The depth of a stereo camera is `f * b / disparity`. For a fixed error of the disparity,
        // the error of the depth grows with its square. A rendered depth is no measurement.
        let along = if keyframe.is_measured {
            (DEPTH_SIGMA_AT_1_M * distance_m.powi(2)).powi(-2)
        } else {
            0.0
        };
        // `across * (I - d d^T) + along * d d^T`, see `docs/design/viewer.md`.
        cell.information +=
            across * Matrix3::identity() + (along - across) * direction * direction.transpose();
    }
}

/// Values of some cells of a grid.
struct SparseCells<T> {
    /// For each cell of the grid: index in `cells`, or `NONE`.
    slots: Vec<u32>,
    /// Indices and values of cells.
    cells: Vec<(usize, T)>,
}

const NONE: u32 = u32::MAX;

impl<T> SparseCells<T> {
    fn new(grid: &Grid) -> Self {
        Self {
            slots: vec![NONE; grid.n_cells.iter().map(|n| *n as usize).product()],
            cells: Vec::new(),
        }
    }

    /// The value of a cell, which is created if it has none.
    fn entry(&mut self, ix: usize, create: impl FnOnce() -> T) -> &mut T {
        let slot = &mut self.slots[ix];
        if *slot == NONE {
            *slot = self.cells.len() as u32;
            self.cells.push((ix, create()));
        }
        &mut self.cells[*slot as usize].1
    }
}

impl Cell {
    /// Standard deviation of the position in the least certain direction, meters.
    fn sigma_m(&self) -> f64 {
        // The smallest eigenvalue belongs to the least certain direction. Rounding may make it
        // negative.
        let sigma_m = self
            .information
            .symmetric_eigenvalues()
            .min()
            .max(0.0)
            .sqrt()
            .recip();
        // A NaN fails this comparison and becomes infinite, too.
        if sigma_m <= MAX_SIGMA_M {
            sigma_m
        } else {
            f64::INFINITY
        }
    }
}

impl Grid {
    /// The grid that contains most of the observed points; `None` if there are none.
    fn around(keyframes: &[PosedDepth]) -> Option<Self> {
        let n_points: usize = keyframes
            .iter()
            .map(|keyframe| keyframe.depth.depth_m.len())
            .sum();
        let stride = n_points.div_ceil(MAX_SAMPLES).max(1);
        let sample: Vec<Point3<f64>> = keyframes
            .iter()
            .flat_map(|keyframe| points(&keyframe.depth))
            .step_by(stride)
            .collect();
        let mut min_m: Vector3<f64> = Vector3::zeros();
        let mut extent_m: Vector3<f64> = Vector3::zeros();
        for axis in 0..3 {
            let low = quantile_along(&sample, axis, QUANTILES[0])?;
            let high = quantile_along(&sample, axis, QUANTILES[1])?;
            let margin = MARGIN_FRAC * (high - low);
            min_m[axis] = low - margin;
            extent_m[axis] = high - low + 2.0 * margin;
        }
        let cell_m = extent_m.max() / f64::from(MAX_CELLS);
        // All points may coincide, for example in a picture of a single pixel.
        if !(cell_m.is_finite() && cell_m > 0.0) {
            return None;
        }
        let n_cells =
            [0, 1, 2].map(|axis| ((extent_m[axis] / cell_m).ceil() as u32).clamp(1, MAX_CELLS));
        Some(Self {
            min_m,
            cell_m,
            n_cells,
        })
    }

    /// Index of the cell that contains a point.
    fn index(&self, point: &Point3<f64>) -> Option<usize> {
        let position = (point.coords - self.min_m) / self.cell_m;
        self.index_of([0, 1, 2].map(|axis| position[axis].floor() as i64))
    }

    fn index_of(&self, [x, y, z]: [i64; 3]) -> Option<usize> {
        let [nx, ny, nz] = self.n_cells.map(i64::from);
        let is_inside = (0..nx).contains(&x) && (0..ny).contains(&y) && (0..nz).contains(&z);
        is_inside.then_some((x + nx * (y + ny * z)) as usize)
    }

    /// Indices of a cell and of those around it.
    fn with_neighbors(&self, ix: usize) -> impl Iterator<Item = usize> {
        let [nx, ny, _] = self.n_cells.map(|n| n as usize);
        let center = [ix % nx, ix / nx % ny, ix / nx / ny].map(|at| at as i64);
        let offsets = (0..27).map(|n| [n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1]);
        offsets.filter_map(move |offset| {
            self.index_of([0, 1, 2].map(|axis| center[axis] + offset[axis]))
        })
    }
}

/// Quantile of one coordinate of points; `None` without points.
fn quantile_along(points: &[Point3<f64>], axis: usize, frac: f64) -> Option<f64> {
    let mut coordinates: Vec<f64> = points.iter().map(|point| point[axis]).collect();
    quantile(&mut coordinates, frac, Rank::Upper)
}

/// The points of a depth map in world.
fn points(depth: &DepthMap) -> impl Iterator<Item = Point3<f64>> {
    let width = depth.size_px[0];
    // 0 marks unknown depth. A model may render an infinite one.
    let readings = depth
        .depth_m
        .iter()
        .zip(0_u32..)
        .filter(|(z_m, _)| **z_m > 0.0 && z_m.is_finite());
    readings.map(move |(z_m, ix)| {
        depth.world_from_camera * Point3::from(depth.point(ix % width, ix / width, f64::from(*z_m)))
    })
}

/// Gives each cell the newest age and the smallest deviation of its neighbors, too. Otherwise, a
/// surface along a boundary between cells would get alternating values, and cells between sparse
/// rays would have no values.
fn extended(grid: &Grid, observed: &[ObservedCell]) -> Vec<ObservedCell> {
    let mut merged = SparseCells::new(grid);
    for cell in observed {
        for ix in grid.with_neighbors(cell.ix) {
            let neighbor = merged.entry(ix, || ObservedCell { ix, ..*cell });
            neighbor.age_secs = neighbor.age_secs.min(cell.age_secs);
            neighbor.sigma_m = neighbor.sigma_m.min(cell.sigma_m);
        }
    }
    merged.cells.into_iter().map(|(_, cell)| cell).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use kinematics::Transform;
    use nalgebra::UnitQuaternion;

    const SIZE_PX: [u32; 2] = [64, 48];
    const FOCAL_PX: f64 = 60.0;

    /// A camera at `eye` that looks at the point (0, 2, 0), in front of a wall at y = 2.
    fn view(secs: i64, eye: [f64; 3], is_measured: bool) -> PosedDepth {
        let eye = Point3::from(eye);
        let forward = Point3::new(0.0, 2.0, 0.0) - eye;
        let rotation = UnitQuaternion::face_towards(&forward, &-Vector3::z());
        let world_from_camera = Transform::from_parts(eye.coords.into(), rotation);
        let principal_px = SIZE_PX.map(|size| f64::from(size) / 2.0);
        let mut depth = DepthMap {
            size_px: SIZE_PX,
            focal_px: [FOCAL_PX; 2],
            principal_px,
            depth_m: vec![1.0; (SIZE_PX[0] * SIZE_PX[1]) as usize].into(),
            world_from_camera,
        };
        let depth_to_wall = |at_1_m: Point3<f64>| ((2.0 - eye.y) / (at_1_m.y - eye.y)) as f32;
        depth.depth_m = points(&depth).map(depth_to_wall).collect();
        PosedDepth {
            stamp: Stamp(secs * 1_000_000_000),
            depth,
            pixel_rad: 1.0 / 600.0,
            is_measured,
        }
    }

    /// The map's entry for the cell that contains a point.
    fn at(map: &ObservationMap, point: [f64; 3]) -> Option<ObservedCell> {
        let grid = Grid {
            min_m: map.min_m.into(),
            cell_m: map.cell_m,
            n_cells: map.n_cells,
        };
        let ix = grid.index(&Point3::from(point))?;
        map.observed.iter().find(|cell| cell.ix == ix).copied()
    }

    #[test]
    fn each_point_has_the_age_of_its_last_view() {
        let views = [
            view(1, [-1.5, 0.0, 0.0], true),
            view(11, [1.5, 0.0, 0.0], true),
        ];
        let map = map_of(&views).expect("points");
        assert!(map.n_cells.iter().all(|n| *n <= MAX_CELLS) && map.n_cells.contains(&MAX_CELLS));
        // Each camera sees farther on the other side of the wall than on its own.
        let in_common = at(&map, [0.0, 2.0, 0.0]).expect("observed");
        assert!(in_common.age_secs.abs() < 1e-9, "{in_common:?}");
        let far_sides = [-2.0, 2.0].map(|x| at(&map, [x, 2.0, 0.0]).map(|cell| cell.age_secs));
        let seen_by = |x: f64| {
            views
                .iter()
                .rev()
                .find(|view| sees(view, [x, 2.0, 0.0]))
                .map(|view| view.stamp.0)
        };
        for (x, age_secs) in [-2.0, 2.0].into_iter().zip(far_sides) {
            assert_eq!(
                age_secs,
                seen_by(x).map(|stamp| (11e9 - stamp as f64) * 1e-9),
                "{x}"
            );
        }
        assert!(far_sides[0] != far_sides[1]);
        assert_eq!(
            at(&map, [0.0, 0.5, 0.0]),
            None,
            "empty space is not observed"
        );
    }

    /// Whether a point is inside the image of a view.
    fn sees(view: &PosedDepth, point: [f64; 3]) -> bool {
        let in_camera = view.depth.world_from_camera.inverse() * Point3::from(point);
        (0..2).all(|axis| {
            let pixel = FOCAL_PX * in_camera[axis] / in_camera.z + view.depth.principal_px[axis];
            pixel > 0.0 && pixel < f64::from(SIZE_PX[axis])
        })
    }

    #[test]
    fn measured_depth_determines_the_position() {
        let map = map_of(&[view(0, [0.0, 0.0, 0.0], true)]).expect("points");
        // Along the ray, 2 mm at 1 m are 8 mm at 2 m; across it, one pixel is 2 m / 600.
        let cell = at(&map, [0.0, 2.0, 0.0]).expect("observed");
        assert!((cell.sigma_m - 0.008).abs() < 2e-4, "{cell:?}");
    }

    #[test]
    fn images_alone_need_two_directions() {
        let one = map_of(&[view(0, [0.0, 0.0, 0.0], false)]).expect("points");
        assert_eq!(
            at(&one, [0.0, 2.0, 0.0]).map(|cell| cell.sigma_m),
            Some(f64::INFINITY)
        );
        let repeated = map_of(&vec![view(0, [0.0, 0.0, 0.0], false); 9]).expect("points");
        assert_eq!(
            at(&repeated, [0.0, 2.0, 0.0]).map(|cell| cell.sigma_m),
            Some(f64::INFINITY)
        );
        // With two rays at right angles, the standard deviation is one pixel in both directions of
        // their plane.
        let across = map_of(&[
            view(0, [-2.0, 0.0, 0.0], false),
            view(1, [2.0, 0.0, 0.0], false),
        ])
        .expect("points");
        let pixel_m = 8.0_f64.sqrt() / 600.0;
        let cell = at(&across, [0.0, 2.0, 0.0]).expect("observed");
        assert!(
            (cell.sigma_m / pixel_m - 1.0).abs() < 0.03,
            "{} instead of {pixel_m}",
            cell.sigma_m
        );
        // A short baseline of b at distance z gives z / b times sqrt(2) pixels.
        let near = map_of(&[
            view(0, [-0.1, 0.0, 0.0], false),
            view(1, [0.1, 0.0, 0.0], false),
        ])
        .expect("points");
        let expected = 2.0 / 0.2 * 2.0_f64.sqrt() * 2.0 / 600.0;
        let cell = at(&near, [0.0, 2.0, 0.0]).expect("observed");
        assert!(
            (cell.sigma_m / expected - 1.0).abs() < 0.05,
            "{} instead of {expected}",
            cell.sigma_m
        );
    }

    #[test]
    fn views_without_points_give_no_map() {
        assert_eq!(map_of(&[]), None);
        let mut empty = view(0, [0.0; 3], true);
        empty.depth.depth_m = vec![0.0; empty.depth.depth_m.len()].into();
        assert_eq!(map_of(&[empty]), None);
    }
}
