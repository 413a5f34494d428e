//! The kernels of the field, compiled for its sizes.

use super::reference::field::N_DIRECTION;
use crate::Error;
use crate::gpu::{Gpu, Kernel, Pipeline, Source};

macro_rules! shared {
    ($name:literal) => {
        Source { name: $name, text: include_str!(concat!("../shared/", $name, ".wgsl")) }
    };
}

macro_rules! kernel {
    ($name:literal) => {
        Kernel { source: Source { name: $name, text: include_str!(concat!($name, ".wgsl")) }, shared: SHARED }
    };
}

const SHARED: &[Source] = &[
    shared!("ray_batch"),
    shared!("space"),
    shared!("hash_grid"),
    shared!("ray_loss"),
    shared!("learn_rule"),
    shared!("sh"),
];

/// All kernels of this folder.
#[cfg(test)]
pub(crate) const KERNELS: &[Kernel] = &[
    kernel!("look_up"),
    kernel!("layer_forward"),
    kernel!("layer_backward"),
    kernel!("layer_gradient"),
    kernel!("sum_chunks"),
    kernel!("color_inputs"),
    kernel!("composite"),
    kernel!("told_backward"),
    kernel!("scatter"),
    kernel!("learn_weights"),
    kernel!("learn_grid"),
    kernel!("end_step"),
];

/// Samples that one partial sum of slopes towards weights goes over.
pub(crate) const N_CHUNK: u32 = 512;

/// Widths of both networks as the kernels have them: multiples of four.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Widths {
    pub(crate) density: Vec<u32>,
    pub(crate) color: Vec<u32>,
    pub(crate) n_code: u32,
}

impl Widths {
    pub(crate) fn new(n_levels: u32, hidden: u32, n_code: u32) -> Self {
        let inputs = u32::try_from(N_DIRECTION).expect("16") + 15 + n_code;
        let [features, hidden, inputs] = [2 * n_levels, hidden, inputs].map(|width| width.next_multiple_of(4));
        Self { density: vec![features, hidden, 16], color: vec![inputs, hidden, hidden, 4], n_code }
    }
}

/// One layer.
#[derive(Debug)]
pub(crate) struct LayerPipelines {
    pub(crate) n_in: u32,
    pub(crate) n_out: u32,
    pub(crate) forward: Pipeline,
    pub(crate) backward: Pipeline,
    pub(crate) gradient: Pipeline,
}

/// All that draws and learns a field.
#[derive(Debug)]
pub(crate) struct FieldPipelines {
    pub(crate) look_up: Pipeline,
    pub(crate) density: Vec<LayerPipelines>,
    pub(crate) color_inputs: Pipeline,
    pub(crate) color: Vec<LayerPipelines>,
    pub(crate) composite: Pipeline,
    pub(crate) told_backward: Pipeline,
    pub(crate) sum_chunks: Pipeline,
    pub(crate) scatter: Pipeline,
    pub(crate) learn_weights: Pipeline,
    pub(crate) learn_grid: Pipeline,
    pub(crate) end_step: Pipeline,
}

impl FieldPipelines {
    pub(crate) fn new(gpu: &Gpu, widths: &Widths) -> Result<Self, Error> {
        let n_inputs = f64::from(widths.color[0]);
        let code = [("N_IN", n_inputs), ("N_CODE", f64::from(widths.n_code))];
        Ok(Self {
            look_up: Pipeline::new(gpu, kernel!("look_up"), &[])?,
            density: layers(gpu, &widths.density)?,
            color_inputs: Pipeline::new(gpu, kernel!("color_inputs"), &code)?,
            color: layers(gpu, &widths.color)?,
            composite: Pipeline::new(gpu, kernel!("composite"), &[])?,
            told_backward: Pipeline::new(gpu, kernel!("told_backward"), &code[..1])?,
            sum_chunks: Pipeline::new(gpu, kernel!("sum_chunks"), &[])?,
            scatter: Pipeline::new(gpu, kernel!("scatter"), &[])?,
            learn_weights: Pipeline::new(gpu, kernel!("learn_weights"), &[])?,
            learn_grid: Pipeline::new(gpu, kernel!("learn_grid"), &[])?,
            end_step: Pipeline::new(gpu, kernel!("end_step"), &[])?,
        })
    }
}

fn layers(gpu: &Gpu, widths: &[u32]) -> Result<Vec<LayerPipelines>, Error> {
    let n_layers = widths.len() - 1;
    let layer = |(ix, pair): (usize, &[u32])| {
        let (n_in, n_out) = (pair[0], pair[1]);
        let sizes = [("N_IN", f64::from(n_in)), ("N_OUT", f64::from(n_out))];
        let with = |name, value| [&sizes[..], &[(name, value)]].concat();
        let is = |what: bool| f64::from(u8::from(what));
        Ok(LayerPipelines {
            n_in,
            n_out,
            forward: Pipeline::new(gpu, kernel!("layer_forward"), &with("RELU", is(ix + 1 < n_layers)))?,
            backward: Pipeline::new(gpu, kernel!("layer_backward"), &with("CUT", is(ix > 0)))?,
            gradient: Pipeline::new(gpu, kernel!("layer_gradient"), &with("N_CHUNK", f64::from(N_CHUNK)))?,
        })
    };
    widths.windows(2).enumerate().map(layer).collect()
}
