//! Incremental meshing. Only blocks that changed are meshed again.

use super::field_store::FieldStore;
use crate::Error;
use crate::tsdf::block::{Blocks, GridCoord};
use crate::tsdf::buffers::FieldBuffers;
use crate::tsdf::capacity::Capacity;
use crate::tsdf::chosen_grid::VoxelGrid;
use crate::tsdf::kernels::Pipelines;
use crate::tsdf::mesh::{BlockMesh, BlockMeshes, ChangedChunks, Mesher};
use crate::tsdf::mesh_buffers::{MeshBuffers, MeshCapacity};
use gpu::{Gpu, PassTiming};
use model_files::Edits;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Blocks per batch when not all blocks are on the GPU. Each batch gets a temporary field. The
/// neighbors of the blocks are also loaded, so small batches load many blocks twice. Large batches
/// need more memory.
const BLOCKS_PER_BATCH: usize = 512;
/// Initial number of chunks of such a temporary field.
const CHUNKS_PER_BATCH: u32 = 256;

/// The mesh of a field, and the buffers for updating it.
#[derive(Debug, Default)]
pub(super) struct Meshing {
    mesher: Mesher,
    buffers: Option<MeshBuffers>,
}

impl Meshing {
    /// The triangles of each block at the last update.
    pub(super) fn blocks(&self) -> &BlockMeshes {
        self.mesher.blocks()
    }

    /// Takes the chunks that have changed since the last call, or all of them.
    pub(super) fn take_chunks(
        &mut self,
        voxel_grid: &VoxelGrid,
        edits: &Arc<Edits>,
        only_changed: bool,
    ) -> ChangedChunks {
        self.mesher.set_edits(voxel_grid, edits);
        ChangedChunks::take(&mut self.mesher, edits, only_changed)
    }

    /// Meshes the blocks that changed since the last call. Returns their number. No submit may be
    /// in flight.
    pub(super) fn update(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        store: &mut FieldStore,
    ) -> Result<usize, Error> {
        let block_meshes = if store.host_blocks.is_empty() {
            self.mesh_on_gpu(gpu, pipelines, store)?
        } else {
            self.mesh_in_batches(gpu, pipelines, store)?
        };
        let n = block_meshes.len();
        self.mesher.replace(block_meshes);
        Ok(n)
    }

    /// GPU time of meshing the changed blocks of a field, which stay marked as changed.
    pub(super) fn profile(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<PassTiming>, Error> {
        reserve(&mut self.buffers, gpu, field.capacity.n_blocks)?.profile(gpu, pipelines, field)
    }

    /// Meshes changed blocks if all blocks are on the GPU.
    fn mesh_on_gpu(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        store: &mut FieldStore,
    ) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let FieldStore {
            buffers: field,
            stale,
            ..
        } = store;
        // Whenever blocks moved to or from host memory, the flags on the GPU were read and cleared.
        // Those blocks are flagged again here.
        if !stale.is_empty() {
            stale.extend(field.take_changed(gpu)?);
            field.set_changed(gpu, stale)?;
            stale.clear();
        }
        let buffers = reserve(&mut self.buffers, gpu, field.capacity.n_blocks)?;
        let block_meshes = buffers.mesh_changed(gpu, pipelines, field)?;
        field.clear_changed(gpu);
        Ok(block_meshes)
    }

    /// Meshes changed blocks if some blocks are in host memory. Loads the changed blocks and their
    /// neighbors, one batch at a time, into a small temporary field.
    fn mesh_in_batches(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        store: &mut FieldStore,
    ) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let FieldStore {
            voxel_grid,
            buffers: field,
            host_blocks,
            stale,
            ..
        } = store;
        stale.extend(field.take_changed(gpu)?);
        let slots: BTreeMap<GridCoord, u32> =
            field.block_coords(gpu)?.into_iter().zip(0..).collect();
        let exists = |block_coord: &GridCoord| {
            slots.contains_key(block_coord) || host_blocks.contains_key(block_coord)
        };
        // The triangles of a block depend on voxels of its neighbors, and so do its normals.
        let affected: BTreeSet<GridCoord> = stale.iter().flat_map(around).filter(exists).collect();
        let affected: Vec<GridCoord> = affected.into_iter().collect();
        let mut block_meshes = Vec::new();
        for part in affected.chunks(BLOCKS_PER_BATCH) {
            let required_coords: BTreeSet<GridCoord> =
                part.iter().flat_map(around).filter(exists).collect();
            // Blocks come from the GPU or from host memory, in order of their coordinates.
            let (resident, resident_slots): (Vec<GridCoord>, Vec<u32>) = required_coords
                .iter()
                .filter_map(|block_coord| Some((*block_coord, *slots.get(block_coord)?)))
                .unzip();
            let read = field.read(gpu, pipelines, &resident_slots)?;
            let on_host = required_coords.iter().filter_map(|block_coord| {
                Some((*block_coord, host_blocks.get(block_coord)?.clone()))
            });
            let blocks: Blocks = resident.into_iter().zip(read).chain(on_host).collect();
            let n_blocks = u32::try_from(blocks.len()).unwrap_or(u32::MAX);
            let capacity = Capacity {
                n_blocks,
                n_chunks: CHUNKS_PER_BATCH,
            };
            let batch_field =
                FieldBuffers::with_blocks(gpu, pipelines, voxel_grid, &blocks, capacity)?;
            // `with_blocks` assigns slots in order. Only the blocks of this part are meshed. Their
            // neighbors belong to other parts, or are unchanged.
            let batch_slots: BTreeMap<GridCoord, u32> = blocks.into_keys().zip(0..).collect();
            let part: Vec<u32> = part
                .iter()
                .map(|block_coord| batch_slots[block_coord])
                .collect();
            let buffers = reserve(&mut self.buffers, gpu, n_blocks)?;
            block_meshes.extend(buffers.mesh_slots(gpu, pipelines, &batch_field, &part)?);
        }
        stale.clear();
        Ok(block_meshes)
    }
}

/// A block and its 26 neighbors.
fn around(block_coord: &GridCoord) -> impl Iterator<Item = GridCoord> + use<> {
    let [x, y, z] = *block_coord;
    (0..27).map(move |ix| [x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1])
}

/// Returns the kept buffers. If they are too small for a pool of this size, allocates new buffers.
fn reserve<'a>(
    kept: &'a mut Option<MeshBuffers>,
    gpu: &Gpu,
    n_blocks: u32,
) -> Result<&'a mut MeshBuffers, Error> {
    let buffers = match kept
        .take()
        .filter(|buffers| buffers.has_capacity_for(n_blocks))
    {
        Some(buffers) => buffers,
        None => MeshBuffers::new(gpu, MeshCapacity::default(), n_blocks)?,
    };
    Ok(kept.insert(buffers))
}
