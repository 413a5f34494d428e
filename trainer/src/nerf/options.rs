//! How a neural field learns.

use crate::splat::CameraRefinement;
use serde::{Deserialize, Serialize};

/// Settings of a [`super::NerfModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NerfOptions {
    /// Seeds every random choice.
    pub seed: u64,
    /// Most bytes of GPU memory the field (its parameters, slopes and the optimiser's moments) may take.
    pub max_bytes: Option<u64>,
    /// Steps over which the learning rate falls.
    pub n_planned_steps: u64,
    /// Weight of the difference of distances, per scene radius, against the squared difference of colors.
    pub distance_weight: f64,
    /// Weight of light that is held back elsewhere than where the depth says.
    pub line_of_sight: f64,
    /// Weight of the spread of light along a ray.
    pub distortion: f64,
    /// Learning rate at the start.
    pub rate: f64,
    /// What is left of it at the end of the planned steps.
    pub final_rate_frac: f64,
    /// What is learned about cameras with the field: of all terms it knows the poses of images.
    pub cameras: CameraRefinement,
    /// Sizes of batch and networks; `None`: as suits the adapter.
    pub nerf_budget: Option<NerfBudget>,
}

/// What a step takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NerfBudget {
    /// Rays of a step.
    pub n_rays: u32,
    /// Most samples of a step, of all its rays.
    pub n_samples: u32,
    /// Width of hidden layers, a multiple of 4 up to 64.
    pub n_hidden: u32,
    /// Cells of the occupancy along an axis, a power of two.
    pub n_cells: u32,
    /// Steps through the inner cube along an axis.
    pub n_steps: u32,
    /// Most entries of a level, as a power of two.
    pub max_log2_entries: u32,
    /// Most levels of the grid, an even number.
    pub max_levels: u32,
    /// Most rays of a picture that are followed at once.
    pub picture_rays: u32,
}

impl NerfBudget {
    /// For a processor in place of a GPU.
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
    /// For a GPU.
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
    /// With cells and steps half as wide, where these are those of a GPU: a processor would wait for them, and more would take too much memory.
    #[must_use]
    pub(crate) fn refined(self) -> Self {
        if self.n_cells != Self::FULL.n_cells {
            return self;
        }
        Self { n_cells: 2 * self.n_cells, n_steps: 2 * self.n_steps, ..self }
    }
}

impl Default for NerfOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            max_bytes: None,
            n_planned_steps: 7000,
            distance_weight: 0.05,
            line_of_sight: 0.1,
            distortion: 0.01,
            rate: 2e-2,
            final_rate_frac: 0.03,
            cameras: CameraRefinement::default(),
            nerf_budget: None,
        }
    }
}
