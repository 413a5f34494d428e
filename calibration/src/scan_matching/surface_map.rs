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
/// Maximum number of cells of a grid, which bounds the memory to about 0.5 GB. A grid with more cells
/// keeps the half of them that was seen last.
const MAX_CELLS: usize = 200_000;

/// Surfaces that were seen so far: planes in the cells of several grids.
#[derive(Debug)]
pub(super) struct SurfaceMap {
    sensor: RangeSensor,
    grids: Vec<Grid>,
    n_scans: u64,
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
            n_scans: 0,
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
    fn plane_at(&self, point: &Point3<f64>) -> Option<([i32; 3], &Cell, &Plane, f64)> {
        let key = self.key(point);
        let cell = self.cells.get(&key)?;
        let plane = cell.plane()?;
        let offset = plane.distance_m(&self.center(key)).abs() / self.side_m;
        (offset <= MAX_OFFSET).then_some((key, cell, plane, offset))
    }

    /// Forgets the cells that were not seen for the longest time, if there are more than this
    /// number.
    fn forget_oldest(&mut self, max_cells: usize) {
        if self.cells.len() <= max_cells {
            return;
        }
        let mut seen_at: Vec<u64> = self.cells.values().map(Cell::seen_at).collect();
        seen_at.sort_unstable();
        // If more than half of the cells were last seen at the same time, they are forgotten
        // together.
        let [oldest, median] = [seen_at[0], seen_at[seen_at.len() / 2]];
        let oldest_kept = median.max(oldest + 1);
        self.cells.retain(|_, cell| cell.seen_at() >= oldest_kept);
    }
}

/// A plane of the map near a point.
pub(super) struct NearPlane {
    pub(super) cell: CellId,
    pub(super) plane: Plane,
    /// Segment of the path from which the plane was first seen.
    pub(super) segment: usize,
}

impl SurfaceMap {
    /// Whether nothing was added yet.
    pub(super) fn is_empty(&self) -> bool {
        self.grids.iter().all(|grid| grid.cells.is_empty())
    }

    /// Adds the points of a scan in the world frame, meters.
    ///
    /// * `segment`: the part of the path on which the scan was made.
    pub(super) fn add(&mut self, points: &[Point3<f64>], segment: usize) {
        let scan_ix = self.n_scans;
        self.n_scans += 1;
        for grid in &mut self.grids {
            let mut changed = Vec::new();
            for point in points {
                let key = grid.key(point);
                let center = grid.center(key);
                let cell = grid.cells.entry(key).or_insert_with(|| Cell::new(segment));
                cell.add(&(point - center), scan_ix);
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
            grid.forget_oldest(MAX_CELLS);
        }
    }

    /// The plane near a point, from the largest cells that have one.
    pub(super) fn plane_at(&self, point: &Point3<f64>) -> Option<NearPlane> {
        let mut grids = self.grids.chunks(N_GRIDS).enumerate();
        grids.find_map(|(level, grids)| {
            let found = grids.iter().enumerate().filter_map(|(ix, grid)| {
                let (key, cell, plane, offset) = grid.plane_at(point)?;
                let grid = level * N_GRIDS + ix;
                let near = NearPlane {
                    cell: CellId { grid, key },
                    plane: *plane,
                    segment: cell.segment(),
                };
                Some((near, offset))
            });
            let nearest = found.min_by(|a, b| a.1.total_cmp(&b.1));
            nearest.map(|(near, _)| near)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_that_were_not_seen_for_long_are_forgotten() {
        let mut map = SurfaceMap::new(RangeSensor::Scanner);
        let wall = |x: f64| -> Vec<Point3<f64>> {
            (0..400)
                .map(|ix| Point3::new(x, 0.05 * f64::from(ix % 20), 0.05 * f64::from(ix / 20)))
                .collect()
        };
        let walls = [0.05, 40.05].map(wall);
        for (segment, points) in walls.iter().enumerate() {
            map.add(points, segment);
        }
        let segments = |map: &SurfaceMap| {
            [&walls[0], &walls[1]].map(|points| Some(map.plane_at(&points[210])?.segment))
        };
        assert_eq!(segments(&map), [Some(0), Some(1)]);
        for grid in &mut map.grids {
            let n_cells = grid.cells.len();
            grid.forget_oldest(n_cells);
            assert_eq!(grid.cells.len(), n_cells);
            grid.forget_oldest(n_cells - 1);
        }
        assert_eq!(segments(&map), [None, Some(1)]);
    }
}
