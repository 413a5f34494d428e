//! Trains one field on the GPU and renders it.

use super::buffers::{
    FieldBuffers, FieldGradients, FieldMoments, ImageParamBuffers, Occupancy, RaySlot,
    SampleBuffers, StepBuffers,
};
use super::extent::Extent;
use super::kernels::{FieldPipelines, Widths};
use super::options::{NerfBudget, NerfOptions};
use super::params::{
    AdamRule, Backdrop, Batch, EMBEDDING, IMAGE_PARAM_STRIDE, ImageParam, ImageParamRule, March,
    OccupancyUpdate, Ray, RayLoss, image_params_of,
};
use super::passes::{Canvas, FieldPasses};
use super::reference::march as reference;
use super::sizes::{MAX_LEVELS, MIN_LEVELS, Sizes};
use crate::model_options::ModelOptions;
use crate::packing::{Output, Reader};
use crate::view::{Camera, ErasedSpace};
use crate::{Error, Rendered};
use calibration::{EMBEDDING_DIM, ParamSet};
use gpu::{Buffer, Gpu, PassTiming, Passes, PendingRead};
use numbers::f32_of;
use numbers::random::{hash, unit_from_bits};
use rayon::prelude::*;
use std::sync::Arc;

/// Maximum number of steps per submit. The rays of all these steps are on the GPU at once, so more
/// steps need more memory. With fewer steps, the GPU waits for the host more often.
pub(crate) const STEPS_PER_SUBMIT: usize = 8;
/// Steps between two updates of the occupancy, as in Mueller et al. 2022, appendix C.
const OCCUPANCY_UPDATE_PERIOD: u64 = 16;
/// First step that updates the occupancy if there is depth. Until then, depth is more reliable than
/// the field.
const FIRST_OCCUPANCY_UPDATE_WITH_DEPTH: u64 = 128;
/// Factor on a cell's previous occupancy at each update. With a larger factor, cells that became
/// empty are sampled longer. With a smaller factor, a single point that happens to miss a thin
/// object clears its cell.
const OCCUPANCY_DECAY: f32 = 0.7;
/// Fraction of the cells that an update evaluates. The number of cells is also limited by the batch
/// size, because the update uses the buffers of a batch. A larger fraction makes updates slower.
/// With a smaller fraction, cells follow the field with a longer delay.
const UPDATED_FRAC: f64 = 0.25;
/// Maximum number of samples of a training ray, as a multiple of the mean, so that a few rays
/// through unknown space cannot use up the batch.
const MAX_SAMPLES_OVER_MEAN: u32 = 4;
/// Samples per round for a ray of a picture. It equals `MAX_SAMPLES_PER_ROUND` of
/// `find_samples.wgsl`.
const SAMPLES_PER_ROUND: u32 = 8;
/// Maximum number of rounds, which limits the length of rays to 2048 samples. This is four times
/// the number of steps that cross the refined inner cube.
const MAX_ROUNDS: u32 = 256;
/// Number of rounds for the first picture, for which the required number is unknown. If it is too
/// small, the picture is drawn again. Superfluous rounds find no samples.
const FIRST_ROUNDS: u32 = 16;
/// The prepass traces one ray per square with sides of this many pixels. It equals `FRONT_STRIDE`
/// of `picture_rays.wgsl`. The prepass costs a 16th of the rays of the picture.
const FRONT_STRIDE: u32 = 4;
/// Initial range of the entries (Mueller et al. 2022, section 4).
const INITIAL_ENTRY_RANGE: f64 = 1e-4;
/// Distance residuals beyond this limit, in units of the scene radius, have no gradient. Such a
/// reading is wrong, or belongs to a surface that the ray does not show yet.
const DISTANCE_CLIP: f32 = 0.5;
/// Relative error of a depth camera, which widens the band of the line-of-sight loss with distance.
/// With a wider band, surfaces are blurred. A narrower band penalizes correct surfaces.
const DEPTH_BAND_FRAC: f32 = 0.01;
/// Minimum distance in the distortion loss, in units of the scene radius. The loss compares inverse
/// distances, which would grow without bound near the camera.
const DISTORTION_NEAR: f32 = 0.05;
/// Initial step of an image's rotation (radians) and translation (units of the scene radius). Their
/// ratio follows from the distance of observed surfaces, which is roughly a third of a radius.
const ROTATION_RATE: f32 = 5e-4;
const TRANSLATION_RATE: f32 = ROTATION_RATE / 3.0;
/// Initial step of a component of an image's appearance embedding. It is equal to the initial
/// learning rate of the weights with which the component is multiplied.
const EMBEDDING_RATE: f32 = 2e-2;
/// Initial decay per step of an image's rotation, translation and embedding, as a fraction. Without
/// decay, all images could drift together, because no image contradicts such a drift.
const IMAGE_PARAM_DECAY: f32 = 5e-4;
/// Initial scale of gradients (2^20), before their magnitudes are known. Gradients of grid entries
/// are summed as integers. `end_step` then chooses the scale of each level from its largest sum.
const INITIAL_GRADIENT_SCALE: f32 = 1_048_576.0;

/// Index of a picture's parameters in their buffer, which holds no other parameters.
const PICTURE_EMBEDDING_IX: u32 = 0;

/// GPU state of one field.
#[derive(Debug)]
pub(crate) struct FieldTrainer {
    pub(crate) sizes: Sizes,
    pub(crate) field: FieldBuffers,
    pub(crate) moments: FieldMoments,
    pub(crate) gradients: FieldGradients,
    pub(crate) occupancy: Occupancy,
    /// Parameters of images, if any are optimized.
    pub(crate) images: Option<ImageParamBuffers>,
    compiled: Arc<Compiled>,
    samples: SampleBuffers,
    step: StepBuffers,
    slots: Vec<RaySlot>,
    rules: [Buffer; 2],
    picture: Option<(RaySlot, SampleBuffers, Canvas)>,
    /// Rounds of samples for the next picture. If its rays need more, it is drawn again.
    picture_rounds: u32,
    reader: Reader,
    erased: ErasedSpace,
    passes: Passes,
}

/// Kernels shared by all fields with the same budget.
#[derive(Debug)]
pub(crate) struct Compiled {
    pipelines: FieldPipelines,
    widths: Widths,
}

impl Compiled {
    pub(crate) fn new(gpu: &Gpu, nerf_budget: &NerfBudget) -> Result<Self, Error> {
        let widths = Widths::new(
            gpu,
            nerf_budget.max_levels.clamp(MIN_LEVELS, MAX_LEVELS),
            nerf_budget.n_hidden,
            embedding_dim(),
        );
        Ok(Self {
            pipelines: FieldPipelines::new(
                gpu,
                &widths,
                nerf_budget.n_samples,
                PICTURE_EMBEDDING_IX,
            )?,
            widths,
        })
    }
}

impl FieldTrainer {
    /// A field with random initial parameters.
    pub(crate) fn new(
        gpu: &Gpu,
        options: &ModelOptions<NerfOptions>,
        sizes: Sizes,
        compiled: Arc<Compiled>,
    ) -> Result<Self, Error> {
        let NerfBudget {
            n_rays, n_samples, ..
        } = sizes.nerf_budget;
        let shape = sizes.shape();
        let widths = compiled.widths.clone();
        let field = FieldBuffers::new(gpu, &shape, &widths)?;
        let gradients = FieldGradients::new(gpu, &shape)?;
        gpu.write(
            &gradients.scales,
            0,
            bytemuck::cast_slice(&vec![INITIAL_GRADIENT_SCALE; shape.n_cells.len()]),
        );
        let field_trainer = Self {
            compiled,
            moments: FieldMoments::new(gpu, &shape, &widths, &rule(options, 0.0))?,
            occupancy: Occupancy::new(
                gpu,
                &occupancy_update_of(&sizes.nerf_budget),
                sizes.has_depth,
            )?,
            images: None,
            samples: SampleBuffers::new(gpu, n_samples)?,
            step: StepBuffers::new(gpu, &widths, n_rays, n_samples)?,
            slots: Vec::new(),
            rules: [
                gpu.uniform_with("nerf.grid_rule", &rule(options, 0.0)),
                gpu.uniform_with("nerf.weight_rule", &rule(options, 1e-6)),
            ],
            picture: None,
            picture_rounds: FIRST_ROUNDS,
            reader: Reader::default(),
            erased: ErasedSpace::none(gpu)?,
            passes: Passes::default(),
            field,
            gradients,
            sizes,
        };
        field_trainer.initialize(gpu, options.common.seed, &widths);
        Ok(field_trainer)
    }

    /// Initializes entries with small random numbers, and weights with random numbers that preserve
    /// the variance (Glorot and Bengio 2010).
    fn initialize(&self, gpu: &Gpu, seed: u64, widths: &Widths) {
        let n_numbers = 2 * self.field.n_entries as usize;
        let entry_stream = RandomStream { seed, stream: 1 };
        let entries: Vec<f32> = (0..n_numbers)
            .into_par_iter()
            .map(|ix| entry_stream.uniform(ix, INITIAL_ENTRY_RANGE))
            .collect();
        gpu.write(&self.field.grid, 0, bytemuck::cast_slice(&entries));
        let mut weights: Vec<f32> = Vec::new();
        let layers = widths.layers().into_iter().zip(widths.used_layers());
        for (([n_in, n_out], [used_in, used_out]), stream) in layers.zip(2..) {
            // The random numbers and their bound depend on the widths without padding, so that a
            // field starts with the same weights on all adapters.
            let weight_stream = RandomStream { seed, stream };
            let bound = (6.0 / f64::from(used_in + used_out)).sqrt();
            for at in 0..n_in * n_out {
                let row = at / n_in;
                let column = at % n_in;
                let is_used = row < used_out && column < used_in;
                let ix = (row * used_in + column) as usize;
                weights.push(if is_used {
                    weight_stream.uniform(ix, bound)
                } else {
                    0.0
                });
            }
        }
        gpu.write(&self.field.weights, 0, bytemuck::cast_slice(&weights));
    }

    /// Bytes of the trained parameters, their gradients and moments.
    pub(crate) fn bytes(&self) -> u64 {
        let Self {
            field,
            gradients,
            moments,
            occupancy,
            ..
        } = self;
        let grids = [
            &field.grid,
            &gradients.grid,
            &moments.grid,
            &occupancy.cell_occupancy,
            &occupancy.occupied,
        ];
        grids
            .into_iter()
            .chain([&field.weights, &moments.weights])
            .map(Buffer::bytes)
            .sum()
    }

    /// Records one training step on `rays` as step `slot_ix` of a submit. The step optimizes the
    /// image parameters in `learned`.
    pub(crate) fn record_step(
        &mut self,
        gpu: &Gpu,
        options: &ModelOptions<NerfOptions>,
        slot_ix: usize,
        step: u64,
        rays: &[Ray],
        learned: ParamSet,
    ) -> Result<(), Error> {
        self.write_slot(gpu, options, slot_ix, step, rays)?;
        let Self {
            compiled,
            field,
            samples,
            step: kept,
            occupancy,
            moments,
            gradients,
            images,
            passes: list,
            ..
        } = self;
        let image_params = images
            .as_ref()
            .map_or(&field.no_image_params, |images| &images.image_params);
        let slot = &self.slots[slot_ix];
        let passes = FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot,
            image_params,
        };
        let images = images.as_ref().filter(|_| !learned.is_empty());
        passes.convert_weights(list);
        // The occupancy is updated first. The update evaluates the field in the buffers of the
        // batch, and the rays of this step are then sampled in the cells that it marks.
        let first_update = if self.sizes.has_depth {
            FIRST_OCCUPANCY_UPDATE_WITH_DEPTH
        } else {
            OCCUPANCY_UPDATE_PERIOD
        };
        if step.is_multiple_of(OCCUPANCY_UPDATE_PERIOD) && step >= first_update {
            passes.occupancy_update(list, occupancy, moments);
        }
        // Poses change the rays, so they are applied before samples are placed.
        if images.is_some() && learned.contains(ParamSet::IMAGE_POSES) {
            passes.apply_pose(list);
        }
        passes.count(list, occupancy);
        passes.place_samples_in_rays(list, occupancy);
        passes.forward(list, kept);
        passes.backward(list, kept, gradients);
        // All gradients use the parameters before this step, so nothing is updated before the last
        // gradient is computed.
        if let Some(images) = images {
            if learned.contains(ParamSet::IMAGE_POSES) {
                passes.pose_gradients(list, kept, images);
            }
            if learned.contains(ParamSet::IMAGE_GAINS) {
                passes.embedding_gradients(list, kept, images);
            }
            passes.update_images(list, moments, images);
        }
        passes.update(
            list,
            [&self.rules[0], &self.rules[1]],
            kept,
            gradients,
            moments,
        );
        Ok(())
    }

    /// Renders rays with their given poses and with one appearance embedding per image, without
    /// training. No submit may be in flight.
    pub(crate) fn render_rays(
        &mut self,
        gpu: &Gpu,
        options: &ModelOptions<NerfOptions>,
        rays: &[Ray],
        embeddings: &[[f64; EMBEDDING_DIM]],
    ) -> Result<Vec<RayColor>, Error> {
        self.write_slot(gpu, options, 0, 0, rays)?;
        let Self {
            compiled,
            field,
            samples,
            step: kept,
            occupancy,
            slots,
            passes: list,
            ..
        } = self;
        let embeddings_buffer = match embeddings {
            [] => None,
            embeddings => Some(gpu.storage_with(
                "nerf.terms_of_others",
                bytemuck::cast_slice(&image_params_of(embeddings)),
            )?),
        };
        let image_params = embeddings_buffer.as_ref().unwrap_or(&field.no_image_params);
        let passes = FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot: &slots[0],
            image_params,
        };
        passes.convert_weights(list);
        passes.count(list, occupancy);
        passes.place_samples_in_rays(list, occupancy);
        passes.forward(list, kept);
        passes.composite(list, kept);
        list.submit(gpu);
        // This buffer of image parameters is used only once, and cached bindings would keep it in
        // memory.
        list.clear_bindings();
        let ray_colors: Vec<[f32; 4]> = gpu.read(&kept.ray_colors, rays.len())?;
        let errors: Vec<[f32; 2]> = gpu.read(&kept.ray_errors, rays.len())?;
        let background = background(options, 0);
        Ok(ray_colors
            .into_iter()
            .zip(errors)
            .map(|(ray_colors, [error, _])| RayColor {
                error: error.into(),
                rgb: over_background(ray_colors, background),
            })
            .collect())
    }

    /// Allocates parameters for `n_images` images, keeps existing values, and sets which parameters
    /// are optimized.
    pub(crate) fn allocate_images(
        &mut self,
        gpu: &Gpu,
        n_images: usize,
        learned: ParamSet,
    ) -> Result<(), Error> {
        let n_images = u32::try_from(n_images).expect("few images");
        let n_allocated = self.images.as_ref().map_or(0, |images| images.n_images);
        let rule = ImageParamRule {
            learned: learned_bits(learned),
            // The number is a power of two, so that the buffer is not replaced for each new image
            // of a live run.
            n_images: if n_allocated >= n_images {
                n_allocated
            } else {
                n_images.next_power_of_two()
            },
            rotation_rate: ROTATION_RATE,
            translation_rate: TRANSLATION_RATE,
            embedding_rate: EMBEDDING_RATE,
            weight_decay: IMAGE_PARAM_DECAY,
            unused: [0; 2],
        };
        if let Some(images) = self.images.as_ref().filter(|_| n_allocated >= n_images) {
            gpu.write(&images.rule, 0, bytemuck::bytes_of(&rule));
            return Ok(());
        }
        self.passes.clear_bindings();
        let NerfBudget {
            n_rays, n_samples, ..
        } = self.sizes.nerf_budget;
        let images = ImageParamBuffers::new(gpu, &rule, n_rays, n_samples)?;
        // Values and optimizer state of known images stay. Values and state of new images start at
        // zero.
        if let Some(known) = self.images.take() {
            gpu.copy(
                (&known.image_params, 0),
                (&images.image_params, 0),
                known.image_params.bytes(),
            );
        }
        self.images = Some(images);
        Ok(())
    }

    /// Sets the appearance embeddings of images from index `first_ix` onward. Sets the pose
    /// corrections of these images to zero.
    pub(crate) fn initialize_images(
        &self,
        gpu: &Gpu,
        first_ix: usize,
        embeddings: &[[f64; EMBEDDING_DIM]],
    ) {
        if let Some(images) = &self.images {
            let row_bytes = IMAGE_PARAM_STRIDE * size_of::<ImageParam>();
            gpu.write(
                &images.image_params,
                (first_ix * row_bytes) as u64,
                bytemuck::cast_slice(&image_params_of(embeddings)),
            );
        }
    }

    /// Parameters of the first `n_images` images: rotation (rotation vector in world, radians),
    /// translation (in world, units of the scene radius) and appearance embedding. Empty if no
    /// image parameters are optimized.
    pub(crate) fn image_param_values(
        &self,
        gpu: &Gpu,
        n_images: usize,
    ) -> Result<Vec<[f64; IMAGE_PARAM_STRIDE]>, Error> {
        let Some(images) = &self.images else {
            return Ok(Vec::new());
        };
        let image_params = read_image_params(gpu, images, n_images)?;
        Ok(image_params
            .iter()
            .map(|image| image.map(|[value, ..]| f64::from(value)))
            .collect())
    }

    /// Drops all parameters of images.
    pub(crate) fn drop_images(&mut self) {
        self.passes.clear_bindings();
        self.images = None;
    }

    /// Removes an image and decrements the index of each later image.
    pub(crate) fn remove_image(&mut self, gpu: &Gpu, image_ix: usize) -> Result<(), Error> {
        let Some(images) = &self.images else {
            return Ok(());
        };
        let mut image_params = read_image_params(gpu, images, images.n_images as usize)?;
        if image_ix < image_params.len() {
            image_params.remove(image_ix);
            // The buffer keeps its size.
            image_params.push([[0.0; 4]; IMAGE_PARAM_STRIDE]);
        }
        gpu.write(&images.image_params, 0, bytemuck::cast_slice(&image_params));
        Ok(())
    }

    /// Resets all image parameters except these to zero.
    pub(crate) fn reset_image_params_except(
        &mut self,
        gpu: &Gpu,
        kept: ParamSet,
    ) -> Result<(), Error> {
        let Some(images) = &self.images else {
            return Ok(());
        };
        let mut image_params = read_image_params(gpu, images, images.n_images as usize)?;
        for (ix, image_param) in image_params
            .iter_mut()
            .flat_map(|image| image.iter_mut().enumerate())
        {
            if learned_bits(kept) & (1 << ix) == 0 {
                *image_param = [0.0; 4];
            }
        }
        gpu.write(&images.image_params, 0, bytemuck::cast_slice(&image_params));
        Ok(())
    }

    /// Writes the inputs of step `slot_ix` of a submit, which trains on `rays`.
    fn write_slot(
        &mut self,
        gpu: &Gpu,
        options: &ModelOptions<NerfOptions>,
        slot_ix: usize,
        step: u64,
        rays: &[Ray],
    ) -> Result<(), Error> {
        let NerfBudget {
            n_rays, n_samples, ..
        } = self.sizes.nerf_budget;
        self.make_slot(gpu, slot_ix)?;
        let slot = &self.slots[slot_ix];
        gpu.write(&slot.rays, 0, bytemuck::cast_slice(rays));
        // This limits the samples of a single ray. The whole batch has its own limit, see
        // `place_samples`.
        let max_samples_per_ray = n_samples / n_rays * MAX_SAMPLES_OVER_MEAN;
        gpu.write(
            &slot.march,
            0,
            bytemuck::bytes_of(&March {
                max_samples: max_samples_per_ray.max(1),
                ..march_of(self.sizes.nerf_budget)
            }),
        );
        let [red, green, blue] = background(options, step);
        let loss = RayLoss {
            background_srgb: [red, green, blue, 0.0],
            distance_weight: f32_of(options.specific.distance_weight),
            distance_clip: DISTANCE_CLIP,
            distortion: f32_of(options.specific.distortion),
            near: DISTORTION_NEAR,
            line_of_sight: f32_of(options.specific.line_of_sight),
            // A surface cannot be located more accurately than the length of the steps, see
            // design/nerf.md.
            band: 2.0 * march_of(self.sizes.nerf_budget).step,
            band_frac: DEPTH_BAND_FRAC,
            unused: 0.0,
        };
        gpu.write(&slot.loss, 0, bytemuck::bytes_of(&loss));
        let n_rays = u32::try_from(rays.len()).expect("at most the rays of a step");
        // All steps of a submit have the same number of rays.
        gpu.write(
            &self.samples.batch,
            0,
            bytemuck::bytes_of(&Batch::of(n_rays)),
        );
        Ok(())
    }

    /// Records both networks with the kernels for rendering, for every sample of the last step.
    pub(crate) fn record_colors(&mut self, gpu: &Gpu) -> Result<(), Error> {
        let NerfBudget {
            n_rays, n_samples, ..
        } = self.sizes.nerf_budget;
        let canvas = Canvas::new(
            gpu,
            &self.compiled.widths,
            self.field.n_entries,
            n_rays.into(),
            n_rays,
            n_samples,
        )?;
        let Self {
            compiled,
            field,
            samples,
            slots,
            passes: list,
            ..
        } = self;
        let image_params = &field.no_image_params;
        FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot: &slots[0],
            image_params,
        }
        .all_picture_colors(list, &canvas);
        Ok(())
    }

    /// Submits the recorded passes. The returned read completes when these passes have completed.
    pub(crate) fn submit(&mut self, gpu: &Gpu) -> PendingRead {
        self.passes.submit_reading(gpu, &[(&self.samples.batch, 8)])
    }

    /// Submits the recorded passes with timestamps around each.
    pub(crate) fn submit_timed(&mut self, gpu: &Gpu) -> Result<Vec<PassTiming>, Error> {
        Ok(self.passes.submit_timed(gpu)?)
    }

    /// Halves the size of cells and steps. The new cells inherit the occupancy of the old cells. No
    /// submit may be in flight.
    pub(crate) fn refine_cells(&mut self, gpu: &Gpu) -> Result<(), Error> {
        // The occupancy is read before the old buffers are dropped.
        let n = self.sizes.nerf_budget.n_cells as usize;
        let known: Vec<f32> = gpu.read(&self.occupancy.cell_occupancy, n.pow(3))?;
        self.sizes.nerf_budget = self.sizes.nerf_budget.refined();
        self.sizes.can_refine = false;
        self.passes.clear_bindings();
        self.occupancy = Occupancy::new(
            gpu,
            &occupancy_update_of(&self.sizes.nerf_budget),
            self.sizes.has_depth,
        )?;
        let refined: Vec<f32> = (0..4 * n * n)
            .into_par_iter()
            .flat_map_iter(|row| coarse_cells_of_row(row, n))
            .map(|cell| half_step_opacity(known[cell]))
            .collect();
        gpu.write(
            &self.occupancy.cell_occupancy,
            0,
            bytemuck::cast_slice(&refined),
        );
        self.make_slot(gpu, 0)?;
        let Self {
            compiled,
            field,
            samples,
            occupancy,
            moments,
            slots,
            passes: list,
            ..
        } = self;
        let passes = FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot: &slots[0],
            image_params: &field.no_image_params,
        };
        // Rays read the marks instead of the values, so the marks are updated before the next step.
        passes.mark_occupied_cells(list, occupancy, moments);
        list.submit(gpu);
        Ok(())
    }

    /// Parameters for walking rays.
    pub(crate) fn march(&self) -> reference::March {
        let NerfBudget {
            n_cells, n_steps, ..
        } = self.sizes.nerf_budget;
        reference::March {
            step: 2.0 / f64::from(n_steps),
            max_samples: usize::MAX,
            n_cells: n_cells as usize,
        }
    }

    /// Applies hints from depth images to the occupancy.
    pub(crate) fn hint(&mut self, gpu: &Gpu, hints: &[u32]) -> Result<(), Error> {
        if hints.is_empty() {
            return Ok(());
        }
        let buffer = gpu.storage_with("nerf.hints", bytemuck::cast_slice(&pad_hints(hints)))?;
        self.make_slot(gpu, 0)?;
        let Self {
            compiled,
            field,
            samples,
            occupancy,
            moments,
            slots,
            passes: list,
            ..
        } = self;
        FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot: &slots[0],
            image_params: &field.no_image_params,
        }
        .hint(list, occupancy, moments, &buffer);
        list.submit(gpu);
        // The hints are used once.
        list.clear_bindings();
        Ok(())
    }

    fn make_slot(&mut self, gpu: &Gpu, slot_ix: usize) -> Result<(), Error> {
        if self.slots.len() <= slot_ix {
            self.slots
                .push(RaySlot::new(gpu, self.sizes.nerf_budget.n_rays)?);
        }
        Ok(())
    }

    /// Renders a pinhole view, given in units of the radius of `extent`, with an appearance
    /// embedding.
    ///
    /// Rays are sampled in rounds of a few samples, until all rays are opaque or have no occupied
    /// cells left.
    pub(crate) fn draw(
        &mut self,
        gpu: &Gpu,
        camera: &Camera,
        background_srgb: [f32; 3],
        extent: &Extent,
        embedding: [f64; EMBEDDING_DIM],
        output: Output,
    ) -> Result<Option<Rendered>, Error> {
        let n_pixels = camera.size_px[0] as usize * camera.size_px[1] as usize;
        self.make_canvas(gpu, n_pixels as u64)?;
        let Some((slot, samples, canvas)) = &self.picture else {
            return Err(Error::internal("the canvas of a picture is missing"));
        };
        write_view(gpu, canvas, camera, background_srgb, extent, embedding);
        let erased = self.erased.set(
            gpu,
            &mut self.passes,
            &camera.edits,
            extent.world_from_scene(),
        )?;
        let Self {
            compiled,
            field,
            occupancy,
            passes: list,
            sizes,
            reader,
            picture_rounds,
            ..
        } = self;
        let image_params = &canvas.image_params;
        let picture_passes = FieldPasses {
            gpu,
            pipelines: &compiled.pipelines,
            field,
            samples,
            slot,
            image_params,
        };
        picture_passes.convert_for_picture(list, canvas);

        // The prepass over every fourth pixel along x and y comes first. All rays of the picture
        // start at the distances that it finds.
        let low_px: usize = camera
            .size_px
            .map(|px| px.div_ceil(FRONT_STRIDE) as usize)
            .iter()
            .product();
        let batches: Vec<PictureBatch> = PictureBatch::all(low_px, slot.n_rays, FRONT_STRIDE)
            .chain(PictureBatch::all(n_pixels, slot.n_rays, 1))
            .collect();

        // The number of rounds is fixed before they are recorded, so the host waits only once per
        // attempt. If rays remain, the picture is drawn again with more rounds.
        loop {
            for (batch_ix, batch) in batches.iter().enumerate() {
                batch.write(&picture_passes, canvas, sizes.nerf_budget);
                batch.record(
                    &picture_passes,
                    list,
                    canvas,
                    occupancy,
                    erased,
                    *picture_rounds,
                );
                let at = 8 * batch_ix as u64;
                list.copy((&samples.batch, 4), (&canvas.progress, at), 4);
                list.copy((&canvas.selected, 8), (&canvas.progress, at + 4), 4);
                // The next batch overwrites the parameters of this batch.
                list.submit(gpu);
            }
            let progress = gpu.read::<[u32; 2]>(&canvas.progress, batches.len())?;
            let needed = progress
                .iter()
                .map(|[_, n_rounds]| *n_rounds)
                .max()
                .unwrap_or(0);
            // The last round of a complete batch found no samples.
            let is_complete = progress.iter().all(|[n_samples, _]| *n_samples == 0)
                || *picture_rounds >= MAX_ROUNDS;
            *picture_rounds = next_rounds(*picture_rounds, needed, is_complete);
            if is_complete {
                break;
            }
        }
        reader.read(
            gpu,
            list,
            output,
            camera.size_px,
            [&canvas.pixels, &canvas.depths],
        )
    }

    fn make_canvas(&mut self, gpu: &Gpu, n_pixels: u64) -> Result<(), Error> {
        let n_rays = u32::try_from(n_pixels)
            .unwrap_or(u32::MAX)
            .min(self.sizes.nerf_budget.picture_rays);
        let fits = |(slot, _, canvas): &(RaySlot, SampleBuffers, Canvas)| {
            canvas.n_pixels >= n_pixels && slot.n_rays >= n_rays
        };
        if !self.picture.as_ref().is_some_and(fits) {
            // The old buffers are freed before the larger buffers are allocated.
            self.passes.clear_bindings();
            self.picture = None;
            let samples = SampleBuffers::new(gpu, SAMPLES_PER_ROUND * n_rays)?;
            let canvas = Canvas::new(
                gpu,
                &self.compiled.widths,
                self.field.n_entries,
                n_pixels,
                n_rays,
                samples.n_samples,
            )?;
            self.picture = Some((RaySlot::new(gpu, n_rays)?, samples, canvas));
        }
        Ok(())
    }
}

/// Rays of a picture that are processed at once.
#[derive(Clone, Copy, Debug)]
struct PictureBatch {
    first_ray: u32,
    n_rays: u32,
    /// Pixels along x and y per ray. The value is 1, except in the prepass, where it is larger.
    pixel_stride: u32,
}

impl PictureBatch {
    /// Batches of up to `max_rays` that cover `n_rays`.
    fn all(n_rays: usize, max_rays: u32, pixel_stride: u32) -> impl Iterator<Item = Self> {
        let max_rays = max_rays as usize;
        (0..n_rays).step_by(max_rays).map(move |first| {
            let [first_ray, n_rays] = [first, (n_rays - first).min(max_rays)]
                .map(|ix| u32::try_from(ix).expect("an image's pixels"));
            Self {
                first_ray,
                n_rays,
                pixel_stride,
            }
        })
    }

    /// Writes the parameters of the batch before its passes.
    fn write(&self, passes: &FieldPasses<'_>, canvas: &Canvas, nerf_budget: NerfBudget) {
        let gpu = passes.gpu;
        let march = March {
            first_ray: self.first_ray,
            max_found: SAMPLES_PER_ROUND,
            pixel_stride: self.pixel_stride,
            ..march_of(nerf_budget)
        };
        gpu.write(&passes.slot.march, 0, bytemuck::bytes_of(&march));
        for batch in [&passes.samples.batch, &canvas.selected] {
            gpu.write(batch, 0, bytemuck::bytes_of(&Batch::of(self.n_rays)));
        }
    }

    /// Records the passes of the batch, with a fixed number of rounds of samples.
    fn record(
        &self,
        passes: &FieldPasses<'_>,
        list: &mut Passes,
        canvas: &Canvas,
        occupancy: &Occupancy,
        erased: &Buffer,
        n_rounds: u32,
    ) {
        passes.picture_rays(list, canvas);
        for _ in 0..n_rounds {
            passes.find(list, occupancy, erased);
            passes.select(list, canvas);
            // The prepass needs only the distances at which rays become opaque.
            if self.pixel_stride == 1 {
                passes.picture_colors(list, canvas);
                passes.show(list, canvas);
            }
        }
        if self.pixel_stride > 1 {
            passes.keep_fronts(list, canvas);
        }
    }
}

/// Writes the parameters of a picture: its view, its background and its appearance embedding.
fn write_view(
    gpu: &Gpu,
    canvas: &Canvas,
    camera: &Camera,
    background_srgb: [f32; 3],
    extent: &Extent,
    embedding: [f64; EMBEDDING_DIM],
) {
    gpu.write(&canvas.view, 0, bytemuck::bytes_of(&camera.view()));
    // Depth is read back in meters, but rays are in units of the radius.
    let backdrop = Backdrop {
        srgb: background_srgb,
        radius_m: f32_of(extent.radius_m),
    };
    gpu.write(&canvas.backdrop, 0, bytemuck::bytes_of(&backdrop));
    gpu.write(
        &canvas.image_params,
        0,
        bytemuck::cast_slice(&image_params_of(&[embedding])),
    );
}

/// Number of rounds for the next attempt, or for the next picture.
fn next_rounds(n_rounds: u32, needed: u32, is_complete: bool) -> u32 {
    let n_next = if is_complete {
        // The next picture gets a few additional rounds, because its rays may need more samples.
        // Rounds without samples take little time.
        needed + needed / 4 + 2
    } else {
        2 * n_rounds
    };
    n_next.min(MAX_ROUNDS)
}

/// Reproducible random numbers. Each number depends only on seed, stream and index, so the numbers
/// can be computed in parallel, and in any order.
#[derive(Clone, Copy, Debug)]
struct RandomStream {
    seed: u64,
    stream: u64,
}

impl RandomStream {
    /// A number between `-bound` and `bound`.
    fn uniform(&self, ix: usize, bound: f64) -> f32 {
        let Self { seed, stream } = self;
        let bits = hash(seed ^ hash(stream << 40 | ix as u64));
        f32_of(bound * (2.0 * unit_from_bits(bits) - 1.0))
    }
}

/// The coarse cells around the cells of a row, after the `n` cells along each axis were halved.
fn coarse_cells_of_row(row: usize, n: usize) -> impl Iterator<Item = usize> {
    let y = row % (2 * n);
    let z = row / (2 * n);
    (0..2 * n).map(move |x| x / 2 + n * (y / 2 + n * (z / 2)))
}

/// Opacity of a step of half the length. This is half the opacity if the opacity is small. Values
/// that are not positive mark cells that were never updated, or that no image observes.
fn half_step_opacity(cell_occupancy: f32) -> f32 {
    if cell_occupancy > 0.0 {
        0.5 * cell_occupancy
    } else {
        cell_occupancy
    }
}

/// Color of a ray over a background. The last number of `ray_color` is the transmittance.
fn over_background([red, green, blue, left]: [f32; 4], background: [f32; 3]) -> [f64; 3] {
    let composite_over = |channel: usize, color: f32| f64::from(color + left * background[channel]);
    [
        composite_over(0, red),
        composite_over(1, green),
        composite_over(2, blue),
    ]
}

/// Rendered color of a ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayColor {
    /// Mean squared color error.
    pub(crate) error: f64,
    /// Composited over the background.
    pub(crate) rgb: [f64; 3],
}

/// A random background, so that the field cannot use the background to explain the images.
fn background(options: &ModelOptions<NerfOptions>, step: u64) -> [f32; 3] {
    [0, 1, 2].map(|ix| {
        f32_of(unit_from_bits(hash(
            options.common.seed ^ hash(step << 2 | ix),
        )))
    })
}

/// Parameters and optimizer state of the first images.
fn read_image_params(
    gpu: &Gpu,
    images: &ImageParamBuffers,
    n_images: usize,
) -> Result<Vec<[ImageParam; IMAGE_PARAM_STRIDE]>, Error> {
    Ok(gpu.read(&images.image_params, n_images.min(images.n_images as usize))?)
}

/// Size of an image's appearance embedding.
fn embedding_dim() -> u32 {
    u32::try_from(EMBEDDING_DIM).expect("a few")
}

/// Bit mask of the optimized parameters.
fn learned_bits(learned: ParamSet) -> u32 {
    let mut bits = 0;
    if learned.contains(ParamSet::IMAGE_POSES) {
        bits |= bit_range(0, EMBEDDING);
    }
    if learned.contains(ParamSet::IMAGE_GAINS) {
        bits |= bit_range(EMBEDDING, EMBEDDING_DIM);
    }
    bits
}

/// `n` bits from the bit `first` on.
fn bit_range(first: usize, n: usize) -> u32 {
    ((1_u32 << n) - 1) << first
}

/// Parameters of an occupancy update.
fn occupancy_update_of(nerf_budget: &NerfBudget) -> OccupancyUpdate {
    let NerfBudget {
        n_samples,
        n_cells,
        n_steps,
        ..
    } = *nerf_budget;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a fraction of a u32"
    )]
    let n_points = (f64::from(n_cells.pow(3)) * UPDATED_FRAC) as u32;
    OccupancyUpdate {
        n_cells,
        n_points: n_points.min(n_samples),
        decay: OCCUPANCY_DECAY,
        step: 2.0 / n_steps as f32,
    }
}

/// Pads the hints to a multiple of 16 bytes, which buffers require. The last hint is repeated.
fn pad_hints(hints: &[u32]) -> Vec<u32> {
    let n = hints.len().next_multiple_of(4);
    hints
        .iter()
        .chain(std::iter::repeat_n(
            &hints[hints.len() - 1],
            n - hints.len(),
        ))
        .copied()
        .collect()
}

fn march_of(nerf_budget: NerfBudget) -> March {
    March {
        step: 2.0 / nerf_budget.n_steps as f32,
        max_samples: 1,
        n_cells: nerf_budget.n_cells,
        first_ray: 0,
        max_found: u32::MAX,
        pixel_stride: 1,
        unused: [0; 2],
    }
}

fn rule(options: &ModelOptions<NerfOptions>, weight_decay: f32) -> AdamRule {
    AdamRule {
        rate: f32_of(options.specific.rate),
        final_rate_frac: f32_of(options.specific.final_rate_frac),
        // The values are from Mueller et al. 2022, section 4. Gradients of grid entries are small
        // and rare, so epsilon must be far below them.
        betas: [0.9, 0.99],
        epsilon: 1e-15,
        weight_decay,
        n_planned_steps: options.common.n_planned_steps as f32,
        unused: 0.0,
    }
}
