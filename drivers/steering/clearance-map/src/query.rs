//! Answers: distances and ages at points, from a version of the map and the robot's volume.

use crate::block::{BLOCK_CELLS, CELL_VOXELS, NEVER};
use crate::capsules::{GridCapsule, in_grid};
use crate::config::{BLOCK_VOXELS, MapConfig};
use crate::grid::{Grid, floor};
use crate::rows::{BUNDLE, Obstacles, Rows};
use crate::snapshot::Snapshot;
use kinematics::{Stamp, Transform};
use nalgebra::{Point3, Vector3};
use std::ops::RangeInclusive;
use std::sync::Arc;
use steering::{Capsule, Seen};

/// Motion of the robot in voxels up to which the voxels inside of it are not computed again.
const MAX_MOTION: f32 = 0.1;

/// The robot now.
#[derive(Clone, Debug)]
pub(crate) struct Robot {
    pub(crate) stamp: Stamp,
    pub(crate) capsules: Vec<Capsule>,
    pub(crate) world_from_base: Transform,
    /// Lowest and highest height of obstacles in the frame of the base, meters; `None` for all.
    pub(crate) heights_m: Option<[f64; 2]>,
}

/// A version of the map without the robot, and the tables for searches.
#[derive(Debug)]
pub(crate) struct Query {
    snapshot: Arc<Snapshot>,
    robot: Option<Robot>,
    in_grid: Vec<GridCapsule>,
    rows: Rows,
    /// The robot that is cleared in the rows.
    cleared: Vec<GridCapsule>,
    is_outdated: bool,
    /// Offsets of bundles in y and z, by distance.
    offsets: Vec<Offset>,
    /// Largest distance, voxels.
    max_distance: f32,
}

/// Position of a bundle relative to that of a point.
#[derive(Clone, Copy, Debug)]
struct Offset {
    y: isize,
    z: isize,
    /// Smallest squared distance from any point of the central bundle.
    min_squared: f32,
}

/// A point between voxels.
struct Around {
    point: Vector3<f32>,
    /// The voxel of the point.
    voxel: [usize; 3],
    /// Position in this voxel along x, from 0 to 1.
    frac_x: f32,
}

impl Query {
    pub(crate) fn new(config: &MapConfig, snapshot: Arc<Snapshot>, obstacles: Obstacles) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "inner loops use f32")]
        let max_distance = (config.max_distance_m / config.voxel_m) as f32;
        Self {
            rows: Rows::new(&snapshot, obstacles),
            snapshot,
            robot: None,
            in_grid: Vec::new(),
            cleared: Vec::new(),
            is_outdated: false,
            offsets: offsets(max_distance),
            max_distance,
        }
    }

    pub(crate) fn set_snapshot(&mut self, snapshot: Arc<Snapshot>) {
        if !Arc::ptr_eq(&snapshot, &self.snapshot) {
            self.snapshot = snapshot;
            self.rows.set_map(&self.snapshot);
            self.cleared.clear();
            self.place_robot();
        }
    }

    pub(crate) fn set_robot(&mut self, robot: Robot) {
        self.robot = Some(robot);
        self.place_robot();
    }

    /// What is known about points in the frame of the base.
    pub(crate) fn readings(
        &mut self,
        points_in_base: &[[f64; 3]],
        now: Stamp,
    ) -> Vec<Option<Seen>> {
        if self.is_outdated {
            self.rows.set_robot(&self.in_grid);
            self.cleared.clone_from(&self.in_grid);
            self.is_outdated = false;
        }
        let world_from_base = self
            .robot
            .as_ref()
            .map_or_else(Transform::identity, |robot| robot.world_from_base);
        let grid = self.snapshot.grid;
        let to_grid = |point: &[f64; 3]| {
            let in_world = world_from_base * Point3::from(*point);
            grid.in_voxels(&in_world.coords).cast::<f32>()
        };
        points_in_base
            .iter()
            .map(|point| self.seen(&to_grid(point), now))
            .collect()
    }

    /// What is known about a point of the grid.
    fn seen(&self, point: &Vector3<f32>, now: Stamp) -> Option<Seen> {
        // A ball around the point with this radius is inside of the robot.
        let in_robot = self
            .in_grid
            .iter()
            .map(|capsule| capsule.depth(point))
            .fold(0.0, f32::max);
        let in_map = self
            .around(point)
            .map_or(0.0, |around| self.distance(&around));
        let distance = in_map.max(in_robot).min(self.max_distance);
        if distance <= 0.0 {
            return None;
        }
        let oldest = self.oldest(point, distance);
        let clock = self.snapshot.clock;
        let age_secs = match (oldest, &self.robot) {
            // Only the robot is there.
            (NEVER, Some(robot)) => now.secs_since(robot.stamp).max(0.0),
            (NEVER, None) => return None,
            (millis, _) => clock.age_secs(millis, now),
        };
        Some(Seen {
            distance_m: f64::from(distance) * self.snapshot.grid.voxel_m,
            age_secs,
        })
    }

    /// The voxel of a point; `None` in the border, which is never seen, and outside.
    fn around(&self, point: &Vector3<f32>) -> Option<Around> {
        let border = self.max_distance + BLOCK_VOXELS as f32;
        let end = self.snapshot.grid.side() as f32 - border;
        if !point.iter().all(|x| *x >= border && *x < end) {
            return None;
        }
        let voxel = [floor(point.x), floor(point.y), floor(point.z)];
        Some(Around {
            point: *point,
            voxel,
            frac_x: point.x - point.x.floor(),
        })
    }

    /// Distance to the closest voxel that is not free, at most the maximum, voxels.
    fn distance(&self, around: &Around) -> f32 {
        let mut best = self.max_distance * self.max_distance;
        let [_, y, z] = around.voxel.map(|voxel| voxel / BUNDLE);
        for offset in &self.offsets {
            if offset.min_squared >= best {
                break;
            }
            let (y, z) = (
                y.wrapping_add_signed(offset.y),
                z.wrapping_add_signed(offset.z),
            );
            let gap_y = gap(around.point.y, y * BUNDLE, BUNDLE);
            let gap_z = gap(around.point.z, z * BUNDLE, BUNDLE);
            let row = self.rows.bundle_row(y, z);
            if gap_y * gap_y + gap_z * gap_z >= best
                || self.window(self.rows.bundles(), row, around.voxel[0]) == 0
            {
                continue;
            }
            best = self.distance_in_bundle(around, [y, z], best);
        }
        best.sqrt()
    }

    /// The smaller one of `best` and the squared distance to the rows of a bundle.
    fn distance_in_bundle(&self, around: &Around, [y, z]: [usize; 2], mut best: f32) -> f32 {
        for z in z * BUNDLE..(z + 1) * BUNDLE {
            let gap_z = gap(around.point.z, z, 1);
            for y in y * BUNDLE..(y + 1) * BUNDLE {
                let gap_y = gap(around.point.y, y, 1);
                let across = gap_y * gap_y + gap_z * gap_z;
                if across >= best {
                    continue;
                }
                let row = self.snapshot.grid.row(y, z);
                let window = self.window(self.rows.blocked(), row, around.voxel[0]);
                if window != 0 {
                    let along = self.gap_x(window, around.frac_x);
                    best = best.min(across + along * along);
                }
            }
        }
        best
    }

    /// Number of voxels on each side of a point that are read.
    fn reach(&self) -> usize {
        floor(self.max_distance) + 1
    }

    /// The bits of a row around a voxel, which is at the bit [`Self::reach`].
    fn window(&self, rows: &[u8], row: usize, x: usize) -> u64 {
        let reach = self.reach();
        let first = x - reach;
        let byte = row + first / BLOCK_VOXELS;
        let mut word = [0; 8];
        word.copy_from_slice(&rows[byte..byte + 8]);
        let window = u64::from_le_bytes(word) >> (first % BLOCK_VOXELS);
        window & ((1 << (2 * reach + 1)) - 1)
    }

    /// Distance along x to the closest set bit of a window that is not zero.
    fn gap_x(&self, window: u64, frac_x: f32) -> f32 {
        let reach = self.reach();
        let right = (window >> reach).trailing_zeros();
        let left = (window << (63 - reach)).leading_zeros();
        if right == 0 {
            return 0.0;
        }
        // The voxel `n` to the right begins `n - frac` after the point. The one to the left ends
        // `n - 1 + frac` before it. Without a set bit on a side, 64 is more than the maximum.
        let to_right = right as f32 - frac_x;
        let to_left = left as f32 - 1.0 + frac_x;
        to_right.min(to_left)
    }

    /// Time of the oldest free voxel in the cells that a ball touches.
    fn oldest(&self, point: &Vector3<f32>, radius: f32) -> u32 {
        let n_cells = self.snapshot.grid.n_blocks * BLOCK_CELLS;
        let radius_squared = radius * radius;
        let mut oldest = NEVER;
        for z in cells(point.z, radius, n_cells) {
            let gap_z = gap(point.z, z * CELL_VOXELS, CELL_VOXELS);
            for y in cells(point.y, radius, n_cells) {
                let gap_y = gap(point.y, y * CELL_VOXELS, CELL_VOXELS);
                let left = radius_squared - gap_y * gap_y - gap_z * gap_z;
                if left < 0.0 {
                    continue;
                }
                let x = cells(point.x, left.sqrt(), n_cells);
                if x.is_empty() {
                    continue;
                }
                let row = self.snapshot.cell(*x.start(), y, z)..=self.snapshot.cell(*x.end(), y, z);
                oldest = self.snapshot.oldest[row]
                    .iter()
                    .copied()
                    .fold(oldest, u32::min);
            }
        }
        oldest
    }

    /// Computes where the robot is in the grid. If it has moved, its volume must be cleared anew.
    fn place_robot(&mut self) {
        let grid = &self.snapshot.grid;
        if let Some(layers) = self.robot.as_ref().and_then(|robot| robot.layers(grid))
            && self.rows.set_layers(layers)
        {
            self.rows.set_map(&self.snapshot);
            self.cleared.clear();
        }
        if let Some(robot) = &self.robot {
            self.in_grid = in_grid(&robot.capsules, &robot.world_from_base, grid, 0.0);
        }
        let moved = |(now, then): (&GridCapsule, &GridCapsule)| now.moved(then) > MAX_MOTION;
        self.is_outdated |= self.in_grid.len() != self.cleared.len()
            || self.in_grid.iter().zip(&self.cleared).any(moved);
    }
}

impl Robot {
    /// The layers of voxels in which obstacles are. A base that walks moves up and down by
    /// millimeters, so the layers are those closest to its heights.
    fn layers(&self, grid: &Grid) -> Option<[usize; 2]> {
        let base = self.world_from_base.translation.vector;
        let layer = |height_m: f64| {
            let up = Vector3::new(0.0, 0.0, height_m);
            #[expect(clippy::cast_possible_truncation, reason = "a layer is a small number")]
            let layer = (grid.in_voxels(&(base + up)).z.max(0.0) + 0.5) as f32;
            floor(layer)
        };
        Some(self.heights_m?.map(layer))
    }
}

/// Distance from a coordinate to an interval of voxels.
fn gap(at: f32, low: usize, length: usize) -> f32 {
    let low = low as f32;
    (low - at).max(at - low - length as f32).max(0.0)
}

/// Cells within a distance of a coordinate.
fn cells(at: f32, distance: f32, n_cells: usize) -> RangeInclusive<usize> {
    let cell = |x: f32| floor((x / CELL_VOXELS as f32).max(0.0));
    cell(at - distance)..=cell(at + distance).min(n_cells - 1)
}

/// Offsets of bundles within the maximum distance of any point of the central one.
fn offsets(max_distance: f32) -> Vec<Offset> {
    let reach = isize::try_from(floor(max_distance / BUNDLE as f32) + 1).unwrap_or(isize::MAX);
    let min_gap = |offset: isize| (offset.unsigned_abs().saturating_sub(1) * BUNDLE) as f32;
    let mut offsets: Vec<Offset> = (-reach..=reach)
        .flat_map(|z| (-reach..=reach).map(move |y| (y, z)))
        .map(|(y, z)| Offset {
            y,
            z,
            min_squared: min_gap(y).powi(2) + min_gap(z).powi(2),
        })
        .collect();
    // Among equal bounds, closer centers are more likely to end the search.
    let key = |offset: &Offset| {
        (
            offset.min_squared,
            (offset.y * offset.y + offset.z * offset.z) as f32,
        )
    };
    offsets.sort_by(|a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
    });
    offsets
}
