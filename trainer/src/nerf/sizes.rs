//! Sizes of a field, limited by the resolution of its images.

use super::extent::{Extent, pixel_size_m};
use super::options::{NerfBudget, NerfOptions};
use super::reference::grid::GridShape;
use crate::Error;
use crate::model_options::ModelOptions;
use keyframe::{DepthMap, Keyframe};
use serde::{Deserialize, Serialize};

/// Cells of the coarsest level along an axis, as in Mueller et al. 2022, table 1.
const N_CELLS_COARSEST: u32 = 16;
/// Ratio of the resolutions of adjacent levels. With a larger ratio, fewer levels are needed to
/// reach the finest cells, but structures between two levels are represented worse.
const LEVEL_GROWTH: f64 = 1.5;
/// Width of the finest cells in pixels. Finer cells would fit noise.
const PIXELS_PER_CELL: f64 = 1.5;
/// Pixels of an image per entry of a level. Images overlap, and surfaces occupy few cells of a
/// level.
const PIXELS_PER_ENTRY: f64 = 0.5;
/// Limits of the number of levels. Mueller et al. 2022 use 16. Each level adds a lookup of eight
/// corners per sample.
pub(crate) const MIN_LEVELS: u32 = 4;
pub(crate) const MAX_LEVELS: u32 = 16;
/// The coarsest level has 17^3 corners, about 2^12. With fewer entries, even this level would have
/// many collisions.
const MIN_LOG2_ENTRIES: u32 = 12;
/// Bytes per entry, for the entry, its gradients and its moments.
const BYTES_PER_ENTRY: u64 = 8 + 8 + MOMENT_BYTES_PER_ENTRY;
const MOMENT_BYTES_PER_ENTRY: u64 = 16;

/// All sizes of a field and of its batches.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Sizes {
    /// Cells of each level along an axis.
    pub(crate) n_cells: Vec<u32>,
    pub(crate) log2_entries: u32,
    /// Whether there is depth to initialize the occupancy from.
    pub(crate) has_depth: bool,
    /// Whether the occupancy cells are refined during training.
    #[serde(default)]
    pub(crate) can_refine: bool,
    pub(crate) nerf_budget: NerfBudget,
}

/// Whether most images have depth for most pixels. If so, few cells are occupied, and refining them
/// costs little.
fn has_dense_depth<'a>(keyframes: impl Iterator<Item = &'a Keyframe>) -> bool {
    /// Only every `STRIDE`-th reading is checked.
    const STRIDE: usize = 61;
    let is_known = |depth: &DepthMap| {
        let readings = depth.depth_m.iter().step_by(STRIDE);
        2 * readings.clone().filter(|z| **z > 0.0).count() > readings.count()
    };
    // A majority is sufficient in both cases, because a few images without depth or with holes
    // change little.
    let known: Vec<bool> = keyframes
        .map(|keyframe| keyframe.depth.as_ref().is_some_and(is_known))
        .collect();
    2 * known.iter().filter(|is_known| **is_known).count() > known.len()
}

impl Sizes {
    /// Chooses levels down to the size of a pixel, and an entry count for the pixels of an image,
    /// within the limits.
    pub(crate) fn choose<'a>(
        options: &ModelOptions<NerfOptions>,
        nerf_budget: NerfBudget,
        max_binding_bytes: u64,
        keyframes: impl Iterator<Item = &'a Keyframe> + Clone,
        extent: &Extent,
    ) -> Result<Self, Error> {
        // The finest level has as many cells as pixels can resolve. The levels range from the
        // coarsest level to this level. The unit cube covers four radii at the scale of the inner
        // cube.
        let cell_m = PIXELS_PER_CELL * pixel_size_m(keyframes.clone(), extent);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "clamped"
        )]
        let finest = (4.0 * extent.radius_m / cell_m).clamp(64.0, 8192.0) as u32;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few"
        )]
        let n_levels =
            1 + (f64::from(finest / N_CELLS_COARSEST).ln() / LEVEL_GROWTH.ln()).ceil() as u32;
        // The number of levels is even. The number of features, two per level, is then a multiple
        // of four like all widths.
        let n_levels = n_levels.next_multiple_of(2).clamp(
            MIN_LEVELS,
            nerf_budget.max_levels.clamp(MIN_LEVELS, MAX_LEVELS),
        );
        let has_depth = keyframes.clone().any(|keyframe| keyframe.depth.is_some());
        let can_refine = nerf_budget.refined() != nerf_budget && has_dense_depth(keyframes.clone());

        // The number of entries matches the detail of the largest image. It is rounded up to a
        // power of two, which hashing requires.
        let n_pixels = keyframes
            .map(|keyframe| keyframe.rgba_srgb.len() / 4)
            .max()
            .unwrap_or(0);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a logarithm"
        )]
        let entries_for_pixels = (n_pixels.max(1) as f64 / PIXELS_PER_ENTRY).log2().ceil() as u32;
        let max_log2_entries_allowed = nerf_budget.max_log2_entries.max(MIN_LOG2_ENTRIES);
        let mut log2_entries = entries_for_pixels.clamp(MIN_LOG2_ENTRIES, max_log2_entries_allowed);

        // The number is reduced if the entries exceed the budget or the limit of the largest buffer
        // (the moments). More collisions blur the field, but with fewer levels, its detail would be
        // lost entirely.
        let max_bytes = options.common.max_bytes.unwrap_or(u64::MAX);
        loop {
            let shape = GridShape::between(N_CELLS_COARSEST, finest, n_levels, log2_entries);
            let n_entries = u64::from(shape.n_entries_total());
            let fits = n_entries * BYTES_PER_ENTRY <= max_bytes
                && n_entries * MOMENT_BYTES_PER_ENTRY <= max_binding_bytes;
            if fits {
                return Ok(Self {
                    n_cells: shape.n_cells,
                    log2_entries,
                    has_depth,
                    can_refine,
                    nerf_budget,
                });
            }
            if log2_entries == MIN_LOG2_ENTRIES {
                let min_bytes = n_entries * BYTES_PER_ENTRY;
                return Err(Error::BudgetTooSmall {
                    model: "neural field",
                    max_bytes,
                    min_bytes,
                });
            }
            log2_entries -= 1;
        }
    }

    pub(crate) fn shape(&self) -> GridShape {
        GridShape {
            n_cells: self.n_cells.clone(),
            log2_entries: self.log2_entries,
        }
    }

    /// Fails if a field cannot have these sizes.
    pub(crate) fn check(&self) -> Result<(), Error> {
        let NerfBudget {
            n_rays,
            n_samples,
            n_hidden,
            n_cells,
            n_steps,
            picture_rays,
            max_levels,
            ..
        } = self.nerf_budget;
        let is_increasing = self.n_cells.windows(2).all(|pair| pair[0] <= pair[1]);
        // Sizes come from files. Implausible sizes must be rejected before kernels are compiled and
        // buffers are allocated for them.
        let is_usable = (1..=16).contains(&self.n_cells.len())
            && self.n_cells.iter().all(|n| (1..=1 << 20).contains(n))
            && is_increasing
            && self.n_cells.len() <= max_levels.clamp(MIN_LEVELS, MAX_LEVELS) as usize
            && (1..=28).contains(&self.log2_entries)
            && (1..=1 << 20).contains(&n_rays)
            && (n_rays..=1 << 24).contains(&n_samples)
            && (4..=64).contains(&n_hidden)
            && (1..=1 << 20).contains(&picture_rays)
            && n_cells.is_power_of_two()
            && (4..=512).contains(&n_cells)
            && n_steps > 0;
        if is_usable {
            Ok(())
        } else {
            Err(Error::CheckpointState {
                reason: format!("unsupported field sizes: {self:?}"),
            })
        }
    }
}
