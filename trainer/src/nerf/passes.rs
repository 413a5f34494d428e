//! The stages of drawing and learning, as lists of passes.

use super::buffers::{BatchBuffers, FieldBuffers, FieldMoments, FieldSlopes, Occupancy, RaySlot};
use super::kernels::{FieldPipelines, LayerPipelines, N_CHUNK};
use super::params::Backdrop;
use crate::Error;
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};
use crate::splat::View;

/// What the passes of one batch of rays touch.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldPasses<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) pipelines: &'a FieldPipelines,
    pub(crate) field: &'a FieldBuffers,
    pub(crate) batch: &'a BatchBuffers,
    pub(crate) slot: &'a RaySlot,
}

/// A picture and where it is drawn.
#[derive(Debug)]
pub(crate) struct Canvas {
    pub(crate) view: Buffer,
    pub(crate) backdrop: Buffer,
    pub(crate) pixels: Buffer,
    pub(crate) depths: Buffer,
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
            light: gpu.storage("nerf.light", 32 * u64::from(n_rays))?,
            n_pixels,
        })
    }
}

/// One network with all that its layers hold.
struct Network<'a> {
    layers: &'a [LayerPipelines],
    weights: &'a [Buffer],
    held: &'a [Buffer],
    v_held: &'a [Buffer],
    partial_sums: &'a [Buffer],
}

fn groups(n: u32, size: u32) -> u64 {
    u64::from(n).div_ceil(u64::from(size))
}

impl FieldPasses<'_> {
    /// Finds the pieces of rays where something is.
    pub(crate) fn count(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self { gpu, pipelines, batch, slot, .. } = *self;
        let found = [
            ("batch", &batch.batch),
            ("march", &slot.march),
            ("rays", &slot.rays),
            ("occupied", &occupancy.occupied),
            ("n_found", &slot.n_found),
        ];
        list.dispatch(gpu, &pipelines.count_samples, groups(slot.n_rays, 64), &found);
    }

    /// After [`FieldPasses::count`]: makes samples of the pieces.
    pub(crate) fn place(&self, list: &mut Passes, occupancy: &Occupancy) {
        let Self { gpu, pipelines, batch, slot, .. } = *self;
        let shared =
            [("batch", &batch.batch), ("march", &slot.march), ("n_found", &slot.n_found), ("rays", &slot.rays)];
        list.dispatch(gpu, &pipelines.place_samples, 1, &shared);
        let written = [("occupied", &occupancy.occupied), ("spans", &batch.spans), ("points", &batch.points)];
        list.dispatch(gpu, &pipelines.write_samples, groups(slot.n_rays, 64), &[&shared[..], &written].concat());
    }

    /// Looks at some cells of the occupancy anew. What the batch held is lost.
    pub(crate) fn visit(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, batch, .. } = *self;
        let Occupancy { thickness, visit, n_points, .. } = occupancy;
        let (visit, steps) = (("visit", visit), ("steps", &moments.steps));
        let of_points = groups(*n_points, 64);
        let visited = [visit, steps, ("batch", &batch.batch), ("points", &batch.points)];
        list.dispatch(gpu, &pipelines.visit_cells, of_points, &visited);
        self.densities(list);
        let thickness = ("thickness", thickness);
        list.dispatch(gpu, &pipelines.note_cells, of_points, &[visit, steps, ("told", &batch.density[2]), thickness]);
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
    fn mark(&self, list: &mut Passes, occupancy: &Occupancy, moments: &FieldMoments) {
        let Self { gpu, pipelines, .. } = *self;
        let Occupancy { occupied, thickness, thickness_sum, n_cells, .. } = occupancy;
        let (thickness, steps) = (("thickness", thickness), ("steps", &moments.steps));
        list.clear(thickness_sum);
        let (sum, of_words) = (("thickness_sum", thickness_sum), groups(n_cells.pow(3) / 32, 64));
        list.dispatch(gpu, &pipelines.sum_cells, of_words, &[thickness, sum]);
        list.dispatch(gpu, &pipelines.mark_cells, of_words, &[thickness, sum, ("occupied", occupied), steps]);
    }

    /// Density of every point, before the exponential, and what is handed on.
    fn densities(&self, list: &mut Passes) {
        let Self { gpu, pipelines, field, batch, .. } = *self;
        let n_lanes = u64::from(batch.n_samples) * u64::from(field.n_levels);
        let found = [
            ("batch", &batch.batch),
            ("levels", &field.levels),
            ("points", &batch.points),
            ("grid", &field.grid),
            ("features", &batch.density[0]),
        ];
        list.dispatch(gpu, &pipelines.look_up, n_lanes.div_ceil(256), &found);
        self.network_forward(list, &self.density());
    }

    /// Density and color of every sample, before the exponential and the sigmoid.
    pub(crate) fn forward(&self, list: &mut Passes) {
        let Self { gpu, pipelines, field, batch, slot } = *self;
        self.densities(list);
        let inputs = [
            ("batch", &batch.batch),
            ("rays", &slot.rays),
            ("spans", &batch.spans),
            ("told", &batch.density[2]),
            ("codes", &field.codes),
            ("inputs", &batch.color[0]),
        ];
        list.dispatch(gpu, &pipelines.color_inputs, groups(batch.n_samples, 256), &inputs);
        self.network_forward(list, &self.color());
    }

    /// Fills in the rays of a picture's pixels.
    pub(crate) fn picture_rays(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, batch, slot, .. } = *self;
        let aimed = [
            ("batch", &batch.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("rays", &slot.rays),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.picture_rays, groups(slot.n_rays, 64), &aimed);
    }

    /// After [`FieldPasses::forward`]: the pixels that the rays see.
    pub(crate) fn show(&self, list: &mut Passes, canvas: &Canvas) {
        let Self { gpu, pipelines, batch, slot, .. } = *self;
        let shown = [
            ("batch", &batch.batch),
            ("march", &slot.march),
            ("view", &canvas.view),
            ("backdrop", &canvas.backdrop),
            ("rays", &slot.rays),
            ("spans", &batch.spans),
            ("told", &batch.density[2]),
            ("colors", &batch.color[3]),
            ("pixels", &canvas.pixels),
            ("depths", &canvas.depths),
            ("light", &canvas.light),
        ];
        list.dispatch(gpu, &pipelines.show_rays, groups(slot.n_rays, 64), &shown);
    }

    /// After [`FieldPasses::forward`]: the loss of every ray, and the slopes towards all that is learned.
    pub(crate) fn backward(&self, list: &mut Passes, slopes: &FieldSlopes) {
        let Self { gpu, pipelines, field, batch, slot } = *self;
        let [counts, rays, spans] = [("batch", &batch.batch), ("rays", &slot.rays), ("spans", &batch.spans)];
        let v_log_density = ("v_log_density", &batch.v_log_density);
        let composited = [
            counts,
            rays,
            spans,
            v_log_density,
            ("loss", &slot.loss),
            ("told", &batch.density[2]),
            ("colors", &batch.color[3]),
            ("seen", &batch.seen),
            ("ray_errors", &batch.ray_errors),
            ("v_colors", &batch.v_color[3]),
        ];
        list.dispatch(gpu, &pipelines.composite, groups(slot.n_rays, 64), &composited);
        self.network_backward(list, &self.color(), &slopes.color);
        let told = [counts, v_log_density, ("v_color_inputs", &batch.v_color[0]), ("v_told", &batch.v_density[2])];
        list.dispatch(gpu, &pipelines.told_backward, groups(batch.n_samples, 256), &told);
        self.network_backward(list, &self.density(), &slopes.density);
        let n_lanes = u64::from(batch.n_samples) * u64::from(field.n_levels);
        let scattered = [
            counts,
            ("levels", &field.levels),
            ("points", &batch.points),
            ("v_features", &batch.v_density[0]),
            ("scales", &slopes.scales),
            ("v_grid", &slopes.grid),
            ("counts", &slopes.counts),
        ];
        list.dispatch(gpu, &pipelines.scatter, n_lanes.div_ceil(256), &scattered);
    }

    /// After [`FieldPasses::backward`]: one step of the optimiser, each with a rule of its own for the grid and for the weights. The
    /// slopes towards the grid are zero afterwards.
    pub(crate) fn learn(
        &self,
        list: &mut Passes,
        [of_grid, of_weights]: [&Buffer; 2],
        slopes: &FieldSlopes,
        moments: &FieldMoments,
    ) {
        let Self { gpu, pipelines, field, .. } = *self;
        let (steps, pace) = (("steps", &moments.steps), ("pace", &moments.pace));
        let networks = [
            (&field.density, &slopes.density, &moments.density, &pipelines.density),
            (&field.color, &slopes.color, &moments.color, &pipelines.color),
        ];
        for (weights, v_weights, moments, layers) in networks {
            for (ix, layer) in layers.iter().enumerate() {
                let buffers = [
                    ("rule", of_weights),
                    pace,
                    ("v_weights", &v_weights[ix]),
                    ("weights", &weights[ix]),
                    ("moments", &moments[ix]),
                ];
                list.dispatch(gpu, &pipelines.learn_weights, groups(layer.n_in * layer.n_out, 64), &buffers);
            }
        }
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

    fn density(&self) -> Network<'_> {
        let (held, v_held, partial_sums) = (&self.batch.density, &self.batch.v_density, &self.batch.partial_density);
        Network { layers: &self.pipelines.density, weights: &self.field.density, held, v_held, partial_sums }
    }

    fn color(&self) -> Network<'_> {
        let (held, v_held, partial_sums) = (&self.batch.color, &self.batch.v_color, &self.batch.partial_color);
        Network { layers: &self.pipelines.color, weights: &self.field.color, held, v_held, partial_sums }
    }

    fn layer(&self, list: &mut Passes, pipeline: &Pipeline, width: u32, buffers: &[(&str, &Buffer)]) {
        let buffers = [&[("batch", &self.batch.batch)][..], buffers].concat();
        let n_lanes = groups(self.batch.n_samples, 4) * u64::from(width / 4);
        list.dispatch(self.gpu, pipeline, n_lanes.div_ceil(256), &buffers);
    }

    fn network_forward(&self, list: &mut Passes, network: &Network<'_>) {
        for (ix, layer) in network.layers.iter().enumerate() {
            let (inputs, weights) = (("inputs", &network.held[ix]), ("weights", &network.weights[ix]));
            self.layer(list, &layer.forward, layer.n_out, &[inputs, weights, ("outputs", &network.held[ix + 1])]);
        }
    }

    fn network_backward(&self, list: &mut Passes, network: &Network<'_>, v_weights: &[Buffer]) {
        for (ix, layer) in network.layers.iter().enumerate().rev() {
            let (inputs, v_outputs) = (("inputs", &network.held[ix]), ("v_outputs", &network.v_held[ix + 1]));
            let partial_sums = ("partial_sums", &network.partial_sums[ix]);
            let n_lanes =
                groups(self.batch.n_samples, N_CHUNK) * u64::from(layer.n_in / 4) * u64::from(layer.n_out / 4);
            let summed = [("batch", &self.batch.batch), inputs, v_outputs, partial_sums];
            list.dispatch(self.gpu, &layer.gradient, n_lanes.div_ceil(256), &summed);
            let n_groups = groups(layer.n_in * layer.n_out / 4, 64);
            list.dispatch(
                self.gpu,
                &self.pipelines.sum_chunks,
                n_groups,
                &[partial_sums, ("v_weights", &v_weights[ix])],
            );
            let weights = ("weights", &network.weights[ix]);
            self.layer(
                list,
                &layer.backward,
                layer.n_in,
                &[inputs, weights, v_outputs, ("v_inputs", &network.v_held[ix])],
            );
        }
    }
}
