//! Small structs that the kernels read, with the layouts of their WGSL counterparts.

use crate::gpu::{f32_of, f32s_of};
use crate::{Aabb, RenderRequest};
use keyframe::Shutter;
use kinematics::Transform;

/// Edge of a tile, pixels.
pub(crate) const TILE_PX: u32 = 16;

/// `View` of shared/view.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct View {
    pub(crate) camera_row_0: [f32; 4],
    pub(crate) camera_row_1: [f32; 4],
    pub(crate) camera_row_2: [f32; 4],
    pub(crate) center_in_world: [f32; 4],
    pub(crate) focal_px: [f32; 2],
    pub(crate) principal_px: [f32; 2],
    pub(crate) size_px: [u32; 2],
    pub(crate) n_tiles: [u32; 2],
    pub(crate) shutter_linear: [f32; 4],
    pub(crate) shutter_angular: [f32; 4],
    pub(crate) crop_row_0: [f32; 4],
    pub(crate) crop_row_1: [f32; 4],
    pub(crate) crop_row_2: [f32; 4],
    pub(crate) crop_min: [f32; 4],
    pub(crate) crop_max: [f32; 4],
}

/// Camera parameters from which a [`View`] is computed.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    pub(crate) world_from_camera: Transform,
    pub(crate) size_px: [u32; 2],
    pub(crate) focal_px: [f64; 2],
    pub(crate) principal_px: [f64; 2],
    pub(crate) shutter: Option<Shutter>,
    pub(crate) near_m: f64,
    pub(crate) far_m: f64,
    pub(crate) crop: Option<Aabb>,
    /// Variance added to every splat on the image plane, pixels squared.
    pub(crate) low_pass_px2: f64,
}

/// Variance of the low-pass at full size, pixels squared.
pub(crate) const LOW_PASS_PX2: f64 = 0.3;

impl Camera {
    /// The pinhole camera of a requested picture.
    pub(crate) fn from_request(request: &RenderRequest, focal_px: [f64; 2], principal_px: [f64; 2]) -> Self {
        Self {
            world_from_camera: request.world_from_camera,
            size_px: request.size_px,
            focal_px,
            principal_px,
            shutter: request.shutter,
            near_m: request.near_m,
            far_m: request.far_m,
            crop: request.crop,
            low_pass_px2: LOW_PASS_PX2,
        }
    }

    /// The same camera with an image smaller by `2^level`; leftover rows and columns at the far edges are cropped.
    pub(crate) fn at_level(&self, level: u32) -> Self {
        let share = 0.5f64.powi(i32::try_from(level).expect("a few levels"));
        Self {
            size_px: self.size_px.map(|size| (size >> level).max(1)),
            focal_px: self.focal_px.map(|focal| focal * share),
            principal_px: self.principal_px.map(|principal| principal * share),
            low_pass_px2: self.low_pass_px2 * share * share, // Keeps the width in the world constant.
            ..self.clone()
        }
    }

    /// The view that the kernels read.
    pub(crate) fn view(&self) -> View {
        let shutter = |of: fn(&Shutter) -> nalgebra::Vector3<f64>| {
            self.shutter.as_ref().map_or([0.0; 3], |shutter| f32s_of((of(shutter) * shutter.readout_secs).into()))
        };
        let linear = shutter(|shutter| shutter.twist.linear_m_s);
        let angular = shutter(|shutter| shutter.twist.angular_rad_s);
        let center = f32s_of::<3>(self.world_from_camera.translation.vector.into());
        let with = |xyz: [f32; 3], w: f32| [xyz[0], xyz[1], xyz[2], w];
        let crop_w = if self.crop.is_some() { 1.0 } else { 0.0 };
        let camera = rows_of(&self.world_from_camera.inverse());
        let crop = rows_of(&self.crop.map_or(Transform::identity(), |crop| crop.world_from_box.inverse()));
        View {
            camera_row_0: camera[0],
            camera_row_1: camera[1],
            camera_row_2: camera[2],
            center_in_world: with(center, f32_of(self.low_pass_px2)),
            focal_px: f32s_of(self.focal_px),
            principal_px: f32s_of(self.principal_px),
            size_px: self.size_px,
            n_tiles: self.size_px.map(|size| size.div_ceil(TILE_PX)),
            shutter_linear: with(linear, f32_of(self.near_m)),
            shutter_angular: with(angular, f32_of(self.far_m)),
            crop_row_0: crop[0],
            crop_row_1: crop[1],
            crop_row_2: crop[2],
            crop_min: with(self.crop.map_or([0.0; 3], |crop| f32s_of(crop.min_m)), crop_w),
            crop_max: with(self.crop.map_or([0.0; 3], |crop| f32s_of(crop.max_m)), 0.0),
        }
    }
}

/// The upper three rows of the transform's matrix.
fn rows_of(transform: &Transform) -> [[f32; 4]; 3] {
    let matrix = transform.to_homogeneous();
    std::array::from_fn(|row| std::array::from_fn(|column| f32_of(matrix[(row, column)])))
}

/// `Model` of shared/model.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Model {
    pub(crate) n_splats: u32,
    pub(crate) capacity: u32,
    pub(crate) sh_degree: u32,
    pub(crate) n_sh_rest: u32,
}

/// `Capacity` of shared/capacity.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Capacity {
    pub(crate) n_entries: u32,
    pub(crate) n_slots: u32,
    pub(crate) unused: [u32; 2],
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
    pub(crate) unused: u32,
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
    /// Length of the array.
    pub(crate) const LEN: usize = 16;
}

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

/// `Gathering` of gather.wgsl: counts and strides of a copy of selected entries.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Gathering {
    pub(crate) n_kept: u32,
    pub(crate) n_planes: u32,
    pub(crate) words: u32,
    pub(crate) from_capacity: u32,
    pub(crate) to_capacity: u32,
}
