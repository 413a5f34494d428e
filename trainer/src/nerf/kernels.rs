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
    shared!("folded"),
    shared!("ray_batch"),
    shared!("march_params"),
    shared!("space"),
    shared!("march"),
    shared!("density"),
    shared!("sample"),
    shared!("scan"),
    shared!("view"),
    shared!("picture_ray"),
    shared!("visit"),
    shared!("random"),
    shared!("hash_grid"),
    shared!("ray_loss"),
    shared!("learn_rule"),
    shared!("sh"),
];

/// All kernels of this folder.
#[cfg(test)]
pub(crate) const KERNELS: &[Kernel] = &[
    kernel!("count_samples"),
    kernel!("place_samples"),
    kernel!("write_samples"),
    kernel!("hint_cells"),
    kernel!("visit_cells"),
    kernel!("note_cells"),
    kernel!("sum_cells"),
    kernel!("mark_cells"),
    kernel!("picture_rays"),
    kernel!("show_rays"),
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
    pub(crate) count_samples: Pipeline,
    pub(crate) place_samples: Pipeline,
    pub(crate) write_samples: Pipeline,
    /// One a kind of hint, in the order in which they are taken.
    pub(crate) hint_cells: [Pipeline; 3],
    pub(crate) visit_cells: Pipeline,
    pub(crate) note_cells: Pipeline,
    pub(crate) sum_cells: Pipeline,
    pub(crate) mark_cells: Pipeline,
    pub(crate) picture_rays: Pipeline,
    pub(crate) show_rays: Pipeline,
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
    /// For batches of at most `n_samples`; rays of pictures have the code `no_image`.
    pub(crate) fn new(gpu: &Gpu, widths: &Widths, n_samples: u32, no_image: u32) -> Result<Self, Error> {
        let n_inputs = f64::from(widths.color[0]);
        let code = [("N_IN", n_inputs), ("N_CODE", f64::from(widths.n_code))];
        let hint = |kind: f64| Pipeline::new(gpu, kernel!("hint_cells"), &[("KIND", kind)]);
        let plain = |kernel: Kernel| Pipeline::new(gpu, kernel, &[]);
        Ok(Self {
            count_samples: plain(kernel!("count_samples"))?,
            place_samples: Pipeline::new(gpu, kernel!("place_samples"), &[("CAPACITY", n_samples.into())])?,
            write_samples: plain(kernel!("write_samples"))?,
            hint_cells: [hint(0.0)?, hint(1.0)?, hint(2.0)?],
            visit_cells: plain(kernel!("visit_cells"))?,
            note_cells: plain(kernel!("note_cells"))?,
            sum_cells: plain(kernel!("sum_cells"))?,
            mark_cells: plain(kernel!("mark_cells"))?,
            picture_rays: Pipeline::new(gpu, kernel!("picture_rays"), &[("NO_IMAGE", no_image.into())])?,
            show_rays: plain(kernel!("show_rays"))?,
            look_up: plain(kernel!("look_up"))?,
            density: layers(gpu, &widths.density)?,
            color_inputs: Pipeline::new(gpu, kernel!("color_inputs"), &code)?,
            color: layers(gpu, &widths.color)?,
            composite: plain(kernel!("composite"))?,
            told_backward: Pipeline::new(gpu, kernel!("told_backward"), &code[..1])?,
            sum_chunks: plain(kernel!("sum_chunks"))?,
            scatter: plain(kernel!("scatter"))?,
            learn_weights: plain(kernel!("learn_weights"))?,
            learn_grid: plain(kernel!("learn_grid"))?,
            end_step: plain(kernel!("end_step"))?,
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
