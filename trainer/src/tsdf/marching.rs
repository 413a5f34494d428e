//! Extracts the triangles of blocks on the GPU and reads them back.

use super::block::GridCoord;
use super::buffers::FieldBuffers;
use super::kernels::Pipelines;
use super::mesh::BlockMesh;
use super::mesh_buffers::{MeshBuffers, N_NEEDED};
use super::params::{BlockMeshRange, MeshBatch, MeshVertex};
use super::passes;
use crate::Error;
use gpu::{Gpu, PassTiming, Passes};

impl MeshBuffers {
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
        gpu.write(
            &self.stale,
            0,
            bytemuck::bytes_of(&u32::try_from(slots.len()).unwrap_or(u32::MAX)),
        );
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
        gpu.write(
            &self.batch,
            0,
            bytemuck::bytes_of(&MeshBatch {
                first: 0,
                max_blocks: self.mesh_capacity.n_blocks,
            }),
        );
        let mut list = Passes::default();
        passes::list_stale(gpu, &mut list, pipelines, field, self);
        passes::march(gpu, &mut list, pipelines, field, self);
        Ok(list.submit_timed(gpu)?)
    }

    /// Extracts the triangles of the listed blocks, a batch at a time.
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
                bytemuck::bytes_of(&MeshBatch {
                    first,
                    max_blocks: self.mesh_capacity.n_blocks,
                }),
            );
            let mut list = Passes::default();
            passes::march(gpu, &mut list, pipelines, field, self);
            list.submit(gpu);
            // The length of the list is known only on the GPU. Both counters are read at once.
            let n_stale = gpu.begin_read(&self.stale, 1);
            let needed: Vec<u32> = gpu.read(&self.needed, N_NEEDED)?;
            let n_stale = n_stale.finish::<u32>(gpu)?[0];
            if needed[0] > self.mesh_capacity.n_vertices
                || needed[1] > self.mesh_capacity.n_triangles
            {
                // Kernels also count the triangles that did not fit. The second attempt therefore
                // has enough space.
                self.grow(gpu, &needed)?;
                continue;
            }
            let n_done = n_stale
                .saturating_sub(first)
                .min(self.mesh_capacity.n_blocks);
            self.read_back(gpu, n_done as usize, &needed, &mut block_meshes)?;
            first += n_done;
            if first >= n_stale {
                return Ok(block_meshes);
            }
        }
    }

    fn grow(&mut self, gpu: &Gpu, needed: &[u32]) -> Result<(), Error> {
        // The buffers get a quarter more than needed, because the mesh of a growing field also
        // grows.
        let [n_vertices, n_triangles] = [needed[0], needed[1]].map(|n| n.saturating_add(n / 4));
        self.mesh_capacity.n_vertices = self.mesh_capacity.n_vertices.max(n_vertices);
        self.mesh_capacity.n_triangles = self.mesh_capacity.n_triangles.max(n_triangles);
        let n_bytes = size_of::<MeshVertex>() as u64 * u64::from(self.mesh_capacity.n_vertices);
        self.vertices = gpu.storage("tsdf.mesh.vertices", n_bytes)?;
        self.triangles = gpu.storage(
            "tsdf.mesh.triangles",
            12 * u64::from(self.mesh_capacity.n_triangles),
        )?;
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
        // All reads begin before the first wait, so their copies overlap.
        let parts = gpu.begin_read(&self.parts, n_blocks * size_of::<BlockMeshRange>() / 4);
        let vertices = gpu.begin_read(
            &self.vertices,
            needed[0] as usize * size_of::<MeshVertex>() / 4,
        );
        let triangles: Vec<[u32; 3]> = gpu.read(&self.triangles, needed[1] as usize)?;
        let vertices: Vec<MeshVertex> = vertices.finish(gpu)?;
        let parts: Vec<BlockMeshRange> = parts.finish(gpu)?;
        block_meshes.extend(parts.iter().map(|part| {
            let own = |first: u32, n: u32| first as usize..(first + n) as usize;
            let mesh = BlockMesh {
                vertices: vertices[own(part.first_vertex, part.n_vertices)].to_vec(),
                triangles: triangles[own(part.first_triangle, part.n_triangles)]
                    .iter()
                    // On the GPU, indices count vertices of the whole batch. Here, each block gets
                    // its own indices.
                    .map(|corners| corners.map(|ix| ix - part.first_vertex))
                    .collect(),
            };
            (part.block_coord, mesh)
        }));
        Ok(())
    }
}
