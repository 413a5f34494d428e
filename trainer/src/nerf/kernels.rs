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
    shared!("march_shares"),
    shared!("density"),
    shared!("sample"),
    shared!("scan"),
    shared!("view"),
    shared!("picture_ray"),
    shared!("visit"),
    shared!("random"),
    shared!("hash_grid"),
    shared!("image_terms"),
    shared!("term_step"),
    shared!("network_tile"),
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
    kernel!("mark_blocks"),
    kernel!("picture_rays"),
    kernel!("show_rays"),
    kernel!("find_samples"),
    kernel!("field_forward"),
    kernel!("composite"),
    kernel!("field_backward"),
    kernel!("aim_rays"),
    kernel!("point_slopes"),
    kernel!("ray_slopes"),
    kernel!("code_slopes"),
    kernel!("learn_images"),
    kernel!("weight_slopes"),
    kernel!("learn_weights"),
    kernel!("learn_grid"),
    kernel!("end_step"),
];

/// Samples of a workgroup, `TILE` of `network_tile.wgsl`.
pub(crate) const N_TILE: u32 = 32;
/// Tiles of samples that one partial sum of slopes towards weights goes over.
pub(crate) const CHUNK_TILES: u32 = 16;
pub(crate) const N_CHUNK: u32 = CHUNK_TILES * N_TILE;
/// Most rows of a layer.
const MOST_ROWS: u32 = 64;
/// Numbers that the first network tells, and colors, as the kernels have them.
const N_TOLD: u32 = 16;
const N_COLORS: u32 = 4;

/// Widths of both networks as the kernels have them: multiples of four.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Widths {
    pub(crate) n_features: u32,
    pub(crate) n_hidden: u32,
    pub(crate) n_color_in: u32,
    pub(crate) n_code: u32,
}

impl Widths {
    pub(crate) fn new(n_levels: u32, hidden: u32, n_code: u32) -> Self {
        let inputs = u32::try_from(N_DIRECTION).expect("16") + 15 + n_code;
        let [n_features, n_hidden, n_color_in] = [2 * n_levels, hidden, inputs].map(|width| width.next_multiple_of(4));
        assert!(n_features.max(n_hidden).max(n_color_in) <= MOST_ROWS, "a layer is wider than its rows");
        Self { n_features, n_hidden, n_color_in, n_code }
    }

    /// Inputs and outputs of all layers of both networks, in the order of their weights.
    pub(crate) fn layers(&self) -> [[u32; 2]; 5] {
        let Self { n_features, n_hidden, n_color_in, .. } = *self;
        [[n_features, n_hidden], [n_hidden, N_TOLD], [n_color_in, n_hidden], [n_hidden, n_hidden], [n_hidden, N_COLORS]]
    }

    /// Weights of all layers.
    pub(crate) fn n_weights(&self) -> u32 {
        self.layers().iter().map(|[n_in, n_out]| n_in * n_out).sum()
    }

    /// Numbers of a sample that are kept for the way back: what goes into each layer.
    pub(crate) fn n_held(&self) -> u32 {
        self.layers().iter().map(|[n_in, _]| n_in).sum()
    }

    /// Slopes of a sample: towards what comes out of each layer, and towards what the grid holds.
    pub(crate) fn n_slopes(&self) -> u32 {
        self.layers().iter().map(|[_, n_out]| n_out).sum::<u32>() + self.n_features
    }
}

/// All that draws and learns a field.
#[derive(Debug)]
pub(crate) struct FieldPipelines {
    pub(crate) count_samples: Pipeline,
    pub(crate) place_samples: Pipeline,
    pub(crate) write_samples: Pipeline,
    pub(crate) find_samples: Pipeline,
    /// One a kind of hint, in the order in which they are taken.
    pub(crate) hint_cells: [Pipeline; 3],
    pub(crate) visit_cells: Pipeline,
    pub(crate) note_cells: Pipeline,
    pub(crate) sum_cells: Pipeline,
    pub(crate) mark_cells: Pipeline,
    pub(crate) mark_blocks: Pipeline,
    pub(crate) picture_rays: Pipeline,
    pub(crate) show_rays: Pipeline,
    /// Densities alone; colors too; and all that is kept for the way back.
    pub(crate) densities: Pipeline,
    pub(crate) colors: Pipeline,
    pub(crate) forward: Pipeline,
    pub(crate) composite: Pipeline,
    pub(crate) field_backward: Pipeline,
    pub(crate) aim_rays: Pipeline,
    pub(crate) point_slopes: Pipeline,
    pub(crate) ray_slopes: Pipeline,
    pub(crate) code_slopes: Pipeline,
    pub(crate) learn_images: Pipeline,
    pub(crate) weight_slopes: Pipeline,
    pub(crate) learn_weights: Pipeline,
    pub(crate) learn_grid: Pipeline,
    pub(crate) end_step: Pipeline,
}

impl FieldPipelines {
    /// For so many samples at most; `of_picture` is where the terms of a picture lie among those that it is drawn with.
    pub(crate) fn new(gpu: &Gpu, widths: &Widths, n_samples: u32, of_picture: u32) -> Result<Self, Error> {
        let Widths { n_features, n_hidden, n_color_in, n_code } = *widths;
        let sizes = [
            ("N_FEATURES", f64::from(n_features)),
            ("N_HIDDEN", f64::from(n_hidden)),
            ("N_COLOR_IN", f64::from(n_color_in)),
            ("LANES", f64::from(2 * n_hidden)),
        ];
        let with = |more: &[(&'static str, f64)]| [&sizes[..], more].concat();
        let forward = |colors: f64, keeps: f64| {
            let kind = [("N_CODE", f64::from(n_code)), ("COLORS", colors), ("KEEPS", keeps)];
            Pipeline::new(gpu, kernel!("field_forward"), &with(&kind))
        };
        // A thread has 16 weights.
        let most_weights = widths.layers().iter().map(|[n_in, n_out]| n_in * n_out).max().expect("five layers");
        let sums = [("SUM_LANES", f64::from(most_weights / 16)), ("CHUNK_TILES", f64::from(CHUNK_TILES))];
        let hint = |kind: f64| Pipeline::new(gpu, kernel!("hint_cells"), &[("KIND", kind)]);
        let plain = |kernel: Kernel| Pipeline::new(gpu, kernel, &[]);
        // These take long to compile.
        let ((densities, colors), (learned, (field_backward, weight_slopes))) = rayon::join(
            || rayon::join(|| forward(0.0, 0.0), || forward(1.0, 0.0)),
            || {
                let backward = || Pipeline::new(gpu, kernel!("field_backward"), &sizes);
                let slopes = || Pipeline::new(gpu, kernel!("weight_slopes"), &with(&sums));
                rayon::join(|| forward(1.0, 1.0), || rayon::join(backward, slopes))
            },
        );
        Ok(Self {
            count_samples: plain(kernel!("count_samples"))?,
            place_samples: Pipeline::new(gpu, kernel!("place_samples"), &[("CAPACITY", n_samples.into())])?,
            write_samples: plain(kernel!("write_samples"))?,
            find_samples: plain(kernel!("find_samples"))?,
            hint_cells: [hint(0.0)?, hint(1.0)?, hint(2.0)?],
            visit_cells: plain(kernel!("visit_cells"))?,
            note_cells: plain(kernel!("note_cells"))?,
            sum_cells: plain(kernel!("sum_cells"))?,
            mark_cells: plain(kernel!("mark_cells"))?,
            mark_blocks: plain(kernel!("mark_blocks"))?,
            picture_rays: Pipeline::new(gpu, kernel!("picture_rays"), &[("OF_PICTURE", of_picture.into())])?,
            show_rays: plain(kernel!("show_rays"))?,
            densities: densities?,
            colors: colors?,
            forward: learned?,
            composite: plain(kernel!("composite"))?,
            field_backward: field_backward?,
            aim_rays: plain(kernel!("aim_rays"))?,
            point_slopes: Pipeline::new(gpu, kernel!("point_slopes"), &sizes)?,
            ray_slopes: plain(kernel!("ray_slopes"))?,
            code_slopes: Pipeline::new(gpu, kernel!("code_slopes"), &with(&[("N_CODE", n_code.into())]))?,
            learn_images: plain(kernel!("learn_images"))?,
            weight_slopes: weight_slopes?,
            learn_weights: Pipeline::new(gpu, kernel!("learn_weights"), &[("CHUNK", f64::from(N_CHUNK))])?,
            learn_grid: plain(kernel!("learn_grid"))?,
            end_step: plain(kernel!("end_step"))?,
        })
    }
}
