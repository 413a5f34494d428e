//! Small structs that kernels read, with the layouts of their WGSL counterparts.

use super::reference::grid::GridShape;
use numbers::f32_of;

/// `Batch` of `shared/ray_batch.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Batch {
    pub(crate) n_rays: u32,
    pub(crate) n_samples: u32,
    pub(crate) max_samples: u32,
    pub(crate) unused: u32,
}

impl Batch {
    /// A batch of rays whose samples have not been placed yet.
    pub(crate) fn of(n_rays: u32) -> Self {
        Self {
            n_rays,
            n_samples: 0,
            max_samples: 0,
            unused: 0,
        }
    }
}

/// `Ray` of `shared/ray_batch.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Ray {
    pub(crate) origin: [f32; 3],
    pub(crate) first_sample: u32,
    pub(crate) direction: [f32; 3],
    pub(crate) n_samples: u32,
    pub(crate) begin: f32,
    pub(crate) end: f32,
    pub(crate) embedding: u32,
    pub(crate) target_rgb: u32,
    pub(crate) target_distance: f32,
    pub(crate) jitter: f32,
    pub(crate) progress: u32,
    pub(crate) next_segment: u32,
}

/// `Span` of `shared/ray_batch.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Span {
    pub(crate) begin: f32,
    pub(crate) end: f32,
    pub(crate) ray: u32,
    pub(crate) sample: u32,
}

/// `March` of `shared/march_params.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct March {
    pub(crate) step: f32,
    pub(crate) max_samples: u32,
    pub(crate) n_cells: u32,
    pub(crate) first_ray: u32,
    pub(crate) max_found: u32,
    pub(crate) pixel_stride: u32,
    pub(crate) unused: [u32; 2],
}

/// `OccupancyUpdate` of `shared/occupancy_update.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct OccupancyUpdate {
    pub(crate) n_cells: u32,
    pub(crate) n_points: u32,
    pub(crate) decay: f32,
    pub(crate) step: f32,
}

/// `Backdrop` of `show_rays.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Backdrop {
    pub(crate) srgb: [f32; 3],
    pub(crate) radius_m: f32,
}

/// `Level` of `shared/hash_grid.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Level {
    pub(crate) n_cells: u32,
    pub(crate) begin: u32,
    pub(crate) mask: u32,
    pub(crate) unused: u32,
}

/// `RayLoss` of `shared/ray_loss.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct RayLoss {
    pub(crate) background_srgb: [f32; 4],
    pub(crate) distance_weight: f32,
    pub(crate) distance_clip: f32,
    pub(crate) distortion: f32,
    pub(crate) near: f32,
    pub(crate) line_of_sight: f32,
    pub(crate) band: f32,
    pub(crate) band_frac: f32,
    pub(crate) unused: f32,
}

/// `AdamRule` of `shared/adam_rule.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct AdamRule {
    pub(crate) rate: f32,
    pub(crate) final_rate_frac: f32,
    pub(crate) betas: [f32; 2],
    pub(crate) epsilon: f32,
    pub(crate) weight_decay: f32,
    pub(crate) n_planned_steps: f32,
    pub(crate) unused: f32,
}

/// `StepScale` of `shared/adam_rule.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct StepScale {
    pub(crate) rate_frac: f32,
    pub(crate) unused: f32,
    pub(crate) correction: [f32; 2],
}

/// `ImageParamRule` of `update_images.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct ImageParamRule {
    pub(crate) learned: u32,
    pub(crate) n_images: u32,
    pub(crate) rotation_rate: f32,
    pub(crate) translation_rate: f32,
    pub(crate) embedding_rate: f32,
    pub(crate) weight_decay: f32,
    pub(crate) unused: [u32; 2],
}

/// One of the [`IMAGE_PARAM_STRIDE`] parameters of an image. It has the value, Adam's two moments,
/// and the number of steps taken. The first three parameters are the rotation, and the next three
/// are the translation. The appearance embedding starts at [`EMBEDDING`], as in
/// `shared/image_params.wgsl`.
pub(crate) type ImageParam = [f32; 4];
pub(crate) const IMAGE_PARAM_STRIDE: usize = 9;
pub(crate) const EMBEDDING: usize = 6;

/// Parameters of images with these appearance embeddings and no pose correction.
pub(crate) fn image_params_of<const N: usize>(
    embeddings: &[[f64; N]],
) -> Vec<[ImageParam; IMAGE_PARAM_STRIDE]> {
    embeddings.iter().map(params_with_embedding).collect()
}

/// Parameters of an image without a pose correction.
fn params_with_embedding<const N: usize>(embedding: &[f64; N]) -> [ImageParam; IMAGE_PARAM_STRIDE] {
    let mut image_params = [[0.0; 4]; IMAGE_PARAM_STRIDE];
    image_params[EMBEDDING..]
        .iter_mut()
        .zip(embedding)
        .for_each(|(image_param, value)| image_param[0] = f32_of(*value));
    image_params
}

impl AdamRule {
    /// Scale of the first step.
    pub(crate) fn first_step_scale(&self) -> StepScale {
        StepScale {
            rate_frac: 1.0,
            unused: 0.0,
            // Bias corrections of the moments for the first step (Kingma and Ba 2015, algorithm 1).
            // `end_step` computes the corrections for later steps.
            correction: self.betas.map(|beta| 1.0 / (1.0 - beta)),
        }
    }
}

/// The levels of a grid in the layout of the kernels.
pub(crate) fn levels(shape: &GridShape) -> Vec<Level> {
    (0..shape.n_cells.len())
        .map(|ix| level(shape, ix))
        .collect()
}

fn level(shape: &GridShape, ix: usize) -> Level {
    // A level with fewer corners than entries needs no hash. The mask 0 marks such a level.
    let is_dense = (u64::from(shape.n_cells[ix]) + 1).pow(3) <= 1 << shape.log2_entries;
    let mask = if is_dense {
        0
    } else {
        (1 << shape.log2_entries) - 1
    };
    Level {
        n_cells: shape.n_cells[ix],
        begin: shape.begin(ix),
        mask,
        unused: 0,
    }
}
