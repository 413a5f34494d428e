//! Training options of a neural field.

use crate::model_options::MethodOptions;
use serde::{Deserialize, Serialize};

/// Options specific to a [`super::NerfModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NerfOptions {
    /// Weight of the absolute distance error, per scene radius, relative to the squared color
    /// error.
    pub distance_weight: f64,
    /// Weight of the line-of-sight loss, which penalizes opacity away from the measured depth.
    pub line_of_sight: f64,
    /// Weight of the distortion loss, which penalizes spread of the weights along a ray.
    pub distortion: f64,
    /// Initial learning rate.
    pub rate: f64,
    /// Fraction of the initial rate that remains after the planned steps.
    pub final_rate_frac: f64,
    /// Sizes of the batch and of the networks. `None` selects the default sizes for the adapter.
    pub nerf_budget: Option<NerfBudget>,
}

/// Sizes of a training step and of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NerfBudget {
    /// Rays per step.
    pub n_rays: u32,
    /// Maximum number of samples per step, over all its rays.
    pub n_samples: u32,
    /// Width of hidden layers, a multiple of 4 up to 64.
    pub n_hidden: u32,
    /// Cells of the occupancy grid along an axis, a power of two.
    pub n_cells: u32,
    /// Steps through the inner cube along an axis.
    pub n_steps: u32,
    /// Maximum number of entries of a level, as log2.
    pub max_log2_entries: u32,
    /// Maximum number of levels of the grid, an even number.
    pub max_levels: u32,
    /// Maximum number of rays of a picture that are processed at once.
    pub picture_rays: u32,
}

impl NerfBudget {
    /// Sizes for a software adapter, on which the full sizes would be far too slow.
    pub const SMALL: Self = Self {
        n_rays: 512,
        n_samples: 1 << 14,
        n_hidden: 16,
        n_cells: 64,
        n_steps: 128,
        max_log2_entries: 15,
        max_levels: 8,
        picture_rays: 1 << 11,
    };
    /// Sizes for a GPU. On the data set of the mobile base, twice the rays and samples, or four
    /// times the entries, gave no higher PSNR after 16 s (`docs/benchmarks/2026-11-23-nerf.md`).
    pub const FULL: Self = Self {
        n_rays: 4096,
        n_samples: 1 << 18,
        n_hidden: 64,
        n_cells: 128,
        n_steps: 256,
        max_log2_entries: 19,
        max_levels: 16,
        picture_rays: 1 << 18,
    };
}

impl NerfBudget {
    /// Halves the size of cells and steps if they have the sizes of [`Self::FULL`]. Other sizes are
    /// not refined, because refinement is too slow on software adapters, and even finer cells would
    /// need too much memory.
    #[must_use]
    pub(crate) fn refined(self) -> Self {
        if self.n_cells != Self::FULL.n_cells {
            return self;
        }
        Self {
            n_cells: 2 * self.n_cells,
            n_steps: 2 * self.n_steps,
            ..self
        }
    }
}

impl NerfOptions {
    /// The sizes in use, which are the given sizes, or the default of the adapter.
    pub(crate) fn budget_or_default(&self, is_software: bool) -> NerfBudget {
        self.nerf_budget.unwrap_or(if is_software {
            NerfBudget::SMALL
        } else {
            NerfBudget::FULL
        })
    }
}

impl MethodOptions for NerfOptions {
    const METHOD: &'static str = "nerf";
}

impl Default for NerfOptions {
    fn default() -> Self {
        Self {
            distance_weight: 0.05,
            line_of_sight: 0.1,
            distortion: 0.01,
            rate: 2e-2,
            final_rate_frac: 0.03,
            nerf_budget: None,
        }
    }
}
