//! GPU memory of the field, which has a pool of blocks and the hash table that locates them.

use super::block::GridCoord;
use super::capacity::{BYTES_PER_BLOCK, BYTES_PER_CHUNK, Capacity};
use super::chosen_grid::VoxelGrid;
use super::params::{Field, status};
use crate::Error;
use gpu::{Buffer, Gpu};
use std::collections::BTreeSet;

/// Buffers of a field.
#[derive(Debug)]
pub(crate) struct FieldBuffers {
    pub(crate) capacity: Capacity,
    pub(crate) field: Buffer,
    pub(crate) status: Buffer,
    pub(crate) keys: Buffer,
    pub(crate) entries: Buffer,
    pub(crate) coords: Buffer,
    pub(crate) geometry: Buffer,
    pub(crate) colors: Buffer,
    pub(crate) changed: Buffer,
    pub(crate) visible: Buffer,
}

impl FieldBuffers {
    /// An empty field.
    pub(crate) fn new(
        gpu: &Gpu,
        voxel_grid: &VoxelGrid,
        capacity: Capacity,
    ) -> Result<Self, Error> {
        let n = u64::from(capacity.n_blocks);
        let field = Field::new(voxel_grid, capacity.n_chunks, capacity.n_blocks);
        Ok(Self {
            capacity,
            field: gpu.uniform_with("tsdf.field", &field),
            status: gpu.storage("tsdf.status", 4 * status::LEN as u64)?,
            keys: gpu.storage("tsdf.keys", 4 * u64::from(capacity.n_chunks))?,
            entries: gpu.storage("tsdf.entries", 4 * 512 * u64::from(capacity.n_chunks))?,
            coords: gpu.storage("tsdf.coords", 16 * n)?,
            geometry: gpu.storage("tsdf.geometry", 4 * 512 * n)?,
            colors: gpu.storage("tsdf.colors", 8 * 512 * n)?,
            changed: gpu.storage("tsdf.changed", 4 * n)?,
            visible: gpu.storage("tsdf.visible", 4 * n)?,
        })
    }

    /// Bytes of `n_blocks` blocks including the table.
    pub(crate) fn bytes(&self, n_blocks: u64) -> u64 {
        n_blocks * BYTES_PER_BLOCK + u64::from(self.capacity.n_chunks) * BYTES_PER_CHUNK
    }

    pub(crate) fn counters(&self, gpu: &Gpu) -> Result<Vec<u32>, Error> {
        Ok(gpu.read(&self.status, status::LEN)?)
    }

    /// Number of blocks that have a slot.
    pub(crate) fn n_blocks(&self, gpu: &Gpu) -> Result<u32, Error> {
        // The counter includes requests for blocks that did not fit.
        Ok(self.counters(gpu)?[status::N_BLOCKS].min(self.capacity.n_blocks))
    }

    /// Coordinates of the blocks, by slot.
    pub(crate) fn block_coords(&self, gpu: &Gpu) -> Result<Vec<GridCoord>, Error> {
        let n = self.n_blocks(gpu)? as usize;
        let coords: Vec<[i32; 4]> = gpu.read(&self.coords, n)?;
        Ok(coords.into_iter().map(|[x, y, z, _]| [x, y, z]).collect())
    }

    /// Returns the coordinates of the blocks that changed since the last call.
    pub(crate) fn take_changed(&self, gpu: &Gpu) -> Result<Vec<GridCoord>, Error> {
        let block_coords = self.block_coords(gpu)?;
        let changed: Vec<u32> = gpu.read(&self.changed, block_coords.len())?;
        self.clear_changed(gpu);
        Ok(block_coords
            .into_iter()
            .zip(changed)
            .filter(|(_, flag)| *flag != 0)
            .map(|(block_coord, _)| block_coord)
            .collect())
    }

    /// Marks all blocks as unchanged.
    pub(crate) fn clear_changed(&self, gpu: &Gpu) {
        gpu.clear(&self.changed, 0, self.changed.bytes());
    }

    /// Marks exactly these blocks as changed.
    pub(crate) fn set_changed(
        &self,
        gpu: &Gpu,
        changed: &BTreeSet<GridCoord>,
    ) -> Result<(), Error> {
        let flags: Vec<u32> = self
            .block_coords(gpu)?
            .iter()
            .map(|block_coord| u32::from(changed.contains(block_coord)))
            .collect();
        gpu.write(&self.changed, 0, bytemuck::cast_slice(&flags));
        Ok(())
    }
}
