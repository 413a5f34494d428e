//! What depth tells about where something is, before anything is learned.

use super::extent::Extent;
use super::reference::march::March;
use crate::DepthMap;
use std::collections::BTreeSet;

/// What is told of a cell, as in `hint_cells.wgsl`.
const LOOKED_AT_WITHOUT_END: u32 = 0;
const LOOKED_THROUGH: u32 = 1 << 30;
const SURFACE: u32 = 2 << 30;
/// Where rays that meet nothing end, in units of the scene's radius.
const NOWHERE: f64 = 50.0;
/// Share of the distance that a reading may be off by: so far in front of it nothing is taken for free.
const OFF_FRAC: f64 = 0.03;

/// Cells that an image looks at or through.
#[derive(Debug, Default)]
struct Cells {
    without_end: BTreeSet<u32>,
    free: BTreeSet<u32>,
    surfaces: BTreeSet<u32>,
}

/// What a depth image tells about cells, each told once.
pub(crate) fn hints(depth: &DepthMap, extent: &Extent, march: &March) -> Vec<u32> {
    let cell_m = 4.0 * extent.radius_m / march.n_cells as f64;
    // Rays that are half a cell apart a radius away.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
    let stride = (0.5 * cell_m / extent.radius_m * depth.focal_px[0]).clamp(1.0, 16.0) as u32;
    let mut cells = Cells::default();
    let origin = extent.in_units(&depth.world_from_camera).translation.vector.into();
    let [width, height] = depth.size_px;
    for y in (0..height).step_by(stride as usize) {
        for x in (0..width).step_by(stride as usize) {
            let along = depth.point(x, y, 1.0);
            let z_m = f64::from(depth.depth_m[(y * width + x) as usize]);
            let reading_m = if z_m.is_finite() && z_m > 0.0 { z_m * along.norm() } else { 0.0 };
            let direction = (depth.world_from_camera.rotation * along.normalize()).into();
            cells.walk(march, (origin, direction), reading_m / extent.radius_m);
        }
    }
    let Cells { without_end, free, surfaces } = cells;
    let free = free.difference(&surfaces).map(|cell| cell | LOOKED_THROUGH);
    let without_end = without_end.into_iter().map(|cell| cell | LOOKED_AT_WITHOUT_END);
    without_end.chain(free).chain(surfaces.iter().map(|cell| cell | SURFACE)).collect()
}

impl Cells {
    /// Follows a ray to its reading; to nowhere where that is 0.
    fn walk(&mut self, march: &March, (origin, direction): ([f64; 3], [f64; 3]), distance: f64) {
        let point = |t: f64| std::array::from_fn(|axis| origin[axis] + t * direction[axis]);
        let cell = |t: f64| u32::try_from(march.cell(point(t)).0).expect("fewer cells than a u32 counts");
        let width = |t: f64| 4.0 / march.n_cells as f64 * march.step_at(point(t)) / march.step;
        let is_open = distance == 0.0;
        let end = if is_open { NOWHERE } else { distance * (1.0 - OFF_FRAC) - width(distance) };
        let passed = if is_open { &mut self.without_end } else { &mut self.free };
        let mut t = 0.0;
        while t < end {
            passed.insert(cell(t));
            t += 0.5 * width(t);
        }
        if !is_open {
            let around = [-1.0, -0.5, 0.0, 0.5, 1.0].map(|part| (distance + part * width(distance)).max(0.0));
            self.surfaces.extend(around.map(cell));
        }
    }
}
