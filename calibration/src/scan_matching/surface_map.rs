//! A map of the surfaces that range scans have measured.

use super::RangeSensor;
use super::cells::{Cell, Plane};
use nalgebra::Point3;
use rustc_hash::FxHashMap;

/// Two grids per side. The second one is moved by half a cell. A plane near the boundary of a cell
/// is divided between two cells, and each of them would get a wrong plane. In one of both grids, the
/// plane is in the middle of the cells.
const N_GRIDS: usize = 2;
/// Maximum distance of a plane from the center of its cell, relative to the side of the cell.
const MAX_OFFSET: f64 = 0.3;

/// Surfaces that were seen so far: planes in the cells of several grids.
#[derive(Debug)]
pub(super) struct SurfaceMap {
    sensor: RangeSensor,
    grids: Vec<Grid>,
}

#[derive(Debug)]
struct Grid {
    side_m: f64,
    /// Offset of the corner of cell 0, meters.
    origin_m: f64,
    cells: FxHashMap<[i32; 3], Cell>,
}

/// A cell of the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct CellId {
    grid: usize,
    key: [i32; 3],
}

impl SurfaceMap {
    /// An empty map for the points of a sensor.
    pub(super) fn new(sensor: RangeSensor) -> Self {
        let grids = sensor
            .cell_sides_m()
            .into_iter()
            .flat_map(|side_m| (0..N_GRIDS).map(move |shift| (side_m, shift)));
        Self {
            sensor,
            grids: grids
                .map(|(side_m, shift)| Grid {
                    side_m,
                    origin_m: side_m * shift as f64 / N_GRIDS as f64,
                    cells: FxHashMap::default(),
                })
                .collect(),
        }
    }

    /// The sensor whose points the map contains.
    pub(super) fn sensor(&self) -> RangeSensor {
        self.sensor
    }
}

impl Grid {
    fn key(&self, point: &Point3<f64>) -> [i32; 3] {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "a cast saturates, and no map is larger than 2^31 cells"
        )]
        [0, 1, 2].map(|axis| ((point[axis] - self.origin_m) / self.side_m).floor() as i32)
    }

    fn center(&self, key: [i32; 3]) -> Point3<f64> {
        Point3::from(key.map(|ix| self.origin_m + (f64::from(ix) + 0.5) * self.side_m))
    }

    /// The plane of the cell that contains a point, and its offset from the center of the cell.
    fn plane_at(&self, point: &Point3<f64>) -> Option<([i32; 3], &Plane, f64)> {
        let key = self.key(point);
        let plane = self.cells.get(&key)?.plane()?;
        let offset = plane.distance_m(&self.center(key)).abs() / self.side_m;
        (offset <= MAX_OFFSET).then_some((key, plane, offset))
    }
}

impl SurfaceMap {
    /// Whether nothing was added yet.
    pub(super) fn is_empty(&self) -> bool {
        self.grids.iter().all(|grid| grid.cells.is_empty())
    }

    /// Adds points in the world frame, meters.
    pub(super) fn add(&mut self, points: &[Point3<f64>]) {
        for grid in &mut self.grids {
            let mut changed = Vec::new();
            for point in points {
                let key = grid.key(point);
                let center = grid.center(key);
                grid.cells.entry(key).or_default().add(&(point - center));
                changed.push(key);
            }
            changed.sort_unstable();
            changed.dedup();
            for key in changed {
                let center = grid.center(key);
                if let Some(cell) = grid.cells.get_mut(&key) {
                    cell.refresh(&center, self.sensor.noise_m());
                }
            }
        }
    }

    /// The plane near a point, from the largest cells that have one.
    pub(super) fn plane_at(&self, point: &Point3<f64>) -> Option<(CellId, Plane)> {
        let mut grids = self.grids.chunks(N_GRIDS).enumerate();
        grids.find_map(|(level, grids)| {
            let found = grids.iter().enumerate().filter_map(|(ix, grid)| {
                let (key, plane, offset) = grid.plane_at(point)?;
                let grid = level * N_GRIDS + ix;
                Some((CellId { grid, key }, *plane, offset))
            });
            let nearest = found.min_by(|a, b| a.2.total_cmp(&b.2));
            nearest.map(|(id, plane, _)| (id, plane))
        })
    }
}
