//! The stages of drawing and learning, as lists of passes.

use super::buffers::{
    FieldBuffers, FieldMoments, FieldSlopes, N_SHARES, Occupancy, RaySlot, SampleBuffers, StepBuffers, TermBuffers,
    n_blocks,
};
use super::kernels::{CHUNK_TILES, FieldPipelines, N_TILE};
use super::params::{Backdrop, TERM_STRIDE, Term};
use crate::Error;
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::splat::View;
use std::ops::Range;

/// What the passes of one batch of rays touch.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldPasses<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) pipelines: &'a FieldPipelines,
    pub(crate) field: &'a FieldBuffers,
    pub(crate) samples: &'a SampleBuffers,
    pub(crate) slot: &'a RaySlot,
    /// Of the images that the rays belong to.
    pub(crate) terms: &'a Buffer,
}

/// A picture and where it is drawn.
#[derive(Debug)]
pub(crate) struct Canvas {
    pub(crate) view: Buffer,
    pub(crate) backdrop: Buffer,
    pub(crate) pixels: Buffer,
    pub(crate) depths: Buffer,
    /// Of the image that it is to look like.
    pub(crate) terms: Buffer,
    /// What the rays of a batch have seen so far.
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
            terms: gpu.storage("nerf.picture_terms", (TERM_STRIDE * size_of::<Term>()) as u64)?,
            light: gpu.storage("nerf.light", 32 * u64::from(n_rays))?,
            n_pixels,
        })
    }
}

/// Layers of both networks.
const N_LAYERS: u64 = 5;
/// Where the number of samples lies in a batch.
const N_SAMPLES_BYTES: Range<u64> = 4..8;

fn groups(n: u32, size: u32) -> u64 {
    u64::from(n).div_ceil(u64::from(size))
}

impl FieldPasses<'_> {
    /// Finds the pieces of rays where something is.
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
        list.dispatch(gpu, &pipelines.count_samples, groups(N_SHARES * slot.n_rays, 64), &found);
    }

    /// After [`FieldPasses::count`]: makes samples of the pieces.
    pub(crate) fn place(&self, list: &mut Passes, occupancy: &Occupancy) {
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
        let n_groups = groups(N_SHARES * slot.n_rays, 64);
        list.dispatch(gpu, &pipelines.write_samples, n_groups, &[&shared[..], &written].concat());
    }

    /// Looks at some cells of the occupancy anew. What the batch held is lost.
    pub(crate) fn visit(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, samples, .. } = *self;
        let Occupancy { thickness, visit, n_points, .. } = occupancy;
        let (visit, steps) = (("visit", visit), ("steps", &moments.steps));
        let of_points = groups(*n_points, 64);
        let visited = [visit, steps, ("batch", &samples.batch), ("points", &samples.points)];
        list.dispatch(gpu, &pipelines.visit_cells, of_points, &visited);
        self.densities(list);
        let thickness = ("thickness", thickness);
        list.dispatch(gpu, &pipelines.note_cells, of_points, &[visit, steps, ("told", &samples.told), thickness]);
        self.mark(list, occupancy, moments);
    }

    /// Takes note of what depth tells, [`super::carve::hints`].
    pub(crate) fn hint(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments, hints: &Buffer) {
        for kernel in &self.pipelines.hint_cells {
            let n_groups = (hints.bytes() / 4).div_ceil(64);
            list.dispatch(self.gpu, kernel, n_groups, &[("hints", hints), ("thickness", &occupancy.thickness)]);
        }
        self.mark(list, occupancy, moments);
    }

    /// Marks the cells that rays are walked through.
    pub(crate) fn mark(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, .. } = *self;
        let Occupancy { occupied, thickness, thickness_sum, visit, n_cells, .. } = occupancy;
        let (thickness, steps) = (("thickness", thickness), ("steps", &moments.steps));
        list.clear(thickness_sum);
        let (sum, of_words) = (("thickness_sum", thickness_sum), groups(n_cells.pow(3) / 32, 64));
        list.dispatch(gpu, &pipelines.sum_cells, of_words, &[thickness, sum]);
        list.dispatch(gpu, &pipelines.mark_cells, of_words, &[thickness, sum, ("occupied", occupied), steps]);
        let n_words = n_blocks(*n_cells).pow(3).div_ceil(32);
        list.dispatch(gpu, &pipelines.mark_blocks, groups(n_words, 64), &[("visit", visit), ("occupied", occupied)]);
    }

    /// Makes layers take the weights as they are now.
    pub(crate) fn halve(&self, list: &mut Passes) {
        let Self { gpu, pipelines, field, .. } = *self;
        if let (Some(kernel), Some(half)) = (&pipelines.halve_weights, &field.half_weights) {
            let n_groups = (half.bytes() / 16).div_ceil(64);
            list.dispatch(gpu, kernel, n_groups, &[("weights", &field.weights), ("half_weights", half)]);
        }
    }

    /// After [`FieldPasses::halve`]: density of every point, before the exponential.
    fn densities(&self, list: &mut Passes) {
        self.networks(list, &self.pipelines.densities, &self.field.nothing);
    }

    /// After [`FieldPasses::halve`]: density and color of every sample, before the exponential and the sigmoid.
    pub(crate) fn colors(&self, list: &mut Passes) {
        self.networks(list, &self.pipelines.colors, &self.field.nothing);
    }

    /// As [`FieldPasses::colors`], and all that is needed on the way back.
    pub(crate) fn forward(&self, list: &mut Passes, step: &StepBuffers) {
        self.networks(list, &self.pipelines.forward, &step.held);
    }

    fn networks(&self, list: &mut Passes, pipeline: &Pipeline, held: &Buffer) {
        let Self { gpu, field, samples, slot, terms, .. } = *self;
        let buffers = [
            ("batch", &samples.batch),
            ("levels", &field.levels),
            ("points", &samples.points),
            ("grid", &field.grid),
            ("weights", field.working_weights()),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("terms", terms),
            ("told", &samples.told),
            ("colors", &samples.colors),
            ("held", held),
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

    /// Fills in the rays of a picture's pixels.
    pub(crate) fn picture_rays(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let aimed = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("rays", &slot.rays),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.picture_rays, groups(slot.n_rays, 64), &aimed);
    }

    /// After [`FieldPasses::forward`]: the pixels that the rays see.
    pub(crate) fn show(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let shown = [
            ("batch", &samples.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("backdrop", &canvas.backdrop),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("told", &samples.told),
            ("colors", &samples.colors),
            ("pixels", &canvas.pixels),
            ("depths", &canvas.depths),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.show_rays, groups(slot.n_rays, 64), &shown);
    }

    /// Moves the rays as their images' poses were found to be moved.
    pub(crate) fn aim(&self, list: &mut Passes) {
        let Self { gpu, pipelines, samples, slot, terms, .. } = *self;
        let aimed = [("batch", &samples.batch), ("terms", terms), ("rays", &slot.rays)];
        list.dispatch(gpu, &pipelines.aim_rays, groups(slot.n_rays, 64), &aimed);
    }

    /// After [`FieldPasses::backward`]: slopes towards the poses of rays.
    pub(crate) fn pose_slopes(&self, list: &mut Passes, step: &StepBuffers, images: &TermBuffers) {
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
            ("v_held", &step.v_held),
            v_points,
        ];
        list.dispatch(gpu, &pipelines.point_slopes, groups(samples.n_samples, 64), &looked_up);
        let summed = [batch, rays, spans, v_points, ("v_rays", &images.v_rays)];
        list.dispatch(gpu, &pipelines.ray_slopes, groups(slot.n_rays, 64), &summed);
    }

    /// After [`FieldPasses::backward`]: slopes of samples towards the codes of their images.
    pub(crate) fn code_slopes(&self, list: &mut Passes, step: &StepBuffers, images: &TermBuffers) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        let carried = [
            ("batch", &samples.batch),
            ("weights", &field.weights),
            ("v_held", &step.v_held),
            ("v_codes", &images.v_codes),
        ];
        list.dispatch(gpu, &pipelines.code_slopes, groups(samples.n_samples, 64), &carried);
    }

    /// After the slopes: one step of the terms of all images.
    pub(crate) fn learn_images(&self, list: &mut Passes, moments: &FieldMoments, images: &TermBuffers) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let learned = [
            ("batch", &samples.batch),
            ("rule", &images.rule),
            ("pace", &moments.pace),
            ("rays", &slot.rays),
            ("v_rays", &images.v_rays),
            ("v_codes", &images.v_codes),
            ("terms", &images.terms),
        ];
        list.dispatch(gpu, &pipelines.learn_images, images.n_images.into(), &learned);
    }

    /// After [`FieldPasses::forward`]: what every ray sees, its loss, and the slopes back to its samples.
    pub(crate) fn composite(&self, list: &mut Passes, step: &StepBuffers) {
        let Self { gpu, pipelines, samples, slot, .. } = *self;
        let composited = [
            ("batch", &samples.batch),
            ("loss", &slot.loss),
            ("rays", &slot.rays),
            ("spans", &samples.spans),
            ("told", &samples.told),
            ("colors", &samples.colors),
            ("seen", &step.seen),
            ("ray_errors", &step.ray_errors),
            ("v_log_density", &step.v_log_density),
            ("v_colors", &step.v_colors),
        ];
        list.dispatch(gpu, &pipelines.composite, groups(slot.n_rays, 64), &composited);
    }

    /// After [`FieldPasses::forward`]: the loss of every ray, and the slopes towards all that is learned.
    pub(crate) fn backward(&self, list: &mut Passes, step: &StepBuffers, slopes: &FieldSlopes) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        self.composite(list, step);
        let batch = ("batch", &samples.batch);
        let (v_log_density, v_colors) = (("v_log_density", &step.v_log_density), ("v_colors", &step.v_colors));
        let (held, v_held) = (("held", &step.held), ("v_held", &step.v_held));
        let carried = [
            batch,
            ("levels", &field.levels),
            ("points", &samples.points),
            ("weights", field.working_weights()),
            held,
            v_log_density,
            v_colors,
            ("scales", &slopes.scales),
            v_held,
            ("v_grid", &slopes.grid),
            ("counts", &slopes.counts),
        ];
        list.dispatch(gpu, &pipelines.field_backward, groups(samples.n_samples, N_TILE), &carried);
        let n_chunks = groups(samples.n_samples, N_TILE * CHUNK_TILES);
        let summed = [batch, held, v_held, ("partial_sums", &step.partial_sums)];
        list.dispatch(gpu, &pipelines.weight_slopes, N_LAYERS * n_chunks, &summed);
    }

    /// After [`FieldPasses::backward`]: one step of the optimiser, each with a rule of its own for the grid and for the weights. The
    /// slopes towards the grid are zero afterwards.
    pub(crate) fn learn(
        &self,
        list: &mut Passes,
        [of_grid, of_weights]: [&Buffer; 2],
        step: &StepBuffers,
        slopes: &FieldSlopes,
        moments: &FieldMoments,
    ) {
        let Self { gpu, pipelines, field, samples, .. } = *self;
        let (steps, pace) = (("steps", &moments.steps), ("pace", &moments.pace));
        let weighed = [
            ("rule", of_weights),
            pace,
            ("batch", &samples.batch),
            ("partial_sums", &step.partial_sums),
            ("weights", &field.weights),
            ("moments", &moments.weights),
        ];
        list.dispatch(gpu, &pipelines.learn_weights, (field.weights.bytes() / 16).div_ceil(16), &weighed);
        let (scales, largest) = (("scales", &slopes.scales), ("largest", &moments.largest));
        let learned = [
            ("rule", of_grid),
            pace,
            scales,
            largest,
            ("levels", &field.levels),
            ("grid", &field.grid),
            ("moments", &moments.grid),
            ("v_grid", &slopes.grid),
        ];
        list.dispatch(gpu, &pipelines.learn_grid, groups(field.n_entries, 256), &learned);
        list.dispatch(
            gpu,
            &pipelines.end_step,
            1,
            &[("rule", of_grid), steps, pace, scales, largest, ("counts", &slopes.counts)],
        );
    }
}
