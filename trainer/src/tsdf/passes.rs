//! Lists of passes for fusing a depth image, rendering a picture and rebuilding the table.

use super::buffers::FieldBuffers;
use super::kernels::Pipelines;
use super::mesh_buffers::MeshBuffers;
use super::params::{Backdrop, DepthView};
use crate::Error;
use crate::view::View;
use gpu::{Buffer, Gpu, Passes};
use keyframe::Keyframe;

/// Maximum number of workgroups that share the visible blocks. It is large enough to fill any GPU.
/// Only the GPU knows how many blocks are visible, so each group processes several blocks if there
/// are more blocks than groups. Groups without a block end at once.
const MAX_INTEGRATE_GROUPS: u32 = 8192;

/// Buffers for one keyframe, and the readings derived from its depth.
#[derive(Debug)]
pub(crate) struct KeyframeSlot {
    depth_view: Buffer,
    depth: Buffer,
    image: Buffer,
    readings: Buffer,
    n_pixels: u64,
}

impl KeyframeSlot {
    /// Buffers for images of these sizes.
    pub(crate) fn new(gpu: &Gpu, n_depth_pixels: u64, n_color_pixels: u64) -> Result<Self, Error> {
        Ok(Self {
            depth_view: gpu.uniform_with(
                "tsdf.depth_view",
                &<DepthView as bytemuck::Zeroable>::zeroed(),
            ),
            depth: gpu.storage("tsdf.depth", 4 * n_depth_pixels)?,
            image: gpu.storage("tsdf.image", 4 * n_color_pixels)?,
            readings: gpu.storage("tsdf.readings", 8 * n_depth_pixels)?,
            n_pixels: 0,
        })
    }

    /// Whether the images of a keyframe fit.
    pub(crate) fn holds(&self, n_depth_pixels: u64, n_color_pixels: u64) -> bool {
        self.depth.bytes() >= 4 * n_depth_pixels && self.image.bytes() >= 4 * n_color_pixels
    }

    /// Uploads a keyframe's images, which must fit.
    pub(crate) fn upload(&mut self, gpu: &Gpu, keyframe: &Keyframe, depth_view: &DepthView) {
        let Some(depth) = &keyframe.depth else { return };
        gpu.write(&self.depth_view, 0, bytemuck::bytes_of(depth_view));
        gpu.write(&self.depth, 0, bytemuck::cast_slice(&depth.depth_m));
        gpu.write(&self.image, 0, &keyframe.rgba_srgb);
        self.n_pixels = depth.depth_m.len() as u64;
    }

    #[cfg(test)]
    pub(super) fn readings(&self) -> &Buffer {
        &self.readings
    }
}

/// Fuses a depth image.
pub(crate) fn fuse(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    slot: &KeyframeSlot,
) {
    let FieldBuffers {
        capacity,
        field,
        status,
        keys,
        entries,
        coords,
        geometry,
        colors,
        changed,
        visible,
    } = buffers;
    let KeyframeSlot {
        depth_view,
        depth,
        image,
        readings,
        n_pixels,
    } = slot;
    // Normals and validity are computed first, because invalid readings must not allocate blocks.
    let n_groups = n_pixels.div_ceil(64);
    list.dispatch(
        gpu,
        &pipelines.readings,
        n_groups,
        &[
            ("field", field),
            ("depth_view", depth_view),
            ("depth", depth),
            ("readings", readings),
        ],
    );
    // All blocks are allocated before any voxel is changed, because nothing of this image may be
    // fused if the pool overflows.
    list.dispatch(
        gpu,
        &pipelines.allocate_blocks,
        n_groups,
        &[
            ("field", field),
            ("depth_view", depth_view),
            ("readings", readings),
            ("status", status),
            ("keys", keys),
            ("entries", entries),
            ("coords", coords),
        ],
    );
    // The visible blocks include more than the blocks of this image's surfaces, because voxels in
    // front of the surfaces are carved.
    list.dispatch(
        gpu,
        &pipelines.find_visible,
        u64::from(capacity.n_blocks).div_ceil(64),
        &[
            ("field", field),
            ("depth_view", depth_view),
            ("coords", coords),
            ("status", status),
            ("visible", visible),
        ],
    );
    list.dispatch(
        gpu,
        &pipelines.integrate,
        capacity.n_blocks.min(MAX_INTEGRATE_GROUPS).into(),
        &[
            ("field", field),
            ("depth_view", depth_view),
            ("readings", readings),
            ("image", image),
            ("coords", coords),
            ("visible", visible),
            ("status", status),
            ("geometry", geometry),
            ("colors", colors),
            ("changed", changed),
        ],
    );
    // This is a separate pass, because all workgroups of `integrate` must have ended before the
    // image counts as fused.
    list.dispatch(gpu, &pipelines.end_keyframe, 1, &[("status", status)]);
}

/// Inserts the first `n` blocks into the empty table.
pub(crate) fn index(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    n: u32,
) {
    let FieldBuffers {
        field,
        status,
        keys,
        entries,
        coords,
        ..
    } = buffers;
    list.dispatch(
        gpu,
        &pipelines.index_blocks,
        u64::from(n).div_ceil(64),
        &[
            ("field", field),
            ("coords", coords),
            ("status", status),
            ("keys", keys),
            ("entries", entries),
        ],
    );
}

/// Copies `n` listed blocks to contiguous buffers.
pub(crate) fn gather(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    listed: &Buffer,
    (geometry, colors): (&Buffer, &Buffer),
    n: usize,
) {
    list.dispatch(
        gpu,
        &pipelines.gather_blocks,
        n as u64,
        &[
            ("listed", listed),
            ("geometry", &buffers.geometry),
            ("colors", &buffers.colors),
            ("gathered_geometry", geometry),
            ("gathered_colors", colors),
        ],
    );
}

/// Lists the blocks whose triangles may have changed.
pub(crate) fn list_stale(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    mesh: &MeshBuffers,
) {
    let FieldBuffers {
        capacity,
        field,
        status,
        keys,
        entries,
        coords,
        changed,
        ..
    } = buffers;
    // The flags make each block appear once in the list, whose first word is its length.
    list.clear(&mesh.is_stale);
    list.clear_range(&mesh.stale, 0..4);
    list.dispatch(
        gpu,
        &pipelines.list_stale,
        capacity.n_blocks.into(),
        &[
            ("field", field),
            ("status", status),
            ("coords", coords),
            ("changed", changed),
            ("keys", keys),
            ("entries", entries),
            ("is_stale", &mesh.is_stale),
            ("stale", &mesh.stale),
        ],
    );
}

/// Extracts the triangles of a batch of the list.
pub(crate) fn march(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    mesh: &MeshBuffers,
) {
    let FieldBuffers {
        capacity,
        field,
        keys,
        entries,
        coords,
        geometry,
        colors,
        ..
    } = buffers;
    list.clear(&mesh.needed);
    list.dispatch(
        gpu,
        &pipelines.march_cubes,
        capacity.n_blocks.min(mesh.mesh_capacity.n_blocks).into(),
        &[
            ("field", field),
            ("batch", &mesh.batch),
            ("coords", coords),
            ("keys", keys),
            ("entries", entries),
            ("geometry", geometry),
            ("colors", colors),
            ("cases", &mesh.cases),
            ("stale", &mesh.stale),
            ("needed", &mesh.needed),
            ("parts", &mesh.parts),
            ("vertices", &mesh.vertices),
            ("triangles", &mesh.triangles),
        ],
    );
}

/// Buffers that a picture is rendered into.
#[derive(Debug)]
pub(crate) struct Canvas {
    view: Buffer,
    backdrop: Buffer,
    pub(crate) pixels: Buffer,
    pub(crate) depths: Buffer,
    pub(crate) n_pixels: u64,
}

impl Canvas {
    pub(crate) fn new(gpu: &Gpu, n_pixels: u64) -> Result<Self, Error> {
        Ok(Self {
            view: gpu.uniform_with("tsdf.view", &<View as bytemuck::Zeroable>::zeroed()),
            backdrop: gpu
                .uniform_with("tsdf.backdrop", &<Backdrop as bytemuck::Zeroable>::zeroed()),
            pixels: gpu.storage("tsdf.pixels", 4 * n_pixels)?,
            depths: gpu.storage("tsdf.depths", 4 * n_pixels)?,
            n_pixels,
        })
    }

    pub(crate) fn set_view(&self, gpu: &Gpu, view: &View, background_srgb: [f32; 3]) {
        let [red, green, blue] = background_srgb;
        gpu.write(&self.view, 0, bytemuck::bytes_of(view));
        gpu.write(
            &self.backdrop,
            0,
            bytemuck::bytes_of(&Backdrop {
                srgb: [red, green, blue, 0.0],
            }),
        );
    }
}

/// Renders the view of the canvas.
pub(crate) fn draw(
    gpu: &Gpu,
    list: &mut Passes,
    pipelines: &Pipelines,
    buffers: &FieldBuffers,
    (canvas, erased): (&Canvas, &Buffer),
    size_px: [u32; 2],
) {
    let [columns, rows] = size_px.map(|size| u64::from(size.div_ceil(8)));
    list.dispatch(
        gpu,
        &pipelines.cast_rays,
        columns * rows,
        &[
            ("view", &canvas.view),
            ("field", &buffers.field),
            ("backdrop", &canvas.backdrop),
            ("status", &buffers.status),
            ("keys", &buffers.keys),
            ("entries", &buffers.entries),
            ("geometry", &buffers.geometry),
            ("colors", &buffers.colors),
            ("pixels", &canvas.pixels),
            ("depths", &canvas.depths),
            ("erased", erased),
        ],
    );
}
