//! Small structs that kernels read, with the layouts of their WGSL counterparts.

use super::chosen_grid::VoxelGrid;
use crate::view::rows_of;
use calibration::CalibratedCamera;
use keyframe::Keyframe;
use numbers::{f32_of, f32s_of};

/// `Field` of `shared/field.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Field {
    pub(crate) voxel_m: f32,
    pub(crate) truncation_m: f32,
    pub(crate) scale_m: f32,
    pub(crate) noise_per_m2: f32,
    pub(crate) max_depth_m: f32,
    pub(crate) max_weight: u32,
    pub(crate) n_chunk_slots: u32,
    pub(crate) n_block_slots: u32,
}

impl Field {
    pub(crate) fn new(voxel_grid: &VoxelGrid, n_chunk_slots: u32, n_block_slots: u32) -> Self {
        Self {
            voxel_m: f32_of(voxel_grid.voxel_m),
            truncation_m: f32_of(voxel_grid.truncation_m),
            scale_m: f32_of(voxel_grid.scale_m),
            noise_per_m2: f32_of(voxel_grid.noise_per_m2),
            max_depth_m: f32_of(voxel_grid.max_depth_m),
            max_weight: voxel_grid.max_weight,
            n_chunk_slots,
            n_block_slots,
        }
    }
}

/// `DepthView` of `shared/depth_view.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct DepthView {
    pub(crate) depth_row_0: [f32; 4],
    pub(crate) depth_row_1: [f32; 4],
    pub(crate) depth_row_2: [f32; 4],
    pub(crate) field_row_0: [f32; 4],
    pub(crate) field_row_1: [f32; 4],
    pub(crate) field_row_2: [f32; 4],
    pub(crate) color_row_0: [f32; 4],
    pub(crate) color_row_1: [f32; 4],
    pub(crate) color_row_2: [f32; 4],
    pub(crate) depth_focal_px: [f32; 2],
    pub(crate) depth_principal_px: [f32; 2],
    pub(crate) color_focal_px: [f32; 2],
    pub(crate) color_principal_px: [f32; 2],
    pub(crate) depth_size_px: [u32; 2],
    pub(crate) color_size_px: [u32; 2],
}

impl DepthView {
    /// Returns `None` if the keyframe has no depth.
    pub(crate) fn of(keyframe: &Keyframe, voxel_grid: &VoxelGrid) -> Option<Self> {
        let depth = keyframe.depth.as_ref()?;
        let field_from_depth = voxel_grid.field_from_world() * depth.world_from_camera;
        let field_from_color =
            voxel_grid.field_from_world() * CalibratedCamera::of(keyframe).world_from_camera;
        let to_depth = rows_of(&field_from_depth.inverse());
        let from_depth = rows_of(&field_from_depth);
        let to_color = rows_of(&field_from_color.inverse());
        Some(Self {
            depth_row_0: to_depth[0],
            depth_row_1: to_depth[1],
            depth_row_2: to_depth[2],
            field_row_0: from_depth[0],
            field_row_1: from_depth[1],
            field_row_2: from_depth[2],
            color_row_0: to_color[0],
            color_row_1: to_color[1],
            color_row_2: to_color[2],
            depth_focal_px: f32s_of(depth.focal_px),
            depth_principal_px: f32s_of(depth.principal_px),
            color_focal_px: f32s_of(keyframe.focal_px),
            color_principal_px: f32s_of(keyframe.principal_px),
            depth_size_px: depth.size_px,
            color_size_px: keyframe.size_px,
        })
    }
}

/// `Backdrop` of `cast_rays.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Backdrop {
    pub(crate) srgb: [f32; 4],
}

/// `MeshBatch` of `shared/mesh_work.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct MeshBatch {
    pub(crate) first: u32,
    pub(crate) max_blocks: u32,
}

/// `BlockMeshRange` of `shared/mesh_work.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct BlockMeshRange {
    pub(crate) block_coord: [i32; 3],
    pub(crate) first_vertex: u32,
    pub(crate) n_vertices: u32,
    pub(crate) first_triangle: u32,
    pub(crate) n_triangles: u32,
}

/// `MeshVertex` of `shared/mesh_work.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct MeshVertex {
    pub(crate) position_m: [f32; 3],
    pub(crate) edge: u32,
    pub(crate) normal: u32,
    pub(crate) color: u32,
}

/// Indices into the status array, as in `shared/field_status.wgsl`.
pub(crate) mod status {
    pub(crate) const N_BLOCKS: usize = 0;
    pub(crate) const FAILED: usize = 2;
    pub(crate) const TABLE_FULL: usize = 3;
    pub(crate) const N_FUSED: usize = 4;
    pub(crate) const N_OUTSIDE: usize = 5;
    pub(crate) const BOUNDS: usize = 6;
    pub(crate) const STOPPED: usize = 13;
    /// Length of the array.
    pub(crate) const LEN: usize = 16;
}
