//! Moves blocks between the GPU pool and host memory, and to pools of other sizes.

use super::block::{Block, Blocks, GridCoord, N_VOXELS};
use super::buffers::FieldBuffers;
use super::capacity::Capacity;
use super::chosen_grid::VoxelGrid;
use super::kernels::Pipelines;
use super::params::status;
use super::passes;
use crate::Error;
use gpu::{Gpu, Passes};
use std::collections::BTreeSet;

/// Number of blocks that are gathered at once. They take 12.6 MB. Larger batches need more GPU
/// memory in addition to the field. Smaller batches wait for the GPU more often.
const GATHER_BATCH: usize = 2048;

impl FieldBuffers {
    /// Copies the field to buffers of another capacity. Drops requests for blocks that did not fit,
    /// so that their depth images can be fused again.
    pub(crate) fn resized(
        &self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        voxel_grid: &VoxelGrid,
        mut capacity: Capacity,
    ) -> Result<Self, Error> {
        let n = self.n_blocks(gpu)?;
        let mut counters = self.counters(gpu)?;
        // Slots stay the same, so blocks are copied as a whole. The table is rebuilt, because
        // positions in it depend on its size. If the table is too small again, the next attempt
        // doubles it.
        loop {
            let resized = Self::new(gpu, voxel_grid, capacity)?;
            for (from, to, bytes) in [
                (&self.coords, &resized.coords, 16),
                (&self.geometry, &resized.geometry, 4 * 512),
                (&self.colors, &resized.colors, 8 * 512),
                (&self.changed, &resized.changed, 4),
            ] {
                if n > 0 {
                    gpu.copy((from, 0), (to, 0), bytes * u64::from(n));
                }
            }
            counters[status::N_BLOCKS] = n;
            clear_failure(&mut counters);
            gpu.write(&resized.status, 0, bytemuck::cast_slice(&counters));
            if resized.index(gpu, pipelines, n)? {
                return Ok(resized);
            }
            capacity.n_chunks *= 2;
        }
    }

    /// Inserts `n` blocks into the empty table. Returns false if the table is too small.
    fn index(&self, gpu: &Gpu, pipelines: &Pipelines, n: u32) -> Result<bool, Error> {
        let mut list = Passes::default();
        passes::index(gpu, &mut list, pipelines, self, n);
        list.submit(gpu);
        Ok(self.counters(gpu)?[status::FAILED] == 0)
    }

    /// A field with the given blocks.
    pub(crate) fn with_blocks(
        gpu: &Gpu,
        pipelines: &Pipelines,
        voxel_grid: &VoxelGrid,
        blocks: &Blocks,
        mut capacity: Capacity,
    ) -> Result<Self, Error> {
        // Slots are assigned in order of the coordinates. `Meshing` relies on this order.
        let n = u32::try_from(blocks.len()).unwrap_or(u32::MAX);
        capacity.n_blocks = capacity.n_blocks.max(n);
        loop {
            let field = Self::new(gpu, voxel_grid, capacity)?;
            for (slot, (block_coord, block)) in (0..).zip(blocks) {
                field.write_block(gpu, slot, *block_coord, block);
            }
            gpu.write(&field.status, 0, bytemuck::bytes_of(&n));
            if field.index(gpu, pipelines, n)? {
                return Ok(field);
            }
            capacity.n_chunks *= 2;
        }
    }

    fn write_block(&self, gpu: &Gpu, slot: u64, block_coord: GridCoord, block: &Block) {
        let [x, y, z] = block_coord;
        gpu.write(&self.coords, 16 * slot, bytemuck::cast_slice(&[x, y, z, 0]));
        gpu.write(
            &self.geometry,
            4 * 512 * slot,
            bytemuck::cast_slice(&block.geometry),
        );
        gpu.write(
            &self.colors,
            8 * 512 * slot,
            bytemuck::cast_slice(&block.colors),
        );
    }

    /// Reads the blocks in these slots.
    pub(crate) fn read(
        &self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        slots: &[u32],
    ) -> Result<Vec<Block>, Error> {
        let mut blocks = Vec::with_capacity(slots.len());
        // The blocks are scattered over the pool. A kernel gathers them, so that only they are read
        // back.
        for part in slots.chunks(GATHER_BATCH) {
            let n = part.len();
            let listed = gpu.storage_with("tsdf.listed", bytemuck::cast_slice(part))?;
            let geometry = gpu.storage("tsdf.gathered_geometry", (4 * N_VOXELS * n) as u64)?;
            let colors = gpu.storage("tsdf.gathered_colors", (8 * N_VOXELS * n) as u64)?;
            let mut list = Passes::default();
            passes::gather(
                gpu,
                &mut list,
                pipelines,
                self,
                &listed,
                (&geometry, &colors),
                n,
            );
            list.submit(gpu);
            let geometry: Vec<u32> = gpu.read(&geometry, N_VOXELS * n)?;
            let colors: Vec<[u32; 2]> = gpu.read(&colors, N_VOXELS * n)?;
            blocks.extend(
                geometry
                    .chunks_exact(N_VOXELS)
                    .zip(colors.chunks_exact(N_VOXELS))
                    .map(|(geometry, colors)| Block {
                        geometry: geometry.to_vec(),
                        colors: colors.to_vec(),
                    }),
            );
        }
        Ok(blocks)
    }

    /// Reads all blocks.
    pub(crate) fn read_all(&self, gpu: &Gpu, pipelines: &Pipelines) -> Result<Blocks, Error> {
        let block_coords = self.block_coords(gpu)?;
        let slots: Vec<u32> = (0..).take(block_coords.len()).collect();
        Ok(block_coords
            .into_iter()
            .zip(self.read(gpu, pipelines, &slots)?)
            .collect())
    }

    /// Removes the blocks of `evicted` (slots, in order) from the pool and adds `added`, which must
    /// fit. No submit may be in flight, and all changes must have been taken.
    pub(crate) fn swap_blocks(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        evicted: &[u32],
        added: &Blocks,
    ) -> Result<(), Error> {
        let n_before = self.n_blocks(gpu)?;
        let block_coords = self.block_coords(gpu)?;
        let n_after = n_before as usize - evicted.len() + added.len();
        let gone: BTreeSet<u32> = evicted.iter().copied().collect();
        // Blocks past the new end move into the holes. Added blocks fill the other holes.
        let end = u32::try_from(n_after).unwrap_or(u32::MAX);
        let moved_slots: Vec<u32> = (end.min(n_before)..n_before)
            .filter(|slot| !gone.contains(slot))
            .collect();
        // The blocks are read before anything is written, because holes are filled in place.
        let moved = self.read(gpu, pipelines, &moved_slots)?;
        let moved = moved_slots
            .iter()
            .map(|slot| block_coords[*slot as usize])
            .zip(moved);
        let free_slots = gone
            .iter()
            .copied()
            .filter(|slot| *slot < end)
            .chain(n_before..end);
        let incoming = moved.collect::<Vec<_>>().into_iter().chain(
            added
                .iter()
                .map(|(block_coord, block)| (*block_coord, block.clone())),
        );
        for (slot, (block_coord, block)) in free_slots.zip(incoming) {
            self.write_block(gpu, slot.into(), block_coord, &block);
        }
        // Slots past the end must be marked as unobserved, because new blocks may get these slots.
        if end < n_before {
            let from = u64::from(end);
            let n = u64::from(n_before - end);
            gpu.clear(&self.geometry, 4 * 512 * from, 4 * 512 * n);
            gpu.clear(&self.colors, 8 * 512 * from, 8 * 512 * n);
        }
        self.set_n(gpu, pipelines, end)
    }

    /// Sets the number of blocks to `n` and rebuilds the table.
    fn set_n(&mut self, gpu: &Gpu, pipelines: &Pipelines, n: u32) -> Result<(), Error> {
        gpu.clear(&self.keys, 0, self.keys.bytes());
        gpu.clear(&self.entries, 0, self.entries.bytes());
        let mut counters = self.counters(gpu)?;
        counters[status::N_BLOCKS] = n;
        clear_failure(&mut counters);
        gpu.write(&self.status, 0, bytemuck::cast_slice(&counters));
        // There were at least as many chunks before, so only hash collisions could fill the table.
        if self.index(gpu, pipelines, n)? {
            return Ok(());
        }
        Err(gpu::Error::BufferTooLarge {
            label: "tsdf.keys".to_owned(),
            bytes: self.keys.bytes(),
            limit_bytes: self.keys.bytes(),
        }
        .into())
    }
}

/// Clears the flags of a failed depth image, and the bounds and number of chunks, which are
/// recounted.
fn clear_failure(counters: &mut [u32]) {
    for ix in [status::FAILED, status::TABLE_FULL, status::STOPPED] {
        counters[ix] = 0;
    }
    counters[status::BOUNDS..status::STOPPED].fill(0);
}
