//! Erased space on the GPU.

use crate::Error;
use crate::edits::Edits;
use crate::gpu::{Buffer, Gpu, Passes};
use nalgebra::Matrix4;
use std::sync::Arc;

/// The buffer of shared/erased.wgsl.
#[derive(Debug)]
pub(crate) struct ErasedSpace {
    edits: Arc<Edits>,
    world_from_drawn: Matrix4<f64>,
    buffer: Buffer,
}

impl ErasedSpace {
    /// Nothing is erased.
    pub(crate) fn none(gpu: &Gpu) -> Result<Self, Error> {
        let (edits, world_from_drawn) = (Arc::default(), Matrix4::identity());
        let buffer = buffer(gpu, &edits, &world_from_drawn)?;
        Ok(Self { edits, world_from_drawn, buffer })
    }

    /// Replaces the buffer if the edits or the frame have changed.
    ///
    /// * `world_from_drawn`: maps points of the kernel to world, meters.
    pub(crate) fn set(
        &mut self,
        gpu: &Gpu,
        passes: &mut Passes,
        edits: &Arc<Edits>,
        world_from_drawn: Matrix4<f64>,
    ) -> Result<&Buffer, Error> {
        let has_same_edits = Arc::ptr_eq(&self.edits, edits) || self.edits == *edits;
        if !has_same_edits || (self.world_from_drawn != world_from_drawn && !edits.is_empty()) {
            passes.clear_bindings(); // Frees the previous buffer.
            self.buffer = buffer(gpu, edits, &world_from_drawn)?;
            (self.edits, self.world_from_drawn) = (Arc::clone(edits), world_from_drawn);
        }
        Ok(&self.buffer)
    }
}

fn buffer(gpu: &Gpu, edits: &Edits, world_from_drawn: &Matrix4<f64>) -> Result<Buffer, Error> {
    gpu.storage_with("erased", bytemuck::cast_slice(&edits.words(world_from_drawn)))
}
