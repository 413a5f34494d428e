//! Incremental meshing: only blocks that changed are meshed again.

use super::TsdfModel;
use crate::Error;
use crate::gpu::{Gpu, PassTiming};
use crate::tsdf::block::{Blocks, GridCoord};
use crate::tsdf::buffers::FieldBuffers;
use crate::tsdf::capacity::Capacity;
use crate::tsdf::mesh::{BlockMesh, Mesh};
use crate::tsdf::mesh_buffers::{MeshBuffers, MeshCapacity};
use std::collections::{BTreeMap, BTreeSet};

/// Blocks per batch when not all blocks are on the GPU. Each batch gets a temporary field.
const BLOCKS_PER_BATCH: usize = 512;
/// Initial number of chunks of such a temporary field.
const CHUNKS_PER_BATCH: u32 = 256;

impl TsdfModel {
    /// The current surface in world. Meshes only blocks that changed since the last call.
    pub fn mesh(&mut self) -> Result<Mesh, Error> {
        self.update_mesh()?;
        Ok(self.voxel_grid.as_ref().map_or_else(Mesh::default, |voxel_grid| self.mesher.mesh(voxel_grid)))
    }

    /// Meshes the blocks that changed since the last call and reads their triangles back, without joining them to one
    /// mesh. Returns the number of blocks.
    pub fn update_mesh(&mut self) -> Result<usize, Error> {
        self.finish_in_flight()?;
        if self.field.is_none() {
            return Ok(0);
        }
        let block_meshes = if self.host_blocks.is_empty() { self.mesh_on_gpu()? } else { self.mesh_in_batches()? };
        let n = block_meshes.len();
        self.mesher.replace(block_meshes);
        Ok(n)
    }

    /// GPU time of meshing the blocks that changed since the last [`Self::update_mesh`]. They stay marked as changed,
    /// and nothing is read back. Empty if the adapter has no timestamps, or if blocks are in host memory.
    pub fn profile_mesh(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        let Some(field) = self.field.as_ref().filter(|_| self.host_blocks.is_empty()) else { return Ok(Vec::new()) };
        let buffers = ensure_mesh_buffers(&mut self.mesh_buffers, &self.gpu, field.capacity.n_blocks)?;
        buffers.profile(&self.gpu, &self.pipelines, field)
    }

    /// Meshes changed blocks if all blocks are on the GPU.
    fn mesh_on_gpu(&mut self) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let Some(field) = &self.field else { return Ok(Vec::new()) };
        if !self.stale.is_empty() {
            self.stale.extend(field.take_changed(&self.gpu)?);
            field.set_changed(&self.gpu, &self.stale)?;
            self.stale.clear();
        }
        let buffers = ensure_mesh_buffers(&mut self.mesh_buffers, &self.gpu, field.capacity.n_blocks)?;
        let block_meshes = buffers.mesh_changed(&self.gpu, &self.pipelines, field)?;
        field.clear_changed(&self.gpu);
        Ok(block_meshes)
    }

    /// Meshes changed blocks if some blocks are in host memory: loads them with their neighbors into a small temporary
    /// field, a batch at a time.
    fn mesh_in_batches(&mut self) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let (Some(voxel_grid), Some(field)) = (&self.voxel_grid, &self.field) else { return Ok(Vec::new()) };
        self.stale.extend(field.take_changed(&self.gpu)?);
        let slots: BTreeMap<GridCoord, u32> = field.block_coords(&self.gpu)?.into_iter().zip(0..).collect();
        let exists =
            |block_coord: &GridCoord| slots.contains_key(block_coord) || self.host_blocks.contains_key(block_coord);
        let stale: BTreeSet<GridCoord> = self.stale.iter().flat_map(around).filter(exists).collect();
        let stale: Vec<GridCoord> = stale.into_iter().collect();
        let mut block_meshes = Vec::new();
        for part in stale.chunks(BLOCKS_PER_BATCH) {
            let required_coords: BTreeSet<GridCoord> = part.iter().flat_map(around).filter(exists).collect();
            let (resident, resident_slots): (Vec<GridCoord>, Vec<u32>) =
                required_coords.iter().filter_map(|block_coord| Some((*block_coord, *slots.get(block_coord)?))).unzip();
            let read = field.read(&self.gpu, &self.pipelines, &resident_slots)?;
            let host_blocks = required_coords
                .iter()
                .filter_map(|block_coord| Some((*block_coord, self.host_blocks.get(block_coord)?.clone())));
            let blocks: Blocks = resident.into_iter().zip(read).chain(host_blocks).collect();
            let n_blocks = u32::try_from(blocks.len()).unwrap_or(u32::MAX);
            let capacity = Capacity { n_blocks, n_chunks: CHUNKS_PER_BATCH };
            let batch_field = FieldBuffers::with_blocks(&self.gpu, &self.pipelines, voxel_grid, &blocks, capacity)?;
            let batch_slots: BTreeMap<GridCoord, u32> = blocks.into_keys().zip(0..).collect();
            let part: Vec<u32> = part.iter().map(|block_coord| batch_slots[block_coord]).collect();
            let buffers = ensure_mesh_buffers(&mut self.mesh_buffers, &self.gpu, n_blocks)?;
            block_meshes.extend(buffers.mesh_slots(&self.gpu, &self.pipelines, &batch_field, &part)?);
        }
        self.stale.clear();
        Ok(block_meshes)
    }
}

/// A block and its 26 neighbors.
fn around(block_coord: &GridCoord) -> impl Iterator<Item = GridCoord> + use<> {
    let [x, y, z] = *block_coord;
    (0..27).map(move |ix| [x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1])
}

/// Returns the kept buffers, or allocates new ones if they are too small for a pool of this size.
fn ensure_mesh_buffers<'a>(
    kept: &'a mut Option<MeshBuffers>,
    gpu: &Gpu,
    n_blocks: u32,
) -> Result<&'a mut MeshBuffers, Error> {
    let buffers = match kept.take().filter(|buffers| buffers.has_capacity_for(n_blocks)) {
        Some(buffers) => buffers,
        None => MeshBuffers::new(gpu, MeshCapacity::default(), n_blocks)?,
    };
    Ok(kept.insert(buffers))
}
