//! The mesh in chunks of neighboring blocks, in a compact form for viewers.
//!
//! Positions are rounded to a grid that all chunks share, so that neighboring chunks meet without
//! gaps. Values are stored as differences to the previous value, which zlib compresses well.

use super::mesher::{BlockMesh, Mesher, shared_key, without_erased};
use crate::model_chunks::{ChunkData, ChunkLayout, MAX_MESH_COUNT, ModelChunk, ModelChunks};
use crate::tsdf::block::{BLOCK_EDGE, GridCoord};
use crate::tsdf::chosen_grid::VoxelGrid;
use flate2::Compression;
use flate2::write::ZlibEncoder;
use model_files::Edits;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::sync::Arc;

/// Blocks along an edge of a chunk. A chunk then has a few thousand vertices, which a viewer draws
/// in one call.
const CHUNK_BLOCKS: i32 = 4;
/// Voxels along an edge of a chunk with the cubes that begin in it.
const CHUNK_VOXELS: i32 = CHUNK_BLOCKS * BLOCK_EDGE + 1;
/// Bits per axis in an id. Three times 17 bits are 51, and ids must be below 2^53.
const ID_BITS: u32 = 17;

/// The blocks of a chunk that has changed.
#[derive(Debug, Default)]
struct ChunkBlocks {
    n_changed: u32,
    /// The blocks that contain triangles.
    blocks: Vec<(GridCoord, Arc<BlockMesh>)>,
}

/// Changed chunks of a mesh that are not encoded yet.
#[derive(Debug, Default)]
pub(in crate::tsdf) struct ChangedChunks {
    is_complete: bool,
    chunks: BTreeMap<GridCoord, ChunkBlocks>,
    edits: Arc<Edits>,
}

impl ChangedChunks {
    /// Takes the chunks that have changed since the last call, or all of them.
    pub(in crate::tsdf) fn take(
        mesher: &mut Mesher,
        edits: &Arc<Edits>,
        only_changed: bool,
    ) -> Self {
        // The list of changes is taken in both cases. After all chunks were sent, no chunk has
        // unsent changes.
        let changed = mesher.take_changed().filter(|_| only_changed);
        let is_complete = changed.is_none();
        let mut chunks: BTreeMap<GridCoord, ChunkBlocks> = BTreeMap::new();
        for block in changed.unwrap_or_else(|| mesher.blocks().keys().copied().collect()) {
            chunks.entry(chunk_of(block)).or_default().n_changed += 1;
        }
        // A chunk is encoded as a whole, so its unchanged blocks are also needed.
        for (block, mesh) in mesher.blocks() {
            if let Some(chunk) = chunks.get_mut(&chunk_of(*block)) {
                chunk.blocks.push((*block, Arc::clone(mesh)));
            }
        }
        Self {
            is_complete,
            chunks,
            edits: Arc::clone(edits),
        }
    }

    /// Encodes the chunks without erased space.
    pub(in crate::tsdf) fn encode(mut self, voxel_grid: &VoxelGrid) -> ModelChunks {
        for chunk in self.chunks.values_mut() {
            chunk
                .blocks
                .par_iter_mut()
                .for_each(|(_, mesh)| *mesh = without_erased(mesh, voxel_grid, &self.edits));
            chunk.blocks.retain(|(_, mesh)| !mesh.triangles.is_empty());
        }
        // A chunk whose last triangle has disappeared must be removed by the viewer.
        let (present, removed): (Vec<_>, Vec<_>) = self
            .chunks
            .into_iter()
            .partition(|(_, chunk)| !chunk.blocks.is_empty());
        ModelChunks {
            is_complete: self.is_complete,
            chunks: present
                .par_iter()
                .map(|(coord, chunk)| encoded(*coord, chunk, voxel_grid))
                .collect(),
            removed: removed.into_iter().map(|(coord, _)| id_of(coord)).collect(),
        }
    }
}

/// The chunk that contains a block.
fn chunk_of(block: GridCoord) -> GridCoord {
    block.map(|along| along.div_euclid(CHUNK_BLOCKS))
}

/// A number for the position of a chunk. Positions repeat after 2^17 chunks along an axis, which is
/// more than a field can contain.
fn id_of(coord: GridCoord) -> u64 {
    coord.iter().fold(0, |id, along| {
        id << ID_BITS | u64::from(along.cast_unsigned() & ((1 << ID_BITS) - 1))
    })
}

fn encoded(coord: GridCoord, chunk: &ChunkBlocks, voxel_grid: &VoxelGrid) -> ModelChunk {
    let counts_per_voxel = f64::from(MAX_MESH_COUNT) / f64::from(CHUNK_VOXELS);
    let meters_per_count = voxel_grid.voxel_m / counts_per_voxel;
    let origin_in_field_m = coord
        .map(|along| f64::from(along) * f64::from(CHUNK_BLOCKS * BLOCK_EDGE) * voxel_grid.voxel_m);
    let mut vertices = VertexWriter::default();
    let mut corners: Vec<u32> = Vec::new();
    let mut shared_vertices: HashMap<(GridCoord, u32), u32> = HashMap::new();
    for (block, mesh) in &chunk.blocks {
        let mut ix_of_vertex = Vec::with_capacity(mesh.vertices.len());
        for vertex in &mesh.vertices {
            // Blocks of a chunk share the vertices on their faces. Other vertices need no lookup.
            let next = vertices.n;
            let ix = shared_key(*block, vertex.edge)
                .map_or(next, |key| *shared_vertices.entry(key).or_insert(next));
            if ix == next {
                let offset_m =
                    |axis: usize| f64::from(vertex.position_m[axis]) - origin_in_field_m[axis];
                let counts = [0, 1, 2].map(|axis| count_of(offset_m(axis), meters_per_count));
                vertices.push(counts, vertex.color);
            }
            ix_of_vertex.push(ix);
        }
        corners.extend(
            mesh.triangles
                .iter()
                .flatten()
                .map(|ix| ix_of_vertex[*ix as usize]),
        );
    }
    let layout = ChunkLayout::Mesh {
        origin_m: std::array::from_fn(|axis| voxel_grid.anchor_m[axis] + origin_in_field_m[axis]),
        meters_per_count,
        n_vertices: vertices.n as usize,
        n_triangles: corners.len() / 3,
    };
    let indices = index_bytes(&corners, vertices.n);
    let bytes = compressed(&[&vertices.positions, &vertices.colors, &indices]);
    ModelChunk {
        id: id_of(coord),
        change: f64::from(chunk.n_changed),
        coarse: None,
        fine: ChunkData { layout, bytes },
    }
}

/// A coordinate relative to the chunk, rounded to whole counts.
fn count_of(offset_m: f64, meters_per_count: f64) -> f64 {
    (offset_m / meters_per_count)
        .round()
        .clamp(0.0, f64::from(MAX_MESH_COUNT))
}

/// Encodes vertices as differences to the previous vertex.
#[derive(Default)]
struct VertexWriter {
    n: u32,
    positions: Vec<u8>,
    colors: Vec<u8>,
    last_counts: [u16; 3],
    last_color: [u8; 3],
}

impl VertexWriter {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "clamped to 16 bits"
    )]
    fn push(&mut self, counts: [f64; 3], color: u32) {
        let counts = counts.map(|count| count as u16);
        for (count, last) in counts.iter().zip(self.last_counts) {
            self.positions
                .extend(count.wrapping_sub(last).to_le_bytes());
        }
        let [red, green, blue, _] = color.to_le_bytes();
        for (part, last) in [red, green, blue].iter().zip(self.last_color) {
            self.colors.push(part.wrapping_sub(last));
        }
        self.last_counts = counts;
        self.last_color = [red, green, blue];
        self.n += 1;
    }
}

/// Indices of the corners as differences to the previous index. Each has 16 bits if all indices
/// fit, and otherwise 32 bits.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the low half, if the indices fit"
)]
fn index_bytes(corners: &[u32], n_vertices: u32) -> Vec<u8> {
    let previous = std::iter::once(&0).chain(corners);
    let differences = corners
        .iter()
        .zip(previous)
        .map(|(ix, previous)| ix.wrapping_sub(*previous));
    if n_vertices <= 1 << 16 {
        differences
            .flat_map(|difference| (difference as u16).to_le_bytes())
            .collect()
    } else {
        differences.flat_map(u32::to_le_bytes).collect()
    }
}

/// A zlib stream. Writing to memory cannot fail.
fn compressed(parts: &[&[u8]]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
    let written = parts.iter().try_for_each(|part| encoder.write_all(part));
    written
        .and_then(|()| encoder.finish())
        .expect("writing to memory cannot fail")
}
