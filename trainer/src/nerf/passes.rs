//! The stages of drawing and learning, as lists of passes.

use super::buffers::{BatchBuffers, FieldBuffers, FieldMoments, FieldSlopes};
use super::kernels::{FieldPipelines, LayerPipelines, N_CHUNK};
use crate::gpu::{Buffer, Gpu, Passes, Pipeline};

/// What the passes of one batch of rays touch.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldPasses<'a> {
    pub(crate) gpu: &'a Gpu,
    pub(crate) pipelines: &'a FieldPipelines,
    pub(crate) field: &'a FieldBuffers,
    pub(crate) batch: &'a BatchBuffers,
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
    /// Density and color of every sample, before the exponential and the sigmoid.
    pub(crate) fn forward(&self, list: &mut Passes) {
        let Self { gpu, pipelines, field, batch } = *self;
        let [counts, rays, spans] = [("batch", &batch.batch), ("rays", &batch.rays), ("spans", &batch.spans)];
        let n_lanes = u64::from(batch.n_samples) * u64::from(field.n_levels);
        let found = [
            counts,
            rays,
            spans,
            ("space", &field.space),
            ("levels", &field.levels),
            ("grid", &field.grid),
            ("features", &batch.density[0]),
        ];
        list.dispatch(gpu, &pipelines.look_up, n_lanes.div_ceil(256), &found);
        self.network_forward(list, &self.density());
        let inputs =
            [counts, rays, spans, ("told", &batch.density[2]), ("codes", &field.codes), ("inputs", &batch.color[0])];
        list.dispatch(gpu, &pipelines.color_inputs, groups(batch.n_samples, 256), &inputs);
        self.network_forward(list, &self.color());
    }

    /// After [`FieldPasses::forward`]: the loss of every ray, and the slopes towards all that is learned.
    pub(crate) fn backward(&self, list: &mut Passes, loss: &Buffer, slopes: &FieldSlopes) {
        let Self { gpu, pipelines, field, batch } = *self;
        let [counts, rays, spans] = [("batch", &batch.batch), ("rays", &batch.rays), ("spans", &batch.spans)];
        let v_log_density = ("v_log_density", &batch.v_log_density);
        let composited = [
            counts,
            rays,
            spans,
            v_log_density,
            ("loss", loss),
            ("told", &batch.density[2]),
            ("colors", &batch.color[3]),
            ("seen", &batch.seen),
            ("ray_errors", &batch.ray_errors),
            ("v_colors", &batch.v_color[3]),
        ];
        list.dispatch(gpu, &pipelines.composite, groups(batch.n_rays, 64), &composited);
        self.network_backward(list, &self.color(), &slopes.color);
        let told = [counts, v_log_density, ("v_color_inputs", &batch.v_color[0]), ("v_told", &batch.v_density[2])];
        list.dispatch(gpu, &pipelines.told_backward, groups(batch.n_samples, 256), &told);
        self.network_backward(list, &self.density(), &slopes.density);
        let n_lanes = u64::from(batch.n_samples) * u64::from(field.n_levels);
        let scattered = [
            counts,
            rays,
            spans,
            ("space", &field.space),
            ("levels", &field.levels),
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
        let steps = ("steps", &moments.steps);
        let networks = [
            (&field.density, &slopes.density, &moments.density, &pipelines.density),
            (&field.color, &slopes.color, &moments.color, &pipelines.color),
        ];
        for (weights, v_weights, moments, layers) in networks {
            for (ix, layer) in layers.iter().enumerate() {
                let buffers = [
                    ("rule", of_weights),
                    steps,
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
            steps,
            scales,
            largest,
            ("levels", &field.levels),
            ("grid", &field.grid),
            ("moments", &moments.grid),
            ("v_grid", &slopes.grid),
        ];
        list.dispatch(gpu, &pipelines.learn_grid, groups(field.n_entries, 256), &learned);
        list.dispatch(gpu, &pipelines.end_step, 1, &[steps, scales, largest, ("counts", &slopes.counts)]);
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
