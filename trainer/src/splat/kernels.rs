//! The kernels of the splat model and their pipelines.

use crate::Error;
use gpu::sort::RadixSort;
use gpu::{Gpu, Kernel, Pipeline, Source, shared};

macro_rules! source {
    ($name:literal, $file:literal) => {
        Source {
            name: $name,
            text: include_str!(concat!("../shared/", $file, ".wgsl")),
        }
    };
    ($name:literal) => {
        source!($name, $name)
    };
}

const VIEW: Source = source!("view");
const STATUS: Source = source!("status");
const MODEL: Source = source!("model");
const PROJECTION: Source = source!("projection");
const GRADIENT: Source = source!("gradient");
const TILES: Source = source!("tiles");
const BINS: Source = source!("bins");
const SHARED: &[Source] = &[
    VIEW,
    STATUS,
    MODEL,
    PROJECTION,
    source!("sh"),
    shared::SCAN,
    source!("scan_f32"),
    source!("random"),
    source!("supervision"),
    source!("growth"),
    source!("capacity"),
    GRADIENT,
    BINS,
    TILES,
    source!("block_bins"),
    source!("camera_params"),
    source!("param_step"),
    source!("camera_sums", "camera_sums_none"),
    source!("ssim_bindings"),
    source!("ssim_upstream", "ssim_upstream_window"),
];
/// Imports of the loss kernels for software adapters, where lanes hold windows of pixels.
const LOSS_STRIPS: &[Source] = &[
    VIEW,
    STATUS,
    source!("random"),
    source!("supervision"),
    source!("ssim_bindings"),
    source!("ssim_upstream", "ssim_upstream_given"),
    source!("rows_and_columns"),
];
/// Imports of `update`.
macro_rules! update_sources {
    ($camera_sums:literal) => {
        &[
            VIEW,
            STATUS,
            MODEL,
            PROJECTION,
            source!("sh"),
            GRADIENT,
            source!("random"),
            source!("camera_sums", $camera_sums),
        ]
    };
}
/// Imports of `update` when camera parameters are also optimized.
const WITH_CAMERA: &[Source] = update_sources!("camera_sums_tree");

/// Imports of `clip`.
const CLIP: &[Source] = &[
    VIEW,
    MODEL,
    PROJECTION,
    source!("splat_clip"),
    source!("space"),
    source!("erased"),
];

/// Imports of the per-pixel kernels.
macro_rules! blend_sources {
    ($($source:expr),*) => {
        &[
            VIEW, STATUS, MODEL, PROJECTION, GRADIENT, TILES, BINS,
            source!("rasterize_bindings"), source!("backward_bindings"), source!("coverage"), source!("tile"),
            source!("capacity"), $($source),*
        ]
    };
}
/// Imports of the kernels for GPUs.
macro_rules! tile_sources {
    ($($source:expr),*) => {
        blend_sources!(source!("pixels", "pixels_2"), source!("tile_queue"), source!("segment"), $($source),*)
    };
}
// Variants of one kernel differ only in the source of one import. Shared code is written once, and
// each variant is compiled without branches for the others.
const RASTERIZE: &[Source] = tile_sources!(
    source!("segments", "segments_none"),
    source!("clips", "clips_none")
);
const RASTERIZE_SEGMENTS: &[Source] = tile_sources!(
    source!("segments", "segments_stored"),
    source!("clips", "clips_none")
);
const RASTERIZE_CLIPPED: &[Source] = tile_sources!(
    source!("segments", "segments_none"),
    source!("clips", "clips_tile"),
    source!("clipping"),
    source!("splat_clip"),
    source!("space"),
    source!("erased")
);
const BACKWARD: &[Source] = tile_sources!(source!("sums", "sums_subgroup"));
const BACKWARD_BY_MEMORY: &[Source] = tile_sources!(source!("sums", "sums_memory"));
const BLEND_STRIPS: &[Source] = blend_sources!(
    source!("pixels", "pixels_4"),
    source!("strips"),
    source!("clips", "clips_none")
);
const BLEND_STRIPS_CLIPPED: &[Source] = blend_sources!(
    source!("pixels", "pixels_4"),
    source!("strips"),
    source!("clips", "clips_strips"),
    source!("clipping"),
    source!("splat_clip"),
    source!("space"),
    source!("erased")
);

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
    ($folder:literal, $name:literal, $shared:expr) => {
        Kernel {
            source: Source {
                name: $name,
                text: include_str!(concat!("../", $folder, "/", $name, ".wgsl")),
            },
            shared: $shared,
        }
    };
}

/// The per-pixel kernels, in the variant that suits the adapter.
struct Blend {
    rasterize: Kernel,
    /// `rasterize` that clips splats at boxes.
    rasterize_clipped: Kernel,
    /// Also divides the lists of the tiles into segments, if `backward` processes segments.
    rasterize_segments: Option<Kernel>,
    backward: Kernel,
    /// Number of lanes per subgroup, if `backward` needs it.
    subgroup: Option<u32>,
}

fn blend(gpu: &Gpu) -> Blend {
    match gpu.optional().subgroup_lanes {
        // This variant is for software adapters, because no GPU has subgroups of exactly 8 lanes.
        // The lanes of these adapters read memory one after the other, so few lanes per tile are
        // faster.
        Some(8) => Blend {
            rasterize: kernel!("rasterize_strips", BLEND_STRIPS),
            rasterize_clipped: kernel!("rasterize_strips", BLEND_STRIPS_CLIPPED),
            rasterize_segments: None,
            backward: kernel!("backward_strips", BLEND_STRIPS),
            subgroup: None,
        },
        // A workgroup has 128 lanes, so larger subgroups would not be full.
        Some(lanes) if (16..=128).contains(&lanes) => Blend {
            rasterize: kernel!("rasterize", RASTERIZE),
            rasterize_clipped: kernel!("rasterize", RASTERIZE_CLIPPED),
            rasterize_segments: Some(kernel!("rasterize", RASTERIZE_SEGMENTS)),
            backward: kernel!("backward", BACKWARD),
            subgroup: Some(lanes),
        },
        // Without subgroups of a known size, lanes are summed through workgroup memory.
        _ => Blend {
            rasterize: kernel!("rasterize", RASTERIZE),
            rasterize_clipped: kernel!("rasterize", RASTERIZE_CLIPPED),
            rasterize_segments: Some(kernel!("rasterize", RASTERIZE_SEGMENTS)),
            backward: kernel!("backward", BACKWARD_BY_MEMORY),
            subgroup: None,
        },
    }
}

/// All kernels of this module, for validation.
#[cfg(test)]
pub(crate) const KERNELS: &[Kernel] = &[
    kernel!("project"),
    kernel!("clip", CLIP),
    kernel!("count_bins"),
    kernel!("sum_bins"),
    kernel!("scan_bins"),
    kernel!("allocate"),
    kernel!("emit"),
    kernel!("tile_bits"),
    kernel!("rasterize", RASTERIZE),
    kernel!("rasterize", RASTERIZE_SEGMENTS),
    kernel!("rasterize", RASTERIZE_CLIPPED),
    kernel!("rasterize_strips", BLEND_STRIPS),
    kernel!("rasterize_strips", BLEND_STRIPS_CLIPPED),
    kernel!("finish"),
    kernel!("loss", "ssim", SHARED),
    kernel!("loss", "ssim_strips", LOSS_STRIPS),
    kernel!("loss", "ssim_upstream_strips", LOSS_STRIPS),
    kernel!("loss", "loss_backward", SHARED),
    kernel!("loss", "loss_backward", LOSS_STRIPS),
    kernel!("backward", BACKWARD),
    kernel!("backward", BACKWARD_BY_MEMORY),
    kernel!("backward_strips", BLEND_STRIPS),
    kernel!("update"),
    kernel!("update", WITH_CAMERA),
    kernel!("correct_view"),
    kernel!("refine_camera"),
    kernel!("advance"),
    kernel!("grow_weigh"),
    kernel!("grow_scan"),
    kernel!("grow_child"),
    kernel!("grow_family"),
    kernel!("score"),
    kernel!("contribute"),
    kernel!("gather"),
];

/// Creates `Self` from given fields and from pipelines. The pipelines are compiled while the given
/// fields are computed.
macro_rules! compile {
    ($gpu:expr, { $($given:ident: $value:expr),* $(,)? }, { $($field:ident: $kernel:expr, $overrides:expr);* $(;)? }) => {{
        // The values may contain `?`, so they are computed in a closure. The fields and the
        // pipelines both take seconds to compile, so they are computed in parallel.
        let others = || -> Result<_, Error> { Ok(($($value),*)) };
        let compile = || Pipeline::compile_all($gpu, [$(($kernel, &$overrides[..])),*]);
        let (others, compiled) = rayon::join(others, compile);
        let ($($given),*) = others?;
        let [$($field),*] = compiled?;
        Ok(Self { $($given,)* $($field),* })
    }};
}

/// Pipelines for drawing.
#[derive(Debug)]
pub(crate) struct DrawPipelines {
    pub(crate) sort: RadixSort,
    pub(crate) project: Pipeline,
    pub(crate) count_bins: Pipeline,
    pub(crate) sum_bins: Pipeline,
    pub(crate) scan_bins: Pipeline,
    pub(crate) allocate: Pipeline,
    pub(crate) emit: Pipeline,
    pub(crate) tile_bits: Pipeline,
    pub(crate) rasterize: Pipeline,
    pub(crate) finish: Pipeline,
    /// Whether training divides the lists of the tiles into segments.
    pub(crate) has_segments: bool,
}

impl DrawPipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        let blend = blend(gpu);
        compile!(gpu, {
            sort: RadixSort::new(gpu)?,
            has_segments: blend.rasterize_segments.is_some(),
        }, {
            project: kernel!("project"), &[];
            count_bins: kernel!("count_bins"), &[];
            sum_bins: kernel!("sum_bins"), &[];
            scan_bins: kernel!("scan_bins"), &[];
            allocate: kernel!("allocate"), &[];
            emit: kernel!("emit"), &[];
            tile_bits: kernel!("tile_bits"), &[];
            rasterize: blend.rasterize, &[];
            finish: kernel!("finish"), &[];
        })
    }
}

/// Pipelines for pictures with a crop box or erased space.
#[derive(Debug)]
pub(crate) struct ClipPipelines {
    pub(crate) clip: Pipeline,
    pub(crate) rasterize: Pipeline,
}

impl ClipPipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        let rasterize = blend(gpu).rasterize_clipped;
        let [clip, rasterize] =
            Pipeline::compile_all(gpu, [(kernel!("clip", CLIP), &[][..]), (rasterize, &[])])?;
        Ok(Self { clip, rasterize })
    }
}

/// Pipelines of SSIM, in the variant that suits the adapter.
#[derive(Debug)]
pub(crate) enum Ssim {
    /// One kernel, whose gradients `loss` gathers.
    Tiles(Pipeline),
    /// Workgroups of a few lanes, for software adapters.
    Strips {
        /// Computes the gradients with respect to the window means.
        means: Pipeline,
        /// Propagates the gradients from the window means to the pixels, for `loss`.
        upstream: Pipeline,
    },
}

impl Ssim {
    fn new(gpu: &Gpu, in_strips: bool) -> Result<Self, Error> {
        if !in_strips {
            return Ok(Self::Tiles(Pipeline::new(
                gpu,
                kernel!("loss", "ssim", SHARED),
                &[],
            )?));
        }
        Ok(Self::Strips {
            means: Pipeline::new(gpu, kernel!("loss", "ssim_strips", LOSS_STRIPS), &[])?,
            upstream: Pipeline::new(
                gpu,
                kernel!("loss", "ssim_upstream_strips", LOSS_STRIPS),
                &[],
            )?,
        })
    }
}

/// Additional pipelines for training.
#[derive(Debug)]
pub(crate) struct TrainPipelines {
    pub(crate) ssim: Ssim,
    pub(crate) loss: Pipeline,
    pub(crate) loss_without_ssim: Pipeline,
    /// Also divides the lists of the tiles into segments for `backward`. `None` if `backward` needs
    /// no segments.
    pub(crate) rasterize_segments: Option<Pipeline>,
    pub(crate) backward: Pipeline,
    pub(crate) update: Pipeline,
    pub(crate) update_with_camera: Pipeline,
    pub(crate) correct_view: Pipeline,
    pub(crate) refine_camera: Pipeline,
    pub(crate) advance: Pipeline,
    pub(crate) grow_weigh: Pipeline,
    pub(crate) grow_scan: Pipeline,
    pub(crate) grow_child: Pipeline,
    pub(crate) grow_family: Pipeline,
    pub(crate) score: Pipeline,
    pub(crate) contribute: Pipeline,
    pub(crate) gather: Pipeline,
}

impl TrainPipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        let blend = blend(gpu);
        // The number of lanes is a constant of the kernel, so that the compiler unrolls the sums
        // over a subgroup.
        let lanes: Vec<_> = blend
            .subgroup
            .map(|lanes| ("SUBGROUP", f64::from(lanes)))
            .into_iter()
            .collect();
        // Only software adapters have no segments.
        let in_strips = blend.rasterize_segments.is_none();
        let loss = kernel!(
            "loss",
            "loss_backward",
            if in_strips { LOSS_STRIPS } else { SHARED }
        );
        compile!(gpu, {
            ssim: Ssim::new(gpu, in_strips)?,
            rasterize_segments: blend.rasterize_segments.map(|kernel| Pipeline::new(gpu, kernel, &[])).transpose()?,
        }, {
            loss: loss, &[("SSIM", 1.0)];
            loss_without_ssim: loss, &[("SSIM", 0.0)];
            backward: blend.backward, &lanes;
            update: kernel!("update"), &[];
            update_with_camera: kernel!("update", WITH_CAMERA), &[];
            correct_view: kernel!("correct_view"), &[];
            refine_camera: kernel!("refine_camera"), &[];
            advance: kernel!("advance"), &[];
            grow_weigh: kernel!("grow_weigh"), &[];
            grow_scan: kernel!("grow_scan"), &[];
            grow_child: kernel!("grow_child"), &[];
            grow_family: kernel!("grow_family"), &[];
            score: kernel!("score"), &[];
            contribute: kernel!("contribute"), &[];
            gather: kernel!("gather"), &[];
        })
    }

    /// The update kernel in a variant that writes gradients instead of new values, for comparison
    /// with the twin.
    #[cfg(test)]
    pub(crate) fn gradients_only(gpu: &Gpu) -> Result<Pipeline, Error> {
        Ok(Pipeline::new(
            gpu,
            kernel!("update", WITH_CAMERA),
            &[("GRADIENTS_ONLY", 1.0)],
        )?)
    }

    /// The kernel of the camera parameters in a variant that writes gradients instead of new
    /// values.
    #[cfg(test)]
    pub(crate) fn camera_gradients_only(gpu: &Gpu) -> Result<Pipeline, Error> {
        Ok(Pipeline::new(
            gpu,
            kernel!("refine_camera"),
            &[("GRADIENTS_ONLY", 1.0)],
        )?)
    }
}

#[cfg(test)]
mod tests {
    use super::KERNELS;
    use gpu::testing::{assert_layout, assert_valid, layout_in_wgsl};

    #[test]
    fn structs_have_the_same_layout_in_rust_and_wgsl() {
        use crate::splat::params::{
            CameraRule, Capacity, Gathering, Growth, Lens, Model, Rule, Supervision, View,
        };
        assert_layout!(
            KERNELS,
            View,
            [
                camera_row_0,
                camera_row_1,
                camera_row_2,
                center_in_world,
                focal_px,
                principal_px,
                size_px,
                n_tiles,
                shutter_linear,
                shutter_angular,
                crop_row_0,
                crop_row_1,
                crop_row_2,
                crop_min,
                crop_max
            ]
        );
        assert_layout!(
            KERNELS,
            Model,
            [
                n_splats,
                capacity,
                sh_degree,
                n_sh_rest,
                is_antialiased,
                unused_0,
                unused_1,
                unused_2
            ]
        );
        assert_layout!(
            KERNELS,
            Rule,
            [
                mean_rate_m,
                log_scale_rate,
                rotation_rate,
                opacity_rate,
                sh_dc_rate,
                sh_rest_rate,
                noise,
                final_mean_rate_frac,
                betas,
                epsilon,
                n_planned_steps,
                opacity_cost,
                scale_cost,
                log_scale_range,
                seed,
                update_all,
                schedule_start,
                noise_center
            ]
        );
        assert_layout!(
            KERNELS,
            Supervision,
            [
                background_srgb,
                dssim_frac,
                depth_weight,
                depth_clip_m,
                random_background
            ]
        );
        assert_layout!(
            KERNELS,
            Growth,
            [
                n_before,
                n_after,
                key,
                capacity,
                n_sh_rest,
                child_spread,
                min_opacity,
                unused
            ]
        );
        assert_layout!(
            KERNELS,
            Lens,
            [linear, angular, camera_params, image_params, unused]
        );
        assert_layout!(
            KERNELS,
            CameraRule,
            [
                camera_mask,
                image_mask,
                rotation_rate,
                translation_rate_m,
                time_offset_rate,
                focal_rate,
                gain_rate,
                image_decay
            ]
        );
        assert_layout!(KERNELS, Capacity, [n_entries, n_slots, n_segments, unused]);
        assert_layout!(
            KERNELS,
            Gathering,
            [n_kept, n_planes, words, from_capacity, to_capacity]
        );
    }

    #[test]
    fn clips_have_the_size_of_their_buffer() {
        use crate::splat::clipping::CLIP_BYTES;
        let (fields, bytes) = layout_in_wgsl(KERNELS, "Clip");
        assert_eq!(bytes as u64, CLIP_BYTES, "{fields:?}");
    }

    #[test]
    fn every_kernel_is_valid() {
        assert_valid(KERNELS);
    }
}
