//! What the field and its samples take on the GPU.

use super::kernels::{N_CHUNK, N_TILE, Widths};
use super::params::{
    AdamRule, Batch, IMAGE_PARAM_STRIDE, ImageParam, ImageParamRule, Level, March, OccupancyUpdate, Ray, RayLoss,
    levels,
};
use super::reference::grid::GridShape;
use crate::Error;
use crate::gpu::{Buffer, Gpu};

/// All that is learned.
#[derive(Debug)]
pub(crate) struct FieldBuffers {
    pub(crate) levels: Buffer,
    /// Two f32 an entry.
    pub(crate) grid: Buffer,
    /// Of all layers of both networks, `[outputs, inputs]` each.
    pub(crate) weights: Buffer,
    /// The same as two numbers of f16 each, as they were before the step, where layers are matrices.
    pub(crate) half_weights: Option<Buffer>,
    /// What kernels bind and do not use.
    pub(crate) unused_buffer: Buffer,
    /// Terms of no image.
    pub(crate) no_image_params: Buffer,
    pub(crate) n_entries: u32,
}

/// Slopes towards the grid.
#[derive(Debug)]
pub(crate) struct FieldGradients {
    /// Two i32 an entry, times the scale of its level.
    pub(crate) grid: Buffer,
    /// A power of two a level.
    pub(crate) scales: Buffer,
    /// How many contributions were too large for their scale: in this step, and in those before.
    pub(crate) counts: Buffer,
}

/// What the optimiser keeps.
#[derive(Debug)]
pub(crate) struct FieldMoments {
    /// Four f32 an entry: first and second of both numbers.
    pub(crate) grid: Buffer,
    /// Eight f32 for four weights: first of all, second of all.
    pub(crate) weights: Buffer,
    /// Largest sum of slopes of each level.
    pub(crate) largest: Buffer,
    /// Steps so far, and visits of cells so far.
    pub(crate) steps: Buffer,
    /// How far the next step goes.
    pub(crate) step_scale: Buffer,
}

/// Where something is: the cells that rays are walked through.
#[derive(Debug)]
pub(crate) struct Occupancy {
    /// A bit a cell, then a bit a block of cells.
    pub(crate) occupied: Buffer,
    /// An f32 a cell: the share of light that it lately held back over a step; negative: never visited; 0: never looked at.
    pub(crate) cell_occupancy: Buffer,
    pub(crate) occupancy_sum: Buffer,
    pub(crate) occupancy_update: Buffer,
    pub(crate) n_points: u32,
    pub(crate) n_cells: u32,
}

/// Blocks of cells along an axis, as in `cell_blocks.wgsl`.
pub(crate) fn n_blocks(n_cells: u32) -> u32 {
    const MAX_BLOCKS: u32 = 16;
    n_cells.min(MAX_BLOCKS)
}

impl Occupancy {
    /// All cells hold something as far as anyone knows; where there is depth it is left to the depth to say so.
    pub(crate) fn new(gpu: &Gpu, occupancy_update: &OccupancyUpdate, has_depth: bool) -> Result<Self, Error> {
        let n = occupancy_update.n_cells.pow(3) as usize;
        let n_words = n / 32 + n_blocks(occupancy_update.n_cells).pow(3).div_ceil(32) as usize;
        Ok(Self {
            occupied: gpu.storage_with("nerf.occupied", &vec![255; 4 * n_words.next_multiple_of(4)])?,
            cell_occupancy: gpu.storage_with(
                "nerf.cell_occupancy",
                bytemuck::cast_slice(&vec![if has_depth { 0.0f32 } else { -1.0 }; n]),
            )?,
            occupancy_sum: gpu.storage("nerf.occupancy_sum", 4)?,
            occupancy_update: gpu.uniform_with("nerf.occupancy_update", occupancy_update),
            n_points: occupancy_update.n_points,
            n_cells: occupancy_update.n_cells,
        })
    }
}

/// Threads that walk one ray, `SHARES` of `march_shares.wgsl`.
pub(crate) const THREADS_PER_RAY: u32 = 8;

/// The rays of one step or of part of a picture, and how they are looked along.
#[derive(Debug)]
pub(crate) struct RaySlot {
    pub(crate) n_rays: u32,
    pub(crate) rays: Buffer,
    /// Pieces found along each ray; and, for each thread that looks for them, by those before it.
    pub(crate) n_found: Buffer,
    pub(crate) n_before: Buffer,
    pub(crate) march: Buffer,
    pub(crate) loss: Buffer,
}

impl RaySlot {
    pub(crate) fn new(gpu: &Gpu, n_rays: u32) -> Result<Self, Error> {
        Ok(Self {
            n_rays,
            rays: gpu.storage("nerf.rays", u64::from(n_rays) * size_of::<Ray>() as u64)?,
            n_found: gpu.storage("nerf.n_found", 4 * u64::from(n_rays))?,
            n_before: gpu.storage("nerf.n_before", 4 * u64::from(THREADS_PER_RAY * n_rays))?,
            march: gpu.uniform_with("nerf.march", &<March as bytemuck::Zeroable>::zeroed()),
            loss: gpu.uniform_with("nerf.loss", &<RayLoss as bytemuck::Zeroable>::zeroed()),
        })
    }
}

/// The samples of rays, and what they look like.
#[derive(Debug)]
pub(crate) struct SampleBuffers {
    /// Most samples.
    pub(crate) n_samples: u32,
    pub(crate) batch: Buffer,
    pub(crate) spans: Buffer,
    /// Middles of the samples in the unit cube, four f32 each.
    pub(crate) points: Buffer,
    /// Logarithms of the densities.
    pub(crate) log_density: Buffer,
    /// Before the sigmoid, four f32 each.
    pub(crate) colors: Buffer,
}

/// What a step keeps of its samples and rays.
#[derive(Debug)]
pub(crate) struct StepBuffers {
    /// What goes into each layer, in numbers of [`Widths::bytes_per_number`], as the next.
    pub(crate) activations: Buffer,
    /// Slopes towards what comes out of each layer.
    pub(crate) v_activations: Buffer,
    pub(crate) v_log_density: Buffer,
    pub(crate) v_colors: Buffer,
    pub(crate) ray_colors: Buffer,
    pub(crate) ray_errors: Buffer,
    /// Slopes towards the weights, of each chunk of samples.
    pub(crate) partial_sums: Buffer,
}

/// What is learned about images, and the slopes towards that.
#[derive(Debug)]
pub(crate) struct ImageParamBuffers {
    /// `[n_images, IMAGE_PARAM_STRIDE]`.
    pub(crate) image_params: Buffer,
    pub(crate) rule: Buffer,
    pub(crate) n_images: u32,
    /// Of the places of each sample, and of each ray.
    pub(crate) v_points: Buffer,
    pub(crate) v_rays: Buffer,
    /// Of each sample.
    pub(crate) v_embeddings: Buffer,
}

impl ImageParamBuffers {
    /// Of images that have right poses and the same light as far as anyone knows.
    pub(crate) fn new(gpu: &Gpu, rule: &ImageParamRule, n_rays: u32, n_samples: u32) -> Result<Self, Error> {
        let n_images = rule.n_images;
        Ok(Self {
            image_params: gpu.storage(
                "nerf.image_params",
                u64::from(n_images) * (IMAGE_PARAM_STRIDE * size_of::<ImageParam>()) as u64,
            )?,
            rule: gpu.uniform_with("nerf.term_rule", rule),
            n_images,
            v_points: gpu.storage("nerf.v_points", 16 * u64::from(n_samples))?,
            v_rays: gpu.storage("nerf.v_rays", 32 * u64::from(n_rays))?,
            v_embeddings: gpu.storage("nerf.v_embeddings", 16 * u64::from(n_samples))?,
        })
    }
}

impl FieldBuffers {
    /// A field of zeros.
    pub(crate) fn new(gpu: &Gpu, shape: &GridShape, widths: &Widths) -> Result<Self, Error> {
        let levels: Vec<Level> = levels(shape);
        Ok(Self {
            levels: gpu.storage_with("nerf.levels", bytemuck::cast_slice(&levels))?,
            grid: gpu.storage("nerf.grid", 8 * u64::from(shape.n_entries_total()))?,
            weights: gpu.storage("nerf.weights", 4 * u64::from(widths.n_weights()))?,
            half_weights: if widths.is_half_precision {
                Some(gpu.storage("nerf.half_weights", 4 * u64::from(widths.n_padded_weights()))?)
            } else {
                None
            },
            unused_buffer: gpu.storage("nerf.nothing", 16)?,
            no_image_params: gpu.storage("nerf.no_terms", 16)?,
            n_entries: shape.n_entries_total(),
        })
    }

    /// Weights as layers take them.
    pub(crate) fn working_weights(&self) -> &Buffer {
        self.half_weights.as_ref().unwrap_or(&self.weights)
    }
}

impl FieldGradients {
    pub(crate) fn new(gpu: &Gpu, shape: &GridShape) -> Result<Self, Error> {
        Ok(Self {
            grid: gpu.storage("nerf.v_grid", 8 * u64::from(shape.n_entries_total()))?,
            scales: gpu.storage("nerf.scales", 4 * shape.n_cells.len() as u64)?,
            counts: gpu.storage("nerf.counts", 8)?,
        })
    }
}

impl FieldMoments {
    pub(crate) fn new(gpu: &Gpu, shape: &GridShape, widths: &Widths, rule: &AdamRule) -> Result<Self, Error> {
        Ok(Self {
            grid: gpu.storage("nerf.grid_moments", 16 * u64::from(shape.n_entries_total()))?,
            weights: gpu.storage("nerf.weight_moments", 8 * u64::from(widths.n_weights()))?,
            largest: gpu.storage("nerf.largest", 4 * shape.n_cells.len() as u64)?,
            steps: gpu.storage("nerf.steps", 8)?,
            step_scale: gpu.storage_with("nerf.step_scale", bytemuck::bytes_of(&rule.first_step_scale()))?,
        })
    }
}

impl SampleBuffers {
    /// Room for so many samples.
    pub(crate) fn new(gpu: &Gpu, n_samples: u32) -> Result<Self, Error> {
        let floats = |name: &str, width: u64| gpu.storage(name, 4 * width * u64::from(n_samples));
        Ok(Self {
            n_samples,
            batch: gpu.storage_with("nerf.batch", bytemuck::bytes_of(&Batch::of(0)))?,
            spans: floats("nerf.spans", 4)?,
            points: floats("nerf.points", 4)?,
            log_density: floats("nerf.log_density", 1)?,
            colors: floats("nerf.colors", 4)?,
        })
    }
}

impl StepBuffers {
    /// For so many rays and samples.
    pub(crate) fn new(gpu: &Gpu, widths: &Widths, n_rays: u32, n_samples: u32) -> Result<Self, Error> {
        let floats = |name: &str, n_rows: u32, width: u32| gpu.storage(name, 4 * u64::from(n_rows) * u64::from(width));
        let in_tiles = u64::from(n_samples.next_multiple_of(N_TILE)) * u64::from(widths.bytes_per_number());
        Ok(Self {
            activations: gpu.storage("nerf.activations", in_tiles * u64::from(widths.n_activations()))?,
            v_activations: gpu.storage("nerf.v_activations", in_tiles * u64::from(widths.n_gradients()))?,
            v_log_density: floats("nerf.v_log_density", n_samples, 1)?,
            v_colors: floats("nerf.v_colors", n_samples, 4)?,
            ray_colors: floats("nerf.ray_colors", n_rays, 4)?,
            ray_errors: floats("nerf.ray_errors", n_rays, 2)?,
            partial_sums: floats("nerf.partial_sums", n_samples.div_ceil(N_CHUNK), widths.n_padded_weights())?,
        })
    }
}
