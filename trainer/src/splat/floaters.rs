//! Finds small parts of a splat model that are not connected to its large parts.
//!
//! Space is divided into cells. A cell is occupied if its splats, together, are about half opaque.
//! Groups of adjacent occupied cells are the parts of the model. A splat that is half opaque also
//! connects the cells that it covers. Splats that are too faint to occupy a cell are also floaters,
//! unless they are next to a large part.

use super::bounds::bounds;
use crate::Bounds;
use crate::floaters::{CellLabels, CellMask, Floaters, Groups};
use model_files::edits::CellGrid;
use model_files::splat::arrays::SplatArrays;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use numbers::f32_of;

/// Number of cells along an axis. Within the radius of the scene, the width of a cell is 2 % of the
/// radius. Smaller cells would separate parts that are only loosely connected, such as thin
/// objects. Larger cells would join floaters to nearby surfaces.
const N_CELLS: u32 = 200;
/// Sum of opacities above which a cell is occupied.
const MIN_CELL_OPACITY: f32 = 0.5;
/// Splats cover cells up to this many standard deviations, where 14 % of the opacity is left.
const REACH: f64 = 2.0;
/// Maximum number of sampled points of one splat. It bounds the time that a single huge splat can
/// take.
const MAX_SAMPLES: f64 = 16_384.0;
/// Maximum number of sampled points of all splats. They take some seconds on one core.
const MAX_TOTAL_SAMPLES: f64 = 5e7;

/// The small parts of a splat model. `None` if there are none.
pub(super) fn floaters(splats: &SplatArrays) -> Option<Floaters> {
    let Bounds {
        center_m, radius_m, ..
    } = bounds(splats)?;
    let grid = CellGrid {
        center_m,
        radius_m,
        n_cells: N_CELLS,
    };
    let visible: Vec<usize> = splats.visible().into_iter().map(|ix| ix as usize).collect();
    let (occupied, connected) = occupied(splats, &visible, &grid);
    let mut labels = CellLabels::of_occupied(&grid, &occupied, connected);
    labels.keep_around(&grid);
    // Splats that are too faint to occupy a cell belong to no part. They are floaters unless they
    // are next to a large part.
    let mean_m = |ix: usize| splats.means[ix].map(f64::from);
    let cells = visible.iter().map(|ix| grid.cell_at(mean_m(*ix)));
    labels
        .floating
        .extend(cells.filter(|cell| !labels.kept.contains(*cell)));
    let cells = labels.erased(&grid)?;
    let n_erased = visible
        .iter()
        .filter(|ix| cells.contains(mean_m(**ix)))
        .count() as u64;
    (n_erased > 0).then_some(Floaters {
        cells,
        n_erased,
        item: "splat",
    })
}

/// The occupied cells, and the cells that opaque splats connect. Large splats also cover cells
/// between their points.
fn occupied(splats: &SplatArrays, visible: &[usize], grid: &CellGrid) -> (CellMask, Groups) {
    let steps: Vec<[f64; 3]> = visible
        .iter()
        .map(|ix| n_steps(splats, *ix, grid))
        .collect();
    // Large models with many large splats would take minutes. The largest splats are therefore
    // sampled more coarsely. This affects the result least, because they still have many points.
    let mut max_samples = MAX_SAMPLES;
    while max_samples > 1.0 && n_samples_of_all(&steps, max_samples) > MAX_TOTAL_SAMPLES {
        max_samples /= 2.0;
    }
    let mut opacities = vec![0.0_f32; grid.n()];
    // For each cell, the last splat that covers it, counted from 1. With this number, each splat
    // counts only once per cell.
    let mut last_splat = vec![0_u32; grid.n()];
    let mut connected = Groups::new(grid.n());
    for (number, (&ix, steps)) in (1..).zip(visible.iter().zip(&steps)) {
        let opacity = splats.opacity(ix);
        let center = grid.cell_at(splats.means[ix].map(f64::from));
        for (point_m, falloff) in samples(splats, ix, &limited(steps, max_samples)) {
            let cell = grid.cell_at(point_m);
            // The points nearest to the center come first, so a cell gets the highest opacity of a
            // splat's points in it. Several points of the same splat in one cell must not add up.
            if std::mem::replace(&mut last_splat[cell as usize], number) != number {
                opacities[cell as usize] += f32_of(falloff * opacity);
                // A faint splat that spans a gap, such as haze, must not connect both sides.
                if opacity >= MIN_CELL_OPACITY.into() {
                    connected.join(center, cell);
                }
            }
        }
    }
    let is_occupied = |(_, opacity): &(u32, &f32)| **opacity >= MIN_CELL_OPACITY;
    let mut occupied = CellMask::none(grid);
    occupied.extend(
        (0..)
            .zip(&opacities)
            .filter(is_occupied)
            .map(|(cell, _)| cell),
    );
    (occupied, connected)
}

/// For each axis of a splat, the number of steps of about a cell from its center to its end.
fn n_steps(splats: &SplatArrays, ix: usize, grid: &CellGrid) -> [f64; 3] {
    let cell_m = grid.cell_m(splats.means[ix].map(f64::from));
    splats.log_scales[ix].map(|log_scale| (REACH * f64::from(log_scale).exp() / cell_m).round())
}

/// Number of points of a splat with these numbers of steps per axis.
fn n_samples(steps: &[f64; 3]) -> f64 {
    steps.iter().map(|n| 2.0 * n + 1.0).product()
}

/// Number of points of all splats, each of which has at most `max` points.
fn n_samples_of_all(steps: &[[f64; 3]], max: f64) -> f64 {
    steps
        .iter()
        .map(|steps| n_samples(steps).min(max))
        .sum::<f64>()
}

/// The steps of a splat. They are reduced if the splat has more than `max_samples` points.
fn limited(steps: &[f64; 3], max_samples: f64) -> [f64; 3] {
    // The excess is divided evenly among the axes along which the splat extends beyond a cell. For
    // example, a flat splat has only two of these axes and needs the square root.
    let n_axes = steps.iter().filter(|n| **n > 0.0).count().max(1);
    let factor = (max_samples / n_samples(steps))
        .min(1.0)
        .powf(1.0 / n_axes as f64);
    steps.map(|n| ((factor * (2.0 * n + 1.0) - 1.0) / 2.0).floor().max(0.0))
}

/// Points of a splat in world coordinates, meters, and the falloff of opacity at these points.
/// Along each axis, points near the center of the splat come first.
fn samples(
    splats: &SplatArrays,
    ix: usize,
    steps: &[f64; 3],
) -> impl Iterator<Item = ([f64; 3], f64)> + use<> {
    let [w, x, y, z] = splats.rotations_wxyz[ix].map(f64::from);
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let deviations_m = splats.log_scales[ix].map(|log_scale| f64::from(log_scale).exp());
    let mean_m = Vector3::from(splats.means[ix].map(f64::from));
    let [xs, ys, zs] = steps.map(offsets);
    let offsets = zs.into_iter().flat_map(move |z| {
        let xs = xs.clone();
        ys.clone()
            .into_iter()
            .flat_map(move |y| xs.clone().into_iter().map(move |x| [x, y, z]))
    });
    offsets.map(move |offset| {
        let in_splat = Vector3::from(std::array::from_fn::<f64, 3, _>(|axis| {
            offset[axis] * deviations_m[axis]
        }));
        let squared: f64 = offset
            .iter()
            .map(|deviations| deviations * deviations)
            .sum();
        (
            (mean_m + rotation * in_splat).into(),
            (-0.5 * squared).exp(),
        )
    })
}

/// Positions along an axis of a splat, in standard deviations. The first position is 0, and the
/// others alternate between both sides.
fn offsets(n_steps: f64) -> Vec<f64> {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small whole number"
    )]
    let n = n_steps as u32;
    let both = |step: u32| [1.0, -1.0].map(|sign| sign * REACH * f64::from(step) / n_steps);
    std::iter::once(0.0).chain((1..=n).flat_map(both)).collect()
}
