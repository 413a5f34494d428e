//! GPU memory of meshing, for the list of blocks to mesh and the triangles of a batch of these
//! blocks.

use super::mesh::CASES;
use super::params::{BlockMeshRange, MeshBatch, MeshVertex};
use crate::Error;
use gpu::{Buffer, Gpu};

/// Sizes of a batch of blocks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MeshCapacity {
    /// Maximum number of blocks per dispatch. The list of a field may be longer.
    pub(crate) n_blocks: u32,
    /// Initial number of vertices. The number grows to fit a batch.
    pub(crate) n_vertices: u32,
    /// Initial number of triangles. The number grows to fit a batch.
    pub(crate) n_triangles: u32,
}

impl Default for MeshCapacity {
    fn default() -> Self {
        // Vertices and triangles take 6 MiB each. Larger batches need fewer waits for the GPU, but
        // more memory.
        Self {
            n_blocks: 8192,
            n_vertices: 1 << 18,
            n_triangles: 1 << 19,
        }
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

/// Number of words in `needed`, for vertices and triangles.
pub(super) const N_NEEDED: usize = 2;

impl MeshBuffers {
    /// Buffers for a pool of `n_block_slots` blocks.
    pub(crate) fn new(
        gpu: &Gpu,
        mesh_capacity: MeshCapacity,
        n_block_slots: u32,
    ) -> Result<Self, Error> {
        Ok(Self {
            mesh_capacity,
            batch: gpu.uniform_with(
                "tsdf.mesh.batch",
                &MeshBatch {
                    first: 0,
                    max_blocks: mesh_capacity.n_blocks,
                },
            ),
            cases: gpu.storage_with("tsdf.mesh.cases", bytemuck::cast_slice(&case_words()))?,
            is_stale: gpu.storage("tsdf.mesh.is_stale", 4 * u64::from(n_block_slots))?,
            stale: gpu.storage("tsdf.mesh.stale", 4 + 4 * u64::from(n_block_slots))?,
            needed: gpu.storage("tsdf.mesh.needed", 4 * N_NEEDED as u64)?,
            parts: gpu.storage(
                "tsdf.mesh.parts",
                size_of::<BlockMeshRange>() as u64 * u64::from(mesh_capacity.n_blocks),
            )?,
            vertices: gpu.storage(
                "tsdf.mesh.vertices",
                size_of::<MeshVertex>() as u64 * u64::from(mesh_capacity.n_vertices),
            )?,
            triangles: gpu.storage(
                "tsdf.mesh.triangles",
                12 * u64::from(mesh_capacity.n_triangles),
            )?,
        })
    }

    /// Whether the buffers are large enough for a pool of `n_block_slots` blocks.
    pub(crate) fn has_capacity_for(&self, n_block_slots: u32) -> bool {
        self.is_stale.bytes() >= 4 * u64::from(n_block_slots)
    }
}

/// The 256 cases in the format of the kernel. A case consists of the number of triangles, then
/// three edges per triangle with five bits each.
fn case_words() -> Vec<u32> {
    CASES
        .iter()
        .flat_map(|triangles| {
            let mut words = [0_u32; 6];
            words[0] = u32::try_from(triangles.len()).unwrap_or(0);
            for (word, edges) in words[1..].iter_mut().zip(triangles) {
                let codes =
                    edges.map(|edge| u32::try_from(edge.corner | edge.axis << 3).unwrap_or(0));
                *word = codes[0] | codes[1] << 5 | codes[2] << 10;
            }
            words
        })
        .collect()
}
