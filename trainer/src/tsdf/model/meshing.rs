//! The mesh of a field: only what changed is made anew.

use super::TsdfModel;
use crate::Error;
use crate::gpu::{Gpu, PassTiming};
use crate::tsdf::block::{Blocks, GridCoord};
use crate::tsdf::buffers::{Capacity, FieldBuffers};
use crate::tsdf::marching::{MeshBuffers, MeshCapacity};
use crate::tsdf::mesh::{BlockMesh, Mesh};
use std::collections::{BTreeMap, BTreeSet};

/// Blocks that are done at once in a field of their own, where not all are on the GPU.
const BLOCKS_PER_BATCH: usize = 512;
/// Chunks of such a field at the start.
const CHUNKS_PER_BATCH: u32 = 256;

impl TsdfModel {
    /// The surface in world as it is now; only what changed since the last call is made anew.
    pub fn mesh(&mut self) -> Result<Mesh, Error> {
        self.update_mesh()?;
        Ok(self.voxel_grid.as_ref().map_or_else(Mesh::default, |voxel_grid| self.mesher.mesh(voxel_grid)))
    }

    /// Makes the triangles of what changed since the last call and brings them to the host, without joining them to one mesh;
    /// says how many blocks it were.
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

    /// GPU time of making the triangles of what changed since the last [`Self::update_mesh`]; they stay due, and nothing is
    /// brought to the host. Empty where the adapter tells no times, or blocks wait in host memory.
    pub fn profile_mesh(&mut self) -> Result<Vec<PassTiming>, Error> {
        self.finish_in_flight()?;
        let Some(field) = self.field.as_ref().filter(|_| self.host_blocks.is_empty()) else { return Ok(Vec::new()) };
        let buffers = ensure_mesh_buffers(&mut self.mesh_buffers, &self.gpu, field.capacity.n_blocks)?;
        buffers.profile(&self.gpu, &self.pipelines, field)
    }

    /// All blocks are on the GPU, and so is the list of those that are due.
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

    /// Some blocks wait in host memory: those that are due are put into a small field with all beside them, a few at a time.
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

/// A block and those that touch it.
fn around(block_coord: &GridCoord) -> impl Iterator<Item = GridCoord> + use<> {
    let [x, y, z] = *block_coord;
    (0..27).map(move |ix| [x + ix % 3 - 1, y + ix / 3 % 3 - 1, z + ix / 9 - 1])
}

/// What is kept, made anew where it is too small for a pool of so many blocks.
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
