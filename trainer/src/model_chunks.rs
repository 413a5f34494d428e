//! Spatial parts of a model in a compact form, for clients that draw the model themselves.

use crate::pending::Pending;
use serde::Serialize;

/// The chunks of a model at one moment.
#[derive(Debug, Default)]
pub struct ModelChunks {
    /// Whether `chunks` are all chunks of the model. If not, `chunks` are the chunks that have
    /// changed since the last call.
    pub is_complete: bool,
    /// The chunks.
    pub chunks: Vec<ModelChunk>,
    /// Ids of chunks that no longer exist.
    pub removed: Vec<u64>,
}

/// A spatial part of a model.
#[derive(Debug)]
pub struct ModelChunk {
    /// Identifies the chunk within its model. It is less than 2^53, so that JavaScript represents
    /// it exactly.
    pub id: u64,
    /// How much the chunk has changed since the last call, in a unit of the method.
    pub change: f64,
    /// A smaller approximation, to be sent first.
    pub coarse: Option<ChunkData>,
    /// The chunk in full.
    pub fine: ChunkData,
}

/// An encoded chunk. `docs/reference/protocol.md` specifies the bytes.
#[derive(Clone, Debug)]
pub struct ChunkData {
    /// What the bytes contain.
    pub layout: ChunkLayout,
    /// The encoded values.
    pub bytes: Vec<u8>,
}

/// Largest integer coordinate of a vertex in a mesh, along each axis.
pub const MAX_MESH_COUNT: u16 = 33 * 1024;

/// Layout of an encoded chunk.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ChunkLayout {
    /// Colored triangles.
    Mesh {
        /// Position of count 0, in world, meters.
        origin_m: [f64; 3],
        /// Size of a count.
        meters_per_count: f64,
        /// Number of vertices.
        n_vertices: usize,
        /// Number of triangles.
        n_triangles: usize,
    },
    /// Gaussian splats.
    Splats {
        /// Number of splats.
        n_splats: usize,
        /// Box around the means, in world, meters.
        min_m: [f32; 3],
        /// Opposite corner of the box.
        max_m: [f32; 3],
        /// Smallest and largest logarithm of a standard deviation in meters.
        log_scale_range: [f32; 2],
        /// Factor for all standard deviations. It is above 1 if few splats represent many.
        scale_factor: f32,
        /// Degree of the spherical harmonics, 0 to 2.
        sh_degree: u32,
        /// Largest coefficients of degree 1 and 2.
        sh_ranges: [f32; 2],
        /// Whether opacities are lowered where the low-pass filter enlarges splats.
        is_antialiased: bool,
    },
}

/// Chunks that are being read from the GPU or encoded.
pub type PendingChunks = Pending<ModelChunks>;
