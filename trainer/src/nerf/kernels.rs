//! The kernels of the field, compiled for its sizes.

use super::reference::field::N_DIRECTION;
use crate::Error;
use gpu::{Gpu, Kernel, Pipeline, Source, shared};

macro_rules! shared {
    ($name:literal) => {
        shared!($name, $name)
    };
    ($name:literal, $file:expr) => {
        Source {
            name: $name,
            text: include_str!(concat!("../shared/", $file, ".wgsl")),
        }
    };
}

macro_rules! kernel {
    ($name:literal) => {
        kernel!($name, SHARED)
    };
    ($name:literal, $shared:expr) => {
        Kernel {
            source: Source {
                name: $name,
                text: include_str!(concat!($name, ".wgsl")),
            },
            shared: $shared,
        }
    };
}

/// Shared sources of the kernels with network layers, for one number type.
macro_rules! layers {
    ($numbers:literal) => {
        layers!($numbers, $numbers, "full")
    };
    ($numbers:literal, $forward:literal, $entries:literal) => {
        &[
            shared::FOLDED,
            shared!("ray_batch"),
            shared!("hash_grid"),
            shared!("grid_entries", concat!("grid_entries_", $entries)),
            shared!("network_tile"),
            shared!("network_layers"),
            shared!("image_params"),
            shared!("sh"),
            shared!("number", concat!("number_", $numbers)),
            shared!("rows", concat!("rows_", $numbers)),
            shared!("forward_layer", concat!("forward_layer_", $forward)),
            shared!("backward_layer", concat!("backward_layer_", $numbers)),
        ]
    };
}
/// Variants with f32 layers, and with f16 cooperative matrices.
const FULL: &[Source] = layers!("full");
const HALF: &[Source] = layers!("half");
/// Variants for rendering. Entries of the grid are two f16, and layers use single f16 numbers.
const FULL_PICTURE: &[Source] = layers!("full", "full", "packed");
const HALF_PICTURE: &[Source] = layers!("half", "single", "packed");

const SHARED: &[Source] = &[
    shared::FOLDED,
    shared!("ray_batch"),
    shared!("march_params"),
    shared!("space"),
    shared!("march"),
    shared!("march_threads"),
    shared!("density"),
    shared!("sample"),
    shared::SCAN,
    shared!("view"),
    shared!("picture_ray"),
    shared!("pixel_order"),
    shared!("occupancy_update"),
    shared!("random"),
    shared!("hash_grid"),
    shared!("image_params"),
    shared!("param_step"),
    shared!("network_tile"),
    shared!("network_layers"),
    shared!("occupancy_sum"),
    shared!("cell_blocks"),
    shared!("erased"),
    shared!("ray_loss"),
    shared!("adam_rule"),
];

/// All kernels of this folder.
#[cfg(test)]
pub(crate) const KERNELS: &[Kernel] = &[
    kernel!("count_samples"),
    kernel!("place_samples"),
    kernel!("write_samples"),
    kernel!("hint_cells"),
    kernel!("sample_cells"),
    kernel!("update_cells"),
    kernel!("sum_cells"),
    kernel!("mark_cells"),
    kernel!("mark_blocks"),
    kernel!("picture_rays"),
    kernel!("show_rays"),
    kernel!("find_samples"),
    kernel!("select_samples"),
    kernel!("keep_fronts"),
    kernel!("field_forward", FULL),
    kernel!("field_forward", HALF),
    kernel!("field_forward", FULL_PICTURE),
    kernel!("field_forward", HALF_PICTURE),
    kernel!("pack_grid"),
    kernel!("composite"),
    kernel!("field_backward", FULL),
    kernel!("field_backward", HALF),
    kernel!("apply_poses"),
    kernel!("point_gradients", FULL),
    kernel!("point_gradients", HALF),
    kernel!("ray_gradients"),
    kernel!("embedding_gradients", FULL),
    kernel!("embedding_gradients", HALF),
    kernel!("update_images"),
    kernel!("weight_gradients"),
    kernel!("weight_gradients_half", HALF),
    kernel!("weights_to_half", HALF),
    kernel!("update_weights"),
    kernel!("update_grid"),
    kernel!("end_step"),
];

/// Samples per workgroup. It equals `TILE` of `network_tile.wgsl`. With 64 samples, a render took
/// 0.48 ms instead of 0.30 ms ("Kernel layouts" in `docs/benchmarks/2026-11-23-nerf.md`).
pub(crate) const N_TILE: u32 = 32;
/// Tiles of samples per partial sum of weight gradients. With more tiles, there are fewer
/// workgroups. With fewer tiles, there are more partial sums to add.
pub(crate) const CHUNK_TILES: u32 = 16;
pub(crate) const N_CHUNK: u32 = CHUNK_TILES * N_TILE;
/// Threads per tile with cooperative matrices. It is a multiple of every subgroup size. With 64
/// threads, a render took 0.37 ms instead of 0.30 ms ("Kernel layouts" in
/// `docs/benchmarks/2026-11-23-nerf.md`).
const HALF_LANES: u32 = 128;
/// Maximum number of rows of a layer, for which workgroup memory is reserved.
const MAX_ROWS: u32 = 64;
/// Rows of a cooperative matrix.
const MATRIX: u32 = 16;
/// Number of outputs of the first and of the second network, in the kernels.
const N_DENSITY_OUT: u32 = 16;
const N_COLORS: u32 = 4;

/// Layer widths of both networks in the kernels. They are multiples of four. With cooperative
/// matrices, they are multiples of the matrix size. Saved fields use multiples of both, so that
/// files work on all adapters.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Widths {
    pub(crate) n_features: u32,
    pub(crate) n_hidden: u32,
    pub(crate) n_color_in: u32,
    pub(crate) embedding_dim: u32,
    /// Whether layers use f16 cooperative matrices ([`gpu::Optional::half_matrices`]). If
    /// so, their inputs are f16.
    pub(crate) is_half_precision: bool,
    /// Widths of features, hidden layers and inputs of the second network, without padding for
    /// matrices.
    used: [u32; 3],
}

fn layers_of([n_features, n_hidden, n_color_in]: [u32; 3]) -> [[u32; 2]; 5] {
    [
        [n_features, n_hidden],
        [n_hidden, N_DENSITY_OUT],
        [n_color_in, n_hidden],
        [n_hidden, n_hidden],
        [n_hidden, N_COLORS],
    ]
}

impl Widths {
    pub(crate) fn new(gpu: &Gpu, n_levels: u32, hidden: u32, embedding_dim: u32) -> Self {
        // One of the 16 outputs of the first network is the density. The other 15 are inputs of the
        // second network.
        let inputs = u32::try_from(N_DIRECTION).expect("16") + 15 + embedding_dim;
        let is_half_precision = gpu.optional().half_matrices;
        let used = [2 * n_levels, hidden, inputs].map(|width| width.next_multiple_of(4));
        // Kernels read four numbers at a time, or a matrix of 16 rows.
        let [n_features, n_hidden, n_color_in] = if is_half_precision {
            used.map(|width| width.next_multiple_of(MATRIX))
        } else {
            used
        };
        assert!(
            n_features.max(n_hidden).max(n_color_in) <= MAX_ROWS,
            "a layer is wider than its rows"
        );
        Self {
            n_features,
            n_hidden,
            n_color_in,
            embedding_dim,
            is_half_precision,
            used,
        }
    }

    /// Inputs and outputs of all layers of both networks, in the order of their weights.
    pub(crate) fn layers(&self) -> [[u32; 2]; 5] {
        layers_of([self.n_features, self.n_hidden, self.n_color_in])
    }

    /// The layers without padding for matrices. Weights in the padding start at zero and stay zero.
    pub(crate) fn used_layers(&self) -> [[u32; 2]; 5] {
        layers_of(self.used)
    }

    /// Number of weights of all layers.
    pub(crate) fn n_weights(&self) -> u32 {
        self.layers().iter().map(|[n_in, n_out]| n_in * n_out).sum()
    }

    /// Outputs of the last layer, which are three colors and padding.
    fn n_colors(&self) -> u32 {
        if self.is_half_precision {
            MATRIX
        } else {
            N_COLORS
        }
    }

    /// Number of weights of all layers, or of their gradient sums, with padding. Padding outputs
    /// come last.
    pub(crate) fn n_padded_weights(&self) -> u32 {
        self.n_weights() + (self.n_colors() - N_COLORS) * self.n_hidden
    }

    /// Bytes per number stored for the backward pass.
    pub(crate) fn bytes_per_number(&self) -> u32 {
        if self.is_half_precision { 2 } else { 4 }
    }

    /// Numbers stored per sample for the backward pass, which are the inputs of each layer.
    pub(crate) fn n_activations(&self) -> u32 {
        self.layers().iter().map(|[n_in, _]| n_in).sum()
    }

    /// Gradients stored per sample. They are with respect to the outputs of each layer and to the
    /// grid features.
    pub(crate) fn n_gradients(&self) -> u32 {
        self.layers().iter().map(|[_, n_out]| n_out).sum::<u32>() + self.n_colors() - N_COLORS
            + self.n_features
    }
}

/// All pipelines for training and rendering a field.
#[derive(Debug)]
pub(crate) struct FieldPipelines {
    pub(crate) count_samples: Pipeline,
    pub(crate) place_samples: Pipeline,
    pub(crate) write_samples: Pipeline,
    pub(crate) find_samples: Pipeline,
    /// One pipeline per kind of hint, in the order in which the hints are applied.
    pub(crate) hint_cells: [Pipeline; 3],
    pub(crate) sample_cells: Pipeline,
    pub(crate) update_cells: Pipeline,
    pub(crate) sum_cells: Pipeline,
    pub(crate) mark_cells: Pipeline,
    pub(crate) mark_blocks: Pipeline,
    pub(crate) picture_rays: Pipeline,
    pub(crate) select_samples: Pipeline,
    pub(crate) keep_fronts: Pipeline,
    pub(crate) show_rays: Pipeline,
    /// The next four fields are variants of the networks. This variant computes only densities. The
    /// second variant computes the densities of a picture and stores the geometry features. The
    /// third variant computes colors from these features. The fourth variant computes both networks
    /// and stores everything that the backward pass needs.
    pub(crate) densities: Pipeline,
    pub(crate) picture_densities: Pipeline,
    pub(crate) picture_colors: Pipeline,
    pub(crate) forward: Pipeline,
    /// `None` if the GPU has no cooperative matrices of f16.
    pub(crate) weights_to_half: Option<Pipeline>,
    pub(crate) pack_grid: Pipeline,
    pub(crate) composite: Pipeline,
    pub(crate) field_backward: Pipeline,
    pub(crate) apply_poses: Pipeline,
    pub(crate) point_gradients: Pipeline,
    pub(crate) ray_gradients: Pipeline,
    pub(crate) embedding_gradients: Pipeline,
    pub(crate) update_images: Pipeline,
    pub(crate) weight_gradients: Pipeline,
    pub(crate) update_weights: Pipeline,
    pub(crate) update_grid: Pipeline,
    pub(crate) end_step: Pipeline,
}

/// Compiles the kernels with network layers, whose constants are the widths of the layers.
struct LayerKernels<'a> {
    gpu: &'a Gpu,
    widths: &'a Widths,
    /// The constants that all of them share.
    sizes: [(&'static str, f64); 5],
}

impl<'a> LayerKernels<'a> {
    fn new(gpu: &'a Gpu, widths: &'a Widths) -> Self {
        let n_lanes = if widths.is_half_precision {
            HALF_LANES
        } else {
            // A thread computes four outputs of four samples, which takes 32 * n_hidden / 16
            // threads.
            2 * widths.n_hidden
        };
        let sizes = [
            ("N_FEATURES", f64::from(widths.n_features)),
            ("N_HIDDEN", f64::from(widths.n_hidden)),
            ("N_COLOR_IN", f64::from(widths.n_color_in)),
            ("N_COLORS", f64::from(widths.n_colors())),
            ("LANES", f64::from(n_lanes)),
        ];
        Self { gpu, widths, sizes }
    }

    /// The variant for f32 or for cooperative matrices.
    fn of_precision(&self, [full, half]: [Kernel; 2]) -> Kernel {
        if self.widths.is_half_precision {
            half
        } else {
            full
        }
    }

    /// The shared constants and more.
    fn sizes_and(&self, more: &[(&'static str, f64)]) -> Vec<(&'static str, f64)> {
        [&self.sizes[..], more].concat()
    }

    /// A variant of the networks that computes and stores what the `enabled` constants name.
    fn networks(
        &self,
        [full, half]: [&'static [Source]; 2],
        enabled: &[&'static str],
    ) -> Result<Pipeline, Error> {
        let flag = |name: &'static str| (name, f64::from(u8::from(enabled.contains(&name))));
        let kind = ["DENSITY", "COLORS", "STORE_ACTIVATIONS", "STORE_GEOMETRY"].map(flag);
        let kernels = [
            kernel!("field_forward", full),
            kernel!("field_forward", half),
        ];
        // Constants select the parts of one kernel, so that all variants share its code.
        let embedding_dim = [("EMBEDDING_DIM", f64::from(self.widths.embedding_dim))];
        Ok(Pipeline::new(
            self.gpu,
            self.of_precision(kernels),
            &self.sizes_and(&[&kind[..], &embedding_dim].concat()),
        )?)
    }

    /// The networks of pictures. They compute densities of all samples and colors of the selected
    /// samples.
    fn picture_networks(&self) -> (Result<Pipeline, Error>, Result<Pipeline, Error>) {
        let variants = [FULL_PICTURE, HALF_PICTURE];
        rayon::join(
            || self.networks(variants, &["DENSITY", "STORE_GEOMETRY"]),
            || self.networks(variants, &["COLORS"]),
        )
    }

    fn backward(&self) -> Result<Pipeline, Error> {
        let kernel = self.of_precision([
            kernel!("field_backward", FULL),
            kernel!("field_backward", HALF),
        ]);
        Ok(Pipeline::new(self.gpu, kernel, &self.sizes)?)
    }

    fn weight_gradients(&self) -> Result<Pipeline, Error> {
        let kernel = self.of_precision([
            kernel!("weight_gradients"),
            kernel!("weight_gradients_half", HALF),
        ]);
        let mut constants = vec![("CHUNK_TILES", f64::from(CHUNK_TILES))];
        if !self.widths.is_half_precision {
            // Each thread sums the gradients of 16 weights of a layer, so the largest layer needs
            // the most threads.
            let max_weights = self
                .widths
                .layers()
                .iter()
                .map(|[n_in, n_out]| n_in * n_out)
                .max()
                .expect("five layers");
            constants.push(("SUM_LANES", f64::from(max_weights / 16)));
        }
        Ok(Pipeline::new(
            self.gpu,
            kernel,
            &self.sizes_and(&constants),
        )?)
    }
}

impl FieldPipelines {
    /// Pipelines for up to `n_samples` samples. `picture_embedding_ix` is the index of a picture's
    /// parameters in its buffer.
    pub(crate) fn new(
        gpu: &Gpu,
        widths: &Widths,
        n_samples: u32,
        picture_embedding_ix: u32,
    ) -> Result<Self, Error> {
        let layers = LayerKernels::new(gpu, widths);
        let hint = |kind: f64| Pipeline::new(gpu, kernel!("hint_cells"), &[("KIND", kind)]);
        let plain = |kernel: Kernel| Pipeline::new(gpu, kernel, &[]);
        // These pipelines take long to compile, so they are compiled in parallel.
        let (
            (densities, (picture_densities, picture_colors)),
            (learned, (field_backward, weight_gradients)),
        ) = rayon::join(
            || {
                rayon::join(
                    || layers.networks([FULL, HALF], &["DENSITY"]),
                    || layers.picture_networks(),
                )
            },
            || {
                rayon::join(
                    || layers.networks([FULL, HALF], &["DENSITY", "COLORS", "STORE_ACTIVATIONS"]),
                    || rayon::join(|| layers.backward(), || layers.weight_gradients()),
                )
            },
        );
        Ok(Self {
            count_samples: plain(kernel!("count_samples"))?,
            place_samples: Pipeline::new(
                gpu,
                kernel!("place_samples"),
                &[("CAPACITY", n_samples.into())],
            )?,
            write_samples: plain(kernel!("write_samples"))?,
            find_samples: plain(kernel!("find_samples"))?,
            hint_cells: [hint(0.0)?, hint(1.0)?, hint(2.0)?],
            sample_cells: plain(kernel!("sample_cells"))?,
            update_cells: plain(kernel!("update_cells"))?,
            sum_cells: plain(kernel!("sum_cells"))?,
            mark_cells: plain(kernel!("mark_cells"))?,
            mark_blocks: plain(kernel!("mark_blocks"))?,
            picture_rays: Pipeline::new(
                gpu,
                kernel!("picture_rays"),
                &[("PICTURE_EMBEDDING_IX", picture_embedding_ix.into())],
            )?,
            show_rays: plain(kernel!("show_rays"))?,
            select_samples: plain(kernel!("select_samples"))?,
            keep_fronts: plain(kernel!("keep_fronts"))?,
            densities: densities?,
            picture_densities: picture_densities?,
            picture_colors: picture_colors?,
            forward: learned?,
            weights_to_half: widths
                .is_half_precision
                .then(|| plain(kernel!("weights_to_half", HALF)))
                .transpose()?,
            pack_grid: plain(kernel!("pack_grid"))?,
            composite: plain(kernel!("composite"))?,
            field_backward: field_backward?,
            apply_poses: plain(kernel!("apply_poses"))?,
            point_gradients: Pipeline::new(
                gpu,
                layers.of_precision([
                    kernel!("point_gradients", FULL),
                    kernel!("point_gradients", HALF),
                ]),
                &layers.sizes,
            )?,
            ray_gradients: plain(kernel!("ray_gradients"))?,
            embedding_gradients: Pipeline::new(
                gpu,
                layers.of_precision([
                    kernel!("embedding_gradients", FULL),
                    kernel!("embedding_gradients", HALF),
                ]),
                &layers.sizes_and(&[("EMBEDDING_DIM", widths.embedding_dim.into())]),
            )?,
            update_images: plain(kernel!("update_images"))?,
            weight_gradients: weight_gradients?,
            update_weights: Pipeline::new(
                gpu,
                kernel!("update_weights"),
                &[
                    ("CHUNK", f64::from(N_CHUNK)),
                    ("N_SUMS", f64::from(widths.n_padded_weights() / 4)),
                ],
            )?,
            update_grid: plain(kernel!("update_grid"))?,
            end_step: plain(kernel!("end_step"))?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::KERNELS;
    use crate::nerf::params::{
        AdamRule, Backdrop, Batch, ImageParamRule, Level, March, OccupancyUpdate, Ray, RayLoss,
        Span, StepScale,
    };
    use gpu::testing::{assert_layout, assert_valid};

    #[test]
    fn structs_have_the_same_layout_in_rust_and_wgsl() {
        assert_layout!(KERNELS, Batch, [n_rays, n_samples, max_samples, unused]);
        assert_layout!(
            KERNELS,
            Ray,
            [
                origin,
                first_sample,
                direction,
                n_samples,
                begin,
                end,
                embedding,
                target_rgb,
                target_distance,
                jitter,
                progress,
                next_segment,
            ]
        );
        assert_layout!(KERNELS, Span, [begin, end, ray, sample]);
        assert_layout!(
            KERNELS,
            March,
            [
                step,
                max_samples,
                n_cells,
                first_ray,
                max_found,
                pixel_stride,
                unused
            ]
        );
        assert_layout!(KERNELS, OccupancyUpdate, [n_cells, n_points, decay, step]);
        assert_layout!(KERNELS, Backdrop, [srgb, radius_m]);
        assert_layout!(KERNELS, Level, [n_cells, begin, mask, unused]);
        assert_layout!(
            KERNELS,
            RayLoss,
            [
                background_srgb,
                distance_weight,
                distance_clip,
                distortion,
                near,
                line_of_sight,
                band,
                band_frac,
                unused,
            ]
        );
        assert_layout!(KERNELS, StepScale, [rate_frac, unused, correction]);
        assert_layout!(
            KERNELS,
            ImageParamRule,
            [
                learned,
                n_images,
                rotation_rate,
                translation_rate,
                embedding_rate,
                weight_decay,
                unused
            ]
        );
        assert_layout!(
            KERNELS,
            AdamRule,
            [
                rate,
                final_rate_frac,
                betas,
                epsilon,
                weight_decay,
                n_planned_steps,
                unused
            ]
        );
    }

    #[test]
    fn every_kernel_is_valid() {
        assert_valid(KERNELS);
    }
}
