//! Makes the triangles of blocks on the GPU and brings them to the host.

use super::block::Place;
use super::buffers::FieldBuffers;
use super::kernels::Pipelines;
use super::mesh::{BlockMesh, CASES};
use super::params::{MeshPart, MeshPiece, MeshVertex};
use super::passes;
use crate::Error;
use crate::gpu::{Buffer, Gpu, PassTiming, Passes};

/// How much is done at once.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MeshRoom {
    /// Blocks of a dispatch; a field's list may be longer.
    pub(crate) n_blocks: u32,
    /// At the start; grown to what a piece needs.
    pub(crate) n_vertices: u32,
    /// Likewise.
    pub(crate) n_triangles: u32,
}

impl Default for MeshRoom {
    fn default() -> Self {
        Self { n_blocks: 8192, n_vertices: 1 << 18, n_triangles: 1 << 19 }
    }
}

/// What the kernels of the mesh write.
#[derive(Debug)]
pub(crate) struct MeshBuffers {
    pub(crate) room: MeshRoom,
    pub(crate) piece: Buffer,
    pub(crate) cases: Buffer,
    pub(crate) is_due: Buffer,
    pub(crate) due: Buffer,
    pub(crate) needed: Buffer,
    pub(crate) parts: Buffer,
    pub(crate) vertices: Buffer,
    pub(crate) triangles: Buffer,
}

/// Words of `needed`: vertices, triangles.
const N_NEEDED: usize = 2;

impl MeshBuffers {
    /// For a pool of so many blocks.
    pub(crate) fn new(gpu: &Gpu, room: MeshRoom, n_block_slots: u32) -> Result<Self, Error> {
        Ok(Self {
            room,
            piece: gpu.uniform_with("tsdf.mesh.piece", &MeshPiece { first: 0, n_most: room.n_blocks }),
            cases: gpu.storage_with("tsdf.mesh.cases", bytemuck::cast_slice(&case_words()))?,
            is_due: gpu.storage("tsdf.mesh.is_due", 4 * u64::from(n_block_slots))?,
            due: gpu.storage("tsdf.mesh.due", 4 + 4 * u64::from(n_block_slots))?,
            needed: gpu.storage("tsdf.mesh.needed", 4 * N_NEEDED as u64)?,
            parts: gpu.storage("tsdf.mesh.parts", size_of::<MeshPart>() as u64 * u64::from(room.n_blocks))?,
            vertices: gpu.storage("tsdf.mesh.vertices", size_of::<MeshVertex>() as u64 * u64::from(room.n_vertices))?,
            triangles: gpu.storage("tsdf.mesh.triangles", 12 * u64::from(room.n_triangles))?,
        })
    }

    /// Whether a pool of so many blocks can be listed.
    pub(crate) fn serves(&self, n_block_slots: u32) -> bool {
        self.is_due.bytes() >= 4 * u64::from(n_block_slots)
    }

    /// Makes the triangles of the blocks that changed, and of those beside them, anew.
    pub(crate) fn of_changed(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<(Place, BlockMesh)>, Error> {
        let mut list = Passes::default();
        passes::list_due(gpu, &mut list, pipelines, field, self);
        list.submit(gpu);
        self.of_listed(gpu, pipelines, field)
    }

    /// Makes the triangles of the blocks in these slots.
    pub(crate) fn of_slots(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
        slots: &[u32],
    ) -> Result<Vec<(Place, BlockMesh)>, Error> {
        gpu.write(&self.due, 0, bytemuck::bytes_of(&u32::try_from(slots.len()).unwrap_or(u32::MAX)));
        gpu.write(&self.due, 4, bytemuck::cast_slice(slots));
        self.of_listed(gpu, pipelines, field)
    }

    /// GPU time of the passes of [`Self::of_changed`] over the first piece, which reads nothing back.
    pub(crate) fn profile(
        &self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<PassTiming>, Error> {
        gpu.write(&self.piece, 0, bytemuck::bytes_of(&MeshPiece { first: 0, n_most: self.room.n_blocks }));
        let mut list = Passes::default();
        passes::list_due(gpu, &mut list, pipelines, field, self);
        passes::march(gpu, &mut list, pipelines, field, self);
        list.submit_timed(gpu)
    }

    fn of_listed(
        &mut self,
        gpu: &Gpu,
        pipelines: &Pipelines,
        field: &FieldBuffers,
    ) -> Result<Vec<(Place, BlockMesh)>, Error> {
        let mut made = Vec::new();
        let mut first = 0;
        loop {
            gpu.write(&self.piece, 0, bytemuck::bytes_of(&MeshPiece { first, n_most: self.room.n_blocks }));
            let mut list = Passes::default();
            passes::march(gpu, &mut list, pipelines, field, self);
            list.submit(gpu);
            let n_due = gpu.begin_read(&self.due, 1);
            let needed: Vec<u32> = gpu.read(&self.needed, N_NEEDED)?;
            let n_due = n_due.finish::<u32>(gpu)?[0];
            if needed[0] > self.room.n_vertices || needed[1] > self.room.n_triangles {
                self.make_room(gpu, &needed)?;
                continue;
            }
            let n_done = n_due.saturating_sub(first).min(self.room.n_blocks);
            self.bring(gpu, n_done as usize, &needed, &mut made)?;
            first += n_done;
            if first >= n_due {
                return Ok(made);
            }
        }
    }

    fn make_room(&mut self, gpu: &Gpu, needed: &[u32]) -> Result<(), Error> {
        let [n_vertices, n_triangles] = [needed[0], needed[1]].map(|n| n.saturating_add(n / 4));
        self.room.n_vertices = self.room.n_vertices.max(n_vertices);
        self.room.n_triangles = self.room.n_triangles.max(n_triangles);
        let n_bytes = size_of::<MeshVertex>() as u64 * u64::from(self.room.n_vertices);
        self.vertices = gpu.storage("tsdf.mesh.vertices", n_bytes)?;
        self.triangles = gpu.storage("tsdf.mesh.triangles", 12 * u64::from(self.room.n_triangles))?;
        Ok(())
    }

    /// Reads what a piece made.
    fn bring(
        &self,
        gpu: &Gpu,
        n_blocks: usize,
        needed: &[u32],
        made: &mut Vec<(Place, BlockMesh)>,
    ) -> Result<(), Error> {
        let parts = gpu.begin_read(&self.parts, n_blocks * size_of::<MeshPart>() / 4);
        let vertices = gpu.begin_read(&self.vertices, needed[0] as usize * size_of::<MeshVertex>() / 4);
        let triangles: Vec<[u32; 3]> = gpu.read(&self.triangles, needed[1] as usize)?;
        let vertices: Vec<MeshVertex> = vertices.finish(gpu)?;
        let parts: Vec<MeshPart> = parts.finish(gpu)?;
        made.extend(parts.iter().map(|part| {
            let own = |first: u32, n: u32| first as usize..(first + n) as usize;
            let mesh = BlockMesh {
                vertices: vertices[own(part.first_vertex, part.n_vertices)].to_vec(),
                triangles: triangles[own(part.first_triangle, part.n_triangles)]
                    .iter()
                    .map(|corners| corners.map(|ix| ix - part.first_vertex))
                    .collect(),
            };
            (part.place, mesh)
        }));
        Ok(())
    }
}

/// The 256 cases as the kernel reads them: how many triangles, and three edges of each in five bits: corner, axis.
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
