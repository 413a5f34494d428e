//! Extracts the triangles of blocks on the GPU and reads them back.

use super::block::GridCoord;
use super::buffers::FieldBuffers;
use super::kernels::Pipelines;
use super::mesh::{BlockMesh, CASES};
use super::params::{BlockMeshRange, MeshBatch, MeshVertex};
use super::passes;
use crate::Error;
use crate::gpu::{Buffer, Gpu, PassTiming, Passes};

/// Sizes of a batch of blocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MeshCapacity {
    /// Maximum number of blocks per dispatch; a field's list may be longer.
    pub(crate) n_blocks: u32,
    /// Initial capacity; grown to the needs of a batch.
    pub(crate) n_vertices: u32,
    /// Initial capacity; grown to the needs of a batch.
    pub(crate) n_triangles: u32,
}

impl Default for MeshCapacity {
    fn default() -> Self {
        Self { n_blocks: 8192, n_vertices: 1 << 18, n_triangles: 1 << 19 }
    }
}

/// Buffers that the mesh kernels write.
#[derive(Debug)]
pub(crate) struct MeshBuffers {
    pub(crate) mesh_capacity: MeshCapacity,
    pub(crate) batch: Buffer,
    pub(crate) cases: Buffer,
    pub(crate) is_stale: Buffer,
    pub(crate) stale: Buffer,
    pub(crate) needed: Buffer,
    pub(crate) parts: Buffer,
    pub(crate) vertices: Buffer,
    pub(crate) triangles: Buffer,
}

/// Number of words in `needed`: vertices, triangles.
const N_NEEDED: usize = 2;

impl MeshBuffers {
    /// Buffers for a pool of `n_block_slots` blocks.
    pub(crate) fn new(gpu: &Gpu, mesh_capacity: MeshCapacity, n_block_slots: u32) -> Result<Self, Error> {
        Ok(Self {
            mesh_capacity,
            batch: gpu.uniform_with("tsdf.mesh.batch", &MeshBatch { first: 0, max_blocks: mesh_capacity.n_blocks }),
            cases: gpu.storage_with("tsdf.mesh.cases", bytemuck::cast_slice(&case_words()))?,
            is_stale: gpu.storage("tsdf.mesh.is_stale", 4 * u64::from(n_block_slots))?,
            stale: gpu.storage("tsdf.mesh.stale", 4 + 4 * u64::from(n_block_slots))?,
            needed: gpu.storage("tsdf.mesh.needed", 4 * N_NEEDED as u64)?,
            parts: gpu
                .storage("tsdf.mesh.parts", size_of::<BlockMeshRange>() as u64 * u64::from(mesh_capacity.n_blocks))?,
            vertices: gpu
                .storage("tsdf.mesh.vertices", size_of::<MeshVertex>() as u64 * u64::from(mesh_capacity.n_vertices))?,
            triangles: gpu.storage("tsdf.mesh.triangles", 12 * u64::from(mesh_capacity.n_triangles))?,
        })
    }

    /// Whether the buffers are large enough for a pool of `n_block_slots` blocks.
    pub(crate) fn has_capacity_for(&self, n_block_slots: u32) -> bool {
        self.is_stale.bytes() >= 4 * u64::from(n_block_slots)
    }

    /// Extracts the triangles of the blocks that changed, and of their neighbors.
    pub(crate) fn mesh_changed(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let mut list = Passes::default();
        passes::list_stale(gpu, &mut list, pipelines, field, self);
        list.submit(gpu);
        self.mesh_listed(gpu, pipelines, field)
    }

    /// Extracts the triangles of the blocks in these slots.
    pub(crate) fn mesh_slots(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
        slots: &[u32],
    ) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        gpu.write(&self.stale, 0, bytemuck::bytes_of(&u32::try_from(slots.len()).unwrap_or(u32::MAX)));
        gpu.write(&self.stale, 4, bytemuck::cast_slice(slots));
        self.mesh_listed(gpu, pipelines, field)
    }

    /// GPU time of the passes of [`Self::mesh_changed`] over the first batch, without read-back.
    pub(crate) fn profile(
        &self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<PassTiming>, Error> {
        gpu.write(&self.batch, 0, bytemuck::bytes_of(&MeshBatch { first: 0, max_blocks: self.mesh_capacity.n_blocks }));
        let mut list = Passes::default();
        passes::list_stale(gpu, &mut list, pipelines, field, self);
        passes::march(gpu, &mut list, pipelines, field, self);
        list.submit_timed(gpu)
    }

    fn mesh_listed(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<(GridCoord, BlockMesh)>, Error> {
        let mut block_meshes = Vec::new();
        let mut first = 0;
        loop {
            gpu.write(
                &self.batch,
                0,
                bytemuck::bytes_of(&MeshBatch { first, max_blocks: self.mesh_capacity.n_blocks }),
            );
            let mut list = Passes::default();
            passes::march(gpu, &mut list, pipelines, field, self);
            list.submit(gpu);
            let n_stale = gpu.begin_read(&self.stale, 1);
            let needed: Vec<u32> = gpu.read(&self.needed, N_NEEDED)?;
            let n_stale = n_stale.finish::<u32>(gpu)?[0];
            if needed[0] > self.mesh_capacity.n_vertices || needed[1] > self.mesh_capacity.n_triangles {
                self.grow(gpu, &needed)?;
                continue;
            }
            let n_done = n_stale.saturating_sub(first).min(self.mesh_capacity.n_blocks);
            self.read_back(gpu, n_done as usize, &needed, &mut block_meshes)?;
            first += n_done;
            if first >= n_stale {
                return Ok(block_meshes);
            }
        }
    }

    fn grow(&mut self, gpu: &Gpu, needed: &[u32]) -> Result<(), Error> {
        let [n_vertices, n_triangles] = [needed[0], needed[1]].map(|n| n.saturating_add(n / 4));
        self.mesh_capacity.n_vertices = self.mesh_capacity.n_vertices.max(n_vertices);
        self.mesh_capacity.n_triangles = self.mesh_capacity.n_triangles.max(n_triangles);
        let n_bytes = size_of::<MeshVertex>() as u64 * u64::from(self.mesh_capacity.n_vertices);
        self.vertices = gpu.storage("tsdf.mesh.vertices", n_bytes)?;
        self.triangles = gpu.storage("tsdf.mesh.triangles", 12 * u64::from(self.mesh_capacity.n_triangles))?;
        Ok(())
    }

    /// Reads the triangles of a batch.
    fn read_back(
        &self,
        gpu: &Gpu,
        n_blocks: usize,
        needed: &[u32],
        block_meshes: &mut Vec<(GridCoord, BlockMesh)>,
    ) -> Result<(), Error> {
        let parts = gpu.begin_read(&self.parts, n_blocks * size_of::<BlockMeshRange>() / 4);
        let vertices = gpu.begin_read(&self.vertices, needed[0] as usize * size_of::<MeshVertex>() / 4);
        let triangles: Vec<[u32; 3]> = gpu.read(&self.triangles, needed[1] as usize)?;
        let vertices: Vec<MeshVertex> = vertices.finish(gpu)?;
        let parts: Vec<BlockMeshRange> = parts.finish(gpu)?;
        block_meshes.extend(parts.iter().map(|part| {
            let own = |first: u32, n: u32| first as usize..(first + n) as usize;
            let mesh = BlockMesh {
                vertices: vertices[own(part.first_vertex, part.n_vertices)].to_vec(),
                triangles: triangles[own(part.first_triangle, part.n_triangles)]
                    .iter()
                    .map(|corners| corners.map(|ix| ix - part.first_vertex))
                    .collect(),
            };
            (part.block_coord, mesh)
        }));
        Ok(())
    }
}

/// The 256 cases in the format of the kernel: number of triangles, and three edges of each in five bits: corner, axis.
fn case_words() -> Vec<u32> {
    CASES
        .iter()
        .flat_map(|triangles| {
            let mut words = [0_u32; 6];
            words[0] = u32::try_from(triangles.len()).unwrap_or(0);
            for (word, edges) in words[1..].iter_mut().zip(triangles) {
                let codes = edges.map(|edge| u32::try_from(edge.corner | edge.axis << 3).unwrap_or(0));
                *word = codes[0] | codes[1] << 5 | codes[2] << 10;
            }
            words
        })
        .collect()
}
