//! The stages of rendering and training, as lists of passes.

use super::buffers::{
    FieldBuffers, FieldGradients, FieldMoments, ImageParamBuffers, Occupancy, RaySlot, SampleBuffers, StepBuffers,
    THREADS_PER_RAY, n_blocks,
};
use super::kernels::{CHUNK_TILES, FieldPipelines, N_TILE};
use super::params::{Backdrop, IMAGE_PARAM_STRIDE, ImageParam};
use crate::Error;
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::view::View;
use std::ops::Range;

/// Resources for the passes of one batch of rays.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldPasses<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) pipelines: &'a FieldPipelines,
    pub(crate) field: &'a FieldBuffers,
    pub(crate) samples: &'a SampleBuffers,
    pub(crate) slot: &'a RaySlot,
    /// Parameters of the images to which the rays belong.
    pub(crate) image_params: &'a Buffer,
}

/// Buffers that a picture is rendered into.
#[derive(Debug)]
pub(crate) struct Canvas {
    pub(crate) view: Buffer,
    pub(crate) backdrop: Buffer,
    pub(crate) pixels: Buffer,
    pub(crate) depths: Buffer,
    /// Parameters of the image whose appearance is used.
    pub(crate) image_params: Buffer,
    /// Color and transmittance accumulated by the rays of a batch.
    light: Buffer,
    pub(crate) n_pixels: u64,
}

impl Canvas {
    pub(crate) fn new(gpu: &Gpu, n_pixels: u64, n_rays: u32) -> Result<Self, Error> {
        Ok(Self {
            view: gpu.uniform_with("nerf.view", &<View as bytemuck::Zeroable>::zeroed()),
            backdrop: gpu.uniform_with("nerf.backdrop", &<Backdrop as bytemuck::Zeroable>::zeroed()),
            pixels: gpu.storage("nerf.pixels", 4 * n_pixels)?,
            depths: gpu.storage("nerf.depths", 4 * n_pixels)?,
            image_params: gpu
                .storage("nerf.picture_image_params", (IMAGE_PARAM_STRIDE * size_of::<ImageParam>()) as u64)?,
            light: gpu.storage("nerf.light", 32 * u64::from(n_rays))?,
            n_pixels,
        })
    }
}

/// Layers of both networks.
const N_LAYERS: u64 = 5;
/// Byte range of the number of samples in a batch.
const N_SAMPLES_BYTES: Range<u64> = 4..8;

fn groups(n: u32, size: u32) -> u64 {
    u64::from(n).div_ceil(u64::from(size))
}

impl FieldPasses<'_> {
    /// Counts the segments of rays in occupied cells.
    pub(crate) fn count(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let found = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("rays", &slot.rays),
            ("occupied", &occupancy.occupied),
            ("n_found", &slot.n_found),
            ("n_before", &slot.n_before),
        ];
        list.dispatch(gpu, &pipelines.count_samples, groups(THREADS_PER_RAY * slot.n_rays, 64), &found);
    }

    /// Turns segments into samples. Run after [`FieldPasses::count`].
    pub(crate) fn place_samples_in_rays(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let shared =
            [("batch", &samples.batch), ("march", &slot.march), ("n_found", &slot.n_found), ("rays", &slot.rays)];
        list.dispatch(gpu, &pipelines.place_samples, 1, &shared);
        let written = [
            ("n_before", &slot.n_before),
            ("occupied", &occupancy.occupied),
            ("spans", &samples.spans),
            ("points", &samples.points),
        ];
        let n_groups = groups(THREADS_PER_RAY * slot.n_rays, 64);
        list.dispatch(gpu, &pipelines.write_samples, n_groups, &[&shared[..], &written].concat());
    }

    /// Updates a subset of the occupancy cells. Overwrites the batch.
    pub(crate) fn occupancy_update(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, samples, .. } = *self;
        let Occupancy { cell_occupancy, occupancy_update, n_points, .. } = occupancy;
        let (occupancy_update, steps) = (("occupancy_update", occupancy_update), ("steps", &moments.steps));
        let n_point_groups = groups(*n_points, 64);
        let sampled = [occupancy_update, steps, ("batch", &samples.batch), ("points", &samples.points)];
        list.dispatch(gpu, &pipelines.sample_cells, n_point_groups, &sampled);
        self.densities(list);
        let cell_occupancy = ("cell_occupancy", cell_occupancy);
        list.dispatch(
            gpu,
            &pipelines.update_cells,
            n_point_groups,
            &[occupancy_update, steps, ("log_density", &samples.log_density), cell_occupancy],
        );
        self.mark_occupied_cells(list, occupancy, moments);
    }

    /// Applies hints from depth, see [`super::carve::hints`].
    pub(crate) fn hint(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments, hints: &Buffer) {
        for kernel in &self.pipelines.hint_cells {
            let n_groups = (hints.bytes() / 4).div_ceil(64);
            list.dispatch(
                self.gpu,
                kernel,
                n_groups,
                &[("hints", hints), ("cell_occupancy", &occupancy.cell_occupancy)],
            );
        }
        self.mark_occupied_cells(list, occupancy, moments);
    }

    /// Marks the cells in which rays are sampled.
    pub(crate) fn mark_occupied_cells(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, .. } = *self;
        let Occupancy { occupied, cell_occupancy, occupancy_sum, occupancy_update, n_cells, .. } = occupancy;
        let (cell_occupancy, steps) = (("cell_occupancy", cell_occupancy), ("steps", &moments.steps));
        list.clear(occupancy_sum);
        let (sum, n_word_groups) = (("occupancy_sum", occupancy_sum), groups(n_cells.pow(3) / 32, 64));
        list.dispatch(gpu, &pipelines.sum_cells, n_word_groups, &[cell_occupancy, sum]);
        list.dispatch(gpu, &pipelines.mark_cells, n_word_groups, &[cell_occupancy, sum, ("occupied", occupied), steps]);
        let n_words = n_blocks(*n_cells).pow(3).div_ceil(32);
        list.dispatch(
            gpu,
            &pipelines.mark_blocks,
            groups(n_words, 64),
            &[("occupancy_update", occupancy_update), ("occupied", occupied)],
        );
    }

    /// Converts the current weights to the number type of the layers.
    pub(crate) fn convert_weights(&self, list: &mut Passes) {
        let Self { gpu, pipelines, field, .. } = *self;
        if let (Some(kernel), Some(half)) = (&pipelines.weights_to_half, &field.half_weights) {
            let n_groups = (half.bytes() / 16).div_ceil(64);
            list.dispatch(gpu, kernel, n_groups, &[("weights", &field.weights), ("half_weights", half)]);
        }
    }

    /// Density of every point, before the exponential. Run after [`FieldPasses::convert_weights`].
    fn densities(&self, list: &mut Passes) {
        self.networks(list, &self.pipelines.densities, &self.field.unused_buffer);
    }

    /// Density and color of every sample, before the exponential and the sigmoid. Run after
    /// [`FieldPasses::convert_weights`].
    pub(crate) fn colors(&self, list: &mut Passes) {
        self.networks(list, &self.pipelines.colors, &self.field.unused_buffer);
    }

    /// Like [`FieldPasses::colors`], and stores everything needed for the backward pass.
    pub(crate) fn forward(&self, list: &mut Passes, step: &StepBuffers) {
        self.networks(list, &self.pipelines.forward, &step.activations);
    }

    fn networks(&self, list: &mut Passes, pipeline: &Pipeline, activations: &Buffer) {
        let Self { gpu, field, samples, slot, image_params, .. } = *self;
        let buffers = [
            ("batch", &samples.batch),
            ("levels", &field.levels),
            ("points", &samples.points),
            ("grid", &field.grid),
            ("weights", field.working_weights()),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("image_params", image_params),
            ("log_density", &samples.log_density),
            ("colors", &samples.colors),
            ("activations", activations),
        ];
        list.dispatch(gpu, pipeline, groups(samples.n_samples, N_TILE), &buffers);
    }

    /// Finds the next samples of a picture's rays.
    pub(crate) fn find(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        list.clear_range(&samples.batch, N_SAMPLES_BYTES);
        let found = [
            ("march", &slot.march),
            ("occupied", &occupancy.occupied),
            ("batch", &samples.batch),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("points", &samples.points),
        ];
        list.dispatch(gpu, &pipelines.find_samples, groups(slot.n_rays, 256), &found);
    }

    /// Generates the rays of a picture's pixels.
    pub(crate) fn picture_rays(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let posed = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("rays", &slot.rays),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.picture_rays, groups(slot.n_rays, 64), &posed);
    }

    /// Writes the pixels of the rays. Run after [`FieldPasses::colors`].
    pub(crate) fn show(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let shown = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("backdrop", &canvas.backdrop),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("log_density", &samples.log_density),
            ("colors", &samples.colors),
            ("pixels", &canvas.pixels),
            ("depths", &canvas.depths),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.show_rays, groups(slot.n_rays, 64), &shown);
    }

    /// Corrects the rays by the optimized poses of their images.
    pub(crate) fn apply_pose(&self, list: &mut Passes) {
        let Self { gpu, pipelines, samples, slot, image_params, .. } = *self;
        let posed = [("batch", &samples.batch), ("image_params", image_params), ("rays", &slot.rays)];
        list.dispatch(gpu, &pipelines.apply_poses, groups(slot.n_rays, 64), &posed);
    }

    /// Gradients with respect to the poses of rays. Run after [`FieldPasses::backward`].
    pub(crate) fn pose_gradients(&self, list: &mut Passes, step: &StepBuffers, images: &ImageParamBuffers) {
        let Self { gpu, pipelines, field, samples, slot, .. } = *self;
        let (batch, rays, spans) = (("batch", &samples.batch), ("rays", &slot.rays), ("spans", &samples.spans));
        let v_points = ("v_points", &images.v_points);
        let looked_up = [
            batch,
            ("levels", &field.levels),
            ("points", &samples.points),
            ("grid", &field.grid),
            rays,
            spans,
            ("v_activations", &step.v_activations),
            v_points,
        ];
        list.dispatch(gpu, &pipelines.point_gradients, groups(samples.n_samples, 64), &looked_up);
        let summed = [batch, rays, spans, v_points, ("v_rays", &images.v_rays)];
        list.dispatch(gpu, &pipelines.ray_gradients, groups(slot.n_rays, 64), &summed);
    }

    /// Gradients of samples with respect to the appearance embeddings of their images. Run after
    /// [`FieldPasses::backward`].
    pub(crate) fn embedding_gradients(&self, list: &mut Passes, step: &StepBuffers, images: &ImageParamBuffers) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        let carried = [
            ("batch", &samples.batch),
            ("weights", &field.weights),
            ("v_activations", &step.v_activations),
            ("v_embeddings", &images.v_embeddings),
        ];
        list.dispatch(gpu, &pipelines.embedding_gradients, groups(samples.n_samples, 64), &carried);
    }

    /// One optimizer step for the parameters of all images. Run after their gradients.
    pub(crate) fn update_images(&self, list: &mut Passes, moments: &FieldMoments, images: &ImageParamBuffers) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let learned = [
            ("batch", &samples.batch),
            ("rule", &images.rule),
            ("step_scale", &moments.step_scale),
            ("rays", &slot.rays),
            ("v_rays", &images.v_rays),
            ("v_embeddings", &images.v_embeddings),
            ("image_params", &images.image_params),
        ];
        list.dispatch(gpu, &pipelines.update_images, images.n_images.into(), &learned);
    }

    /// Color and loss of every ray, and the gradients with respect to its samples. Run after [`FieldPasses::forward`].
    pub(crate) fn composite(&self, list: &mut Passes, step: &StepBuffers) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let composited = [
            ("batch", &samples.batch),
            ("loss", &slot.loss),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("log_density", &samples.log_density),
            ("colors", &samples.colors),
            ("ray_colors", &step.ray_colors),
            ("ray_errors", &step.ray_errors),
            ("v_log_density", &step.v_log_density),
            ("v_colors", &step.v_colors),
        ];
        list.dispatch(gpu, &pipelines.composite, groups(slot.n_rays, 64), &composited);
    }

    /// Loss of every ray, and the gradients with respect to all parameters of the field. Run after
    /// [`FieldPasses::forward`].
    pub(crate) fn backward(&self, list: &mut Passes, step: &StepBuffers, gradients: &FieldGradients) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        self.composite(list, step);
        let batch = ("batch", &samples.batch);
        let (v_log_density, v_colors) = (("v_log_density", &step.v_log_density), ("v_colors", &step.v_colors));
        let (activations, v_activations) = (("activations", &step.activations), ("v_activations", &step.v_activations));
        let carried = [
            batch,
            ("levels", &field.levels),
            ("points", &samples.points),
            ("weights", field.working_weights()),
            activations,
            v_log_density,
            v_colors,
            ("scales", &gradients.scales),
            v_activations,
            ("v_grid", &gradients.grid),
            ("counts", &gradients.counts),
        ];
        list.dispatch(gpu, &pipelines.field_backward, groups(samples.n_samples, N_TILE), &carried);
        let n_chunks = groups(samples.n_samples, N_TILE * CHUNK_TILES);
        let summed = [batch, activations, v_activations, ("partial_sums", &step.partial_sums)];
        list.dispatch(gpu, &pipelines.weight_gradients, N_LAYERS * n_chunks, &summed);
    }

    /// One optimizer step, with separate rules for grid and weights. Resets the gradients of the grid to zero. Run
    /// after [`FieldPasses::backward`].
    pub(crate) fn update(
        &self,
        list: &mut Passes,
        [grid_rule, weights_rule]: [&Buffer; 2],
        step: &StepBuffers,
        gradients: &FieldGradients,
        moments: &FieldMoments,
    ) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        let (steps, step_scale) = (("steps", &moments.steps), ("step_scale", &moments.step_scale));
        let weighed = [
            ("rule", weights_rule),
            step_scale,
            ("batch", &samples.batch),
            ("partial_sums", &step.partial_sums),
            ("weights", &field.weights),
            ("moments", &moments.weights),
        ];
        list.dispatch(gpu, &pipelines.update_weights, (field.weights.bytes() / 16).div_ceil(16), &weighed);
        let (scales, largest) = (("scales", &gradients.scales), ("largest", &moments.largest));
        let learned = [
            ("rule", grid_rule),
            step_scale,
            scales,
            largest,
            ("levels", &field.levels),
            ("grid", &field.grid),
            ("moments", &moments.grid),
            ("v_grid", &gradients.grid),
        ];
        list.dispatch(gpu, &pipelines.update_grid, groups(field.n_entries, 256), &learned);
        list.dispatch(
            gpu,
            &pipelines.end_step,
            1,
            &[("rule", grid_rule), steps, step_scale, scales, largest, ("counts", &gradients.counts)],
        );
    }
}
