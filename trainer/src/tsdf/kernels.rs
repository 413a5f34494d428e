//! The compiled kernels of this model.

use crate::Error;
use gpu::{Gpu, Kernel, Pipeline, Source, shared};

macro_rules! source {
    ($name:literal) => {
        Source {
            name: $name,
            text: include_str!(concat!("../shared/", $name, ".wgsl")),
        }
    };
}

const SHARED: &[Source] = &[
    source!("view"),
    source!("picture_ray"),
    source!("field"),
    source!("field_status"),
    source!("field_insert"),
    source!("field_lookup"),
    shared::FOLDED,
    source!("mesh_work"),
    shared::SCAN,
    source!("depth_view"),
    source!("space"),
    source!("erased"),
];

macro_rules! kernel {
    ($name:literal) => {
        Kernel {
            source: Source {
                name: $name,
                text: include_str!(concat!($name, ".wgsl")),
            },
            shared: SHARED,
        }
    };
}

/// All kernels of this module, for validation.
#[cfg(test)]
pub(crate) const KERNELS: &[Kernel] = &[
    kernel!("readings"),
    kernel!("allocate_blocks"),
    kernel!("index_blocks"),
    kernel!("find_visible"),
    kernel!("integrate"),
    kernel!("end_keyframe"),
    kernel!("gather_blocks"),
    kernel!("cast_rays"),
    kernel!("list_stale"),
    kernel!("march_cubes"),
];

/// All compiled pipelines of the model.
#[derive(Debug)]
pub(crate) struct Pipelines {
    pub(crate) readings: Pipeline,
    pub(crate) allocate_blocks: Pipeline,
    pub(crate) index_blocks: Pipeline,
    pub(crate) find_visible: Pipeline,
    pub(crate) integrate: Pipeline,
    pub(crate) end_keyframe: Pipeline,
    pub(crate) gather_blocks: Pipeline,
    pub(crate) cast_rays: Pipeline,
    pub(crate) list_stale: Pipeline,
    pub(crate) march_cubes: Pipeline,
}

impl Pipelines {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, Error> {
        Ok(Self {
            readings: Pipeline::new(gpu, kernel!("readings"), &[])?,
            allocate_blocks: Pipeline::new(gpu, kernel!("allocate_blocks"), &[])?,
            index_blocks: Pipeline::new(gpu, kernel!("index_blocks"), &[])?,
            find_visible: Pipeline::new(gpu, kernel!("find_visible"), &[])?,
            integrate: Pipeline::new(gpu, kernel!("integrate"), &[])?,
            end_keyframe: Pipeline::new(gpu, kernel!("end_keyframe"), &[])?,
            gather_blocks: Pipeline::new(gpu, kernel!("gather_blocks"), &[])?,
            cast_rays: Pipeline::new(gpu, kernel!("cast_rays"), &[])?,
            list_stale: Pipeline::new(gpu, kernel!("list_stale"), &[])?,
            march_cubes: Pipeline::new(gpu, kernel!("march_cubes"), &[])?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::KERNELS;
    use crate::tsdf::params::{Backdrop, BlockMeshRange, DepthView, Field, MeshBatch, MeshVertex};
    use crate::view::View;
    use gpu::testing::{assert_layout, assert_valid, layout_in_wgsl};

    #[test]
    fn structs_have_the_same_fields_in_rust_and_wgsl() {
        assert_layout!(
            KERNELS,
            Field,
            [
                voxel_m,
                truncation_m,
                scale_m,
                noise_per_m2,
                max_depth_m,
                max_weight,
                n_chunk_slots,
                n_block_slots
            ]
        );
        assert_layout!(
            KERNELS,
            DepthView,
            [
                depth_row_0,
                depth_row_1,
                depth_row_2,
                field_row_0,
                field_row_1,
                field_row_2,
                color_row_0,
                color_row_1,
                color_row_2,
                depth_focal_px,
                depth_principal_px,
                color_focal_px,
                color_principal_px,
                depth_size_px,
                color_size_px
            ]
        );
        assert_layout!(KERNELS, Backdrop, [srgb]);
        assert_layout!(KERNELS, MeshBatch, [first, max_blocks]);
        assert_layout!(
            KERNELS,
            BlockMeshRange,
            [
                block_coord,
                first_vertex,
                n_vertices,
                first_triangle,
                n_triangles
            ]
        );
        assert_layout!(KERNELS, MeshVertex, [position_m, edge, normal, color]);
        assert_eq!(layout_in_wgsl(KERNELS, "View").1, size_of::<View>());
    }

    #[test]
    fn every_kernel_is_valid() {
        assert_valid(KERNELS);
    }
}
