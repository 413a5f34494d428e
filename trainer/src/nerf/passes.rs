//! The stages of rendering and training, as lists of passes.

use super::buffers::{
    FieldBuffers, FieldGradients, FieldMoments, ImageParamBuffers, Occupancy, RaySlot,
    SampleBuffers, StepBuffers, THREADS_PER_RAY, n_box_words,
};
use super::kernels::{CHUNK_TILES, FieldPipelines, N_TILE, Widths};
use super::params::{Backdrop, Batch, IMAGE_PARAM_STRIDE, ImageParam};
use crate::Error;
use crate::view::View;
use gpu::{Buffer, Gpu, Passes, Pipeline};
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
    /// Color, transmittance, distance and front of the rays of a batch. The front is the distance
    /// at which the weights of a ray first reach 1/64.
    pub(crate) light: Buffer,
    /// Distances at which the weights of every fourth ray along x and y first reach 1/64.
    fronts: Buffer,
    /// For each batch of rays, the number of samples in its last round and the number of rounds
    /// that had samples.
    pub(crate) progress: Buffer,
    /// The grid's entries as f16.
    packed_grid: Buffer,
    /// Outputs of the first network.
    geometry: Buffer,
    /// Samples whose colors are evaluated, with their number, spans, and weights in their rays.
    pub(crate) selected: Buffer,
    selected_spans: Buffer,
    selected_weights: Buffer,
    pub(crate) n_pixels: u64,
}

impl Canvas {
    pub(crate) fn new(
        gpu: &Gpu,
        widths: &Widths,
        n_entries: u32,
        n_pixels: u64,
        n_rays: u32,
        n_samples: u32,
    ) -> Result<Self, Error> {
        let per_sample =
            |name: &str, bytes: u32| gpu.storage(name, u64::from(bytes) * u64::from(n_samples));
        Ok(Self {
            view: gpu.uniform_with("nerf.view", &<View as bytemuck::Zeroable>::zeroed()),
            backdrop: gpu
                .uniform_with("nerf.backdrop", &<Backdrop as bytemuck::Zeroable>::zeroed()),
            pixels: gpu.storage("nerf.pixels", 4 * n_pixels)?,
            depths: gpu.storage("nerf.depths", 4 * n_pixels)?,
            image_params: gpu.storage(
                "nerf.picture_image_params",
                (IMAGE_PARAM_STRIDE * size_of::<ImageParam>()) as u64,
            )?,
            light: gpu.storage("nerf.light", 32 * u64::from(n_rays))?,
            fronts: gpu.storage("nerf.fronts", 4 * n_pixels)?,
            progress: gpu.storage(
                "nerf.progress",
                8 * (2 * n_pixels.div_ceil(u64::from(n_rays)) + 1),
            )?,
            packed_grid: gpu.storage("nerf.packed_grid", 4 * u64::from(n_entries))?,
            geometry: per_sample("nerf.geometry", 16 * widths.bytes_per_number())?,
            selected: gpu.storage_with("nerf.selected", bytemuck::bytes_of(&Batch::of(0)))?,
            selected_spans: per_sample("nerf.selected_spans", 16)?,
            selected_weights: per_sample("nerf.selected_weights", 4)?,
            n_pixels,
        })
    }
}

/// Layers of both networks.
const N_LAYERS: u64 = 5;
/// Maximum number of workgroups that evaluate the networks. They process larger batches in a loop.
/// The number of samples is known only on the GPU, so there are groups for a full batch.
const MAX_NETWORK_GROUPS: u64 = 8192;
/// Byte range of the number of samples in a batch.
const N_SAMPLES_BYTES: Range<u64> = 4..8;

fn groups(n: u32, size: u32) -> u64 {
    u64::from(n).div_ceil(u64::from(size))
}

impl FieldPasses<'_> {
    /// Counts the segments of rays in occupied cells.
    pub(crate) fn count(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
        let found = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("rays", &slot.rays),
            ("occupied", &occupancy.occupied),
            ("n_found", &slot.n_found),
            ("n_before", &slot.n_before),
        ];
        list.dispatch(
            gpu,
            &pipelines.count_samples,
            groups(THREADS_PER_RAY * slot.n_rays, 64),
            &found,
        );
    }

    /// Turns segments into samples. Run after [`FieldPasses::count`].
    pub(crate) fn place_samples_in_rays(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
        let shared = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("n_found", &slot.n_found),
            ("rays", &slot.rays),
        ];
        // A single workgroup places the samples of all rays. The first sample of a ray depends on
        // all rays before it, and the number of samples that are kept depends on all rays.
        list.dispatch(gpu, &pipelines.place_samples, 1, &shared);
        let written = [
            ("n_before", &slot.n_before),
            ("occupied", &occupancy.occupied),
            ("spans", &samples.spans),
            ("points", &samples.points),
        ];
        // The rays are walked a second time, because segments cannot be stored before their number
        // is known.
        let n_groups = groups(THREADS_PER_RAY * slot.n_rays, 64);
        list.dispatch(
            gpu,
            &pipelines.write_samples,
            n_groups,
            &[&shared[..], &written].concat(),
        );
    }

    /// Updates a subset of the occupancy cells. Overwrites the batch.
    pub(crate) fn occupancy_update(
        &self,
        list: &mut Passes,
        occupancy: &Occupancy,
        moments: &FieldMoments,
    ) {
        let Self {
            gpu,
            pipelines,
            samples,
            ..
        } = *self;
        let Occupancy {
            cell_occupancy,
            occupancy_update,
            n_points,
            ..
        } = occupancy;
        let occupancy_update = ("occupancy_update", occupancy_update);
        let steps = ("steps", &moments.steps);
        let n_point_groups = groups(*n_points, 64);
        let sampled = [
            occupancy_update,
            steps,
            ("batch", &samples.batch),
            ("points", &samples.points),
        ];
        list.dispatch(gpu, &pipelines.sample_cells, n_point_groups, &sampled);
        // The points replace the samples of the batch, so that the kernels and buffers of training
        // evaluate them.
        self.densities(list);
        let cell_occupancy = ("cell_occupancy", cell_occupancy);
        list.dispatch(
            gpu,
            &pipelines.update_cells,
            n_point_groups,
            &[
                occupancy_update,
                steps,
                ("log_density", &samples.log_density),
                cell_occupancy,
            ],
        );
        self.mark_occupied_cells(list, occupancy, moments);
    }

    /// Applies hints from depth, see [`super::carve::hints`].
    pub(crate) fn hint(
        &self,
        list: &mut Passes,
        occupancy: &Occupancy,
        moments: &FieldMoments,
        hints: &Buffer,
    ) {
        // One dispatch per kind, because a cell may have several hints, and their order matters.
        for kernel in &self.pipelines.hint_cells {
            let n_groups = (hints.bytes() / 4).div_ceil(64);
            list.dispatch(
                self.gpu,
                kernel,
                n_groups,
                &[
                    ("hints", hints),
                    ("cell_occupancy", &occupancy.cell_occupancy),
                ],
            );
        }
        self.mark_occupied_cells(list, occupancy, moments);
    }

    /// Marks the cells in which rays are sampled.
    pub(crate) fn mark_occupied_cells(
        &self,
        list: &mut Passes,
        occupancy: &Occupancy,
        moments: &FieldMoments,
    ) {
        let Self { gpu, pipelines, .. } = *self;
        let Occupancy {
            occupied,
            cell_occupancy,
            occupancy_sum,
            occupancy_update,
            n_cells,
            ..
        } = occupancy;
        let cell_occupancy = ("cell_occupancy", cell_occupancy);
        let steps = ("steps", &moments.steps);
        // The threshold depends on the mean over all cells, so the sum comes first.
        list.clear(occupancy_sum);
        let sum = ("occupancy_sum", occupancy_sum);
        let n_word_groups = groups(n_cells.pow(3) / 32, 64);
        list.dispatch(
            gpu,
            &pipelines.sum_cells,
            n_word_groups,
            &[cell_occupancy, sum],
        );
        let occupancy_update = ("occupancy_update", occupancy_update);
        let marked = [
            occupancy_update,
            cell_occupancy,
            sum,
            ("occupied", occupied),
            steps,
        ];
        list.dispatch(gpu, &pipelines.mark_cells, n_word_groups, &marked);
        // Groups and blocks of both sets, which are the cells to sample and the solid cells.
        let n_words = 2 * n_box_words(*n_cells);
        list.dispatch(
            gpu,
            &pipelines.mark_blocks,
            groups(n_words, 64),
            &[occupancy_update, ("occupied", occupied)],
        );
    }

    /// Converts the current weights to the number type of the layers.
    pub(crate) fn convert_weights(&self, list: &mut Passes) {
        let Self {
            gpu,
            pipelines,
            field,
            ..
        } = *self;
        // Weights change in every step, so their f16 copies are made again. Without matrices, the
        // layers read the f32 weights.
        if let (Some(kernel), Some(half)) = (&pipelines.weights_to_half, &field.half_weights) {
            let n_groups = (half.bytes() / 16).div_ceil(64);
            list.dispatch(
                gpu,
                kernel,
                n_groups,
                &[("weights", &field.weights), ("half_weights", half)],
            );
        }
    }

    /// Converts weights and grid to the precision used for rendering.
    pub(crate) fn convert_for_picture(&self, list: &mut Passes, canvas: &Canvas) {
        self.convert_weights(list);
        let Self {
            gpu,
            pipelines,
            field,
            ..
        } = *self;
        let n_groups = (canvas.packed_grid.bytes() / 8).div_ceil(256);
        let packed = [("grid", &field.grid), ("packed_grid", &canvas.packed_grid)];
        list.dispatch(gpu, &pipelines.pack_grid, n_groups, &packed);
    }

    /// Density of every point, before the exponential. Run after [`FieldPasses::convert_weights`].
    fn densities(&self, list: &mut Passes) {
        let unused = &self.field.unused_buffer;
        self.networks(
            list,
            &self.pipelines.densities,
            [
                &self.samples.batch,
                &self.field.grid,
                &self.samples.spans,
                unused,
                unused,
            ],
        );
    }

    /// Density and color of every sample, before the exponential and the sigmoid, and everything
    /// needed for the backward pass. Run after [`FieldPasses::convert_weights`].
    pub(crate) fn forward(&self, list: &mut Passes, step: &StepBuffers) {
        let SampleBuffers { batch, spans, .. } = self.samples;
        self.networks(
            list,
            &self.pipelines.forward,
            [
                batch,
                &self.field.grid,
                spans,
                &step.activations,
                &self.field.unused_buffer,
            ],
        );
    }

    /// Densities of a picture's samples, and the selection of the samples whose colors contribute
    /// to their rays. Run after [`FieldPasses::find`].
    pub(crate) fn select(&self, list: &mut Passes, canvas: &Canvas) {
        let Self {
            gpu,
            pipelines,
            field,
            samples,
            slot,
            ..
        } = *self;
        let Canvas {
            light,
            packed_grid,
            geometry,
            selected,
            selected_spans,
            selected_weights,
            ..
        } = canvas;
        let unused = &field.unused_buffer;
        self.networks(
            list,
            &pipelines.picture_densities,
            [
                &samples.batch,
                packed_grid,
                &samples.spans,
                unused,
                geometry,
            ],
        );
        // Each round fills the list of selected samples again from its beginning.
        list.clear_range(selected, N_SAMPLES_BYTES);
        let composited = [
            ("march", &slot.march),
            ("spans", &samples.spans),
            ("log_density", &samples.log_density),
            ("rays", &slot.rays),
            ("light", light),
            ("selected", selected),
            ("selected_spans", selected_spans),
            ("selected_weights", selected_weights),
            ("batch", &samples.batch),
        ];
        list.dispatch(
            gpu,
            &pipelines.select_samples,
            groups(slot.n_rays, 256),
            &composited,
        );
    }

    /// Colors of the selected samples. Run after [`FieldPasses::select`].
    pub(crate) fn picture_colors(&self, list: &mut Passes, canvas: &Canvas) {
        let Self {
            pipelines, field, ..
        } = *self;
        let Canvas {
            packed_grid,
            geometry,
            selected,
            selected_spans,
            ..
        } = canvas;
        let unused = &field.unused_buffer;
        self.networks(
            list,
            &pipelines.picture_colors,
            [selected, packed_grid, selected_spans, unused, geometry],
        );
    }

    /// Like [`FieldPasses::picture_colors`], but with the colors of all samples.
    pub(crate) fn all_picture_colors(&self, list: &mut Passes, canvas: &Canvas) {
        let SampleBuffers { batch, spans, .. } = self.samples;
        let buffers = [
            batch,
            &canvas.packed_grid,
            spans,
            &self.field.unused_buffer,
            &canvas.geometry,
        ];
        self.networks(list, &self.pipelines.picture_densities, buffers);
        self.networks(list, &self.pipelines.picture_colors, buffers);
    }

    fn networks(
        &self,
        list: &mut Passes,
        pipeline: &Pipeline,
        [batch, grid, spans, activations, geometry]: [&Buffer; 5],
    ) {
        let Self {
            gpu,
            field,
            samples,
            slot,
            image_params,
            ..
        } = *self;
        let buffers = [
            ("batch", batch),
            ("levels", &field.levels),
            ("points", &samples.points),
            ("grid", grid),
            ("weights", field.working_weights()),
            ("rays", &slot.rays),
            ("spans", spans),
            ("image_params", image_params),
            ("log_density", &samples.log_density),
            ("colors", &samples.colors),
            ("activations", activations),
            ("geometry", geometry),
        ];
        list.dispatch(
            gpu,
            pipeline,
            groups(samples.n_samples, N_TILE).min(MAX_NETWORK_GROUPS),
            &buffers,
        );
    }

    /// Finds the next samples of a picture's rays, outside erased space.
    pub(crate) fn find(&self, list: &mut Passes, occupancy: &Occupancy, erased: &Buffer) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
        // Rays add their samples to the batch by an atomic counter, which starts at zero in each
        // round.
        list.clear_range(&samples.batch, N_SAMPLES_BYTES);
        let found = [
            ("march", &slot.march),
            ("occupied", &occupancy.occupied),
            ("batch", &samples.batch),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("points", &samples.points),
            ("erased", erased),
        ];
        list.dispatch(
            gpu,
            &pipelines.find_samples,
            groups(slot.n_rays, 256),
            &found,
        );
    }

    /// The rays of a picture, their accumulated colors and distances, and their view.
    fn picture_bindings<'a>(&'a self, canvas: &'a Canvas) -> [(&'static str, &'a Buffer); 5] {
        [
            ("batch", &self.samples.batch),
            ("march", &self.slot.march),
            ("view", &canvas.view),
            ("rays", &self.slot.rays),
            ("light", &canvas.light),
        ]
    }

    /// Keeps the distances at which the weights of the rays first reach 1/64.
    pub(crate) fn keep_fronts(&self, list: &mut Passes, canvas: &Canvas) {
        let Self {
            gpu,
            pipelines,
            slot,
            ..
        } = *self;
        let kept = [
            &self.picture_bindings(canvas)[..],
            &[("fronts", &canvas.fronts)],
        ]
        .concat();
        list.dispatch(gpu, &pipelines.keep_fronts, groups(slot.n_rays, 64), &kept);
    }

    /// Generates the rays of a picture's pixels.
    pub(crate) fn picture_rays(&self, list: &mut Passes, canvas: &Canvas) {
        let Self {
            gpu,
            pipelines,
            slot,
            ..
        } = *self;
        let posed = [
            &self.picture_bindings(canvas)[..],
            &[("fronts", &canvas.fronts)],
        ]
        .concat();
        list.dispatch(
            gpu,
            &pipelines.picture_rays,
            groups(slot.n_rays, 64),
            &posed,
        );
    }

    /// Writes the pixels of the rays. Run after [`FieldPasses::picture_colors`].
    pub(crate) fn show(&self, list: &mut Passes, canvas: &Canvas) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
        let colored = [
            ("backdrop", &canvas.backdrop),
            ("selected_weights", &canvas.selected_weights),
            ("colors", &samples.colors),
            ("pixels", &canvas.pixels),
            ("depths", &canvas.depths),
        ];
        let shown = [&self.picture_bindings(canvas)[..], &colored].concat();
        list.dispatch(gpu, &pipelines.show_rays, groups(slot.n_rays, 64), &shown);
    }

    /// Corrects the rays by the optimized poses of their images.
    pub(crate) fn apply_pose(&self, list: &mut Passes) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            image_params,
            ..
        } = *self;
        let posed = [
            ("batch", &samples.batch),
            ("image_params", image_params),
            ("rays", &slot.rays),
        ];
        list.dispatch(gpu, &pipelines.apply_poses, groups(slot.n_rays, 64), &posed);
    }

    /// Gradients with respect to the poses of rays. Run after [`FieldPasses::backward`].
    pub(crate) fn pose_gradients(
        &self,
        list: &mut Passes,
        step: &StepBuffers,
        images: &ImageParamBuffers,
    ) {
        let Self {
            gpu,
            pipelines,
            field,
            samples,
            slot,
            ..
        } = *self;
        let batch = ("batch", &samples.batch);
        let rays = ("rays", &slot.rays);
        let spans = ("spans", &samples.spans);
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
        list.dispatch(
            gpu,
            &pipelines.point_gradients,
            groups(samples.n_samples, 64),
            &looked_up,
        );
        // A ray's gradient is the sum over its samples, in their order.
        let summed = [batch, rays, spans, v_points, ("v_rays", &images.v_rays)];
        list.dispatch(
            gpu,
            &pipelines.ray_gradients,
            groups(slot.n_rays, 64),
            &summed,
        );
    }

    /// Gradients of samples with respect to the appearance embeddings of their images. Run after
    /// [`FieldPasses::backward`].
    pub(crate) fn embedding_gradients(
        &self,
        list: &mut Passes,
        step: &StepBuffers,
        images: &ImageParamBuffers,
    ) {
        let Self {
            gpu,
            pipelines,
            field,
            samples,
            ..
        } = *self;
        let carried = [
            ("batch", &samples.batch),
            ("weights", &field.weights),
            ("v_activations", &step.v_activations),
            ("v_embeddings", &images.v_embeddings),
        ];
        list.dispatch(
            gpu,
            &pipelines.embedding_gradients,
            groups(samples.n_samples, 64),
            &carried,
        );
    }

    /// One optimizer step for the parameters of all images. Run after their gradients.
    pub(crate) fn update_images(
        &self,
        list: &mut Passes,
        moments: &FieldMoments,
        images: &ImageParamBuffers,
    ) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
        let learned = [
            ("batch", &samples.batch),
            ("rule", &images.rule),
            ("step_scale", &moments.step_scale),
            ("rays", &slot.rays),
            ("v_rays", &images.v_rays),
            ("v_embeddings", &images.v_embeddings),
            ("image_params", &images.image_params),
        ];
        // A workgroup per image sums the gradients of its rays. Images without rays in this batch
        // keep their parameters.
        list.dispatch(
            gpu,
            &pipelines.update_images,
            images.n_images.into(),
            &learned,
        );
    }

    /// Color and loss of every ray, and the gradients with respect to its samples. Run after
    /// [`FieldPasses::forward`].
    pub(crate) fn composite(&self, list: &mut Passes, step: &StepBuffers) {
        let Self {
            gpu,
            pipelines,
            samples,
            slot,
            ..
        } = *self;
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
        list.dispatch(
            gpu,
            &pipelines.composite,
            groups(slot.n_rays, 64),
            &composited,
        );
    }

    /// Loss of every ray, and the gradients with respect to all parameters of the field. Run after
    /// [`FieldPasses::forward`].
    pub(crate) fn backward(
        &self,
        list: &mut Passes,
        step: &StepBuffers,
        gradients: &FieldGradients,
    ) {
        let Self {
            gpu,
            pipelines,
            field,
            samples,
            ..
        } = *self;
        // Gradients are propagated from the loss to the samples, then through the networks to grid
        // entries and activations, and from the activations to the weights.
        self.composite(list, step);
        let batch = ("batch", &samples.batch);
        let v_log_density = ("v_log_density", &step.v_log_density);
        let v_colors = ("v_colors", &step.v_colors);
        let activations = ("activations", &step.activations);
        let v_activations = ("v_activations", &step.v_activations);
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
        list.dispatch(
            gpu,
            &pipelines.field_backward,
            groups(samples.n_samples, N_TILE),
            &carried,
        );
        // There are partial sums per chunk of samples, which `update_weights` adds in a fixed
        // order. With float atomics, the order would depend on scheduling.
        let n_chunks = groups(samples.n_samples, N_TILE * CHUNK_TILES);
        let summed = [
            batch,
            activations,
            v_activations,
            ("partial_sums", &step.partial_sums),
        ];
        list.dispatch(
            gpu,
            &pipelines.weight_gradients,
            N_LAYERS * n_chunks,
            &summed,
        );
    }

    /// One optimizer step, with separate rules for grid and weights. Resets the gradients of the
    /// grid to zero. Run after [`FieldPasses::backward`].
    pub(crate) fn update(
        &self,
        list: &mut Passes,
        [grid_rule, weights_rule]: [&Buffer; 2],
        step: &StepBuffers,
        gradients: &FieldGradients,
        moments: &FieldMoments,
    ) {
        let Self {
            gpu,
            pipelines,
            field,
            samples,
            ..
        } = *self;
        let steps = ("steps", &moments.steps);
        let step_scale = ("step_scale", &moments.step_scale);
        let weighed = [
            ("rule", weights_rule),
            step_scale,
            ("batch", &samples.batch),
            ("partial_sums", &step.partial_sums),
            ("weights", &field.weights),
            ("moments", &moments.weights),
        ];
        list.dispatch(
            gpu,
            &pipelines.update_weights,
            (field.weights.bytes() / 16).div_ceil(16),
            &weighed,
        );
        let scales = ("scales", &gradients.scales);
        let largest = ("largest", &moments.largest);
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
        list.dispatch(
            gpu,
            &pipelines.update_grid,
            groups(field.n_entries, 256),
            &learned,
        );
        // This pass is last, because it replaces the scales with which this step's gradients were
        // summed.
        list.dispatch(
            gpu,
            &pipelines.end_step,
            1,
            &[
                ("rule", grid_rule),
                steps,
                step_scale,
                scales,
                largest,
                ("counts", &gradients.counts),
            ],
        );
    }
}
