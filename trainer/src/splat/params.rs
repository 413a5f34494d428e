//! Small structs that kernels read. Their layouts match their WGSL counterparts.

pub(crate) use crate::view::{Camera, LOW_PASS_PX2, TILE_PX, View};

/// `Model` of shared/model.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Model {
    pub(crate) n_splats: u32,
    pub(crate) capacity: u32,
    pub(crate) sh_degree: u32,
    pub(crate) n_sh_rest: u32,
    pub(crate) is_antialiased: u32,
    pub(crate) unused_0: u32,
    pub(crate) unused_1: u32,
    pub(crate) unused_2: u32,
}

/// `Capacity` of shared/capacity.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Capacity {
    pub(crate) n_entries: u32,
    pub(crate) n_slots: u32,
    pub(crate) n_segments: u32,
    pub(crate) unused: u32,
}

/// `Rule` of update.wgsl: learning rates and costs.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Rule {
    pub(crate) mean_rate_m: f32,
    pub(crate) log_scale_rate: f32,
    pub(crate) rotation_rate: f32,
    pub(crate) opacity_rate: f32,
    pub(crate) sh_dc_rate: f32,
    pub(crate) sh_rest_rate: f32,
    pub(crate) noise: f32,
    pub(crate) final_mean_rate_frac: f32,
    pub(crate) betas: [f32; 2],
    pub(crate) epsilon: f32,
    pub(crate) n_planned_steps: f32,
    pub(crate) opacity_cost: f32,
    pub(crate) scale_cost: f32,
    pub(crate) log_scale_range: [f32; 2],
    pub(crate) seed: u32,
    pub(crate) update_all: u32,
    pub(crate) schedule_start: f32,
    pub(crate) noise_center: f32,
}

/// Number of parameters of a camera or an image, as in `shared/camera_params.wgsl`.
pub(crate) const N_PARAMS: u32 = 16;

/// `Lens` of `shared/camera_params.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Lens {
    pub(crate) linear: [f32; 4],
    pub(crate) angular: [f32; 4],
    pub(crate) camera_params: u32,
    pub(crate) image_params: u32,
    pub(crate) unused: [u32; 2],
}

/// `CameraRule` of `shared/camera_params.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct CameraRule {
    pub(crate) camera_mask: u32,
    pub(crate) image_mask: u32,
    pub(crate) rotation_rate: f32,
    pub(crate) translation_rate_m: f32,
    pub(crate) time_offset_rate: f32,
    pub(crate) focal_rate: f32,
    pub(crate) gain_rate: f32,
    pub(crate) image_decay: f32,
}

/// `Supervision` of shared/supervision.wgsl: background and loss weights.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Supervision {
    pub(crate) background_srgb: [f32; 4],
    pub(crate) dssim_frac: f32,
    pub(crate) depth_weight: f32,
    pub(crate) depth_clip_m: f32,
    pub(crate) random_background: f32,
}

/// Indices into the status array, as in shared/status.wgsl.
pub(crate) mod status {
    pub(crate) const N_SPLATS: u32 = 0;
    pub(crate) const FAILED: usize = 3;
    pub(crate) const NEED_ENTRIES: usize = 4;
    pub(crate) const NEED_SLOTS: usize = 5;
    pub(crate) const STEP: usize = 6;
    pub(crate) const N_NON_FINITE: usize = 7;
    pub(crate) const FURTHEST: u32 = 8;
    pub(crate) const DROP_FRAC: usize = 10;
    pub(crate) const DROP_SEED: usize = 11;
    /// Length of the array.
    pub(crate) const LEN: usize = 16;
}

/// Opacity below which a splat is dead. A dead splat is replaced by a child of another splat, as in
/// 3DGS-MCMC (Kheradmand et al. 2024). At most 0.5 % of a pixel depends on such a splat. It is also
/// the minimum opacity of a new member of a family. With less opacity, the new member would be dead
/// at once. At this opacity, the exploration noise is half of its maximum.
pub(crate) const MIN_OPACITY: f32 = 0.005;

/// `Growth` of shared/growth.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Growth {
    pub(crate) n_before: u32,
    pub(crate) n_after: u32,
    pub(crate) key: u32,
    pub(crate) capacity: u32,
    pub(crate) n_sh_rest: u32,
    pub(crate) child_spread: f32,
    pub(crate) min_opacity: f32,
    pub(crate) unused: f32,
}

/// `Gathering` of gather.wgsl: counts and strides for copying selected entries.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Gathering {
    pub(crate) n_kept: u32,
    pub(crate) n_planes: u32,
    pub(crate) words: u32,
    pub(crate) from_capacity: u32,
    pub(crate) to_capacity: u32,
}
