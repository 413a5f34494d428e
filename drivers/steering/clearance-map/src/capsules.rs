//! The robot's capsules in the grid: which voxels and points are inside.

use crate::config::BLOCK_VOXELS;
use crate::grid::{Grid, floor};
use kinematics::Transform;
use nalgebra::Vector3;
use std::ops::Range;
use steering::Capsule;

/// A capsule in voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct GridCapsule {
    start: Vector3<f32>,
    along: Vector3<f32>,
    radius: f32,
}

/// Voxels of one row along x whose centers are inside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RowSpan {
    pub(crate) x: Range<usize>,
    pub(crate) y: usize,
    pub(crate) z: usize,
}

impl RowSpan {
    /// The blocks of the row, and the voxels of each: the lowest bit is the first one.
    pub(crate) fn bytes(&self) -> impl Iterator<Item = (usize, u8)> + use<> {
        let Range { start, end } = self.x;
        (start / BLOCK_VOXELS..end.div_ceil(BLOCK_VOXELS)).map(move |byte| {
            let first = byte * BLOCK_VOXELS;
            let low = start.saturating_sub(first);
            let high = (end - first).min(BLOCK_VOXELS);
            (byte, (u8::MAX << low) & (u8::MAX >> (BLOCK_VOXELS - high)))
        })
    }
}

/// Capsules in voxels.
///
/// * `margin_m`: growth of each radius.
pub(crate) fn in_grid(
    capsules_in_base: &[Capsule],
    world_from_base: &Transform,
    grid: &Grid,
    margin_m: f64,
) -> Vec<GridCapsule> {
    let to_grid = |capsule: &Capsule| {
        let in_world = capsule.transformed(world_from_base);
        let [start, end] = in_world.ends.map(|end| grid.in_voxels(&end));
        GridCapsule {
            start: start.cast(),
            along: (end - start).cast(),
            #[expect(clippy::cast_possible_truncation, reason = "inner loops use f32")]
            radius: ((in_world.radius_m + margin_m) / grid.voxel_m) as f32,
        }
    };
    capsules_in_base.iter().map(to_grid).collect()
}

impl GridCapsule {
    /// How far a point is inside; negative outside, voxels.
    pub(crate) fn depth(&self, point: &Vector3<f32>) -> f32 {
        let offset = point - self.start;
        let length_squared = self.along.norm_squared();
        // A segment without length has no direction; its start is the closest point.
        let frac =
            (offset.dot(&self.along) / length_squared.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
        self.radius - (offset - self.along * frac).norm()
    }

    /// The largest motion of an end or change of the radius to another capsule, voxels.
    pub(crate) fn moved(&self, other: &Self) -> f32 {
        let start = self.start - other.start;
        let end = start + self.along - other.along;
        let radius = (self.radius - other.radius).abs();
        start.norm().max(end.norm()).max(radius)
    }

    /// Calls `act` for each row of voxels with centers inside.
    pub(crate) fn rows(&self, side: usize, mut act: impl FnMut(RowSpan)) {
        let end = self.start + self.along;
        // The centers of voxels are at half-integers.
        let span = |axis: usize| {
            let low = self.start[axis].min(end[axis]) - self.radius;
            let high = self.start[axis].max(end[axis]) + self.radius;
            centers_between(low, high, side)
        };
        for z in span(2) {
            for y in span(1) {
                let Some([low, high]) = self.along_x(y as f32 + 0.5, z as f32 + 0.5) else {
                    continue;
                };
                let x = centers_between(low, high, side);
                if !x.is_empty() {
                    act(RowSpan { x, y, z });
                }
            }
        }
    }

    /// The part of a line along x that is inside. A capsule is convex and the union of two spheres
    /// and a cylinder, so this part reaches from the smallest to the largest point on any of them.
    fn along_x(&self, y: f32, z: f32) -> Option<[f32; 2]> {
        let end = self.start + self.along;
        let spheres = [self.start, end].map(|center| self.in_sphere(&center, y, z));
        let pieces = [spheres[0], spheres[1], self.in_cylinder(y, z)];
        pieces
            .into_iter()
            .flatten()
            .reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
    }

    fn in_sphere(&self, center: &Vector3<f32>, y: f32, z: f32) -> Option<[f32; 2]> {
        let off_axis = (y - center.y).powi(2) + (z - center.z).powi(2);
        let half_squared = self.radius * self.radius - off_axis;
        (half_squared >= 0.0).then(|| {
            let half = half_squared.sqrt();
            [center.x - half, center.x + half]
        })
    }

    /// Points `(x, y, z)` whose distance to the axis is at most the radius, between both ends.
    fn in_cylinder(&self, y: f32, z: f32) -> Option<[f32; 2]> {
        /// Below this squared length in voxels, the spheres cover the cylinder.
        const MIN_LENGTH_SQUARED: f32 = 1e-4;
        /// Below this, the axis is parallel to x: rounding would dominate the quotients.
        const PARALLEL: f32 = 1e-5;
        let length_squared = self.along.norm_squared();
        if length_squared < MIN_LENGTH_SQUARED {
            return None;
        }
        let axis = self.along / length_squared.sqrt();
        // The offset of a point of the line from the start is `offset + x * (1, 0, 0)`.
        let offset = Vector3::new(-self.start.x, y - self.start.y, z - self.start.z);
        let along = offset.dot(&axis);
        // The squared distance to the axis is `a x² + 2 b x + c + radius²`.
        let a = 1.0 - axis.x * axis.x;
        let b = offset.x - along * axis.x;
        let c = offset.norm_squared() - along * along - self.radius * self.radius;
        let [mut low, mut high] = [f32::NEG_INFINITY, f32::INFINITY];
        if a > PARALLEL {
            let discriminant = b * b - a * c;
            if discriminant < 0.0 {
                return None;
            }
            let root = discriminant.sqrt();
            [low, high] = [(-b - root) / a, (-b + root) / a];
        } else if c > 0.0 {
            return None;
        }
        // Between both ends: `0 <= along + x * axis.x <= length`.
        let length = length_squared.sqrt();
        if axis.x.abs() > PARALLEL {
            let ends = [-along / axis.x, (length - along) / axis.x];
            low = low.max(ends[0].min(ends[1]));
            high = high.min(ends[0].max(ends[1]));
        } else if along < 0.0 || along > length {
            return None;
        }
        (low <= high && low.is_finite() && high.is_finite()).then_some([low, high])
    }
}

/// Indices of voxels whose centers are in a range, within a side of the grid.
fn centers_between(low: f32, high: f32, side: usize) -> Range<usize> {
    let first = floor((low - 0.5).ceil().max(0.0));
    // The cast saturates at zero, so a range that ends before the grid is empty.
    let end = floor((high + 0.5).floor().max(0.0)).min(side);
    first..end.max(first)
}

/// Which capsules may contain points of a block, so that most points need no test.
#[derive(Clone, Debug, Default)]
pub(crate) struct RobotMask {
    capsules: Vec<GridCapsule>,
    /// For each block, the bit `ix % 64` of each capsule near it.
    near_block: Vec<u64>,
}

impl RobotMask {
    /// Prepares the tests for capsules, whose radii include the margin.
    pub(crate) fn set(&mut self, grid: &Grid, capsules: Vec<GridCapsule>) {
        let n = grid.n_blocks;
        self.near_block.clear();
        self.near_block.resize(n * n * n, 0);
        let block_side = BLOCK_VOXELS as f32;
        // From the center of a block to its corners.
        let half_diagonal = 0.5 * 3.0_f32.sqrt() * block_side;
        for (ix, capsule) in capsules.iter().enumerate() {
            let grown = GridCapsule {
                start: capsule.start / block_side,
                along: capsule.along / block_side,
                radius: (capsule.radius + half_diagonal) / block_side,
            };
            grown.rows(n, |span| {
                let first = grid.block_ix([span.x.start, span.y, span.z]);
                for near in &mut self.near_block[first..first + span.x.len()] {
                    *near |= 1 << (ix % 64);
                }
            });
        }
        self.capsules = capsules;
    }

    /// Whether a point in voxels, in a block, is inside a capsule.
    pub(crate) fn contains(&self, point: &Vector3<f32>, block_ix: usize) -> bool {
        let mut near = self.near_block[block_ix];
        while near != 0 {
            let first = near.trailing_zeros() as usize;
            let mut others = self.capsules.iter().skip(first).step_by(64);
            if others.any(|capsule| capsule.depth(point) >= 0.0) {
                return true;
            }
            near &= near - 1;
        }
        false
    }
}
