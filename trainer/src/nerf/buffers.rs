//! GPU buffers of the field, its samples and its training.

use super::kernels::{N_CHUNK, N_TILE, Widths};
use super::params::{
    AdamRule, Batch, IMAGE_PARAM_STRIDE, ImageParam, ImageParamRule, Level, March, OccupancyUpdate,
    Ray, RayLoss, levels,
};
use super::reference::grid::GridShape;
use crate::Error;
use gpu::{Buffer, Gpu};

/// All trained parameters of a field.
#[derive(Debug)]
pub(crate) struct FieldBuffers {
    pub(crate) levels: Buffer,
    /// Two f32 per entry.
    pub(crate) grid: Buffer,
    /// Weights of all layers of both networks, `[outputs, inputs]` each.
    pub(crate) weights: Buffer,
    /// The weights before the step, as two f16 numbers each. They exist only if layers use
    /// cooperative matrices.
    pub(crate) half_weights: Option<Buffer>,
    /// Placeholder for bindings that a kernel does not use.
    pub(crate) unused_buffer: Buffer,
    /// Placeholder for the parameters of images if there are none.
    pub(crate) no_image_params: Buffer,
    pub(crate) n_entries: u32,
}

/// Gradients with respect to the grid.
#[derive(Debug)]
pub(crate) struct FieldGradients {
    /// Two i32 per entry, multiplied by the scale of the level.
    pub(crate) grid: Buffer,
    /// One power of two per level.
    pub(crate) scales: Buffer,
    /// Numbers of contributions that overflowed their scale, in this step and in all earlier steps.
    pub(crate) counts: Buffer,
}

/// State of the optimizer.
#[derive(Debug)]
pub(crate) struct FieldMoments {
    /// Four f32 per entry, which are the first and second moments of both numbers.
    pub(crate) grid: Buffer,
    /// Eight f32 per four weights: four first moments, then four second moments.
    pub(crate) weights: Buffer,
    /// Largest gradient sum of each level.
    pub(crate) largest: Buffer,
    /// Number of steps and number of occupancy updates so far.
    pub(crate) steps: Buffer,
    /// Scale of the next step.
    pub(crate) step_scale: Buffer,
}

/// Occupancy grid: the cells in which rays are sampled.
#[derive(Debug)]
pub(crate) struct Occupancy {
    /// Two bit sets: the cells to sample, and the solid cells. Each set has bits for cells, groups
    /// and blocks, see `cell_blocks.wgsl`.
    pub(crate) occupied: Buffer,
    /// One f32 per cell, which is its recent opacity over one step. It is negative if the cell was
    /// never updated, and 0 if the cell is outside all views.
    pub(crate) cell_occupancy: Buffer,
    pub(crate) occupancy_sum: Buffer,
    pub(crate) occupancy_update: Buffer,
    pub(crate) n_points: u32,
    pub(crate) n_cells: u32,
}

/// Words of the bits of all groups and blocks of cells, as in `cell_blocks.wgsl`.
pub(crate) fn n_box_words(n_cells: u32) -> u32 {
    const MAX_BLOCKS: u32 = 16;
    const MAX_GROUPS: u32 = 64;
    [MAX_GROUPS, MAX_BLOCKS]
        .map(|max| n_cells.min(max).pow(3).div_ceil(32))
        .iter()
        .sum()
}

impl Occupancy {
    /// An occupancy grid with all cells marked. With depth, cells count as outside all views until
    /// hints arrive.
    pub(crate) fn new(
        gpu: &Gpu,
        occupancy_update: &OccupancyUpdate,
        has_depth: bool,
    ) -> Result<Self, Error> {
        let n = occupancy_update.n_cells.pow(3) as usize;
        let n_set_words = n.div_ceil(32) + n_box_words(occupancy_update.n_cells) as usize;
        Ok(Self {
            // All bits are set. Without hints, rays are sampled everywhere until the first update.
            occupied: gpu.storage_with(
                "nerf.occupied",
                &vec![255; 4 * (2 * n_set_words).next_multiple_of(4)],
            )?,
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

/// Threads that walk one ray. It equals `THREADS_PER_RAY` of `march_threads.wgsl`.
pub(crate) const THREADS_PER_RAY: u32 = 8;

/// The rays of one step or of part of a picture, and the parameters for walking them.
#[derive(Debug)]
pub(crate) struct RaySlot {
    pub(crate) n_rays: u32,
    pub(crate) rays: Buffer,
    /// Number of segments found per ray. The buffer also contains, for each thread of a ray, the
    /// number of segments found by earlier threads.
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

/// The samples of rays and the networks' outputs for them.
#[derive(Debug)]
pub(crate) struct SampleBuffers {
    /// Maximum number of samples.
    pub(crate) n_samples: u32,
    pub(crate) batch: Buffer,
    pub(crate) spans: Buffer,
    /// Centers of the samples in the unit cube, four f32 each.
    pub(crate) points: Buffer,
    /// Logarithms of the densities.
    pub(crate) log_density: Buffer,
    /// Colors before the sigmoid, four f32 each.
    pub(crate) colors: Buffer,
}

/// Intermediate values of a training step for its samples and rays.
#[derive(Debug)]
pub(crate) struct StepBuffers {
    /// Inputs of each layer. The numbers in this buffer and the next have
    /// [`Widths::bytes_per_number`] bytes each.
    pub(crate) activations: Buffer,
    /// Gradients with respect to the outputs of each layer.
    pub(crate) v_activations: Buffer,
    pub(crate) v_log_density: Buffer,
    pub(crate) v_colors: Buffer,
    pub(crate) ray_colors: Buffer,
    pub(crate) ray_errors: Buffer,
    /// Gradients with respect to the weights, per chunk of samples.
    pub(crate) partial_sums: Buffer,
}

/// Parameters of images and their gradients.
#[derive(Debug)]
pub(crate) struct ImageParamBuffers {
    /// `[n_images, IMAGE_PARAM_STRIDE]`.
    pub(crate) image_params: Buffer,
    pub(crate) rule: Buffer,
    pub(crate) n_images: u32,
    /// Gradients with respect to the position of each sample, and with respect to the pose of each
    /// ray.
    pub(crate) v_points: Buffer,
    pub(crate) v_rays: Buffer,
    /// Gradients with respect to the appearance embedding, per sample.
    pub(crate) v_embeddings: Buffer,
}

impl ImageParamBuffers {
    /// Creates parameters that are all zero, which means no pose correction and the same lighting
    /// for all images.
    pub(crate) fn new(
        gpu: &Gpu,
        rule: &ImageParamRule,
        n_rays: u32,
        n_samples: u32,
    ) -> Result<Self, Error> {
        let n_images = rule.n_images;
        Ok(Self {
            // New buffers are filled with zeros.
            image_params: gpu.storage(
                "nerf.image_params",
                u64::from(n_images) * (IMAGE_PARAM_STRIDE * size_of::<ImageParam>()) as u64,
            )?,
            rule: gpu.uniform_with("nerf.image_param_rule", rule),
            n_images,
            v_points: gpu.storage("nerf.v_points", 16 * u64::from(n_samples))?,
            v_rays: gpu.storage("nerf.v_rays", 32 * u64::from(n_rays))?,
            v_embeddings: gpu.storage("nerf.v_embeddings", 16 * u64::from(n_samples))?,
        })
    }
}

impl FieldBuffers {
    /// A field with all parameters zero.
    pub(crate) fn new(gpu: &Gpu, shape: &GridShape, widths: &Widths) -> Result<Self, Error> {
        let levels: Vec<Level> = levels(shape);
        Ok(Self {
            levels: gpu.storage_with("nerf.levels", bytemuck::cast_slice(&levels))?,
            grid: gpu.storage("nerf.grid", 8 * u64::from(shape.n_entries_total()))?,
            weights: gpu.storage("nerf.weights", 4 * u64::from(widths.n_weights()))?,
            half_weights: if widths.is_half_precision {
                Some(gpu.storage(
                    "nerf.half_weights",
                    4 * u64::from(widths.n_padded_weights()),
                )?)
            } else {
                None
            },
            // Every binding needs a buffer, even if the variant of a kernel does not use it.
            unused_buffer: gpu.storage("nerf.unused", 16)?,
            no_image_params: gpu.storage("nerf.no_image_params", 16)?,
            n_entries: shape.n_entries_total(),
        })
    }

    /// Weights in the number type that the layers use.
    pub(crate) fn working_weights(&self) -> &Buffer {
        self.half_weights.as_ref().unwrap_or(&self.weights)
    }
}

impl FieldGradients {
    pub(crate) fn new(gpu: &Gpu, shape: &GridShape) -> Result<Self, Error> {
        Ok(Self {
            // The gradients are integers, because sums of floats would depend on the order of the
            // atomic additions.
            grid: gpu.storage("nerf.v_grid", 8 * u64::from(shape.n_entries_total()))?,
            scales: gpu.storage("nerf.scales", 4 * shape.n_cells.len() as u64)?,
            counts: gpu.storage("nerf.counts", 8)?,
        })
    }
}

impl FieldMoments {
    pub(crate) fn new(
        gpu: &Gpu,
        shape: &GridShape,
        widths: &Widths,
        rule: &AdamRule,
    ) -> Result<Self, Error> {
        Ok(Self {
            grid: gpu.storage("nerf.grid_moments", 16 * u64::from(shape.n_entries_total()))?,
            weights: gpu.storage("nerf.weight_moments", 8 * u64::from(widths.n_weights()))?,
            largest: gpu.storage("nerf.largest", 4 * shape.n_cells.len() as u64)?,
            steps: gpu.storage("nerf.steps", 8)?,
            step_scale: gpu.storage_with(
                "nerf.step_scale",
                bytemuck::bytes_of(&rule.first_step_scale()),
            )?,
        })
    }
}

impl SampleBuffers {
    /// Buffers for up to `n_samples` samples.
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
    /// Buffers for up to `n_rays` rays and `n_samples` samples.
    pub(crate) fn new(
        gpu: &Gpu,
        widths: &Widths,
        n_rays: u32,
        n_samples: u32,
    ) -> Result<Self, Error> {
        let floats = |name: &str, n_rows: u32, width: u32| {
            gpu.storage(name, 4 * u64::from(n_rows) * u64::from(width))
        };
        // Kernels read and write whole tiles of samples.
        let in_tiles =
            u64::from(n_samples.next_multiple_of(N_TILE)) * u64::from(widths.bytes_per_number());
        Ok(Self {
            activations: gpu.storage(
                "nerf.activations",
                in_tiles * u64::from(widths.n_activations()),
            )?,
            v_activations: gpu.storage(
                "nerf.v_activations",
                in_tiles * u64::from(widths.n_gradients()),
            )?,
            v_log_density: floats("nerf.v_log_density", n_samples, 1)?,
            v_colors: floats("nerf.v_colors", n_samples, 4)?,
            ray_colors: floats("nerf.ray_colors", n_rays, 4)?,
            ray_errors: floats("nerf.ray_errors", n_rays, 2)?,
            partial_sums: floats(
                "nerf.partial_sums",
                n_samples.div_ceil(N_CHUNK),
                widths.n_padded_weights(),
            )?,
        })
    }
}
