//! Triangle mesh of the surface of a field.

mod cases;
mod chunks;
mod cluster;
mod floaters;
mod glb;
mod mesher;
mod ply;

pub(super) use cases::CASES;
pub(super) use chunks::ChangedChunks;
pub(super) use floaters::floaters;
pub use glb::write as write_glb;
#[cfg(test)]
pub(super) use mesher::unit_of;
pub(super) use mesher::{BlockMesh, BlockMeshes, Mesher, joined};
pub use ply::write as write_ply;

#[cfg(test)]
mod chunk_tests;
#[cfg(test)]
mod tests;

/// Triangles with shared vertices, in the order of their blocks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Origin of the positions, in world, meters. f32 is precise near it.
    pub origin_m: [f64; 3],
    /// Relative to `origin_m`, along the world's axes, meters.
    pub positions_m: Vec<[f32; 3]>,
    /// Outward normals of length 1, along the world's axes.
    pub normals: Vec<[f32; 3]>,
    /// Red, green, blue.
    pub colors_srgb: Vec<[u8; 3]>,
    /// Vertex indices, counterclockwise when viewed from outside.
    pub triangles: Vec<[u32; 3]>,
}
