//! The blocks of a field, on the GPU and in host memory.
//!
//! Blocks that do not fit on the GPU are kept in host memory until a camera observes them again.
//! Before a depth image is fused, every block that it could change is loaded back. The field is
//! therefore bit-identical to a field with unlimited memory.

use super::frustum::ViewFrustum;
use crate::Error;
use crate::tsdf::block::{Blocks, GridCoord};
use crate::tsdf::buffers::FieldBuffers;
use crate::tsdf::capacity::{self, Capacity};
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::kernels::Pipelines;
use crate::tsdf::params::status;
use gpu::Gpu;
use std::collections::BTreeSet;

/// Initial capacity, which takes 26 MB. Growing copies the field, so a much smaller capacity would
/// slow down the first images. A larger capacity would exceed small budgets.
pub(super) const INITIAL_CAPACITY: Capacity = Capacity {
    n_blocks: 4096,
    n_chunks: 512,
};
/// Fraction of the pool that is freed at once, to avoid evictions for every image. With a larger
/// fraction, more of the evicted blocks are needed again by the next images.
const EVICTED_FRAC: f64 = 0.125;

/// A field that may be larger than the GPU's memory.
#[derive(Debug)]
pub(super) struct FieldStore {
    pub(super) voxel_grid: VoxelGrid,
    pub(super) buffers: FieldBuffers,
    /// Blocks that do not fit on the GPU.
    pub(super) host_blocks: Blocks,
    /// Blocks that changed since the mesh was updated, in addition to the blocks flagged on the
    /// GPU.
    pub(super) stale: BTreeSet<GridCoord>,
    /// Number of blocks on the GPU when this number was last read from the GPU.
    pub(super) n_resident: u32,
    max_bytes: Option<u64>,
}

impl FieldStore {
    /// An empty field.
    pub(super) fn new(
        gpu: &Gpu,
        voxel_grid: VoxelGrid,
        max_bytes: Option<u64>,
    ) -> Result<Self, Error> {
        let buffers = FieldBuffers::new(gpu, &voxel_grid, initial_capacity(gpu, max_bytes))?;
        Ok(Self {
            voxel_grid,
            buffers,
            host_blocks: Blocks::new(),
            stale: BTreeSet::new(),
            n_resident: 0,
            max_bytes,
        })
    }

    /// A field with the given blocks.
    pub(super) fn with_blocks(
        gpu: &Gpu,
        pipelines: &Pipelines,
        voxel_grid: VoxelGrid,
        max_bytes: Option<u64>,
        blocks: Blocks,
    ) -> Result<Self, Error> {
        // The first blocks in order are resident, and the rest is in host memory. The choice does
        // not matter, because every image and every render loads the blocks that it needs.
        let max_resident =
            capacity::max_blocks_within(gpu, max_bytes, INITIAL_CAPACITY.n_chunks) as usize;
        let stale = blocks.keys().copied().collect();
        let mut resident = blocks;
        let host_blocks = match resident.keys().nth(max_resident).copied() {
            Some(first) => resident.split_off(&first),
            None => Blocks::new(),
        };
        let capacity = initial_capacity(gpu, max_bytes);
        let buffers = FieldBuffers::with_blocks(gpu, pipelines, &voxel_grid, &resident, capacity)?;
        let n_resident = buffers.n_blocks(gpu)?;
        Ok(Self {
            voxel_grid,
            buffers,
            host_blocks,
            stale,
            n_resident,
            max_bytes,
        })
    }

    /// All blocks, ordered by their coordinates.
    pub(super) fn blocks(&self, gpu: &Gpu, pipelines: &Pipelines) -> Result<Blocks, Error> {
        let mut blocks = self.host_blocks.clone();
        blocks.extend(self.buffers.read_all(gpu, pipelines)?);
        Ok(blocks)
    }

    /// Number of blocks on the GPU and in host memory.
    pub(super) fn n_blocks(&self) -> u64 {
        u64::from(self.n_resident) + self.host_blocks.len() as u64
    }

    /// Maximum number of blocks that fit on the GPU, if the hash table keeps its present size.
    pub(super) fn max_blocks(&self, gpu: &Gpu) -> u32 {
        capacity::max_blocks_within(gpu, self.max_bytes, self.buffers.capacity.n_chunks)
    }

    /// Grows the buffers after an overflow. Returns the number of blocks that must also be evicted.
    pub(super) fn grow(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        counters: &[u32],
    ) -> Result<u32, Error> {
        // Table and pool grow separately. A larger table leaves less of the budget for blocks.
        let mut capacity = self.buffers.capacity;
        if counters[status::TABLE_FULL] != 0 {
            capacity.n_chunks *= 2;
        }
        let n_needed = counters[status::N_BLOCKS];
        let n_allowed = capacity::max_blocks_within(gpu, self.max_bytes, capacity.n_chunks);
        // The pool grows by at least half, so that a field of n blocks is copied only a logarithmic
        // number of times. The counter continues to count after an overflow, so it contains the
        // number that the image needs.
        if n_needed > capacity.n_blocks {
            let n_target = n_needed.max(capacity.n_blocks.saturating_add(capacity.n_blocks / 2));
            capacity.n_blocks = n_target.min(n_allowed).max(capacity.n_blocks);
        }
        if capacity != self.buffers.capacity {
            log::debug!("tsdf: grown to {capacity:?}");
            self.buffers = self
                .buffers
                .resized(gpu, pipelines, &self.voxel_grid, capacity)?;
        }
        Ok(n_needed.saturating_sub(n_allowed))
    }

    /// Frees slots for at least `n` more blocks by evicting blocks outside the frustum. Returns
    /// whether that was possible.
    pub(super) fn evict(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        frustum: &ViewFrustum,
        n: u32,
    ) -> Result<bool, Error> {
        let n_spare = f64::from(self.max_blocks(gpu)) * EVICTED_FRAC;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a fraction of a u32"
        )]
        let n_evicted = self.swap_blocks(
            gpu,
            pipelines,
            frustum,
            n as usize + n_spare as usize,
            &Blocks::new(),
        )?;
        Ok(n_evicted >= n as usize)
    }

    /// Loads visible blocks from host memory. If not all of them fit, the result depends on
    /// `allows_partial`. If it is true, the nearest blocks are loaded. If it is false, no blocks
    /// are loaded, and false is returned.
    pub(super) fn load_visible(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        frustum: &ViewFrustum,
        allows_partial: bool,
    ) -> Result<bool, Error> {
        let mut visible: Vec<GridCoord> = self
            .host_blocks
            .keys()
            .copied()
            .filter(|block| frustum.may_be_visible(*block))
            .collect();
        if visible.is_empty() {
            return Ok(true);
        }
        visible.sort_by(|a, b| frustum.distance_m(*a).total_cmp(&frustum.distance_m(*b)));
        // Resident blocks that the camera also observes must stay.
        let n_slots = self.buffers.capacity.n_blocks as usize;
        let resident = self.buffers.block_coords(gpu)?;
        let n_observed = resident
            .into_iter()
            .filter(|block| frustum.may_be_visible(*block))
            .count();
        let n_free_slots = n_slots.saturating_sub(n_observed);
        if visible.len() > n_free_slots && !allows_partial {
            return Ok(false);
        }
        visible.truncate(n_free_slots);
        let added: Blocks = visible
            .into_iter()
            .filter_map(|block| Some((block, self.host_blocks.remove(&block)?)))
            .collect();
        let n_free = n_slots - self.buffers.n_blocks(gpu)? as usize;
        self.swap_blocks(
            gpu,
            pipelines,
            frustum,
            added.len().saturating_sub(n_free),
            &added,
        )?;
        Ok(true)
    }

    /// Evicts up to `n` blocks outside the frustum to host memory, farthest first. Then adds
    /// `added`. Returns the number of evicted blocks.
    fn swap_blocks(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        frustum: &ViewFrustum,
        n: usize,
        added: &Blocks,
    ) -> Result<usize, Error> {
        // The flags of changed blocks belong to slots, which are about to be reassigned.
        self.stale.extend(self.buffers.take_changed(gpu)?);
        let block_coords = self.buffers.block_coords(gpu)?;
        let mut invisible_slots: Vec<(u32, GridCoord)> = (0..)
            .zip(&block_coords)
            .map(|(slot, block_coord)| (slot, *block_coord))
            .filter(|(_, block)| !frustum.may_be_visible(*block))
            .collect();
        // Slots depend on scheduling on the GPU. Ties are broken by coordinates, so that the choice
        // of blocks does not depend on scheduling.
        invisible_slots.sort_by(|(_, a), (_, b)| {
            frustum
                .distance_m(*b)
                .total_cmp(&frustum.distance_m(*a))
                .then_with(|| a.cmp(b))
        });
        invisible_slots.truncate(n);
        let evicted: BTreeSet<u32> = invisible_slots.iter().map(|(slot, _)| *slot).collect();
        let slots: Vec<u32> = evicted.iter().copied().collect();
        let blocks = self.buffers.read(gpu, pipelines, &slots)?;
        self.host_blocks.extend(
            slots
                .iter()
                .map(|slot| block_coords[*slot as usize])
                .zip(blocks),
        );
        self.buffers.swap_blocks(gpu, pipelines, &slots, added)?;
        self.n_resident = self.buffers.n_blocks(gpu)?;
        Ok(slots.len())
    }
}

fn initial_capacity(gpu: &Gpu, max_bytes: Option<u64>) -> Capacity {
    let max_blocks = capacity::max_blocks_within(gpu, max_bytes, INITIAL_CAPACITY.n_chunks);
    Capacity {
        n_blocks: INITIAL_CAPACITY.n_blocks.min(max_blocks),
        ..INITIAL_CAPACITY
    }
}
